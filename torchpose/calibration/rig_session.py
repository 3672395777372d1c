"""From the frames of several cameras to a calibrated rig, with the target measured or as its file has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from torchpose.calibration.hand_eye import HandEyeFit, calibrate_mount
from torchpose.calibration.intrinsics import first_fit
from torchpose.calibration.measured import check_seen, measured_plate, poorly_known, scale_sigma
from torchpose.calibration.plate import free_plate, stated_plate
from torchpose.calibration.session import (
    Frames,
    Shown,
    all_centers,
    calibrate_camera,
    linear_frames,
    locate_camera,
)
from torchpose.calibration.several import Located, RigCalibration, calibrate_rig
from torchpose.calibration.views import Views
from torchpose.camera import LINEAR, Camera, Tone
from torchpose.config import within
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.target import Target

RobotPoses = Mapping[str, Sequence[float]]
"""base_from_tool by name of the moment: x, y, z in mm, rotation vector in rad."""

_MEASURED = 2  # times that the grey values are fitted, as with one camera


@dataclass(frozen=True, eq=False)
class OneCamera:
    """A camera of a rig to be calibrated: its name, its frames named by their moments, and what is known of its lens.

    ``given`` is the camera as it is, or one to start from; ``guess``: only its size counts.
    """

    name: str
    frames: Frames
    given: Camera
    guess: bool = True


@dataclass(frozen=True, eq=False)
class RigMeasurement:
    """A calibrated rig, and the target that was measured with it."""

    calibration: RigCalibration
    nominal: Target
    target: Target


def calibrate_cameras(
    several: Sequence[OneCamera],
    shown: Shown,
    *,
    lens: str | None = "brown5",
    tone: Tone | None = None,
    robot: RobotPoses | None = None,
) -> RigCalibration:
    """Places of cameras, and their intrinsics unless they are held, from frames of a target or a board.

    Every camera is calibrated by itself first; all points are then adjusted together.

    Args:
        several: the cameras.
        shown: what the frames show.
        lens: a name of `LENS_MODELS`; None: the cameras are held as they are.
        tone: see `calibrate_camera`.
        robot: see `calibrate_rig`.

    Raises:
        ConfigError: as `calibrate_camera` for one of the cameras, or as `calibrate_rig`.
    """
    plate = stated_plate(shown) if isinstance(shown, Target) else None
    located = [_alone(one, shown, lens, tone) for one in several]
    return calibrate_rig(located, lens=lens, plate=plate, robot=robot)


def _alone(one: OneCamera, shown: Shown, lens: str | None, tone: Tone | None) -> Located:
    with within(f"{one.name}: "):
        if lens is None:
            views, bundle = locate_camera(one.frames, shown, one.given)
            return Located(one.name, one.given, views, bundle.R, bundle.t)
        found = calibrate_camera(one.frames, shown, one.given, guess=one.guess, lens=lens, tone=tone)
    return Located(one.name, found.camera, found.views, found.bundle.R, found.bundle.t)


def measure_with_cameras(
    several: Sequence[OneCamera],
    target: Target,
    *,
    lens: str | None = "brown5",
    tone: Tone | None = None,
    robot: RobotPoses | None = None,
) -> RigMeasurement:
    """The same with places, edge gain and sizes of the target's rings unknown, see `measure_target`.

    Correlations of the target with the cameras are in the joint covariance, and in no file.
    """
    cameras = calibrate_cameras(several, target, lens=lens, tone=tone, robot=robot).rig.cameras
    known = target
    for _ in range(_MEASURED):
        located = [_rims(one, camera, known) for one, camera in zip(several, cameras, strict=True)]
        _check_seen(located, target)
        plate = free_plate(target.ids, target.centers, known.normals, discs=target.discs)
        found = calibrate_rig(located, lens=lens, plate=plate, robot=robot)
        of_plate = found.joint[-len(plate) :, -len(plate) :]
        measured = measured_plate(plate, found.bundle.plate, of_plate, known)
        known = replace(measured, scale_sigma=scale_sigma(target, None))
        cameras = found.rig.cameras
    doubts = poorly_known(plate, found.bundle.plate, of_plate, target)
    return RigMeasurement(replace(found, warnings=[*found.warnings, *doubts]), target, known)


def hand_eye_of(found: RigCalibration, robot: RobotPoses) -> HandEyeFit:
    """Hand-eye transform of the first camera of a rig, from the poses of all moments of which the robot's is known.

    Raises:
        ConfigError: as `calibrate_mount`.
    """
    if found.hand_eye is not None:
        return found.hand_eye
    bundle, there = found.bundle, torch.tensor([name in robot for name in found.views.names])
    tool = bundle.t.new_tensor([robot[name] for name in found.views.names if name in robot]).view(-1, 6)
    shift, seen = (bundle.gain[there], found.joint), (bundle.R[there], bundle.t[there])
    return calibrate_mount(
        (rotations.exp(tool[:, 3:]), tool[:, :3]), seen, bundle.pose_covariance[there], intrinsics=shift
    )


def _rims(one: OneCamera, camera: Camera, target: Target) -> Located:
    """What the rims tell a camera that is known about, with the poses of its views."""
    frames, linear = linear_frames(one.frames, camera.tone or LINEAR), replace(camera, tone=None)
    with within(f"{one.name}: "):
        views = all_centers(frames, target, linear, tilts="open")
        found = first_fit(views, linear, free=False) if len(views.view) else None
        if found is None:
            raise ConfigError("INPUT: no view has a pose; check the target and the frames")
    views, bundle = found
    return Located(one.name, camera, views, bundle.R, bundle.t)


def _check_seen(located: Sequence[Located], target: Target) -> None:
    """As `check_seen`, over the views of all cameras."""
    check_seen(Views.cat([replace(one.views, rims=None) for one in located]), target)
