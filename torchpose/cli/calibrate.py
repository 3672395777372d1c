"""``torchpose calibrate``: frames of a known target in, camera file and hand-eye file out."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from torchpose.cli.common import (
    Quiet,
    Threads,
    Tone,
    check_robot_poses,
    cores,
    ended,
    frames_of,
    interrupted,
    read_tone,
    say,
    with_tone,
)
from torchpose.cli.options import camera_option, target_option
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose import camera as cameras
    from torchpose.calibration import Calibration, HandEyeFit
    from torchpose.calibration.measured import Distance
    from torchpose.calibration.session import Measurement, Shown
    from torchpose.camera import Camera
    from torchpose.io.sources import Source
    from torchpose.target import Target

_BOARD = (
    "Instead of a target: circles:7x6:20mm (columns, rows, pitch), acircles:4x11:20mm (OpenCV's asymmetric grid), "
    "rings:10x7:20mm:6mm:3mm (equal rings: pitch, radii), chessboard:9x6:5mm (inner corners, square) or "
    "charuco:8x5:10mm:7mm:4X4_50 (squares, square, marker, dictionary)."
)
_HAND_EYE_OUT = (
    "Hand-eye file to write; needs a manifest with robot poses. Which of camera and target is on the tool is found "
    "from the poses. With --cameras-out that of the first camera."
)
_MEASURE_TARGET = (
    "Target file to write: places, edge gain and radii of the target's markers as the frames show them, with their "
    "covariance. With --camera and without --out the camera is held."
)
_DISTANCE = (
    "Distance between the centres of two markers, which gives the measured target its scale: ids, mm, and its standard "
    "deviation in mm if it is not 0. By default the scale is that of the nominal places."
)
_LENSES = "pinhole|brown4|brown5|rational8|kannala_brandt"
_INPUTS = (
    "Image files, folders or capture manifests (.jsonl) of one camera; with --cameras-out one folder with a folder a "
    "camera, or one manifest: pictures of one name are of one moment."
)
_CAMERAS_OUT = (
    "File to write of several cameras (Kalibr camchain): intrinsics, places and their covariances, in one adjustment."
)
_CAMERAS = (
    "With --cameras-out: a file of all cameras, or once a camera its file, in the order of their names. Intrinsics are "
    "held, and their covariances carried through."
)
_OUT = "Camera file to write; without it --camera is taken as it is."


def calibrate(
    inputs: Annotated[list[Path], typer.Argument(metavar="INPUT...", help=_INPUTS)],
    target: Annotated[str | None, target_option("Target file or name of a built-in target.")] = None,
    board: Annotated[str | None, typer.Option(help=_BOARD)] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=_OUT)] = None,
    camera: Annotated[str | None, camera_option("Camera file to start from, or to use.")] = None,
    model: Annotated[str, typer.Option(metavar=_LENSES, help="Distortion of the lens.")] = "brown5",
    target_out: Annotated[Path | None, typer.Option("--measure-target", metavar="FILE", help=_MEASURE_TARGET)] = None,
    distance: Annotated[tuple[int, int, float] | None, typer.Option(metavar="ID ID MM [SIGMA]", help=_DISTANCE)] = None,
    hand_eye_out: Annotated[Path | None, typer.Option(help=_HAND_EYE_OUT)] = None,
    cameras_out: Annotated[Path | None, typer.Option(metavar="RIG", help=_CAMERAS_OUT)] = None,
    cameras: Annotated[list[Path] | None, typer.Option(metavar="RIG", help=_CAMERAS)] = None,
    tone: Tone = None,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for residual plots and tables.")] = None,
    threads: Threads = None,
    quiet: Quiet = False,
) -> int:
    """Calibrate a camera from views of a target, and where it sits on the robot, each with its covariance."""
    from torchpose.calibration.session import parse_board
    from torchpose.camera import Camera
    from torchpose.target import Target

    if (target is None) == (board is None):
        raise ConfigError("--target: give either --target or --board, what the frames show")
    if cameras_out is not None or cameras:
        from torchpose.cli.calibrate_rig import Request, calibrate_rig

        single = {"--out": out, "--camera": camera, "--distance": distance}
        outs = (cameras_out, target_out, hand_eye_out, plots)
        shown = Target.load(target) if target is not None else parse_board(board or "")
        return calibrate_rig(Request(inputs, shown, model, cameras or [], *outs, tone, threads, quiet), single)
    _check_files(out, hand_eye_out, camera, target_out)
    shown = Target.load(target) if target is not None else parse_board(board or "")
    between, inputs = _distance(distance, inputs, shown, target_out)
    sources = frames_of(inputs)
    if hand_eye_out is not None:
        check_robot_poses(sources)
    start = None if camera is None else with_tone(Camera.load(camera), tone)
    said = start.tone if start is not None else read_tone(tone)
    frames = CameraFrames(sources, start, threads=threads or cores(), quiet=quiet)
    return _run(frames, shown, start, model, between, said, _Outputs(out, target_out, hand_eye_out, plots))


class _Outputs(NamedTuple):
    """Files to write, and the folder of plots."""

    camera: Path | None
    target: Path | None
    hand_eye: Path | None
    plots: Path | None


def _run(
    frames: CameraFrames,
    shown: Shown,
    start: Camera | None,
    model: str,
    between: Distance | None,
    said: cameras.Tone | None,
    out: _Outputs,
) -> int:
    """Calibrates and writes one after the other; returns the exit code."""
    from torchpose.cli.terminal import native_stderr_silenced

    calibration = fit = measured = None
    try:
        with native_stderr_silenced():
            if out.target is not None:
                measured = _measured(frames, shown, start, model, between, said, held=out.camera is None)
                calibration = measured.calibration
                _show(calibration, len(frames.sources), held=out.camera is None)
                show_places(measured.target, measured.nominal)
                save(measured.target, out.target, "--measure-target")
                if out.camera is not None:
                    save(measured.camera, out.camera, "--out")
            elif out.camera is not None:
                calibration = _calibrate(frames, shown, start, model, said)
                _show(calibration, len(frames.sources))
                save(calibration.camera, out.camera, "--out")
            if out.hand_eye is not None:
                fit = _hand_eye(frames, shown, calibration, start)
                show_hand_eye(fit)
                save(fit.hand_eye, out.hand_eye, "--hand-eye-out")
            if out.plots is not None:
                from torchpose.report.calibration import save_calibration

                for path in save_calibration(calibration, fit, out.plots, measured):
                    say(str(path))
    except KeyboardInterrupt:
        return interrupted("nothing more was written; run again")
    return ended(frames.unreadable)


def _check_files(
    out: Path | None, hand_eye_out: Path | None, camera: str | None, target_out: Path | None = None
) -> None:
    if out is None and hand_eye_out is None and target_out is None:
        raise ConfigError(
            "--out: nothing to write; give --out for the camera, --measure-target for the target, --hand-eye-out for "
            "the camera's place on the robot"
        )
    if out is None and camera is None:
        found = "--measure-target" if target_out is not None else "--hand-eye-out"
        raise ConfigError(f"--camera: needed to find {found}; give the camera file, or --out to calibrate it now")
    check_places({"--out": out, "--hand-eye-out": hand_eye_out, "--measure-target": target_out})


def check_places(given: Mapping[str, Path | None]) -> None:
    """Refuses files, by option, that cannot be written or that two options name."""
    from torchpose.config import real
    from torchpose.io.writers import check_folder_of

    files: dict[Path, str] = {}
    for option, path in given.items():
        if path is None:
            continue
        check_folder_of(path, option)
        if os.path.isdir(path):
            raise ConfigError(f"{path}: {option}: is a folder; give the name of a file")
        if (other := files.setdefault(real(path), option)) != option:
            raise ConfigError(f"{path}: {option}: is the file of {other}, too; choose another")


def save(found: Any, path: Path, option: str) -> None:
    """Writes the file of a camera, target or hand-eye transform, its folder made where it is missing."""
    from torchpose.io.writers import make_folder_of

    make_folder_of(path, option)
    found.save(path)


def _distance(
    given: tuple[int, int, float] | None, inputs: list[Path], shown: Shown, target_out: Path | None
) -> tuple[Distance | None, list[Path]]:
    """The distance with its deviation, which the command line has among the INPUTs, and what is left of these."""
    from torchpose.calibration.boards import Board
    from torchpose.calibration.measured import Distance

    if target_out is not None and isinstance(shown, Board):
        raise ConfigError(
            "--measure-target: measures rings and discs; give --target, or --board circles:, acircles: or rings:"
        )
    if given is None:
        return None, inputs
    if target_out is None or isinstance(shown, Board):
        raise ConfigError("--distance: scales a measured target; give --measure-target too")
    numbers = [path for path in inputs if not os.path.exists(path) and _is_number(str(path))]
    sigma = float(str(numbers[0])) if numbers else 0.0
    distance = Distance(*given, sigma)
    distance.check(shown)
    return distance, [path for path in inputs if path not in numbers[:1]]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class CameraFrames:
    """The frames of all sources in batches, anew at every call; what could not be read is remembered."""

    def __init__(self, sources: Sequence[Source], start: Camera | None, *, threads: int, quiet: bool) -> None:
        self.sources, self._threads, self._quiet = sources, threads, quiet
        self.width, self.height = (start.width, start.height) if start is not None else first_size(sources)
        self.unreadable: dict[str, str] = {}

    def __call__(self) -> Iterator[tuple[list[str], Tensor]]:
        from collections import Counter

        from torchpose.cli.terminal import FrameProgress
        from torchpose.io.reader import FrameReader, default_batch, in_batches
        from torchpose.results import Status

        batches = in_batches(self.sources, default_batch(self.width, self.height))
        with FrameProgress(len(self.sources), 0, quiet=self._quiet) as progress:
            for batch in FrameReader(batches, self.width, self.height, threads=self._threads):
                for position, fault in batch.faults.items():
                    source = batch.sources[position]
                    if fault.status == Status.WRONG_SIZE:
                        raise ConfigError(
                            f"{source.path}: INPUT: is {fault.reason}, not {self.width}x{self.height} as the first "
                            "frame or --camera; calibrate the frames of one camera at a time"
                        )
                    self.unreadable[source.name] = fault.reason
                for positions, frames in batch.groups:
                    yield [batch.sources[position].name for position in positions], frames
                progress.advance(len(batch.sources), Counter())


def first_size(sources: Sequence[Source]) -> tuple[int, int]:
    from torchpose.io.images import UnreadableImageError

    for source in sources:
        try:
            height, width = source.decode().shape
        except UnreadableImageError:
            continue
        return width, height
    raise ConfigError(f"{sources[0].path}: INPUT: no frame could be read; give readable images")


def _calibrate(
    frames: CameraFrames, shown: Shown, start: Camera | None, model: str, tone: cameras.Tone | None
) -> Calibration:
    from torchpose.calibration.intrinsics import start_cameras
    from torchpose.calibration.session import calibrate_camera

    first = start or start_cameras(frames.width, frames.height, model)[0]
    return calibrate_camera(frames, shown, first, guess=start is None, lens=model, tone=tone)


def _measured(
    frames: CameraFrames,
    shown: Shown,
    start: Camera | None,
    model: str,
    distance: Distance | None,
    tone: cameras.Tone | None,
    *,
    held: bool,
) -> Measurement:
    from torchpose.calibration.boards import Board
    from torchpose.calibration.intrinsics import start_cameras
    from torchpose.calibration.session import measure_target

    assert not isinstance(shown, Board)  # checked with the options
    first = start or start_cameras(frames.width, frames.height, model)[0]
    given: Literal["camera", "start", "size"] = "camera" if held else "start" if start is not None else "size"
    return measure_target(frames, shown, first, given=given, lens=model, distance=distance, tone=tone)


def _hand_eye(frames: CameraFrames, shown: Shown, calibration: Calibration | None, camera: Camera | None) -> HandEyeFit:
    from torchpose.calibration.session import calibrate_robot, locate_camera

    robot = {source.name: source.robot_pose for source in frames.sources if source.robot_pose is not None}
    if calibration is not None:
        return calibrate_robot(calibration.views, calibration.bundle, calibration.joint, robot)
    assert camera is not None  # checked with the options
    views, bundle = locate_camera(frames, shown, camera)
    return calibrate_robot(views, bundle, camera.covariance, robot)


def _show(found: Calibration, frames: int, *, held: bool = False) -> None:
    """The intrinsics with their standard deviations unless they were held, and what they were computed from."""
    if not held:
        _show_intrinsics(found)
    points = f"{len(found.views.view)} points{f', {found.left_out} points left out' if found.left_out else ''}"
    say(f"{len(found.views)} of {frames} views, {points}, residual RMS {found.rms_px:.3g} px")
    if found.common_sigma_px:
        measure = "" if found.plate is not None else "; --measure-target takes what the print does out of it"
        say(f"{found.common_sigma_px:.3g} px per axis, beyond the noise of the frames, in every point{measure}")
    if found.camera.tone is not None:
        say(f"tone {found.camera.tone}")
    for warning in found.warnings:
        say(f"warning: {warning}", err=True)


def show_places(target: Target, nominal: Target) -> None:
    """How far the markers of a measured target are from their nominal places, and how well that is known."""
    assert target.covariance is not None  # always there after a measurement
    off = target.centers - nominal.centers
    sigma = target.covariance.diagonal()[:-1].view(-1, 3).sqrt()
    for name, of, known in zip("xyz", off.unbind(1), sigma.unbind(1), strict=True):
        rms, most = float(of.square().mean().sqrt()), float(of.abs().max())
        known_um = 1e3 * float(known.square().mean().sqrt())
        say(f"places {name}: {1e3 * rms:.3g} um RMS off, {1e3 * most:.3g} at most; known to {known_um:.2g} um")
    if target.grid is not None:
        radii = [radius for radius in target.printed_radii.mean(0).tolist() if radius]
        say(f"{len(target)} marks, radius {' and '.join(f'{radius:.5g}' for radius in radii)} mm")
        return
    size = float((target.radii / nominal.radii).mean())
    gain, gain_sigma = 1e3 * target.edge_gain, 1e3 * float(target.covariance[-1, -1].sqrt())
    say(f"edge gain {gain:.3g} +- {gain_sigma:.2g} um, rings {size:.5f} times as large as in the file")


def _show_intrinsics(found: Calibration) -> None:
    matrix = found.camera.matrix
    values = [*matrix.diagonal()[:2].tolist(), *matrix[:2, 2].tolist(), *found.camera.distortion.tolist()]
    for name, value, sigma in zip(found.names, values, found.covariance.diagonal().sqrt().tolist(), strict=True):
        digits = max(0, 1 - math.floor(math.log10(sigma))) if sigma > 0 else 6
        say(f"{name:>3} {value:14.{digits}f} +- {sigma:.2g}{' px' if name[0] in 'fc' else ''}")


def show_hand_eye(fit: HandEyeFit) -> None:
    """The transform with its standard deviations, and the robot's noise."""
    from torchpose.geometry import rotations

    found = fit.hand_eye
    assert found.covariance is not None  # always there after a fit
    sigmas = found.covariance.diagonal().sqrt().tolist()
    say(f"{found.mount}_from_camera, from {len(fit.residual)} poses")
    for name, value, sigma in zip("xyz", found.translation.tolist(), sigmas[:3], strict=True):
        say(f"{name:>3} {value:12.4f} +- {sigma:.2g} mm")
    for name, value, sigma in zip("xyz", rotations.log(found.rotation).tolist(), sigmas[3:], strict=True):
        say(f" r{name} {value:12.7f} +- {sigma:.2g} rad")
    say(f"robot noise {fit.robot_sigma_mm:.2g} mm and {fit.robot_sigma_rad:.2g} rad per axis")
