"""``torchpose estimate``: frames in, one row a frame and target out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import typer

from torchpose.cli.common import (
    CLOSED,
    Batch,
    Overlay,
    Silent,
    Threads,
    Tone,
    check_device,
    check_outputs,
    check_robot_poses,
    cores,
    ended,
    frames_of,
    importing,
    interrupted,
    listed_files,
    one_thread_each,
    say,
    with_tone,
)
from torchpose.cli.moments import check_several, estimate_moments
from torchpose.cli.options import (
    ADDRESS,
    ENGINE,
    CameraFile,
    Cameras,
    Engine,
    FilesFrom,
    HandEyeFile,
    Instances,
    LastStage,
    RelativeTo,
    Targets,
    Upright,
    check_address,
)
from torchpose.errors import ConfigError

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.camera import Camera
    from torchpose.handeye import HandEye
    from torchpose.io.estimates import Estimation
    from torchpose.io.misfits import Misfits
    from torchpose.io.project import Settings
    from torchpose.io.sources import Source
    from torchpose.io.storage import Place
    from torchpose.io.store import ResultStore
    from torchpose.io.stream import StreamedRows
    from torchpose.io.tally import Tally
    from torchpose.target import Target

_OUT = (
    "Table of the poses: .csv, .jsonl or .parquet, on a disk or in a store, with --engine ray a folder of parts; or "
    "`-`: JSON lines on standard output."
)
_INPUTS = (
    "Image files (PNG, TIFF, BMP, JPEG, PGM; 8 or 16 bit, grey or colour), films (.mp4, .avi, .mov, .mkv, .webm), "
    "folders of both, searched recursively and taken in natural order, or capture manifests (.jsonl); paths, or URLs "
    "such as s3://BUCKET/FOLDER."
)
_JUDGED = 16  # frames that the tone is judged by
_RESUME = "Keep the frames that an earlier run finished and do the rest."
_DEVICE = "Where the frames are worked on; with cuda, --threads decode for it."
_TRACK = (
    "The frames of a folder, film or manifest follow each other: look for targets near their last pose first. The same "
    "results, sooner where much else is in sight."
)
_DETECTIONS = "Table of the markers found: .csv, .jsonl or .parquet."


def estimate(
    out: Annotated[str, typer.Option("--out", "-o", help=_OUT)],
    inputs: Annotated[list[str] | None, typer.Argument(metavar="INPUT...", help=_INPUTS)] = None,
    camera: CameraFile = None,
    cameras: Cameras = None,
    target: Targets = None,
    files_from: FilesFrom = None,
    detections: Annotated[str | None, typer.Option("--detections", "-d", help=_DETECTIONS)] = None,
    overlay: Overlay = None,
    instances: Instances = None,
    assume_upright: Upright = None,
    resume: Annotated[bool, typer.Option("--resume", help=_RESUME)] = False,
    track: Annotated[bool, typer.Option("--track", help=_TRACK)] = False,
    hand_eye: HandEyeFile = None,
    relative_to: RelativeTo = None,
    method: LastStage = None,
    tone: Tone = None,
    srgb: Annotated[bool, typer.Option("--srgb", help="The same as --tone srgb.")] = False,
    batch: Batch = None,
    threads: Threads = None,
    device: Annotated[str, typer.Option(metavar="cpu|cuda", help=_DEVICE)] = "cpu",
    engine: Annotated[Engine, typer.Option(help=ENGINE)] = Engine.local,
    address: Annotated[str | None, typer.Option(help=ADDRESS)] = None,
    quiet: Silent = False,
) -> int:
    """Measure the pose of ring targets in every frame, with its uncertainty.

    One row a frame and target, or with --instances one a copy: status, translation in mm, rotation vector in rad
    (target to camera), their standard deviations, reprojection RMS in px, number of markers.
    """
    with importing():
        from torchpose.cli.terminal import native_stderr_silenced
        from torchpose.io.estimates import Estimation  # noqa: F401  # imports all that is needed
        from torchpose.io.project import settings
        from torchpose.io.storage import place_of

    places = [place_of(name) for name in inputs or []]
    on_ray, tables = engine is Engine.ray, _Tables.of(out, detections)
    check_address(engine, address, threads)
    _check_engine(overlay, device, on_ray=on_ray)
    tables.check(resume=resume, on_ray=on_ray)
    one_thread_each()
    listed = listed_files(places, files_from)
    options: dict[str, Any] = {"camera": camera, "target": target, "method": method, "instances": instances}
    options |= {"hand_eye": hand_eye, "relative_to": relative_to, "assume_upright": assume_upright}
    stated = settings([*places, *listed], **options, tone="srgb" if srgb and tone is None else tone)
    how: _How = {"resume": resume, "batch": batch, "threads": threads or cores(), "quiet": quiet, "told": stated.told}
    if cameras is not None:
        other = {"--device": device != "cpu", "--track": track, "--engine ray": on_ray}
        check_several(camera, {"-f": files_from, **other})
        rest, several = partial(estimation, stated), {**how, "tone": stated["tone"]}
        return estimate_moments(cameras, places, rest, (tables.out, tables.detections, overlay), several)
    sources = frames_of(places, listed)
    work = _check_track(replace(estimation(stated, sources), track=track), tables, on_ray=on_ray)
    check_outputs([*places, *listed], sources, tables.paths, overlay)
    with native_stderr_silenced():
        if on_ray:
            return _run_on_ray(work, sources, tables, address, **how)
        return _run(work, sources, tables, overlay, device=device, **how)


def estimation(stated: Settings, sources: Sequence[Source], lens: Camera | None = None) -> Estimation:
    """What the rows depend on, by the options, or with a camera that is given.

    ConfigError: one is missing, or they do not go together.
    """
    from torchpose.camera import Camera
    from torchpose.io.estimates import Estimation
    from torchpose.target import Target

    given, lens = lens, lens or Camera.load(stated.needed("camera"))
    targets = [Target.load(name) for name in stated.needed("target")]
    if stated["assume_upright"]:
        targets = [one.upright() for one in targets]
    lens = with_tone(lens, stated["tone"])
    lens = lens if lens.tone is not None or given else with_judged_tone(lens, targets[0], sources)
    instances = stated["instances"] or 1
    _check_relative(stated["relative_to"], targets, stated["hand_eye"], instances)
    return Estimation(
        lens,
        targets,
        _load_hand_eye(stated["hand_eye"], sources),
        stated["method"] or "photometric",
        instances,
        stated["relative_to"],
        bool(stated["assume_upright"]),
    )


class _How(TypedDict):
    """Options that rows do not depend on."""

    resume: bool
    batch: int | None
    threads: int
    quiet: bool
    told: str


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
        from torchpose.io.stream import is_standard

        return [path for path in (self.out, self.detections) if isinstance(path, Path) and not is_standard(path)]

    def check(self, *, resume: bool, on_ray: bool) -> None:
        """Raises ConfigError unless both can be written, and for what standard output cannot have."""
        from torchpose.io.stream import is_standard
        from torchpose.io.writers import check_table_path

        options = {"--resume": resume, "--detections": self.detections is not None, "--engine ray": on_ray}
        if isinstance(self.out, Path) and is_standard(self.out):
            for option in [option for option, given in options.items() if given]:
                fix = f"give a file, or leave {option} out"
                raise ConfigError(f"--out: - is standard output, which has no {option}; {fix}")
        for path, option in ((self.out, "--out"), (self.detections, "--detections")):
            if isinstance(path, Path) and not is_standard(path) and not on_ray:
                check_table_path(path, option)


def _check_engine(overlay: Path | None, device: str, *, on_ray: bool) -> None:
    if overlay is not None and on_ray:
        raise ConfigError("--overlay: is not drawn by --engine ray; run a part of the frames with --engine local")
    if device != "cpu" and on_ray:
        raise ConfigError("--device: is cpu with --engine ray; leave one of them out")
    check_device(device)


def _check_shared(sources: Sequence[Source]) -> None:
    """Raises ConfigError unless workers can share the sources."""
    film = next((source for source in sources if source.film), None)
    if film is not None:
        raise ConfigError(
            f"{film.path}: --engine ray: a film is decoded from its beginning, so workers cannot share it; use "
            "--engine local"
        )


def _check_track(work: Estimation, tables: _Tables, *, on_ray: bool) -> Estimation:
    """The same work. ConfigError: it tracks, and has options that do not go with it."""
    from torchpose.io.stream import is_standard

    options = {"--engine ray": on_ray, "--instances": work.instances > 1}
    options["--out -"] = isinstance(tables.out, Path) and is_standard(tables.out)  # rows of several stretches mix
    for option in [option for option, given in options.items() if given and work.track]:
        raise ConfigError(f"--track: cannot be combined with {option}; leave one of them out")
    return work


def with_judged_tone(lens: Camera, target: Target, sources: Sequence[Source]) -> Camera:
    """The camera with the tone that the frames tell, where their kind of file makes one likely; says what it took."""
    from torchpose.io.images import UnreadableImageError, WrongSizeError

    if not sources or not sources[0].likely_encoded():
        return lens
    import numpy as np
    import torch

    from torchpose.calibration.tone import judge_tone, sizes_of_target
    from torchpose.camera import LINEAR

    images = []
    step = 1 if sources[0].film else (len(sources) - 1) // _JUDGED + 1  # a film is read from its beginning
    for source in sources[: step * _JUDGED : step]:
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
        f"torchpose: {sources[0].name}: JPEG, film or colour, and neither the camera file nor --tone says its tone: "
        f"taken as {tone or LINEAR} ({told})",
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
    device: str,
    quiet: bool,
    told: str,
) -> int:
    """Estimates what is not done yet and writes the tables; returns the exit code."""
    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.estimates import estimated, tracked
    from torchpose.io.processes import Crew
    from torchpose.io.staged import Staged
    from torchpose.io.storage import REQUESTS
    from torchpose.io.stream import StreamedRows
    from torchpose.report.overlay import Overlay

    estimator = work.estimator().to(device)
    painter = None if overlay is None else Overlay(work.camera, work.targets, overlay, threads=1)
    staged = Staged(tables.out, tables.detections, resume=resume)
    store = _opened(work, sources, staged.out, staged.detections, resume)
    # a resumed run works on the same batches as one that was not interrupted, so that rows agree to the last bit
    pending = [one for one in _batches(work, sources, batch) if any(source.name not in store for source in one)]
    # a single process decodes ahead with all threads, several do so with one each, or more that wait for a store;
    # neither a GPU nor an open film, whose decoder has threads of its own, can be shared with processes
    stored = any(not isinstance(source.path, Path) for source in sources)
    processes = threads if device == "cpu" and all(source.film is None for source in sources) else 1
    decoding = max(threads if min(processes, len(pending)) < 2 else 1, REQUESTS if stored else 1)
    paint = None if painter is None else painter.write
    job = partial(tracked if work.track else estimated, work, estimator, paint, decoding)
    try:
        with (
            Crew(job, pending, processes, let_go=store.close, fresh=stored) as crew,
            FrameProgress(len(sources), len(store), quiet=quiet) as progress,
        ):
            for records in crew:
                new = [record for record in records if record["frame"] not in store]
                store.append(new)
                progress.advance(len(new), store.tally.counts)
        store.finish([source.name for source in sources])
        staged.send()
    except KeyboardInterrupt:
        stream = isinstance(store, StreamedRows)
        kept = "are out; standard output has no --resume" if stream else "are kept; add --resume to go on"
        return interrupted(f"{len(store)} of {len(sources)} frames {kept}")
    except BrokenPipeError:
        return CLOSED
    finally:
        store.close()
    progress.summary(store.tally.counts, tables.out)
    if store.damaged:
        lost = f"{store.damaged} damaged lines of {staged.out}.partial left out, their frames done again"
        say(f"torchpose: {lost}", err=True)
    return _told(store.tally, work, len(sources), quiet=quiet, told=told)


def _batches(work: Estimation, sources: Sequence[Source], batch: int | None) -> Sequence[Any]:
    """What is worked on at a time: batches of frames, or of frames that follow others."""
    from torchpose.io.lanes import in_lanes
    from torchpose.io.reader import default_batch, in_batches

    return (in_lanes if work.track else in_batches)(
        sources, batch or default_batch(work.camera.width, work.camera.height)
    )


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
    told: str,
) -> int:
    """The same on the workers of a Ray cluster."""
    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.reader import default_batch
    from torchpose.io.rows import DETECTION_SCHEMA
    from torchpose.io.tally import Tally
    from torchpose.scale.cluster import cluster
    from torchpose.scale.estimate import measured, pending
    from torchpose.scale.parts import Parts

    _check_shared(sources)
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
                for records in measured(work, blocks, poses, marks, workers=workers.count):
                    for frame, rows in records:
                        tally.add(frame, rows)
                    left -= len(records)
                    progress.advance(len(records), tally.counts)
                if lost := workers.lost():
                    say(f"torchpose: {lost} nodes were lost on the way; others have done their blocks again", err=True)
        except KeyboardInterrupt:
            return interrupted(f"{len(sources) - left} of {len(sources)} frames are kept; add --resume to go on")
    for parts in (marks, poses):
        if parts is not None:
            parts.finish()
    progress.summary(tally.counts, tables.out)
    return _told(tally, work, len(sources), quiet=quiet, told=told)


def _opened(
    work: Estimation, sources: Sequence[Source], out: Path, detections: Path | None, resume: bool
) -> ResultStore | StreamedRows:
    """Where the rows go, with those of an earlier run."""
    from torchpose.io.store import ResultStore
    from torchpose.io.stream import StreamedRows, is_standard

    if is_standard(out):
        return StreamedRows(work.schema)

    files = {source.name: source.stamp() for source in sources}  # before they are read
    kept: dict[str, Any] = {"schema": work.schema, "targets": len(work.rows_of), "files": files}
    origin = work.origin((str(source.root) for source in sources), detections=detections is not None)
    return ResultStore(out, detections, resume=resume, origin=origin, **kept)


def _told(tally: Tally, work: Estimation, frames: int, *, quiet: bool, told: str) -> int:
    """Tells, on stderr, what is wrong with the run as a whole and what its rows say together; the exit code."""
    for line in tally.whole_run.lines(f"{work.camera.width}x{work.camera.height}"):
        say(f"torchpose: warning: {line}", err=True)
    if not quiet:
        if told:
            say(f"torchpose: {told}", err=True)
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
