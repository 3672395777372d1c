"""Tables of pose errors over a data set: bias, spread and consistency of each axis, success by status."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.analysis.errors import PoseErrors, pose_errors, rms
from torchpose.geometry import rotations
from torchpose.io.rows import Row
from torchpose.io.truth import Truth

AXES = ("x", "y", "z", "pitch", "yaw", "roll")
UNITS = ("um", "um", "um", "mdeg", "mdeg", "mdeg")
SCALE = torch.tensor([1e3] * 3 + [math.degrees(1e3)] * 3, dtype=torch.float64)  # mm and rad to those units
BOUND = ("sx", "sy", "sz", "srx", "sry", "srz")
NEES_MEAN = 6.0  # of errors with the predicted covariance, which has 6 degrees of freedom


@dataclass(frozen=True, eq=False)
class Estimates:
    """Rows of a result table in the order of a truth, mm and rad; NaN where there is no pose."""

    status: list[str]
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    full_covariance: bool  # whether the table held it; otherwise it is the diagonal of the standard deviations


@dataclass(frozen=True)
class AxisErrors:
    """Errors along or about one camera axis, in the units of `UNITS`; frames with the status ok."""

    axis: str
    unit: str
    bias: float
    spread: float  # standard deviation
    rms: float
    worst: float  # largest magnitude
    predicted: float  # RMS of the standard deviations that the estimates claim
    bound: float  # RMS of the Cramer-Rao standard deviations, NaN where the truth has none


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Estimates against their truth."""

    errors: PoseErrors
    error: Float[Tensor, "N 6"]  # in the units of `UNITS`, NaN where the status is not ok
    predicted: Float[Tensor, "N 6"]  # standard deviations in the same units
    bound: Float[Tensor, "N 6"]  # the same
    axes: list[AxisErrors]
    counts: Counter[str]  # rows by status
    nees: float  # mean over the ok rows, 6 where the covariances are right
    nees_interval: tuple[float, float]  # where 95 % of such means lie
    center: float  # largest lateral error of the target's origin over the ok rows, um
    visible: int  # rows whose target is in view as a whole, where the truth says so
    found: int  # ok rows among them


def evaluate(estimates: Estimates, truth: Truth) -> Evaluation:
    """Errors of estimates, row by row of the truth."""
    errors = pose_errors(estimates, truth)
    scale = SCALE.to(errors.nees)
    ok = torch.tensor([status == "ok" for status in estimates.status], device=scale.device)
    error = torch.where(ok[:, None], torch.cat([errors.translation, errors.rotation], 1) * scale, torch.nan)
    std = estimates.covariance.diagonal(dim1=1, dim2=2).sqrt()
    predicted = torch.where(ok[:, None], std * scale, torch.nan)
    bound = torch.full_like(error, torch.nan)
    if all(name in truth.extra for name in BOUND):
        claimed = torch.stack([truth.extra[name] for name in BOUND], 1)
        bound = torch.where(error.isnan(), torch.nan, claimed * scale)
    bias = error.nanmean(0)
    worst = error.abs().nan_to_num(-1).amax(0) if len(error) else bias
    columns = (bias, rms(error - bias), rms(error), worst, rms(predicted), rms(bound))
    rows = zip(AXES, UNITS, *(column.tolist() for column in columns), strict=True)
    in_view = torch.ones_like(ok)
    if "markers_in_view" in truth.extra:
        in_view = truth.extra["markers_in_view"] >= truth.extra["markers_in_view"].max()
    nees = errors.nees[ok]
    nees = nees[nees.isfinite()]
    # chi-squared with 6 n degrees of freedom, nearly Gaussian (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2)
    half = 1.96 * math.sqrt(2 * NEES_MEAN / max(len(nees), 1))
    return Evaluation(
        errors=errors,
        error=error,
        predicted=predicted,
        bound=bound,
        axes=[AxisErrors(*row) for row in rows],
        counts=Counter(estimates.status),
        nees=float(nees.mean()) if len(nees) else math.nan,
        nees_interval=(NEES_MEAN - half, NEES_MEAN + half),
        center=float(errors.lateral[ok].max()) * 1e3 if bool(ok.any()) else math.nan,
        visible=int(in_view.sum()),
        found=int((in_view & ok).sum()),
    )


def match_copies(
    keys: Sequence[tuple[str, str]], places: Float[Tensor, "N 3"], table: Mapping[tuple[str, str], Sequence[Row]]
) -> tuple[list[Row], int]:
    """The row of each true pose, and how many rows with a pose are left over.

    Args:
        keys: frame and target of each true pose; a copy of a target has the same.
        places: of the true poses, mm.
        table: rows of each frame and target. Nearest ones belong together, the nearest pair first; a true pose that
            none is left for gets a row without a pose, ``no_target`` where there is no such row.
    """
    wanted: dict[tuple[str, str], list[int]] = {}
    for number, key in enumerate(keys):
        wanted.setdefault(key, []).append(number)
    matched: dict[int, Row] = {}
    more = 0
    for key, numbers in wanted.items():
        found = [row for row in table[key] if row["tx"] is not None]
        others = iter([row for row in table[key] if row["tx"] is None])
        at = torch.tensor([[row[name] for name in ("tx", "ty", "tz")] for row in found], dtype=places.dtype)
        apart = torch.cdist(places[numbers], at.reshape(-1, 3))
        for _ in range(min(apart.shape)):
            i, j = divmod(int(apart.argmin()), apart.shape[1])
            matched[numbers[i]] = found[j]
            apart[i], apart[:, j] = torch.inf, torch.inf
        more += max(0, len(found) - len(numbers))
        blank = dict.fromkeys(table[key][0]) | {"frame": key[0], "target": key[1], "status": "no_target"}
        matched |= {number: next(others, blank) for number in numbers if number not in matched}
    return [matched[number] for number in range(len(keys))], more


def estimates_of(rows: Sequence[Row]) -> Estimates:
    """Estimates from rows of a result table; cells may be None."""

    def cells(names: Sequence[str]) -> Tensor:
        values = [[math.nan if row[name] is None else row[name] for name in names] for row in rows]
        return torch.tensor(values, dtype=torch.float64).reshape(-1, len(names))

    pose, std = cells(("tx", "ty", "tz", "rx", "ry", "rz")), cells(BOUND)
    full = any(row.get("covariance") is not None for row in rows)
    covariance, nothing = torch.diag_embed(std.square()), [[math.nan] * 6] * 6
    if full:
        covariance = torch.tensor([row.get("covariance") or nothing for row in rows], dtype=torch.float64)
    return Estimates([str(row["status"]) for row in rows], rotations.exp(pose[:, 3:]), pose[:, :3], covariance, full)
