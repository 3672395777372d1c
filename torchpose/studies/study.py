"""What every study returns: tables with their units in the column names, pictures, and figures beside the paper's."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure

from torchpose.io.rows import Row
from torchpose.io.writers import atomic_path, write_rows
from torchpose.report.files import make_folder, save_figures

Progress = Callable[[float], None]  # told the part that is done, 0 to 1
RESULT = "result.json"
DATA = Path(__file__).with_name("data")


@dataclass(frozen=True)
class Table:
    """A table of a study.

    Attributes:
        name: file name without suffix, unique within its study.
        title: one line, what the rows are.
        rows: numbers, texts and None, all rows with the same keys; a key that holds a unit says so (``error_px``).
        note: what a reader has to know beside the figures: where a published figure differs and why.
    """

    name: str
    title: str
    rows: list[Row]
    note: str = ""

    @property
    def columns(self) -> list[str]:
        return list(self.rows[0]) if self.rows else []


@dataclass(frozen=True)
class Picture:
    """A picture of a study; ``name``, ``title`` and ``note`` as of tables."""

    name: str
    title: str
    figure: Figure
    note: str = ""


@dataclass(frozen=True)
class Comparison:
    """One figure of the paper beside ours and, where there is one, the bound that no method can beat.

    Attributes:
        what: the quantity and its circumstances.
        unit: of all three figures, "" for counts and ratios.
        paper: None where there is none, text where the paper states a claim; ``ours`` and ``bound`` likewise.
    """

    what: str
    unit: str
    paper: float | str | None
    ours: float | str | None
    bound: float | str | None = None


@dataclass
class StudyResult:
    """What one study found.

    Attributes:
        comparisons: the figures of the paper that the study repeats.
        statements: sentences with the figures of this run.
        settings: what the figures depend on (seeds, frames, noise).
    """

    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)
    statements: list[str] = field(default_factory=list)
    settings: Row = field(default_factory=dict)

    def save(self, folder: Path, about: Row | None = None) -> list[Path]:
        """Writes every table as ``NAME.csv``, every picture as ``NAME.png``, and all but the pictures' pixels as JSON.

        Args:
            folder: made if missing.
            about: further entries of the JSON file, which is written last: where it is, the others are whole.

        Raises:
            ConfigError: the folder cannot be written.
        """
        make_folder(folder, "--out")
        written = []
        for table in self.tables:
            written.append(folder / f"{table.name}.csv")
            write_rows(written[-1], table.rows, {column: _type(table.rows, column) for column in table.columns})
        written += save_figures({f"{p.name}.png": p.figure for p in self.pictures}, folder, dpi=110)
        record = {
            **(about or {}),
            "settings": self.settings,
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
            "statements": self.statements,
            "tables": [asdict(table) for table in self.tables],
            "pictures": [{"name": p.name, "title": p.title, "note": p.note} for p in self.pictures],
        }
        written.append(folder / RESULT)
        with atomic_path(written[-1]) as temporary:
            temporary.write_text(json.dumps(_finite(record), indent=1, default=str) + "\n", encoding="utf-8")
        return written


def ignore_progress(_done: float) -> None:
    """Progress of a study that nobody watches."""


def load_data(name: str) -> Any:
    """A file of data/: what the paper prints, scenes, set-ups, notes of tables."""
    text = (DATA / name).read_text(encoding="utf-8")
    return json.loads(text) if name.endswith(".json") else yaml.safe_load(text)


def _type(rows: list[Row], column: str) -> type:
    """Type of a column: of the values that are there, float where integers and floats mix."""
    types = {type(row[column]) for row in rows if row[column] is not None}
    return types.pop() if len(types) == 1 else float if types == {int, float} else str


def _finite(value: Any) -> Any:
    """The same with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
