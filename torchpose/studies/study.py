"""What every study returns: tables with their units in the column names, pictures and sentences with figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.errors import ConfigError
from torchpose.io.writers import atomic_path, write_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = float | int | str | bool | None
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Table:
    """A table of a study.

    Attributes:
        name: file name without suffix, unique within its study.
        title: one line, what the rows are.
        rows: one mapping per row, all with the same keys; a key that holds a unit says so (``error_px``).
        note: what a reader has to know beside the figures: where a published figure differs and why.
    """

    name: str
    title: str
    rows: list[dict[str, Value]]
    note: str = ""

    def columns(self) -> list[str]:
        return list(self.rows[0]) if self.rows else []


@dataclass(frozen=True)
class Picture:
    """A picture of a study; ``name`` and ``note`` as for tables."""

    name: str
    title: str
    figure: Figure
    note: str = ""


@dataclass
class StudyResult:
    """Tables, pictures and statements of one study. ``settings``: what the figures depend on (seeds, frames, noise)."""

    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    statements: list[str] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)

    def save(self, folder: Path) -> list[Path]:
        """Writes ``NAME.csv`` for every table and ``NAME.png`` for every picture; returns their paths.

        Raises:
            ConfigError: the folder cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder}: --out: {error.strerror}; choose a folder that can be written") from None
        written = []
        for table in self.tables:
            path = folder / f"{table.name}.csv"
            write_rows(path, table.rows, {column: _type(table.rows, column) for column in table.columns()})
            written.append(path)
        for picture in self.pictures:
            path = folder / f"{picture.name}.png"
            with atomic_path(path) as temporary:
                picture.figure.savefig(temporary, format="png", dpi=130)
            written.append(path)
        return written


def ignore_progress(_done: float) -> None:
    """Progress of a study that nobody watches."""


def _type(rows: list[dict[str, Value]], column: str) -> type:
    """Type of a column: of the values that are there, float where integers and floats mix."""
    types = {type(row[column]) for row in rows if row[column] is not None}
    return types.pop() if len(types) == 1 else float if types == {int, float} else str
