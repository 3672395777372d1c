"""``torchpose estimate --cameras``: pictures of several cameras in, one row a moment and target out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli.common import check_outputs, ended, interrupted, read_tone, say, use_threads
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.camera import Camera
    from torchpose.io.estimates import Estimation
    from torchpose.io.moments import Moment, RigEstimation
    from torchpose.io.sources import Source
    from torchpose.io.storage import Place


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
    out: Path | Place,
    options: dict[str, Any],
) -> int:
    """Estimates what is not done yet and writes the table; returns the exit code.

    Args:
        cameras: file of the rig.
        inputs: of the command: one folder, or one manifest.
        rest: what the rows depend on besides, by a picture of every moment and the first camera.
        out: table of the poses.
        options: ``tone``, ``resume``, ``batch``, ``threads``, ``quiet`` and ``told`` of the command.
    """
    from torchpose.camera import CameraRig
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.moments import RigEstimation, find_moments
    from torchpose.io.stream import is_standard

    if len(inputs) != 1:
        raise ConfigError("INPUT: with --cameras there is one; give the folder of all cameras")
    if not isinstance(inputs[0], Path) or not isinstance(out, Path) or is_standard(out):
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
    check_outputs(inputs, sources, [out], None)
    with native_stderr_silenced():
        return _run(work, moments, out, options)


def _run(work: RigEstimation, moments: list[Moment], out: Path, options: dict[str, Any]) -> int:
    import cv2
    import torch

    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.moments import MomentReader, batches_of
    from torchpose.io.reader import default_batch
    from torchpose.io.store import ResultStore
    from torchpose.results import Status

    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    use_threads(options["threads"], share=0.5)
    estimator = work.estimator()
    roots = sorted({str(s.root) for moment in moments for s in moment.sources if s is not None})
    store = ResultStore(
        out,
        None,
        schema=work.schema,
        targets=len(work.rest.rows_of),
        origin=work.origin(roots),
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
                new = [record for record in work.records(pictures, estimator) if record["frame"] not in store]
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
        _tell_disagreement(store.tally.disagree, work)
    return ended(unreadable)


def _tell_disagreement(count: int, work: RigEstimation) -> None:
    """Tells, on stderr, of moments whose cameras contradict each other."""
    if not count:
        return
    stated = "" if work.rig.covariance is not None else ", or state extrinsics_covariance, which --cameras does not"
    say(
        f"torchpose: {count} rows are rejected, their cameras disagree (column consistency; odd_camera names one where "
        f"the others agree): calibrate the rig again, check that the pictures are of one time{stated}",
        err=True,
    )
