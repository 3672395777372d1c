"""From frames to a calibration: one camera, a ring target or a board, and the robot's poses where there are any."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from torchpose.calibration.boards import Board, find_corners
from torchpose.calibration.bundle import Bundle
from torchpose.calibration.grids import Grid, Marks, find_marks, measure_marks, nominal_board, sizes_of_marks
from torchpose.calibration.hand_eye import HandEyeFit, calibrate_mount
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
    of_seen,
    scale_sigma,
    scaled_by_distance,
)
from torchpose.calibration.plate import Plate, free_plate, stated_plate
from torchpose.calibration.rings import find_rings, measure_centers
from torchpose.calibration.tone import judge_tone, sizes_of_target
from torchpose.calibration.views import Views
from torchpose.camera import LINEAR, Camera, Tone
from torchpose.config import within
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.target import Target

Frames = Callable[[], Iterable[tuple[Sequence[str], Tensor]]]
"""Gives names and frames (B, H, W) in batches, from the first on each time it is called."""

Shown = Target | Board | Grid
"""What the frames show."""

_MEASURED = 2  # times that the grey values are fitted: the second changes places by less than their deviation
_SAMPLE = 16  # frames that the tone is judged by


def parse_board(text: str) -> Board | Grid:
    """The board that ``--board`` names.

    Raises:
        ConfigError: it names none.
    """
    with within("--board: "):
        grid = Grid.parse(text)
    return grid or Board.parse(text)


def calibrate_camera(
    frames: Frames, shown: Shown, start: Camera, *, guess: bool, lens: str, tone: Tone | None = None
) -> Calibration:
    """Intrinsics from frames of a ring target or a board.

    A ring target, or a grid of discs or rings, is measured in two rounds: rough centres to calibrate the camera, with
    which `measure_centers` or `measure_marks` fits the grey values; those of a target twice.
    The places and the edge gain of a target are unknowns with the covariance that its file states; tilts are open then.

    Args:
        frames: read once for a board of squares, else three times at most.
        guess: only the size of ``start`` is known; several focal lengths are tried.
        lens: a name of `torchpose.calibration.LENS_MODELS`.
        tone: of the frames; None: the one that their marks tell (`torchpose.calibration.tone`). The camera of the
            result has it, but for boards of squares, whose corners hardly depend on it.

    Raises:
        ConfigError: nothing in view, or as `calibrate_intrinsics`.
    """
    stored, frames = frames, linear_frames(frames, tone or LINEAR)
    starts = start_cameras(start.width, start.height, lens) if guess else [with_lens(replace(start, tone=None), lens)]
    if isinstance(shown, Board):
        return calibrate_intrinsics(_all_corners(frames, shown), starts, lens=lens)
    if isinstance(shown, Grid):
        camera, tone = _rough_camera(stored, shown, starts, lens, tone)
        frames = linear_frames(stored, tone)
        marks = _all_marks(frames, shown, camera)
        found = calibrate_intrinsics(_all_mark_centers(frames, shown, camera, marks), [camera], lens=lens)
        return replace(found, camera=replace(found.camera, tone=tone))
    camera, tone = _rough_camera(stored, shown, starts, lens, tone)
    frames, plate = linear_frames(stored, tone), stated_plate(shown)
    rough = calibrate_intrinsics(all_centers(frames, shown, camera, tilts="open"), [camera], lens=lens, plate=plate)
    # poses by a rough camera have not the tilts of the rings, and what rims tell is linear in it;
    # nor have those of a plate whose places are off
    exact = plate is None and rough.common_sigma_px == 0.0
    seen = all_centers(frames, shown, rough.camera, tilts="held" if exact else "open")
    found = calibrate_intrinsics(seen, [rough.camera], lens=lens, plate=plate)
    return replace(found, camera=replace(found.camera, tone=tone))


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
    shown: Target | Grid,
    start: Camera,
    *,
    given: Literal["camera", "start", "size"] = "start",
    lens: str = "brown5",
    distance: Distance | None = None,
    tone: Tone | None = None,
) -> Measurement:
    """Places, edge gain and sizes of a target's rings, and the camera with them unless it is known.

    The grey values are fitted twice: with the target as its file has it, then as it was measured, so that neither the
    tilt at which a ring is fitted nor the pixels that are taken depend on the print's errors. A board has marks as
    large as they look at first, and in the end those that are in views enough.

    Args:
        frames: read some times: two of them where the target is coded and the camera given.
        shown: the target, or a board.
        given: what ``start`` is: the camera, whose covariance is carried through, a camera to start from, or the size
            of the frames alone.
        lens: see `calibrate_camera`.
        distance: what gives the scale; None: the mean of the nominal distances.
        tone: see `calibrate_camera`; of a camera that is held, its own.

    Raises:
        ConfigError: nothing in view, a marker that is in too few views, or as `calibrate_intrinsics`.
    """
    held = given == "camera"
    # frames are taken for linear below: the camera's tone would count twice
    camera, stored = replace(start, tone=None), frames
    tone = start.tone or LINEAR if held else tone
    if not held:
        guess = given == "size"
        starts = start_cameras(start.width, start.height, lens) if guess else [with_lens(camera, lens)]
        camera, tone = _rough_camera(stored, shown, starts, lens, tone)
    frames = linear_frames(stored, tone or LINEAR)
    target = nominal_board(_all_marks(frames, shown, camera), shown, camera) if isinstance(shown, Grid) else shown
    known = target
    for _ in range(_MEASURED):
        views = all_centers(frames, known, camera, tilts="open")
        if isinstance(shown, Grid):
            known, target = of_seen(known, views), of_seen(target, views)
            views = views[torch.isin(views.point, target.ids)]
        check_seen(views, target)
        plate = free_plate(target.ids, target.centers, known.normals, discs=target.discs)
        found = _with_plate(views, camera, plate, None if held else lens)
        if distance is not None:
            found = scaled_by_distance(found, distance)
        measured, camera_of = measured_target(found, known)
        measured = replace(measured, scale_sigma=scale_sigma(target, distance))
        if held:  # what both share is of use where the camera's file has a name for it
            cross = None if start.adjustment is None else measured.cross_covariance
            measured, camera_of = replace(measured, adjustment=start.adjustment, cross_covariance=cross), start
        camera, known = replace(camera_of, tone=None), measured
    camera_of = camera_of if held else replace(camera_of, tone=tone)
    found = replace(found, camera=camera_of, warnings=[*found.warnings, *doubts(found, target)])
    return Measurement(found, target, measured, camera_of)


def _with_plate(views: Views, camera: Camera, plate: Plate, lens: str | None) -> Calibration:
    """The adjustment of a plate, and of a camera with such a lens unless it is held (None)."""
    if lens is None:
        return measure_plate(views, camera, plate)
    return calibrate_intrinsics(views, [camera], lens=lens, plate=plate)


def _rough_camera(
    stored: Frames, shown: Target | Grid, starts: Sequence[Camera], lens: str, tone: Tone | None
) -> tuple[Camera, Tone]:
    """The camera from the ellipses of a target or board that is taken as exact, and the tone of the frames."""
    frames = linear_frames(stored, tone or LINEAR)
    if isinstance(shown, Grid):
        marks = _all_marks(frames, shown, starts[0])
        camera = calibrate_intrinsics(marks.views(shown), list(starts), lens=lens).camera
    else:
        camera = _rough(frames, shown, starts, lens)
    return camera, tone or frames_tone(stored, shown, camera)


def linear_frames(frames: Frames, tone: Tone) -> Frames:
    """The frames by their light."""
    return lambda: ((names, tone.linear(part)) for names, part in frames())


def frames_tone(frames: Frames, shown: Target | Grid, camera: Camera) -> Tone:
    """The tone that the marks of some of the frames tell; linear where they do not."""
    names, some = _sample(frames)
    camera = replace(camera, tone=None)
    if isinstance(shown, Grid):
        grid = shown
        return judge_tone(lambda tone: sizes_of_marks(tone.linear(some), names, grid, camera))[0] or LINEAR
    target = shown
    return judge_tone(lambda tone: sizes_of_target(tone.linear(some), camera, target))[0] or LINEAR


def _sample(frames: Frames) -> tuple[list[str], Tensor]:
    """Frames of one pixel type, evenly from all batches, so that they differ."""
    some: list[tuple[str, Tensor]] = []
    for names, part in frames():
        if not some or part.dtype == some[0][1].dtype:
            some += list(zip(names, part.clone(), strict=True))
        some = some[:: len(some) // _SAMPLE + 1] if len(some) > 2 * _SAMPLE else some
    some = some[:: (len(some) - 1) // _SAMPLE + 1]
    return [name for name, _ in some], torch.stack([frame for _, frame in some])


def locate_camera(frames: Frames, shown: Shown, camera: Camera) -> tuple[Views, Bundle]:
    """Views of a camera that is known, with their poses.

    Raises:
        ConfigError: nothing in view.
    """
    frames = linear_frames(frames, camera.tone or LINEAR)
    camera = replace(camera, tone=None)
    if isinstance(shown, Grid):
        return locate_views(_all_mark_centers(frames, shown, camera, _all_marks(frames, shown, camera)), camera)
    seen = _all_corners(frames, shown) if isinstance(shown, Board) else all_centers(frames, shown, camera)
    return locate_views(seen, camera)


def _all_corners(frames: Frames, board: Board) -> Views:
    views = Views.cat([find_corners(names, part, board) for names, part in frames()])
    if not len(views.view):
        raise ConfigError("INPUT: the board is in none of the frames; check --board (inner corners) and the frames")
    return views


def _all_marks(frames: Frames, grid: Grid, camera: Camera) -> Marks:
    marks = Marks.cat([find_marks(names, part, grid, camera) for names, part in frames()])
    if not len(marks):
        raise ConfigError(
            f"INPUT: the board {grid.name} is in none of the frames, or so little of it that its marks cannot be told "
            "apart; check --board (columns x rows) and the frames"
        )
    return marks


def _all_mark_centers(frames: Frames, grid: Grid, camera: Camera, marks: Marks) -> Views:
    batches = ((names, part, marks.of_names(names)) for names, part in frames())
    return Views.cat([measure_marks(names, part, some, grid, camera) for names, part, some in batches])


def all_centers(frames: Frames, target: Target, camera: Camera, *, tilts: Literal["held", "open"] = "held") -> Views:
    return Views.cat([measure_centers(names, part, camera, target, tilts=tilts) for names, part in frames()])


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
    return calibrate_mount(poses, seen, bundle.pose_covariance, intrinsics=shift)
