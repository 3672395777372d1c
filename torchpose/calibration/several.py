"""Several cameras calibrated together: which of them see the target at one time, and one adjustment of all.

Not all cameras need to see the target at once. Moments tie those together that do; a chain of ties is enough, and where
there is none the poses of a robot are (`calibration.ties`): then its chain is part of the adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchpose.calibration import lenses
from torchpose.calibration.bundle import Bundle, adjust
from torchpose.calibration.hand_eye import HandEyeFit
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
from torchpose.calibration.robot import CHAIN, Settled
from torchpose.calibration.ties import (
    check_connected,
    common_moments,
    first_places,
    group_of_moments,
    groups_of,
    names_of,
    tied_by_robot,
)
from torchpose.calibration.views import Views
from torchpose.camera import Camera, CameraRig
from torchpose.camera.rig import POSE
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum
from torchpose.handeye import HandEye

_FEW_TIES = 3  # moments that tie a camera to the others (convention): fewer leave a false one unseen
_START_SIGMA = 1.0  # px (convention): of every point, for the start
_ORDINARY_SIGMA = 0.01  # px: of the centres of rings in the end (docs/precision.md)
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
        joint: covariance of the intrinsics of all cameras, of the places of all but the first (6 each), of X and Z of a
            robot (12) where one ties the cameras, and of the unknowns of the plate.
        names: of the intrinsics and the places.
        views: the points that were used, by moment.
        bundle: poses and residuals of these.
        left_out: points left out because they contradict the others.
        chi2: sum over all points.
        degrees: of freedom.
        common_sigma_px: as in `Calibration`.
        common: in how many moments two cameras see the target, and each by itself.
        plate: what was unknown of the target.
        hand_eye: of the first camera, where a robot ties the cameras together; its residuals are the robot's pose, said
            less predicted, along and about the axes of its base.
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
    hand_eye: HandEyeFit | None = None
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
    located: Sequence[Located],
    *,
    lens: str | None = "brown5",
    plate: Plate | None = None,
    robot: Mapping[str, Sequence[float]] | None = None,
) -> RigCalibration:
    """Maximum-likelihood places of cameras, their intrinsics, and the poses of all moments, in one adjustment.

    Points are weighed and left out as in `calibrate_intrinsics`.

    Args:
        located: the cameras; the first is the one that places count from.
        lens: a name of `LENS_MODELS`, of all cameras; None: intrinsics are held, and their covariances carried through.
        plate: what is unknown of the target beside its poses; None where its points are exact.
        robot: base_from_tool by name of the moment, x y z in mm, rotation vector in rad: ties cameras together that no
            chain of common moments does, and is left alone where one does.

    Raises:
        ConfigError: cameras that neither moments nor the robot tie together, views that do not determine what is asked,
            or no convergence.
    """
    together, free = _started(located, robot or {}), lens is not None
    cameras, before = together.rig.cameras, len(together.views.view)
    start = adjust(_equal(together.views), together.rig, together.R, together.t, free=free)
    views, bundle, common = weigh(together.views, start, lenses.count(cameras) if free else 0, plate)
    names = tuple(one.name for one in located)
    ties = common_moments(views, len(cameras))
    check_connected(names, ties, robot=views.robot is not None)
    if not bundle.converged:
        raise ConfigError("INPUT: calibration did not converge; use a simpler --model or more varied views")
    for number in range(len(cameras)):
        own = views.lens == number
        check_residuals(views.of_lens(number), bundle.residual[own], int((together.views.lens == number).sum()))
    more = () if bundle.robot is None else ("hand-eye", "target on the robot")
    places = tuple(f"{name} {what}" for name in (*names[1:], *more) for what in ("x", "y", "z", "rx", "ry", "rz"))
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
        None if bundle.robot is None else _hand_eye(bundle.robot, joint, rig),
    )
    return replace(found, warnings=_warnings(found, together.views, free=free))


def _equal(views: Views) -> Views:
    """With the same weight of all points, and a robot in proportion: else the views would follow it."""
    robot = None if views.robot is None else views.robot.coarser(_START_SIGMA / _ORDINARY_SIGMA)
    return replace(views, covariance=widened(torch.zeros_like(views.covariance), _START_SIGMA), robot=robot)


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


def _hand_eye(robot: Settled, joint: Tensor, rig: CameraRig) -> HandEyeFit:
    """The first camera in its mount, with the covariance that it has in the adjustment."""
    first = lenses.count(rig.cameras) + POSE * (len(rig) - 1)
    (x, z), spread = (robot.robot.x, robot.robot.z), joint[first : first + CHAIN, first : first + CHAIN]
    mounted = HandEye(robot.robot.mount, *x, covariance=spread[:POSE, :POSE])
    known = robot.robot.known
    scale = robot.residual.new_tensor(robot.robot.noise).repeat_interleave(3)
    chi2 = float((robot.residual / scale)[known].square().sum())
    degrees = POSE * int(known.sum()) - CHAIN
    return HandEyeFit(mounted, *z, spread, robot.residual[known], chi2, degrees, *robot.robot.noise)


def _started(located: Sequence[Located], robot: Mapping[str, Sequence[float]]) -> Together:
    """All views by moment, the cameras where most common moments put them, and the poses that explain most points.

    With the robot that ties them together, where common moments do not.
    """
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
    rig = first_places(cameras, torch.stack(R), torch.stack(t), common)
    poses = _first_poses(views, rig, torch.stack(R), torch.stack(t))
    if int(groups_of(common).amax()) == 0:
        return Together(views, rig, *poses)
    of_cameras = [one.name for one in located]
    check_connected(of_cameras, common, robot=bool(robot.keys() & set(names)))
    tool = torch.tensor([robot.get(name, [torch.nan] * POSE) for name in names], dtype=t[0].dtype)
    tied = tied_by_robot(of_cameras, views, rig, poses, tool)
    return Together(replace(views, robot=tied.robot), tied.rig, tied.R, tied.t)


def _part(views: Views, moment: Tensor, names: tuple[str, ...], number: int, cameras: tuple[Camera, ...]) -> Views:
    """One camera's views among those of all."""
    rims = views.rims
    if rims is not None:
        before = lenses.starts(cameras)[number]
        after = lenses.count(cameras) - before - rims.by_camera.shape[-1]
        rims = replace(rims, by_camera=pad(rims.by_camera, (before, after)), cameras=cameras)
    return replace(views, view=moment, names=names, camera=torch.full_like(moment, number), rims=rims)


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
    told += _few_ties(found)
    told += _lost_poses(views, seen)
    rest = [name for name in seen.names if name not in views.names]
    if rest:
        told.append(
            f"{_moments(len(rest))} ({_some(rest)}) contradict the others: the target moved between their pictures, "
            "or a camera in its place"
        )
    return told


def _lost_poses(views: Views, seen: Views) -> list[str]:
    """Robot poses that were left out."""
    if views.robot is None or seen.robot is None:
        return []
    before, after = (dict(zip(v.names, v.robot.known.tolist(), strict=True)) for v in (seen, views) if v.robot)
    lost = [name for name, known in after.items() if before[name] and not known]
    if not lost:
        return []
    return [
        f"robot poses of {_moments(len(lost))} ({_some(lost)}) contradict the others and were left out: check that "
        "each was read when its pictures were taken"
    ]


def _moments(count: int) -> str:
    return f"{count} moment{'' if count == 1 else 's'}"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (" and others" if len(names) > _NAMED else "")


def _few_ties(found: RigCalibration) -> list[str]:
    """Cameras that few moments tie to the others, and groups that the robot ties in few."""
    names, common, group = found.rig.names, found.common, groups_of(found.common)
    members = torch.bincount(group)
    most = (common - torch.diag(common.diagonal())).amax(1).tolist()
    ties = [(name, "by", most[n]) for n, name in enumerate(names) if int(members[group[n]]) > 1]
    if (robot := found.views.robot) is not None:
        moments = torch.bincount(group_of_moments(found.views, group)[robot.known], minlength=len(members)).tolist()
        ties += [(names_of(names, group, k), "by the robot in", count) for k, count in enumerate(moments)]
    return [
        f"{name} is tied to the others {by} {_moments(count)} only; add some, so that a false one shows"
        for name, by, count in ties
        if count < _FEW_TIES
    ]
