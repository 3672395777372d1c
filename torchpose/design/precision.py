"""Predicted precision of a target over a working volume: its middle, its worst points, and maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.analysis.evaluation import AXES, UNITS
from torchpose.camera import Camera, CameraRig
from torchpose.design.predict import Imaging, deviations, edge_covariance, predicted_covariance
from torchpose.design.view import FRAME_MARGIN_PX, in_view, outlines, rings_that_count
from torchpose.design.volume import Offsets, Poses, WorkingVolume
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.geometry.rows import Rows
from torchpose.io.rows import Row
from torchpose.target import Target

_TILTS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the largest one
_DIRECTIONS = 8  # of the tilt, and turns about the axis, among which the weakest pose is searched
_STEPS = 4  # of distance and tilt in a map
# what a map shows where one distance or no tilt is asked for, so that it is no single dot: so much nearer and farther,
# and so far tilted, on a coarser grid (convention)
_AROUND = 0.2
_SHOWN_TILT = math.radians(30)
_SHOWN_STEPS, _SHOWN_DIRECTIONS = 3, 4
_PLACES = 3  # across the offset, along x and y
_COLUMNS = ["axis", "unit", "needed", "middle", "worst", "worst_x_mm", "worst_y_mm", "worst_z_mm", "worst_tilt_deg"]
_MEASURED, _ALONE = "worst_measured", "worst_first_camera_alone"


@dataclass(frozen=True)
class Need:
    """Largest standard deviations that are acceptable: across and along the optical axis (um), about any axis (deg)."""

    lateral_um: float
    depth_um: float
    angle_deg: float = math.inf

    def __post_init__(self) -> None:
        for value in (self.lateral_um, self.depth_um, self.angle_deg):
            if not value > 0:
                raise ConfigError(f"accuracy: {value:g} is not above 0; give standard deviations in um and degrees")

    @property
    def allowed(self) -> list[float | None]:
        """Of every axis, in the units of `deviations`; None where any will do."""
        angle = 1e3 * self.angle_deg if math.isfinite(self.angle_deg) else None
        return [self.lateral_um, self.lateral_um, self.depth_um, angle, angle, angle]

    def excess(self, deviation: Tensor) -> Tensor:
        """How many times (...) the deviations (..., 6) of `deviations` exceed the need; up to 1 is good."""
        allowed = [math.inf if value is None else value for value in self.allowed]
        return (deviation / deviation.new_tensor(allowed)).amax(-1)


@dataclass(frozen=True, eq=False)
class Precision(Rows):
    """Predicted standard deviations over a working volume, a row an axis, in the units of `deviations`."""

    middle: Float[Tensor, " 6"]  # facing the camera in the middle
    worst: Float[Tensor, " 6"]  # the largest
    R: Float[Tensor, "6 3 3"]  # where it was found
    t: Float[Tensor, "6 3"]

    def rows(
        self, need: Need | None = None, measured: Precision | None = None, alone: Precision | None = None
    ) -> list[Row]:
        """One row an axis: what is needed, the deviation in the middle, the largest one, and where that is.

        With the precision of the same target once its print is measured its largest deviation, too; and with that of
        the first camera alone.
        """
        tilt = self.R[:, 2, 2].clamp(max=1).acos().rad2deg()
        columns = (self.middle, self.worst, *self.t.unbind(1), tilt)
        needed = [None] * len(AXES) if need is None else need.allowed
        rows = zip(AXES, UNITS, needed, *(column.tolist() for column in columns), strict=True)
        made: list[Row] = [dict(zip(_COLUMNS, row, strict=True)) for row in rows]
        for column, other in ((_MEASURED, measured), (_ALONE, alone)):
            if other is not None:
                made = [row | {column: worst} for row, worst in zip(made, other.worst.tolist(), strict=True)]
        return made


@dataclass(frozen=True, eq=False)
class PrecisionMap:
    """Largest predicted deviations: across (um), along (um) and about any (mdeg) axis, on two grids."""

    distance: Float[Tensor, " D"]  # mm
    tilt: Float[Tensor, " T"]  # rad
    by_tilt: Float[Tensor, "D T 3"]  # on the optical axis, over all directions of the tilt; beyond the volume, too
    x: Float[Tensor, " X"]  # mm
    y: Float[Tensor, " Y"]  # mm
    by_place: Float[Tensor, "Y X 3"]  # at the farthest distance, over tilts of 0 and the largest


@checked
def predict_volume(camera: Camera | CameraRig, target: Target, volume: WorkingVolume, imaging: Imaging) -> Precision:
    """Predicted standard deviations of a target in the middle and where each of them is largest.

    Of several cameras the volume is that of the first, which sees all rings; the others have what they see of them.

    Raises:
        ConfigError: a ring leaves the frame somewhere in the volume.
    """
    first, extremes = CameraRig.of(camera).cameras[0], on_device(volume.extremes(), camera)
    if not in_view(first, outlines(target), *extremes, FRAME_MARGIN_PX):
        raise ConfigError(
            f"{target.name}: rings leave the frame within the working volume; narrow offset, tilt or roll, or keep "
            "farther away"
        )
    # the closed form finds the weakest pose of every axis at each tilt; the full prediction compares the tilts
    tilts = [volume.tilt * part for part in _TILTS] if volume.tilt else [0.0]
    chosen = [on_device(volume.middle, camera)]
    for tilt in tilts:
        R, t = on_device(volume.borders([tilt], _DIRECTIONS), camera)
        weakest = deviations(edge_covariance(camera, target, R, t, imaging)).argmax(0).unique()
        chosen.append((R[weakest], t[weakest]))
    R, t = (torch.cat(parts) for parts in zip(*chosen, strict=True))
    found = deviations(predicted_covariance(camera, target, R, t, imaging))
    worst = found.argmax(0)
    return Precision(found[0], found.amax(0), R[worst], t[worst])


@checked
def precision_map(camera: Camera | CameraRig, target: Target, volume: WorkingVolume, imaging: Imaging) -> PrecisionMap:
    """Maps of the predicted deviations over distance and tilt, and over the offset; the roll is 0.

    Of a volume with one distance or without tilt the first map shows more than the volume: the surroundings of that
    distance, and tilts.
    """
    shown = surroundings(volume)
    whole = shown == volume
    distance = _steps(*shown.distance, _STEPS if volume.distance[0] < volume.distance[1] else _SHOWN_STEPS)
    tilt = _steps(0.0, shown.tilt, _STEPS if volume.tilt else _SHOWN_STEPS)
    x, y = (_steps(-half, half, _PLACES) for half in volume.offset)

    def largest(tilts: Tensor, distances: Tensor, places: Offsets, azimuths: int = _DIRECTIONS) -> Tensor:
        """Largest deviations (distances * places, tilts, 3)."""
        columns = []
        for angle in tilts.tolist():
            poses = volume.poses(distances=distances.tolist(), tilts=[angle], azimuths=azimuths, offsets=places)
            found = deviations(predicted_covariance(camera, target, *on_device(poses, camera), imaging))
            found = found.unflatten(0, (len(distances) * len(places), -1)).amax(1)
            columns.append(torch.stack([found[:, :2].amax(1), found[:, 2], found[:, 3:].amax(1)], 1))
        return torch.stack(columns, 1)

    by_tilt = largest(tilt, distance, [(0.0, 0.0)], _DIRECTIONS if whole else _SHOWN_DIRECTIONS)
    grid = [(across, down) for down in y.tolist() for across in x.tolist()]
    ends = tilt.new_tensor([0.0, volume.tilt])
    far = tilt.new_tensor(volume.distance[1:])
    places = largest(ends, far, grid).amax(1) if len(grid) > 1 else by_tilt[-1:, -1]
    return PrecisionMap(distance, tilt, by_tilt, x, y, places.view(len(y), len(x), 3))


@checked
def share_that_counts(rig: CameraRig, number: int, target: Target, volume: WorkingVolume) -> float:
    """Share of the rings that count in a camera of several, over the extremes of the volume."""
    R, t = rig.seen_by(number, *on_device(volume.extremes(), rig))
    return float(rings_that_count(rig.cameras[number], target, R, t).double().mean())


@checked
def surroundings(volume: WorkingVolume) -> WorkingVolume:
    """The volume, with a range of distance where it has a single one, and tilts where it has none."""
    near, far = volume.distance
    around = (near, far) if near < far else ((1 - _AROUND) * near, (1 + _AROUND) * far)
    return replace(volume, distance=around, tilt=volume.tilt or _SHOWN_TILT)


def _steps(low: float, high: float, count: int = _STEPS) -> Tensor:
    return torch.linspace(low, high, count if high > low else 1, dtype=torch.float64, device="cpu")


def on_device(poses: Poses, camera: Camera | CameraRig) -> Poses:
    """Poses where the camera is."""
    like = CameraRig.of(camera).cameras[0].matrix
    return poses[0].to(like), poses[1].to(like)
