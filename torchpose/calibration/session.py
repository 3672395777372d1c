"""From frames to a calibration: one camera, a ring target or a board, and the robot's poses where there are any."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from torchpose.calibration.boards import Board, find_corners
from torchpose.calibration.bundle import Bundle
from torchpose.calibration.hand_eye import HandEyeFit, Mount, calibrate_hand_eye
from torchpose.calibration.intrinsics import (
    Calibration,
    calibrate_intrinsics,
    locate_views,
    measure_plate,
    start_cameras,
    with_lens,
)
from torchpose.calibration.measured import (
    Distance,
    check_seen,
    doubts,
    measured_target,
    scaled_by_distance,
)
from torchpose.calibration.plate import free_plate, stated_plate
from torchpose.calibration.rings import find_rings, measure_centers
from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.target import Target

Frames = Callable[[], Iterable[tuple[Sequence[str], Tensor]]]
"""Gives names and frames (B, H, W) in batches, from the first on each time it is called."""

_MEASURED = 2  # times that the grey values are fitted: the second changes places by less than their deviation
_MOST_NOISE = (5.0, 0.05)  # mm, rad: a robot that is farther off was not there when the frames were taken


def calibrate_camera(frames: Frames, shown: Target | Board, start: Camera, *, guess: bool, lens: str) -> Calibration:
    """Intrinsics from frames of a ring target or a board.

    A ring target is seen in two rounds: rough centres to calibrate the camera, with which `measure_centers` fits the
    grey values. Its places are unknowns with the covariance that its file states.

    Args:
        frames: read once for a board, twice for a target.
        guess: only the size of ``start`` is known; several focal lengths are tried.
        lens: a name of `torchpose.calibration.LENS_MODELS`.

    Raises:
        ConfigError: nothing in view, or as `calibrate_intrinsics`.
    """
    starts = start_cameras(start.width, start.height, lens) if guess else [with_lens(start, lens)]
    if isinstance(shown, Board):
        return calibrate_intrinsics(_all_corners(frames, shown), starts, lens=lens)
    camera = _rough(frames, shown, starts, lens)
    plate = None
    if shown.covariance is not None:
        plate = stated_plate(shown.ids, shown.centers, shown.covariance[:-1, :-1])
    return calibrate_intrinsics(_all_centers(frames, shown, camera), [camera], lens=lens, plate=plate)


def _rough(frames: Frames, target: Target, starts: Sequence[Camera], lens: str) -> Camera:
    """The camera from the ellipses of a target that is taken as exact."""
    batches = [find_rings(names, part, starts, target) for names, part in frames()]
    every = [Views.cat(views) for views in zip(*batches, strict=True)]
    rough = max(every, key=lambda views: len(views.view), default=None)
    if rough is None or not len(rough.view):
        raise ConfigError(f"INPUT: no marker of target {target.name} in any frame; check --target and the frames")
    return calibrate_intrinsics(rough, list(starts), lens=lens).camera


@dataclass(frozen=True, eq=False)
class Measurement:
    """A target measured by a camera: the adjustment, and both as their files hold them."""

    calibration: Calibration
    nominal: Target
    target: Target
    camera: Camera


def measure_target(
    frames: Frames,
    target: Target,
    start: Camera,
    *,
    held: bool,
    guess: bool = False,
    lens: str = "brown5",
    distance: Distance | None = None,
) -> Measurement:
    """Places, edge gain and sizes of a target's rings, and the camera with them unless it is known.

    The grey values are fitted twice: with the target as its file has it, then as it was measured, so that neither the
    tilt at which a ring is fitted nor the pixels that are taken depend on the print's errors.

    Args:
        frames: read twice where the camera is ``held``, else three times.
        held: ``start`` is the camera, its covariance is carried through.
        guess: see `calibrate_camera`.
        lens: the same.
        distance: what gives the scale; None: the mean of the nominal distances.

    Raises:
        ConfigError: nothing in view, a marker that is in too few views, or as `calibrate_intrinsics`.
    """
    camera, known = start, target
    if not held:
        starts = start_cameras(start.width, start.height, lens) if guess else [with_lens(start, lens)]
        camera = _rough(frames, target, starts, lens)
    for _ in range(_MEASURED):
        views = _all_centers(frames, known, camera, rims=True)
        check_seen(views, target)
        plate = free_plate(target.ids, target.centers, known.normals)
        if held:
            found = measure_plate(views, camera, plate)
        else:
            found = calibrate_intrinsics(views, [camera], lens=lens, plate=plate)
        if distance is not None:
            found = scaled_by_distance(found, distance)
        measured, camera_of = measured_target(found, known)
        if held:  # what both share is of use where the camera's file has a name for it
            cross = None if start.adjustment is None else measured.cross_covariance
            measured, camera_of = replace(measured, adjustment=start.adjustment, cross_covariance=cross), start
        camera, known = camera_of, measured
    found = replace(found, camera=camera_of, warnings=[*found.warnings, *doubts(found, target)])
    return Measurement(found, target, measured, camera_of)


def locate_camera(frames: Frames, shown: Target | Board, camera: Camera) -> tuple[Views, Bundle]:
    """Views of a camera that is known, with their poses.

    Raises:
        ConfigError: nothing in view.
    """
    seen = _all_corners(frames, shown) if isinstance(shown, Board) else _all_centers(frames, shown, camera)
    return locate_views(seen, camera)


def _all_corners(frames: Frames, board: Board) -> Views:
    views = Views.cat([find_corners(names, part, board) for names, part in frames()])
    if not len(views.view):
        raise ConfigError("INPUT: the board is in none of the frames; check --board (inner corners) and the frames")
    return views


def _all_centers(frames: Frames, target: Target, camera: Camera, *, rims: bool = False) -> Views:
    return Views.cat([measure_centers(names, part, camera, target, rims=rims) for names, part in frames()])


def calibrate_robot(
    views: Views, bundle: Bundle, intrinsics: Tensor | None, robot: Mapping[str, Sequence[float]]
) -> HandEyeFit:
    """Hand-eye transform from the poses of views; on which side the camera is mounted follows from the poses.

    Args:
        intrinsics: covariance of the bundle's first intrinsics (n, n), None for an exact camera.
        robot: base_from_tool by name of the view, x y z in mm, rotation vector in rad.

    Raises:
        ConfigError: as `calibrate_hand_eye`, or poses of robot and target that have nothing to do with each other.
    """
    tool = bundle.t.new_tensor([robot[name] for name in views.names])
    poses, seen = (rotations.exp(tool[:, 3:]), tool[:, :3]), (bundle.R, bundle.t)
    shift = None if intrinsics is None else (bundle.gain[..., : len(intrinsics)], intrinsics)
    mounts: tuple[Mount, Mount] = ("base", "tool")
    fits = [calibrate_hand_eye(poses, seen, bundle.pose_covariance, mount, intrinsics=shift) for mount in mounts]
    fit = min(fits, key=lambda one: one.robot_sigma_mm)
    if fit.robot_sigma_mm > _MOST_NOISE[0] or fit.robot_sigma_rad > _MOST_NOISE[1]:
        raise ConfigError(
            f"robot_pose: robot and target poses disagree by {fit.robot_sigma_mm:.1f} mm and "
            f"{fit.robot_sigma_rad:.2g} rad; check the units and that each pose was read when its frame was taken"
        )
    return fit
