"""``torchpose estimate --cameras``: pictures of several cameras in, one row a moment and target out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.cli.common import check_outputs, check_robot_poses, ended, interrupted, read_tone, say, use_threads
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.camera import CameraRig
    from torchpose.io.estimates import Estimation
    from torchpose.io.moments import Moment, RigEstimation
    from torchpose.io.storage import Place


def rig_of(camera: str | None, cameras: Path | None, options: dict[str, Any]) -> CameraRig | None:
    """The rig of --cameras; None where there is one camera. ``options`` do not go with several."""
    from torchpose.camera import CameraRig

    if (camera is None) == (cameras is None):
        raise ConfigError(
            f"--camera: {'missing' if camera is None else 'stands beside --cameras'}; give --camera of one camera, or "
            "--cameras of several"
        )
    if cameras is None:
        return None
    for name, given in options.items():
        if given:
            raise ConfigError(f"{name}: is of one camera; leave it out with --cameras, or run each camera by itself")
    return CameraRig.load(cameras)


def estimate_moments(
    rig: CameraRig, inputs: list[Path | Place], rest: Estimation, out: Path | Place, options: dict[str, Any]
) -> int:
    """Estimates what is not done yet and writes the table; returns the exit code.

    Args:
        rig: the cameras.
        inputs: of the command: one folder, or one manifest.
        rest: what the rows depend on besides; its camera counts for nothing.
        out: table of the poses.
        options: ``tone``, ``resume``, ``batch``, ``threads`` and ``quiet`` of the command.
    """
    from torchpose.camera import CameraRig
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.moments import RigEstimation, find_moments

    if len(inputs) != 1:
        raise ConfigError(f"{inputs[1]}: INPUT: with --cameras there is one INPUT; give the folder of all cameras")
    if not isinstance(inputs[0], Path) or not isinstance(out, Path):
        raise ConfigError("--cameras: reads and writes folders of this machine; copy the pictures here")
    if rest.instances > 1:
        raise ConfigError("--instances: several cameras look for one copy; leave it out with --cameras")
    if (tone := read_tone(options["tone"])) is not None:
        lenses = [replace(camera, tone=tone) for camera in rig.cameras]
        rig = CameraRig(lenses, rig.R, rig.t, rig.covariance, rig.names)
    moments = find_moments(inputs[0], rig, lambda line: say(f"torchpose: {line}", err=True))
    sources = [source for moment in moments for source in moment.sources if source is not None]
    check_outputs(inputs, sources, [out], None)
    if rest.hand_eye is not None and rest.hand_eye.mount == "tool":
        check_robot_poses([moment.first for moment in moments], ", but the camera of the hand-eye file is on the tool")
    work = RigEstimation(rig, replace(rest, camera=rig.cameras[0]))
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
