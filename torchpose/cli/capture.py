"""``torchpose capture``: a robot moves through a plan, cameras take a frame at each pose."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.cli.common import INTERRUPTED, say
from torchpose.cli.options import camera_option, folder_option, target_option
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.rig.plan import CapturePlan
    from torchpose.rig.session import Session
    from torchpose.rig.settings import Rig
    from torchpose.rig.status import LiveStatus


def capture(
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="Capture plan (YAML): the poses of the tool.")],
    rig: Annotated[Path, typer.Option(help="Rig file (YAML): robot, workspace, cameras.")],
    out: Annotated[Path, folder_option("Folder of the session: manifest.jsonl and images/.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print and draw the path; nothing moves.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before the robot moves.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session that was cut short.")] = False,
    twin: Annotated[
        Path | None, typer.Option(metavar="TWIN", help="Emulate robot and cameras as this file (YAML) says.")
    ] = None,
    camera: Annotated[
        list[str] | None,
        camera_option("Camera file, to show the status of every frame; repeat in the order of the rig file."),
    ] = None,
    target: Annotated[list[str] | None, target_option("Target file or built-in target, for the status.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No path, progress bar or summary.")] = False,
) -> int:
    """Move a UR robot through a plan and take a frame of every Basler camera at each pose.

    The manifest joins every image with the robot's pose before and after the exposure. A session that ends early keeps
    all of its frames.
    """
    from torchpose.rig.capture import image_origin, missing
    from torchpose.rig.plan import load_plan
    from torchpose.rig.session import Session
    from torchpose.rig.settings import load_rig
    from torchpose.rig.status import LiveStatus

    settings, path = load_rig(rig), load_plan(plan)
    path.check(settings.robot.workspace)
    if twin is not None:
        from torchpose.rig.twin.scene import Scene

        Scene.load(twin).check(settings, twin)
    status = LiveStatus.load(camera or [], target or [], settings.cameras)
    session = Session(out, plan=path.digest, images=image_origin(settings), resume=resume)
    with contextlib.closing(session):
        left = len(missing(path, settings, session.done))
        if not quiet:
            _show(path, settings, left, out)
        if dry_run:
            return 0
        if left == 0:
            say(f"{session.manifest}: complete, nothing is missing", err=True)
            return 0
        if not yes and not typer.confirm(f"Move the robot through {left} waypoints?", err=True):
            raise ConfigError("capture: not confirmed, nothing has moved; add --yes to run without the question")
        with session, status:
            return _run(path, settings, session, twin, status, quiet)


def _run(plan: CapturePlan, rig: Rig, session: Session, twin: Path | None, status: LiveStatus, quiet: bool) -> int:
    """Captures what is missing; returns the exit code."""
    from torchpose.cli.terminal import FrameProgress
    from torchpose.rig.cameras import Frame
    from torchpose.rig.capture import capture
    from torchpose.rig.faults import RigFault
    from torchpose.rig.plan import Waypoint

    total, ended, code = len(plan.waypoints) * len(rig.cameras), "", 0

    def on_frame(_waypoint: Waypoint, frame: Frame) -> None:
        status.look(frame)
        progress.advance(1, status.counts)

    with contextlib.ExitStack() as stack:
        scene = None
        if twin is not None:
            from torchpose.rig.twin.scene import running_twin

            emulation = stack.enter_context(running_twin(twin, rig, plan.origin, len(session.done)))
            rig, scene = emulation.rig, emulation.look
        progress = stack.enter_context(FrameProgress(total, len(session.done), quiet=quiet))
        try:
            capture(plan, rig, session, scene=scene, on_frame=on_frame, notes={"twin": twin and str(twin)})
        except RigFault as fault:
            ended, code = f"{fault.reason}: {fault}", 1
        except KeyboardInterrupt:
            ended, code = "interrupted: the robot is stopped", INTERRUPTED
    if ended:
        kept = f"{session.folder} keeps {len(session.done)} of {total} frames"
        more = "; add --resume to go on" if session.begun else ""
        say(f"torchpose: error: {ended} ({kept}{more})", err=True)
    elif not quiet:
        status.wait()
        found = ", ".join(f"{name} {count}" for name, count in status.counts.most_common())
        say(f"{len(session.done)} frames in {session.manifest}{found and f': {found}'}", err=True)
    return code


def _show(plan: CapturePlan, rig: Rig, left: int, out: Path) -> None:
    """Prints what the robot will do and where; draws it too."""
    from torchpose.report.path import draw_path

    say(f"{plan.name}: {len(plan.waypoints)} waypoints, {left} to take, {len(rig.cameras)} camera(s)", err=True)
    for line in plan.summary(rig.robot.workspace):
        say(line, err=True)
    out.mkdir(parents=True, exist_ok=True)
    draw_path(plan, rig.robot.workspace, out / "path.svg")
    say(f"path drawn in {out / 'path.svg'}", err=True)
