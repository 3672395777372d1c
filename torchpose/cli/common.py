"""What the commands share: cores, checks of outputs, the line about unreadable files, exit codes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from torchpose.io.sources import Source

INTERRUPTED = 130  # as shells have it: 128 + SIGINT


def check_outputs(
    inputs: Sequence[Path],
    sources: Sequence[Source],
    tables: list[Path],
    overlay: Path | None,
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

    frames = {source.path.resolve() for source in sources}
    if any(picture_path(place, source.name) in frames for source in sources):
        raise ConfigError(f"{overlay}: --overlay: its pictures would overwrite the frames; choose another folder")


def cores() -> int:
    """Cores that this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def report_unreadable(unreadable: dict[str, str]) -> None:
    shown = [f"{frame} ({reason})" for frame, reason in list(unreadable.items())[:5]]
    more = [f"and {len(unreadable) - 5} more"] if len(unreadable) > 5 else []
    typer.echo(
        f"torchpose: error: {', '.join(shown + more)}: INPUT: {len(unreadable)} could not be read; "
        "replace the files and run again",
        err=True,
    )
