"""Several cameras calibrated together: which of them see the target at one time, and one adjustment of all.

Not all cameras need to see the target at once. Moments tie those together that do; a chain of ties is enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.calibration import lenses
from torchpose.calibration.bundle import Bundle, adjust
from torchpose.calibration.intrinsics import (
    carried,
    channels,
    check_lens,
    check_residuals,
    coefficients_of,
    covariance_of,
    doubts_of,
    name_of,
    stated_intrinsics,
    weigh,
    widened,
)
from torchpose.calibration.plate import Plate
from torchpose.calibration.views import Views
from torchpose.camera import Camera, CameraRig
from torchpose.camera.rig import POSE
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum

_FEW_TIES = 3  # moments that tie a camera to the others (convention): fewer leave a false one unseen
_START_SIGMA = 1.0  # px (convention): of every point, for the start
_LOST = 27.6  # chi-squared of a point that a start does not explain (derived: one good one in 10^6 has more)
_NAMED = 3  # moments in a sentence (convention)


@dataclass(frozen=True, eq=False)
class Located:
    """What one camera tells by itself: its lens, its views, named by their moments, and poses (N, 3, 3), (N, 3)."""

    name: str
    camera: Camera
    views: Views
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Result of `calibrate_rig`.

    Attributes:
        rig: cameras and places, each with its covariance.
        joint: covariance of the intrinsics of all cameras, of the places of all but the first (6 each), and of the
            unknowns of the plate.
        names: of the intrinsics and the places.
        views: the points that were used, by moment.
        bundle: poses and residuals of these.
        left_out: points left out because they contradict the others.
        chi2: sum over all points.
        degrees: of freedom.
        common_sigma_px: as in `Calibration`.
        common: in how many moments two cameras see the target, and each by itself.
        plate: what was unknown of the target.
        warnings: what makes the result doubtful, one sentence each.
    """

    rig: CameraRig
    joint: Float[Tensor, "u u"]
    names: tuple[str, ...]
    views: Views
    bundle: Bundle
    left_out: int
    chi2: float
    degrees: float
    common_sigma_px: float
    common: Int[Tensor, "C C"]
    plate: Plate | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def rms_px(self) -> Float[Tensor, " C"]:
        """Root mean square length of the residuals of each camera, px."""
        square, lens = self.bundle.residual.square().sum(-1), self.views.lens
        return (segment_sum(square, lens, len(self.rig)) / self.counts).sqrt()

    @property
    def counts(self) -> Int[Tensor, " C"]:
        """Number of points of each camera."""
        return torch.bincount(self.views.lens, minlength=len(self.rig))

    @property
    def pose_covariance(self) -> Float[Tensor, "N 6 6"]:
        """Of the moments' poses in the first camera, everything that was unknown included."""
        gain = self.bundle.gain
        return self.bundle.pose_covariance + gain @ self.joint @ gain.mT


class Together(NamedTuple):
    """Views by moment of several cameras, and where all is at first."""

    views: Views
    rig: CameraRig
    R: Tensor
    t: Tensor


def calibrate_rig(
    located: Sequence[Located], *, lens: str | None = "brown5", plate: Plate | None = None
) -> RigCalibration:
    """Maximum-likelihood places of cameras, their intrinsics, and the poses of all moments, in one adjustment.

    Points are weighed and left out as in `calibrate_intrinsics`.

    Args:
        located: the cameras; the first is the one that places count from.
        lens: a name of `LENS_MODELS`, of all cameras; None: intrinsics are held, and their covariances carried through.
        plate: what is unknown of the target beside its poses; None where its points are exact.

    Raises:
        ConfigError: cameras that no moments tie together, views that do not determine what is asked, or no convergence.
    """
    together, free = _started(located, free=lens is not None), lens is not None
    cameras, before = together.rig.cameras, len(together.views.view)
    equal = replace(together.views, covariance=widened(torch.zeros_like(together.views.covariance), _START_SIGMA))
    start = adjust(equal, together.rig, together.R, together.t, free=free)
    views, bundle, common = weigh(together.views, start, lenses.count(cameras) if free else 0, plate)
    names = tuple(one.name for one in located)
    ties = common_moments(views, len(cameras))
    check_connected(names, ties)
    if not bundle.converged:
        raise ConfigError("INPUT: calibration did not converge; use a simpler --model or more varied views")
    for number in range(len(cameras)):
        own = views.lens == number
        check_residuals(views.of_lens(number), bundle.residual[own], int((together.views.lens == number).sum()))
    places = tuple(f"{name} {what}" for name in names[1:] for what in ("x", "y", "z", "rx", "ry", "rz"))
    known = tuple(f"{name} {what}" for name in names for what in ("fx", "fy", "cx", "cy", *_coefficients(lens)))
    if free:
        joint = covariance_of(bundle.information, known + places)
    else:
        held = torch.block_diag(*[stated_intrinsics(camera) for camera in cameras]).to(bundle.information)
        joint = carried(bundle.information, held, places)
    rig = _stated(bundle.rig, joint, names, known if free else ())
    found = RigCalibration(
        rig,
        joint,
        (known if free else tuple(f"{name} intrinsics" for name in names)) + places,
        views,
        bundle,
        before - len(views.view),
        float(bundle.chi2.sum()),
        channels(views, bundle)[0].redundancy(common.px),
        common.px,
        ties,
        plate,
    )
    return replace(found, warnings=_warnings(found, together.views, free=free))


def _coefficients(lens: str | None) -> tuple[str, ...]:
    return () if lens is None else coefficients_of(lens)[1]


def _stated(rig: CameraRig, joint: Tensor, names: tuple[str, ...], known: tuple[str, ...]) -> CameraRig:
    """The rig with the covariances of the adjustment; intrinsics that were held (no names) stay as they are."""
    cameras, first = list(rig.cameras), lenses.starts(rig.cameras)
    count = lenses.count(cameras)
    if known:
        adjustment = name_of(joint, rig.t)
        ends = [*first[1:], count]
        for number, (start, end) in enumerate(zip(first, ends, strict=True)):
            own = joint[start:end, start:end]
            check_lens(cameras[number], own, tuple(name.split()[-1] for name in known[start:end]))
            cameras[number] = replace(cameras[number], covariance=own, adjustment=adjustment)
    places = slice(count, count + POSE * (len(rig) - 1))
    return CameraRig(cameras, rig.R, rig.t, joint[places, places] if len(rig) > 1 else None, names)


def common_moments(views: Views, cameras: int) -> Int[Tensor, "C C"]:
    """In how many moments each two cameras see the target."""
    seen = torch.zeros(cameras, len(views), dtype=torch.int64, device=views.view.device)
    seen[views.lens, views.view] = 1
    return seen @ seen.mT


def check_connected(names: Sequence[str], common: Int[Tensor, "C C"]) -> None:
    """
    Raises:
        ConfigError: cameras that no chain of common moments ties to the first one.
    """
    reached = torch.linalg.matrix_power((common > 0).double(), len(names)) > 0
    groups = dict.fromkeys(" and ".join(compress(names, row)) for row in reached.tolist())
    if len(groups) > 1:
        raise ConfigError(
            f"INPUT: cameras {' | '.join(groups)} are apart: the target is seen by one of each at no moment; add "
            "moments in which it is, or calibrate each by itself"
        )


def _started(located: Sequence[Located], *, free: bool) -> Together:
    """All views by moment, the cameras where most common moments put them, and the poses that explain most points."""
    names = list(dict.fromkeys(name for one in located for name in one.views.names))
    number = {name: k for k, name in enumerate(names)}
    cameras = tuple(one.camera for one in located)
    parts, R, t = [], [], []
    for k, one in enumerate(located):
        moment = torch.tensor([number[name] for name in one.views.names])
        parts.append(_part(one.views, moment[one.views.view], tuple(names), k, cameras))
        R.append(torch.full((len(names), 3, 3), torch.nan, dtype=one.R.dtype).index_copy(0, moment, one.R))
        t.append(torch.full((len(names), 3), torch.nan, dtype=one.t.dtype).index_copy(0, moment, one.t))
    shared = tuple(names)
    views = Views.joined([replace(part, names=shared) for part in parts])
    common = common_moments(views, len(cameras))
    check_connected([one.name for one in located], common)
    rig = _first_places(cameras, torch.stack(R), torch.stack(t), common)
    return Together(views, rig, *_first_poses(views, rig, torch.stack(R), torch.stack(t)))


def _part(views: Views, moment: Tensor, names: tuple[str, ...], number: int, cameras: tuple[Camera, ...]) -> Views:
    """One camera's views among those of all."""
    rims = views.rims
    if rims is not None:
        before = lenses.starts(cameras)[number]
        after = lenses.count(cameras) - before - rims.by_camera.shape[-1]
        rims = replace(rims, by_camera=pad(rims.by_camera, (before, after)), cameras=cameras)
    return replace(views, view=moment, names=names, camera=torch.full_like(moment, number), rims=rims)


def _first_places(cameras: tuple[Camera, ...], R: Tensor, t: Tensor, common: Tensor) -> CameraRig:
    """Places from the poses (C, N, 3, 3), (C, N, 3), NaN where there is none, along the ties of most moments."""
    count = len(cameras)
    eye = torch.eye(3, dtype=R.dtype)
    turns, shifts = [eye] * count, [torch.zeros(3, dtype=R.dtype)] * count
    placed = torch.zeros(count, dtype=torch.bool)
    placed[0] = True
    for _ in range(count - 1):
        open_ties = torch.where(placed[:, None] & ~placed, common, 0)
        known, new = divmod(int(open_ties.argmax()), count)
        back = rotations.inverse(R[known], t[known])
        turn, shift = _most_agreed(*rotations.compose(R[new], t[new], *back))
        turns[new], shifts[new] = rotations.compose(turn, shift, turns[known], shifts[known])
        placed[new] = True
    return CameraRig(cameras, torch.stack(turns), torch.stack(shifts))


def _most_agreed(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """That of some transforms (N, 3, 3), (N, 3) of the least median distance to all; NaN are none."""
    there = t.isfinite().all(-1)
    R, t = R[there], t[there]
    turned = rotations.log(R[:, None] @ R.mT).norm(dim=-1)
    moved = (t[:, None] - t).norm(dim=-1) / t.norm(dim=-1).median().clamp_min(1.0)
    best = int((turned + moved).median(-1).values.argmin())
    return R[best], t[best]


def _first_poses(views: Views, rig: CameraRig, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Of the poses that the cameras have of each moment the one that explains its points in all of them best."""
    moved = [rig.from_camera(number, R[number], t[number]) for number in range(len(rig))]
    costs = torch.stack([_cost(views, rig, *pose) for pose in moved])
    best, moments = costs.argmin(0), torch.arange(len(views))
    return torch.stack([pose[0] for pose in moved])[best, moments], torch.stack([p[1] for p in moved])[best, moments]


def _cost(views: Views, rig: CameraRig, R: Tensor, t: Tensor) -> Tensor:
    """Of poses (N, 3, 3), (N, 3) by moment; a point costs no more than one that is lost."""
    lens, view = views.lens, views.view
    turn, shift = rotations.compose(rig.R[lens], rig.t[lens], R[view], t[view])
    at = (turn @ views.points[..., None])[..., 0] + shift
    pixels = lenses.distorted(rig.cameras, lens, at[:, :2] / at[:, 2:])
    chi2 = ((views.pixels - pixels) / _START_SIGMA).square().sum(-1)
    cost = torch.where(at[:, 2] > 0, chi2 / (1 + chi2 / _LOST), torch.nan).nan_to_num(nan=_LOST)
    whole = segment_sum(cost, view, len(views))
    return torch.where(t.isfinite().all(-1), whole, torch.inf)


def _warnings(found: RigCalibration, seen: Views, *, free: bool) -> list[str]:
    views, rig, names = found.views, found.rig, found.rig.names
    told = []
    for number, camera in enumerate(rig.cameras):
        own = views.of_lens(number)
        turns = found.bundle.R[torch.bincount(views.view[views.lens == number], minlength=len(views)) > 0]
        if free and camera.covariance is not None:
            doubts = doubts_of(own, camera, turns, camera.covariance, found.common_sigma_px)
            told += [f"{names[number]}: {text}" for text in doubts]
    ties = found.common - torch.diag(found.common.diagonal())
    for number, most in enumerate(ties.amax(1).tolist()):
        if most < _FEW_TIES:
            told.append(
                f"{names[number]} is tied to the others by {most} moments only; add some, so that a false one shows"
            )
    rest = [name for name in seen.names if name not in views.names]
    if rest:
        some = ", ".join(rest[:_NAMED]) + (" and others" if len(rest) > _NAMED else "")
        told.append(
            f"{len(rest)} moments ({some}) contradict the others: the target moved between their pictures, or a camera "
            "in its place"
        )
    return told
