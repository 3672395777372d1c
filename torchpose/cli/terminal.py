"""What a command shows on stderr while it runs. Nothing unless stderr is a terminal."""

from __future__ import annotations

import contextlib
import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Self

from torchpose.errors import printable

if TYPE_CHECKING:  # imported where something is shown: rich takes a twentieth of a second
    from rich.console import Console

STATUS_STYLE = {"ok": "green", "ambiguous": "yellow"}  # all others are red


class _Bar:
    """A bar on stderr of a terminal, gone when the block ends."""

    def __init__(self, *, quiet: bool) -> None:
        self._progress: Any = None
        if quiet or not _may_be_terminal():
            return
        from rich.console import Console
        from rich.progress import Progress

        self._console = Console(stderr=True)
        if self._console.is_terminal:
            self._progress = Progress(*self._columns(), console=self._console, transient=True)

    def _columns(self) -> tuple[Any, ...]:
        raise NotImplementedError

    def __enter__(self) -> Self:
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()


def _may_be_terminal() -> bool:
    """Whether stderr is one, or the environment may want it to be taken for one."""
    wanted = any(name in os.environ for name in ("FORCE_COLOR", "TTY_COMPATIBLE"))
    return sys.stderr is not None and (wanted or sys.stderr.isatty())


class FrameProgress(_Bar):
    """Bar with frames a second and rows by status.

    Args:
        total: frames to come in all.
        done: of these, finished by an earlier run.
        quiet: show nothing even on a terminal.
    """

    def __init__(self, total: int, done: int, *, quiet: bool) -> None:
        super().__init__(quiet=quiet)
        if self._progress is not None:
            self._task = self._progress.add_task("frames", total=total, completed=done, speed="", counts="")

    def _columns(self) -> tuple[Any, ...]:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

        speed, counts = TextColumn("{task.fields[speed]}"), TextColumn("{task.fields[counts]}")
        return TextColumn("frames"), BarColumn(), MofNCompleteColumn(), speed, TimeRemainingColumn(), counts

    def advance(self, frames: int, counts: Counter[str]) -> None:
        """Tells of ``frames`` more finished frames and of the rows so far by status."""
        if self._progress is None:
            return
        task = self._progress.tasks[0]
        speed = f"{task.speed:.1f} frames/s" if task.speed else ""
        self._progress.update(self._task, advance=frames, speed=speed, counts="  ".join(_coloured(counts)))

    def summary(self, counts: Counter[str], out: object) -> None:
        """Shows the rows by status and where they are."""
        if self._progress is None:
            return
        from rich.table import Table
        from rich.text import Text

        table = Table("status", "rows", title=Text(printable(str(out))), title_justify="left")
        for status, count in counts.most_common():
            table.add_row(Text(status, STATUS_STYLE.get(status, "red")), str(count))
        self._console.print(table)


class StudyProgress(_Bar):
    """One bar over studies that run one after the other.

    Args:
        names: of the studies.
        quiet: show nothing even on a terminal.
    """

    def __init__(self, names: list[str], *, quiet: bool) -> None:
        super().__init__(quiet=quiet)
        self._names = names
        if self._progress is not None:
            self._task = self._progress.add_task("studies", total=len(names))

    def _columns(self) -> tuple[Any, ...]:
        from rich.progress import BarColumn, TextColumn

        return TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %")

    def advance(self, name: str, done: float) -> None:
        """Tells that ``done``, 0 to 1, of the study ``name`` is finished."""
        if self._progress is not None:
            self._progress.update(self._task, description=name, completed=self._names.index(name) + done)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> Console:
    """Prints a table, its numbers with three digits; the console, for what comes below."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(width=max(Console().width, 100))  # a pipe counts as 80 columns, which would cut the numbers
    # as text: names in brackets are no markup
    table = Table(box=box.SIMPLE_HEAD, title=Text(printable(title)))
    for name in columns:
        table.add_column(name, justify="left" if name in ("axis", "unit", "source") else "right")
    for row in rows:
        table.add_row(
            *(Text(printable(v)) if isinstance(v, str) else "-" if v is None or v != v else f"{v:.3g}" for v in row)
        )
    console.print(table)
    return console


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
