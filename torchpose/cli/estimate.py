"""``torchpose estimate``: frames in, one row a frame and target out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import typer

from torchpose.cli.common import (
    Batch,
    Overlay,
    Silent,
    Threads,
    Tone,
    check_outputs,
    check_robot_poses,
    cores,
    ended,
    frames_of,
    interrupted,
    say,
    use_threads,
    with_tone,
)

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.camera import Camera
    from torchpose.handeye import HandEye
    from torchpose.io.estimates import Estimation
    from torchpose.io.misfits import Misfits
    from torchpose.io.sources import Source
    from torchpose.io.storage import Place
    from torchpose.io.store import ResultStore
    from torchpose.io.tally import Tally
    from torchpose.target import Target

_OUT = "Table of the poses: .csv, .jsonl or .parquet, on a disk or in a store; with --engine ray a folder of parts."
_ENGINE = "What runs the work: this process, or the workers of a Ray cluster (extra: ray)."
_ADDRESS = "With --engine ray: a cluster that is there; without it, one starts here and ends with the command."
_INPUTS = (
    "Image files (PNG, TIFF, BMP, JPEG, PGM; 8 or 16 bit, grey or colour), folders of them, searched recursively and "
    "taken in natural order, or capture manifests (.jsonl); paths, or URLs such as s3://BUCKET/FOLDER."
)
_CAMERA = (
    "Camera file: OpenCV YAML, JSON or XML, ROS camera_info, Kalibr camchain, COLMAP cameras.txt and others "
    "(docs/cameras.md). FILE#cam1 or FILE#2 picks one of several."
)
_CAMERAS = (
    "Several cameras, instead of --camera: Kalibr camchain, OpenCV's stereo calibration, or a folder of ROS "
    "camera_info with tf_static.yaml. INPUT has one folder a camera (cam0, cam1, ...), or is a capture manifest "
    "(docs/rigs.md)."
)
_METHODS = "photometric|edges|centers|paper"  # torchpose.pipeline.Method, which takes a second to import
_METHOD = "Last stage: grey values, edge points, ring centres, or the paper's own chain."
_HAND_EYE = "Calibrated camera-to-base or camera-to-tool transform; adds the poses in the robot base."
_JUDGED = 16  # frames that the tone is judged by
_RESUME = "Keep the frames that an earlier run finished and do the rest."
_INSTANCES = "Most copies of a target in a frame (a tray of equal parts): up to as many rows, column instance."
_TARGET = (
    "Target file or name of a built-in target, or a board of equal marks: rings:10x7:20mm:6mm:3mm (columns, rows, "
    "pitch, radii), circles:7x6:20mm:4mm, acircles:4x11:20mm:4mm (pitch, radius); repeat for several."
)
_UPRIGHT = (
    "Boards that look the same after a turn have their rows to the right. Without, they are ambiguous unless measured."
)
_RELATIVE = "Name of a target: give the poses of the others (of their parts) in its frame (that of its part)."
_DETECTIONS = "Table of the markers found: .csv, .jsonl or .parquet."


class Engine(StrEnum):
    local = "local"
    ray = "ray"


def estimate(
    inputs: Annotated[list[str], typer.Argument(metavar="INPUT...", help=_INPUTS)],
    target: Annotated[list[str], typer.Option(help=_TARGET)],
    out: Annotated[str, typer.Option(help=_OUT)],
    camera: Annotated[str | None, typer.Option(help=_CAMERA)] = None,
    cameras: Annotated[Path | None, typer.Option(metavar="RIG", help=_CAMERAS)] = None,
    detections: Annotated[str | None, typer.Option(help=_DETECTIONS)] = None,
    overlay: Overlay = None,
    instances: Annotated[int, typer.Option(min=1, max=1000, metavar="K", help=_INSTANCES)] = 1,
    assume_upright: Annotated[bool, typer.Option("--assume-upright", help=_UPRIGHT)] = False,
    resume: Annotated[bool, typer.Option("--resume", help=_RESUME)] = False,
    hand_eye: Annotated[Path | None, typer.Option(help=_HAND_EYE)] = None,
    relative_to: Annotated[str | None, typer.Option(metavar="NAME", help=_RELATIVE)] = None,
    method: Annotated[str, typer.Option(metavar=_METHODS, help=_METHOD)] = "photometric",
    tone: Tone = None,
    srgb: Annotated[bool, typer.Option("--srgb", help="The same as --tone srgb.")] = False,
    batch: Batch = None,
    threads: Threads = None,
    engine: Annotated[Engine, typer.Option(help=_ENGINE)] = Engine.local,
    address: Annotated[str | None, typer.Option(help=_ADDRESS)] = None,
    quiet: Silent = False,
) -> int:
    """Measure the pose of ring targets in every frame, with its uncertainty.

    One row a frame and target, or with --instances one a copy: status, translation in mm, rotation vector in rad
    (target to camera), their standard deviations, reprojection RMS in px, number of markers.
    """
    from torchpose.camera import Camera
    from torchpose.cli.moments import estimate_moments, rig_of
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.estimates import Estimation
    from torchpose.io.storage import place_of
    from torchpose.target import Target

    places = [place_of(name) for name in inputs]
    on_ray, tables = engine is Engine.ray, _Tables.of(out, detections)
    _check_engine(address, overlay, on_ray=on_ray)
    if not on_ray:
        tables.check()
    targets = [Target.load(name).upright() if assume_upright else Target.load(name) for name in target]
    _check_relative(relative_to, targets, hand_eye, instances)
    how: _How = {"resume": resume, "batch": batch, "threads": threads or cores(), "quiet": quiet}
    tone = "srgb" if srgb and tone is None else tone
    if several := rig_of(camera, cameras, {"--overlay": overlay, "--detections": detections, "--engine": on_ray}):
        work = Estimation(
            several.cameras[0], targets, _load_hand_eye(hand_eye, []), method, instances, relative_to, assume_upright
        )
        return estimate_moments(several, places, work, tables.out, {"tone": tone, **how})
    lens, sources = Camera.load(str(camera)), frames_of(places)
    lens = with_tone(lens, tone)
    lens = lens if lens.tone is not None else _with_judged_tone(lens, targets[0], sources)
    base = _load_hand_eye(hand_eye, sources)
    work = Estimation(lens, targets, base, method, instances, relative_to, assume_upright)
    check_outputs(places, sources, tables.paths, overlay)
    with native_stderr_silenced():
        if on_ray:
            return _run_on_ray(work, sources, tables, address, **how)
        return _run(work, sources, tables, overlay, **how)


class _How(TypedDict):
    """Options that rows do not depend on."""

    resume: bool
    batch: int | None
    threads: int
    quiet: bool


@dataclass(frozen=True)
class _Tables:
    """Where the tables of a run go: paths, or places in a store."""

    out: Path | Place
    detections: Path | Place | None

    @classmethod
    def of(cls, out: str, detections: str | None) -> _Tables:
        from torchpose.io.storage import place_of

        return cls(place_of(out), None if detections is None else place_of(detections))

    @property
    def paths(self) -> list[Path]:
        """Those on a disk."""
        return [path for path in (self.out, self.detections) if isinstance(path, Path)]

    def check(self) -> None:
        """Raises ConfigError unless both can be written."""
        from torchpose.io.writers import check_table_path

        for path, option in ((self.out, "--out"), (self.detections, "--detections")):
            if isinstance(path, Path):
                check_table_path(path, option)


def _check_engine(address: str | None, overlay: Path | None, *, on_ray: bool) -> None:
    from torchpose.errors import ConfigError

    if address is not None and not on_ray:
        raise ConfigError("--address: is of --engine ray alone; add it or leave --address out")
    if overlay is not None and on_ray:
        raise ConfigError("--overlay: is not drawn by --engine ray; run a part of the frames with --engine local")


def _with_judged_tone(lens: Camera, target: Target, sources: Sequence[Source]) -> Camera:
    """The camera with the tone that the frames tell, where their kind of file makes one likely; says what it took."""
    from torchpose.io.images import UnreadableImageError, WrongSizeError

    if not sources or not sources[0].likely_encoded():
        return lens
    from dataclasses import replace

    import numpy as np
    import torch

    from torchpose.calibration.tone import judge_tone, sizes_of_target
    from torchpose.camera import LINEAR

    images = []
    for source in sources[:: (len(sources) - 1) // _JUDGED + 1]:
        try:
            image = source.decode(size=(lens.width, lens.height))
        except (UnreadableImageError, WrongSizeError):
            continue
        if image.dtype == np.uint8:
            images.append(image)
    tone, shift = None, None
    if images:
        frames = torch.from_numpy(np.stack(images))
        tone, shift = judge_tone(lambda one: sizes_of_target(one.linear(frames), lens, target))
    told = (
        "too few rings to tell" if shift is None else f"as linear ones their edges would be {abs(shift.px):.2g} px off"
    )
    say(
        f"torchpose: {sources[0].name}: JPEG or colour, and neither the camera file nor --tone says its tone: taken as "
        f"{tone or LINEAR} ({told})",
        err=True,
    )
    return replace(lens, tone=tone or LINEAR)


def _run(
    work: Estimation,
    sources: list[Source],
    tables: _Tables,
    overlay: Path | None,
    *,
    resume: bool,
    batch: int | None,
    threads: int,
    quiet: bool,
) -> int:
    """Estimates what is not done yet and writes the tables; returns the exit code."""
    import cv2
    import torch

    from torchpose.camera import LINEAR
    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.reader import FrameReader, default_batch, in_batches
    from torchpose.io.staged import Staged
    from torchpose.report.overlay import Overlay

    cv2.setNumThreads(1)  # frames are decoded side by side; threads inside of one would only compete
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # decoding is the larger part of the work; torch's threads wait actively and would take its cores away
    use_threads(threads, share=0.5)
    camera, targets = work.camera, work.targets
    tone, estimator = camera.tone or LINEAR, work.estimator()
    painter = None if overlay is None else Overlay(camera, targets, overlay, threads=threads)
    staged = Staged(tables.out, tables.detections, resume=resume)
    store = _opened(work, sources, staged.out, staged.detections, resume)
    # a resumed run works on the same batches as one that was not interrupted, so that rows agree to the last bit
    batches = in_batches(sources, batch or default_batch(camera.width, camera.height))
    pending = [one for one in batches if any(source.name not in store for source in one)]
    reader = FrameReader(pending, camera.width, camera.height, threads=threads, tone=tone)
    try:
        with FrameProgress(len(sources), len(store), quiet=quiet) as progress, torch.inference_mode():
            for frames in reader:
                records = work.records(frames, estimator, None if painter is None else painter.write)
                new = [record for record in records if record["frame"] not in store]
                store.append(new)
                progress.advance(len(new), store.tally.counts)
        store.finish([source.name for source in sources])
        staged.send()
    except KeyboardInterrupt:
        return interrupted(f"{len(store)} of {len(sources)} frames are kept; add --resume to go on")
    finally:
        store.close()
    progress.summary(store.tally.counts, tables.out)
    if store.damaged:
        say(
            f"torchpose: {store.damaged} damaged lines of {staged.out}.partial left out, their frames done again",
            err=True,
        )
    return _told(store.tally, work, len(sources), quiet=quiet)


def _run_on_ray(
    work: Estimation,
    sources: list[Source],
    tables: _Tables,
    address: str | None,
    *,
    resume: bool,
    batch: int | None,
    threads: int,
    quiet: bool,
) -> int:
    """The same on the workers of a Ray cluster."""
    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.reader import default_batch
    from torchpose.io.rows import DETECTION_SCHEMA
    from torchpose.io.tally import Tally
    from torchpose.scale.cluster import cluster
    from torchpose.scale.estimate import measured, pending
    from torchpose.scale.parts import Parts

    poses, marks = Parts.at(tables.out, work.schema), None
    if tables.detections is not None:
        marks = Parts.at(tables.detections, DETECTION_SCHEMA, "--detections")
    origin = work.origin((str(source.root) for source in sources), detections=marks is not None)
    for parts in (poses, marks):
        if parts is not None:
            parts.begin(origin, resume=resume)
    tally = Tally()
    blocks = pending(sources, batch or default_batch(work.camera.width, work.camera.height), poses, tally)
    left = sum(len(block.sources) for block in blocks)
    with FrameProgress(len(sources), len(sources) - left, quiet=quiet) as progress:
        try:
            with cluster(address, threads) as workers:
                for records in measured(work, blocks, poses, marks, workers=workers):
                    for frame, rows in records:
                        tally.add(frame, rows)
                    left -= len(records)
                    progress.advance(len(records), tally.counts)
        except KeyboardInterrupt:
            return interrupted(f"{len(sources) - left} of {len(sources)} frames are kept; add --resume to go on")
    for parts in (marks, poses):
        if parts is not None:
            parts.finish()
    progress.summary(tally.counts, tables.out)
    return _told(tally, work, len(sources), quiet=quiet)


def _opened(
    work: Estimation, sources: Sequence[Source], out: Path, detections: Path | None, resume: bool
) -> ResultStore:
    """Where the rows go, with those of an earlier run."""
    from torchpose.io.store import ResultStore

    files = {source.name: source.stamp() for source in sources}  # before they are read
    kept: dict[str, Any] = {"schema": work.schema, "targets": len(work.rows_of), "files": files}
    origin = work.origin((str(source.root) for source in sources), detections=detections is not None)
    return ResultStore(out, detections, resume=resume, origin=origin, **kept)


def _told(tally: Tally, work: Estimation, frames: int, *, quiet: bool) -> int:
    """Tells, on stderr, what is wrong with the run as a whole and what its rows say together; the exit code."""
    for line in tally.whole_run.lines(f"{work.camera.width}x{work.camera.height}"):
        say(f"torchpose: warning: {line}", err=True)
    if not quiet:
        _tell_crowded(tally, frames, work)
        _tell_misfits(tally.misfits, work)
    return ended(tally.unreadable)


def _tell_crowded(tally: Tally, count: int, work: Estimation) -> None:
    """Tells, in a line on stderr, of copies that were seen in some of the frames and have no row."""
    frames, most = tally.crowded, tally.most
    if not frames:
        return
    seen = ", ".join(f"{number} of {target}" for target, number in most.items())
    more = max(most.values()) > work.instances
    fix = f"--instances {max(most.values())} looks for all" if more else "no pose explains the others"
    say(
        f"torchpose: {len(frames)} of {count} frames show more copies of a target than they have rows, "
        f"up to {seen}; {fix}",
        err=True,
    )


def _tell_misfits(misfits: dict[str, Misfits], work: Estimation) -> None:
    """Tells, on stderr, what the files leave out that the standard deviations then cannot count."""
    silent = [t.name for t in work.rows_of if t.covariance is None and t.name in misfits and misfits[t.name].frames]
    files = [f"target {', '.join(silent)} (center_sigma, edge_gain_sigma)"] if silent else []
    if work.camera.covariance is None and any(m.frames for m in misfits.values()):
        files.append("camera (intrinsics_covariance)")
    stated = work.camera.covariance is not None or any(t.covariance is not None for t in work.rows_of)
    if files:
        say(
            f"torchpose: no uncertainty is stated of {' and '.join(files)}: s* counts the noise of the frames"
            f"{', what the other files state' if stated else ' alone'}, and what residuals show beyond it",
            err=True,
        )
    mirrored = sum(m.mirrored for m in misfits.values())
    if mirrored:
        say(
            f"torchpose: {mirrored} rows show a target mirrored, from behind its printed side: turn the camera's "
            "mirroring off, or write normal: [0, 0, -1] for the markers of a target that is drawn y-up",
            err=True,
        )
    for target in work.rows_of:
        if target.name in misfits:
            for line in misfits[target.name].lines(target.name, target.ids.tolist(), _stated(target)):
                say(f"torchpose: {line}", err=True)


def _stated(target: Target) -> tuple[float, float]:
    """Deviations of places (RMS length) and edge gain that the target's file states, mm."""
    if target.covariance is None:
        return 0.0, 0.0
    variance = target.covariance.diagonal()
    return float((variance[:-1].sum() / len(target)).sqrt()), float(variance[-1].sqrt())


def _load_hand_eye(path: Path | None, sources: Sequence[Source]) -> HandEye | None:
    if path is None:
        return None
    from torchpose.handeye import HandEye

    hand_eye = HandEye.load(path)
    if hand_eye.mount == "tool":
        check_robot_poses(sources, f", but the camera of {path} is on the tool")
    return hand_eye


def _check_relative(name: str | None, targets: Sequence[Target], hand_eye: Path | None, instances: int) -> None:
    from torchpose.errors import ConfigError

    if name is None:
        return
    names = [target.name for target in targets]
    if name not in names or len(names) < 2:
        raise ConfigError(
            f"--relative-to: {name} needs to be one of two or more targets, but --target gives {', '.join(names)}; "
            "repeat --target"
        )
    if hand_eye is not None or instances > 1:
        other = "--hand-eye" if hand_eye is not None else "--instances"
        raise ConfigError(f"--relative-to: cannot be combined with {other}; leave one of them out")
