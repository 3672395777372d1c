"""``torchpose estimate --cameras``: pictures of several cameras in, one row a moment and target out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli.common import check_outputs, ended, interrupted, read_tone, say, use_threads
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.camera import Camera
    from torchpose.io.estimates import Estimation
    from torchpose.io.moments import Moment, Paint, RigEstimation
    from torchpose.io.sources import Source
    from torchpose.io.storage import Place
    from torchpose.io.tally import Tally
    from torchpose.results import Poses


def check_several(camera: str | None, options: dict[str, Any]) -> None:
    """Refuses what does not go with --cameras, of options by their names."""
    if camera is not None:
        raise ConfigError("--camera: stands beside --cameras; give --camera of one camera, or --cameras of several")
    for name, given in options.items():
        if given:
            raise ConfigError(f"{name}: is of one camera; leave it out with --cameras, or run each camera by itself")


def estimate_moments(
    cameras: Path,
    inputs: list[Path | Place],
    rest: Callable[[list[Source], Camera], Estimation],
    out: tuple[Path | Place, Path | Place | None, Path | None],
    options: dict[str, Any],
) -> int:
    """Estimates what is not done yet and writes the table; returns the exit code.

    Args:
        cameras: file of the rig.
        inputs: of the command: one folder, or one manifest.
        rest: what the rows depend on besides, by a picture of every moment and the first camera.
        out: table of the poses, that of the markers, and the folder for pictures of what was found.
        options: ``tone``, ``resume``, ``batch``, ``threads``, ``quiet`` and ``told`` of the command.
    """
    from torchpose.camera import CameraRig
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.moments import RigEstimation, find_moments
    from torchpose.io.stream import is_standard

    if len(inputs) != 1:
        raise ConfigError("INPUT: with --cameras there is one; give the folder of all cameras")
    poses, marks, overlay = out
    tables = [table for table in (poses, marks) if table is not None]
    here = [table for table in tables if isinstance(table, Path) and not is_standard(table)]
    if not isinstance(inputs[0], Path) or len(here) < len(tables):
        raise ConfigError("--cameras: reads and writes files of this machine; copy the pictures here, and name a file")
    rig = CameraRig.load(cameras)
    if (tone := read_tone(options["tone"])) is not None:
        lenses = [replace(camera, tone=tone) for camera in rig.cameras]
        rig = CameraRig(lenses, rig.R, rig.t, rig.covariance, rig.names)
    moments = find_moments(inputs[0], rig, lambda line: say(f"torchpose: {line}", err=True))
    work = RigEstimation(rig, rest([moment.first for moment in moments], rig.cameras[0]))
    if work.rest.instances > 1:
        raise ConfigError("--instances: several cameras look for one copy; leave it out with --cameras")
    sources = [source for moment in moments for source in moment.sources if source is not None]
    check_outputs(inputs, sources, here, overlay)
    paint = None if overlay is None else _painter(work, overlay)
    with native_stderr_silenced():
        return _run(work, moments, here, paint, options)


def _painter(work: RigEstimation, folder: Path) -> Paint:
    """Writes pictures of what every camera found below a folder of its name."""
    from torchpose.report.overlay import Overlay

    rig, targets = work.rig, work.rest.targets
    places = zip(rig.cameras, rig.names, rig.R, rig.t, strict=True)
    painters = [Overlay(lens, targets, folder / name, place=(R, t)) for lens, name, R, t in places]

    def paint(frames: Sequence[Tensor], seen: Tensor, poses: Poses, names: list[str]) -> None:
        found = poses.detections
        for number, painter in enumerate(painters):
            own = replace(poses, detections=found[found.camera == number])
            painter.write(frames[number], own, names, seen[number].tolist())

    return paint


def _run(
    work: RigEstimation, moments: list[Moment], tables: list[Path], paint: Paint | None, options: dict[str, Any]
) -> int:
    import cv2
    import torch

    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.moments import MomentReader, MomentStore, batches_of
    from torchpose.io.reader import default_batch
    from torchpose.results import Status

    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    use_threads(options["threads"], share=0.5)
    estimator = work.estimator()
    roots = sorted({str(s.root) for moment in moments for s in moment.sources if s is not None})
    out, marks = tables[0], tables[1] if len(tables) > 1 else None
    store = MomentStore(
        out,
        marks,
        schema=work.schema,
        targets=len(work.rest.rows_of),
        origin=work.origin(roots, detections=marks is not None),
        resume=options["resume"],
        files={moment.name: moment.stamp for moment in moments},
    )
    largest = max(work.rig.cameras, key=lambda camera: camera.width * camera.height)
    batches = batches_of(moments, work.rig, options["batch"] or default_batch(largest.width, largest.height))
    pending = [one for one in batches if any(moment.name not in store for moment in one)]
    unreadable: dict[str, str] = {}
    other: dict[str, str] = {}
    try:
        with FrameProgress(len(moments), len(store), quiet=options["quiet"]) as progress, torch.inference_mode():
            for pictures in MomentReader(pending, work.rig, threads=options["threads"]):
                new = [record for record in work.records(pictures, estimator, paint) if record["frame"] not in store]
                for number, camera, status, reason in pictures.faults:
                    kind = unreadable if status == Status.UNREADABLE else other
                    kind[f"{work.rig.names[camera]}/{pictures.moments[number].name}"] = reason
                store.append(new)
                progress.advance(len(new), store.tally.counts)
        store.finish([moment.name for moment in moments])
    except KeyboardInterrupt:
        return interrupted(f"{len(store)} of {len(moments)} moments are kept; add --resume to go on")
    finally:
        store.close()
    progress.summary(store.tally.counts, out)
    for line in store.tally.whole_run.lines(f"{largest.width}x{largest.height}"):
        say(f"torchpose: warning: {line}", err=True)
    if other:
        first, reason = next(iter(other.items()))
        say(f"torchpose: warning: {first} ({reason}): {len(other)} have not the size of their camera", err=True)
    if not options["quiet"]:
        if options["told"]:
            say(f"torchpose: {options['told']}", err=True)
        _tell_disagreement(store.tally, work)
    return ended(unreadable)


def _tell_disagreement(tally: Tally, work: RigEstimation) -> None:
    """Tells, on stderr, of moments whose cameras contradict each other, and of a run whose cameras do by little."""
    from torchpose.geometry.robust import CUT, quantile

    count = tally.disagree
    if tally.compared and tally.surprise > quantile(2.0 * tally.compared, CUT):
        say(
            f"torchpose: the cameras contradict each other by more than chance over {tally.compared} ok rows (column "
            "consistency, 1 in the mean where they do not), too little in each to reject it; s* counts that: calibrate "
            "the rig again",
            err=True,
        )
    if not count:
        return
    stated = "" if work.rig.covariance is not None else ", or state extrinsics_covariance, which --cameras does not"
    say(
        f"torchpose: {count} rows are rejected, their cameras disagree (column consistency; odd_camera names one where "
        f"the others agree): calibrate the rig again, check that the pictures are of one time{stated}",
        err=True,
    )
