"""Tables of pose errors over a data set: bias, spread and consistency of each axis, success by status."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.analysis.errors import PoseErrors, pose_errors, rms
from torchpose.geometry import rotations
from torchpose.io.truth import Truth

AXES = ("x", "y", "z", "pitch", "yaw", "roll")
UNITS = ("um", "um", "um", "mdeg", "mdeg", "mdeg")
SCALE = torch.tensor([1e3] * 3 + [math.degrees(1e3)] * 3, dtype=torch.float64)  # mm and rad to those units
BOUND = ("sx", "sy", "sz", "srx", "sry", "srz")
NEES_MEAN = 6.0  # of errors with the predicted covariance, which has 6 degrees of freedom


@dataclass(frozen=True, eq=False)
class Estimates:
    """Rows of a result table in the order of a truth; NaN where there is no pose.

    Attributes:
        status: N words. R: (N, 3, 3). t: (N, 3), mm. covariance: (N, 6, 6), mm and rad.
        full_covariance: whether the table held it; otherwise it is the diagonal of the standard deviations.
    """

    status: list[str]
    R: Tensor
    t: Tensor
    covariance: Tensor
    full_covariance: bool


@dataclass(frozen=True)
class AxisErrors:
    """Errors along or about one camera axis, in the units of `UNITS`; frames with the status ok.

    Attributes:
        bias: mean. spread: standard deviation. rms. worst: largest magnitude. predicted: RMS of the standard deviations
        that the estimates claim. bound: RMS of the Cramer-Rao standard deviations, NaN where the truth has none.
    """

    axis: str
    unit: str
    bias: float
    spread: float
    rms: float
    worst: float
    predicted: float
    bound: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Estimates against their truth.

    Attributes:
        errors: (N,) `PoseErrors`. error: (N, 6) in the units of `UNITS`, NaN where the status is not ok.
        predicted, bound: (N, 6) standard deviations in the same units.
        axes: one `AxisErrors` each.
        counts: rows by status. nees: mean over the ok rows, 6 where the covariances are right.
        nees_interval: (low, high), where 95 % of such means lie.
        center: largest lateral error of the target's origin over the ok rows, um.
        visible: rows whose target is in view as a whole, where the truth says so. found: ok rows among them.
    """

    errors: PoseErrors
    error: Tensor
    predicted: Tensor
    bound: Tensor
    axes: list[AxisErrors]
    counts: Counter[str]
    nees: float
    nees_interval: tuple[float, float]
    center: float
    visible: int
    found: int


def evaluate(estimates: Estimates, truth: Truth) -> Evaluation:
    """Errors of N estimates, row by row of the truth."""
    errors = pose_errors(estimates, truth)
    ok = torch.tensor([status == "ok" for status in estimates.status])
    error = torch.cat([errors.translation, errors.rotation], 1) * SCALE
    error[~ok] = torch.nan
    predicted = estimates.covariance.diagonal(dim1=1, dim2=2).sqrt() * SCALE
    predicted[~ok] = torch.nan
    bound = torch.full_like(error, torch.nan)
    if all(name in truth.extra for name in BOUND):
        bound = torch.stack([truth.extra[name] for name in BOUND], 1) * SCALE
        bound = torch.where(error.isnan(), torch.nan, bound)
    bias = error.nanmean(0)
    columns = (
        bias,
        rms(error - bias),
        rms(error),
        error.abs().nan_to_num(-1).amax(0) if len(error) else bias,
        rms(predicted),
        rms(bound),
    )
    rows = zip(AXES, UNITS, *(c.tolist() for c in columns), strict=True)
    in_view = torch.ones(len(truth), dtype=torch.bool)
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


def estimates_of(rows: Sequence[dict[str, object]]) -> Estimates:
    """Estimates from rows of a result table; cells may be None."""

    def cells(names: Sequence[str]) -> Tensor:
        values = [[math.nan if row[n] is None else float(str(row[n])) for n in names] for row in rows]
        return torch.tensor(values, dtype=torch.float64).reshape(-1, len(names))

    pose, std = cells(("tx", "ty", "tz", "rx", "ry", "rz")), cells(BOUND)
    full = any(row.get("covariance") is not None for row in rows)
    nothing = [[math.nan] * 6] * 6
    covariance = (
        torch.tensor([row.get("covariance") or nothing for row in rows], dtype=torch.float64)
        if full
        else torch.diag_embed(std.square())
    )
    return Estimates([str(row["status"]) for row in rows], rotations.exp(pose[:, 3:]), pose[:, :3], covariance, full)
