"""What a command shows on stderr while it runs. Nothing unless stderr is a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from collections import Counter
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

STATUS_STYLE = {"ok": "green", "ambiguous": "yellow", "no_target": "red", "too_few_markers": "red", "rejected": "red"}


class FrameProgress:
    """Bar with frames a second and rows by status.

    Args:
        total: frames to come in all. done: of these, finished by an earlier run.
        quiet: show nothing even on a terminal.
    """

    def __init__(self, total: int, done: int, *, quiet: bool) -> None:
        console = Console(stderr=True)
        self._shown = console.is_terminal and not quiet
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[counts]}"),
            console=console,
            disable=not self._shown,
            transient=True,
        )
        self._task = self._progress.add_task("frames", total=total, completed=done, speed="", counts="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def advance(self, frames: int, counts: Counter[str]) -> None:
        """Tells of ``frames`` more finished frames and of the rows so far by status."""
        task = self._progress.tasks[0]
        speed = f"{task.speed:.1f} frames/s" if task.speed else ""
        self._progress.update(self._task, advance=frames, speed=speed, counts="  ".join(_coloured(counts)))

    def summary(self, counts: Counter[str], out: object) -> None:
        """Shows the rows by status and where they are."""
        if not self._shown:
            return
        table = Table("status", "rows", title=str(out), title_justify="left")
        for status, count in counts.most_common():
            table.add_row(f"[{STATUS_STYLE.get(status, 'red')}]{status}[/]", str(count))
        self._console.print(table)


class StudyProgress:
    """One bar over studies that run one after the other.

    Args:
        names: of the studies. quiet: show nothing even on a terminal.
    """

    def __init__(self, names: list[str], *, quiet: bool) -> None:
        console = Console(stderr=True)
        self._names = names
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:.0f} %"),
            console=console,
            disable=quiet or not console.is_terminal,
            transient=True,
        )
        self._task = self._progress.add_task("studies", total=len(names))

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def advance(self, name: str, done: float) -> None:
        """Tells that ``done``, 0 to 1, of the study ``name`` is finished."""
        self._progress.update(self._task, description=name, completed=self._names.index(name) + done)


def _coloured(counts: Counter[str]) -> list[str]:
    return [f"[{STATUS_STYLE.get(status, 'red')}]{status} {count}[/]" for status, count in counts.most_common()]


@contextlib.contextmanager
def native_stderr_silenced() -> Iterator[None]:
    """Keeps what C libraries print (libpng and libjpeg on damaged files) off the screen; Python's stderr still works.

    The results say the same of a damaged file in a form that can be used.
    """
    try:
        screen = os.dup(2)
    except OSError:  # the process was started without a stderr
        yield
        return
    python_stderr: Any = sys.stderr
    try:
        if python_stderr and python_stderr == sys.__stderr__:
            python_stderr.flush()
            sys.stderr = os.fdopen(
                screen, "w", buffering=1, encoding=python_stderr.encoding, errors="backslashreplace", closefd=False
            )
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
        yield
    finally:
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(screen, 2)
        sys.stderr = python_stderr
        os.close(screen)
