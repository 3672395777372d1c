"""``torchpose calibrate --cameras-out``: frames of several cameras in, a file of all cameras out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli.common import cores, ended, interrupted, read_tone, say
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.calibration.hand_eye import HandEyeFit
    from torchpose.calibration.rig_session import RigMeasurement
    from torchpose.calibration.session import Shown
    from torchpose.calibration.several import RigCalibration
    from torchpose.camera import Camera, CameraRig
    from torchpose.cli.calibrate import CameraFrames
    from torchpose.io.moments import Moment


@dataclass(frozen=True)
class Request:
    """What the command line asks for: options of `torchpose calibrate`."""

    inputs: Sequence[Path]
    shown: Shown
    model: str
    cameras: Sequence[Path]
    cameras_out: Path | None
    target_out: Path | None
    hand_eye_out: Path | None
    plots: Path | None
    tone: str | None
    threads: int | None
    quiet: bool


def calibrate_rig(asked: Request, single: Mapping[str, Any]) -> int:
    """Calibrates and writes the file; returns the exit code.

    Args:
        asked: what is asked for.
        single: options of one camera, which are refused.
    """
    from torchpose.calibration.rig_session import OneCamera, calibrate_cameras, hand_eye_of, measure_with_cameras
    from torchpose.cli.calibrate import CameraFrames, first_size
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.target import Target

    _check(asked, single)
    known = _known(asked.cameras)
    names = known.names if known is not None and len(asked.cameras) == 1 else _names(asked.inputs[0])
    moments = _moments(asked.inputs[0], names)
    if known is not None and len(known) != len(names):
        raise ConfigError(
            f"--cameras: {len(known)} cameras for {len(names)} folders ({', '.join(names)}); give one file a folder"
        )
    tone, several, frames = read_tone(asked.tone), [], []
    for number, name in enumerate(names):
        sources = [replace(s, name=m.name) for m in moments if (s := m.sources[number]) is not None]
        if not sources:
            raise ConfigError(f"{asked.inputs[0]}: INPUT: has no picture of camera {name}; add some, or leave it out")
        given = None if known is None else _with_tone(known.cameras[number], tone)
        batches = CameraFrames(sources, given, threads=asked.threads or cores(), quiet=asked.quiet)
        frames.append(batches)
        several.append(OneCamera(name, batches, given or _of_size(*first_size(sources)), guess=given is None))
    lens = asked.model if known is None else None
    robot = {moment.name: pose for moment in moments if (pose := moment.first.robot_pose) is not None}
    if asked.hand_eye_out is not None and not robot:
        raise ConfigError(f"{asked.inputs[0]}: robot_pose: missing; --hand-eye-out needs a manifest with robot poses")
    how: dict[str, Any] = {"lens": lens, "tone": tone, "robot": robot}
    measured = None
    try:
        with native_stderr_silenced():
            if asked.target_out is not None:
                assert isinstance(asked.shown, Target)  # checked with the options
                measured = measure_with_cameras(several, asked.shown, **how)
                found = measured.calibration
            else:
                found = calibrate_cameras(several, asked.shown, **how)
        _show(found, len(moments))
        fit = found.hand_eye if asked.hand_eye_out is None else hand_eye_of(found, robot)
        _write(asked, found, measured, fit)
    except KeyboardInterrupt:
        return interrupted("nothing was written; run again")
    return ended(_unreadable(names, frames))


def _check(asked: Request, single: Mapping[str, Any]) -> None:
    from torchpose.cli.calibrate import check_places
    from torchpose.target import Target

    if asked.cameras_out is None:
        raise ConfigError("--cameras: goes with --cameras-out; give --camera for one camera")
    for option, given in single.items():
        if given is not None:
            raise ConfigError(f"{option}: is of one camera; leave it out with --cameras-out")
    if len(asked.inputs) != 1:
        raise ConfigError(
            f"{asked.inputs[1]}: INPUT: with --cameras-out there is one INPUT; give the folder of all cameras"
        )
    if asked.target_out is not None and not isinstance(asked.shown, Target):
        raise ConfigError("--measure-target: with several cameras measures a target; give --target")
    outs = {"--measure-target": asked.target_out, "--hand-eye-out": asked.hand_eye_out}
    check_places({"--cameras-out": asked.cameras_out, **outs})


def _known(files: Sequence[Path]) -> CameraRig | None:
    """The cameras of the files; their places count for nothing."""
    import torch

    from torchpose.camera import Camera, CameraRig

    if not files:
        return None
    if len(files) == 1:
        return CameraRig.load(files[0])
    cameras = [Camera.load(file) for file in files]
    eye = torch.eye(3, dtype=torch.float64).repeat(len(cameras), 1, 1)
    return CameraRig(cameras, eye, torch.zeros(len(cameras), 3, dtype=torch.float64))


def _names(given: Path) -> list[str]:
    """Of the cameras: the folders of a folder, or those that a manifest names."""
    from torchpose.io.manifest import read_manifest_cameras
    from torchpose.io.sources import MANIFEST_SUFFIX, natural_key

    if given.suffix.lower() == MANIFEST_SUFFIX:
        names = read_manifest_cameras(given)
    elif given.is_dir():
        names = [path.name for path in given.iterdir() if path.is_dir() and path.name[0] != "."]
    else:
        raise ConfigError(f"{given}: INPUT: is no folder; give one with a folder a camera, or a capture manifest")
    if len(names) < 2:
        raise ConfigError(
            f"{given}: INPUT: has {len(names)} folders of cameras; give one folder a camera, with pictures of one "
            "moment under one name, or --out for one camera"
        )
    return sorted(names, key=natural_key)


def _moments(given: Path, names: Sequence[str]) -> list[Moment]:
    import torch

    from torchpose.camera import Camera, CameraRig
    from torchpose.io.moments import find_moments

    any_size = Camera.ideal(1, 1, 1.0)  # moments go by names alone
    eye = torch.eye(3, dtype=torch.float64).repeat(len(names), 1, 1)
    rig = CameraRig([any_size] * len(names), eye, torch.zeros(len(names), 3, dtype=torch.float64), names=names)
    return find_moments(given, rig, lambda line: say(f"torchpose: {line}", err=True))


def _of_size(width: int, height: int) -> Camera:
    from torchpose.camera import Camera

    return Camera.ideal(width, height, float(width))


def _with_tone(camera: Camera, tone: Any) -> Camera:
    return camera if tone is None else replace(camera, tone=tone)


def _show(found: RigCalibration, moments: int) -> None:
    """Every camera: what it was computed from, its focal length, and where it is."""
    from torchpose.calibration.ties import apart
    from torchpose.geometry import rotations

    rig = found.rig
    seen = found.common.diagonal().tolist()
    for number, (name, camera) in enumerate(zip(rig.names, rig.cameras, strict=True)):
        sigma = "" if camera.covariance is None else f" +- {float(camera.covariance[0, 0].sqrt()):.2g}"
        say(
            f"{name}: {seen[number]} moments, {int(found.counts[number])} points, residual RMS "
            f"{float(found.rms_px[number]):.3g} px, fx {float(camera.matrix[0, 0]):.2f}{sigma} px"
        )
        if not number:
            continue
        assert rig.covariance is not None  # always there after a calibration
        sigmas = rig.covariance.diagonal()[6 * (number - 1) : 6 * number].sqrt().tolist()
        shift, turn = rig.t[number].tolist(), rotations.log(rig.R[number]).tolist()
        say("  " + ", ".join(f"{a} {v:.4f} +- {s:.2g}" for a, v, s in zip("xyz", shift, sigmas, strict=False)) + " mm")
        turned = zip("xyz", turn, sigmas[3:], strict=True)
        say("  " + ", ".join(f"r{a} {v:.7f} +- {s:.2g}" for a, v, s in turned) + " rad")
    if found.hand_eye is not None:
        say(f"{apart(rig.names, found.common)}: tied by the robot, cameras on its {found.hand_eye.hand_eye.mount}")
    left_out = f", {found.left_out} points left out" if found.left_out else ""
    say(f"{len(found.views)} of {moments} moments, {len(found.views.view)} points{left_out}")
    if found.common_sigma_px:
        say(f"{found.common_sigma_px:.3g} px per axis, beyond the noise of the frames, in every point")
    for warning in found.warnings:
        say(f"warning: {warning}", err=True)


def _write(asked: Request, found: RigCalibration, measured: RigMeasurement | None, hand_eye: HandEyeFit | None) -> None:
    from torchpose.cli.calibrate import save, show_hand_eye, show_places

    assert asked.cameras_out is not None  # checked with the options
    save(found.rig, asked.cameras_out, "--cameras-out")
    if measured is not None and asked.target_out is not None:
        show_places(measured.target, measured.nominal)
        save(measured.target, asked.target_out, "--measure-target")
    if hand_eye is not None:
        say(f"{found.rig.names[0]} by the robot:")
        show_hand_eye(hand_eye)
        if asked.hand_eye_out is not None:
            save(hand_eye.hand_eye, asked.hand_eye_out, "--hand-eye-out")
    if asked.plots is not None:
        from torchpose.report.rig_calibration import save_rig_calibration

        for path in save_rig_calibration(found, asked.plots):
            say(str(path))


def _unreadable(names: Sequence[str], frames: Sequence[CameraFrames]) -> dict[str, str]:
    return {
        f"{name}/{picture}": reason
        for name, batches in zip(names, frames, strict=True)
        for picture, reason in batches.unreadable.items()
    }
