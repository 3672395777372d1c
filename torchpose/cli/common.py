"""What the commands share: options, cores, checks of inputs and outputs, the last line and the exit code."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose import camera as cameras
    from torchpose.io.sources import Source

INTERRUPTED = 130  # as shells have it: 128 + SIGINT

Threads = Annotated[int | None, typer.Option(min=1, help="Threads to use; by default one a core.")]
Tone = Annotated[
    str | None,
    typer.Option(
        metavar="linear|srgb|gamma:G", help="How grey values follow light; goes before `tone` in the camera file."
    ),
]
Batch = Annotated[int | None, typer.Option(min=1, help="Frames at once; by default chosen by their size.")]
Overlay = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for pictures of what was found, one a frame.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")]
Silent = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar and no summary.")]
Resume = Annotated[bool, typer.Option("--resume", help="Keep the frames that an earlier run finished.")]


def frames_of(inputs: Sequence[Path]) -> list[Source]:
    """Frames of the INPUTs; what is passed over is told on stderr."""
    from torchpose.io.sources import find_sources

    return find_sources(inputs, lambda line: typer.echo(f"torchpose: {line}", err=True))


def check_outputs(
    inputs: Sequence[Path], sources: Sequence[Source], tables: Sequence[Path], overlay: Path | None
) -> None:
    """Refuses outputs that would overwrite or mingle with inputs."""
    read = {path.resolve() for path in inputs}
    for table in tables:
        if table.resolve() in read:
            raise ConfigError(f"{table}: --out: is an INPUT too; choose another file")
    if overlay is None:
        return
    place = overlay.resolve()
    folder = next((path for path in inputs if path.is_dir() and place.is_relative_to(path.resolve())), None)
    if folder is not None:
        raise ConfigError(
            f"{overlay}: --overlay: lies inside INPUT {folder}, where its pictures would be taken for frames; "
            "choose a folder outside"
        )
    from torchpose.report.overlay import picture_path

    frames = {Path(os.path.realpath(source.path)) for source in sources}  # which takes a loop of links, too
    if any(picture_path(place, source.name) in frames for source in sources):
        raise ConfigError(f"{overlay}: --overlay: its pictures would overwrite the frames; choose another folder")


def read_tone(text: str | None) -> cameras.Tone | None:
    """The tone that --tone names."""
    from torchpose.camera import Tone

    return None if text is None else Tone.parse(text, "--tone")


def with_tone(camera: cameras.Camera, text: str | None) -> cameras.Camera:
    """The camera with the tone that --tone names, where it is given."""
    from dataclasses import replace

    return camera if text is None else replace(camera, tone=read_tone(text))


def check_robot_poses(sources: Sequence[Source], why: str = "") -> None:
    """Refuses frames without a robot pose; ``why`` they need one."""
    without = [source for source in sources if source.robot_pose is None]
    if without:
        raise ConfigError(
            f"{without[0].path}: robot_pose: missing for {len(without)} of {len(sources)} frames{why}; "
            "give a capture manifest with robot poses as INPUT"
        )


def cores() -> int:
    """Cores that this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def interrupted(what: str) -> int:
    """Tells what an interruption has left; the exit code."""
    typer.echo(f"torchpose: error: interrupted: {what}", err=True)
    return INTERRUPTED


def ended(unreadable: dict[str, str]) -> int:
    """Tells of frames that could not be read, by name with the reason; the exit code of a run that came to its end."""
    if not unreadable:
        return 0
    shown = [f"{frame} ({reason})" for frame, reason in list(unreadable.items())[:5]]
    more = [f"and {len(unreadable) - 5} more"] if len(unreadable) > 5 else []
    typer.echo(
        f"torchpose: error: {', '.join(shown + more)}: INPUT: {len(unreadable)} could not be read; "
        "replace the files and run again",
        err=True,
    )
    return 1
