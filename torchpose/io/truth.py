"""The truth of simulated frames: one CSV row per frame and target."""

import csv
import io
import itertools
import os
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from torchpose.config import MOST_TABLE_BYTES, format_number, read_text, shown, within, write_text
from torchpose.config.kinds import Length, Radians, Word
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.cells import FileName

NAMES = ("frame", "target")
POSE = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class _Column:
    """What the cells of a column are: ``cells`` reads a list of text."""

    meant: str
    cells: Any  # TypeAdapter

    def read(self, name: str, cells: tuple[str, ...]) -> list[Any]:
        try:
            values: list[Any] = self.cells.validate_python(list(cells))
            return values
        except ValidationError as caught:
            line = caught.errors()[0]["loc"][0]
        assert isinstance(line, int)  # the place in the list
        raise ConfigError(f"{name}: {shown(cells[line])} in line {line + 2} is not {self.meant}; write one")


_NUMBER = _Column("a number", TypeAdapter(list[float]))  # NaN and infinity too: a bound that does not exist
_COLUMNS = {
    "frame": _Column("the name of a file", TypeAdapter(list[FileName])),
    "target": _Column("a name", TypeAdapter(list[Word])),
    **dict.fromkeys(POSE[:3], _Column("a number, in mm", TypeAdapter(list[Length]))),
    **dict.fromkeys(POSE[3:], _Column("a number, in rad", TypeAdapter(list[Radians]))),
}


@dataclass(frozen=True, eq=False)
class Truth:
    """Known poses of N frame-target pairs.

    Attributes:
        frame: paths relative to the folder of frames.
        target: names of targets.
        t: float64, mm, target to camera.
        rotation_vector: float64, rad, target to camera.
        extra: further columns by name, float64. Their names carry the unit where it is not mm, rad, px or grey levels;
            ``sx sy sz srx sry srz`` are the Cramer-Rao standard deviations of `torchpose.analysis`.
    """

    frame: list[str]
    target: list[str]
    t: Float[Tensor, "N 3"]
    rotation_vector: Float[Tensor, "N 3"]
    extra: dict[str, Float[Tensor, " N"]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def R(self) -> Float[Tensor, "N 3 3"]:
        """Target to camera, float64."""
        return rotations.exp(self.rotation_vector)


def write_truth(path: str | os.PathLike[str], truth: Truth) -> None:
    """Writes a truth file in one piece; every number reads back exactly.

    Raises:
        ConfigError: the folder does not exist or cannot be written.
    """
    columns = [*truth.t.unbind(1), *truth.rotation_vector.unbind(1), *truth.extra.values()]
    numbers = zip(*(c.tolist() for c in columns), strict=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*NAMES, *POSE, *truth.extra])
    for frame, target, row in zip(truth.frame, truth.target, numbers, strict=True):
        writer.writerow([frame, target, *map(format_number, row)])
    write_text(path, text.getvalue())


def read_truth(path: str | os.PathLike[str]) -> Truth:
    """Reads a truth file: ``frame,target,tx,ty,tz,rx,ry,rz`` and further columns of numbers, in any order.

    Raises:
        ConfigError: the file is missing or not text, a column is missing or given twice, a row has another number of
            fields than the header, or a field is not a number.
    """
    try:
        header, *rows = csv.reader(io.StringIO(read_text(path, most=MOST_TABLE_BYTES)))
    except csv.Error as error:
        raise ConfigError(f"{path}: file: is no table ({error}); give a truth file") from None
    for name in (*NAMES, *POSE):
        if name not in header:
            raise ConfigError(f"{path}: {name}: column is missing; the header needs {','.join((*NAMES, *POSE))}")
    for name in header:
        if header.count(name) > 1:
            raise ConfigError(f"{path}: {name}: column is given twice; keep one")
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ConfigError(f"{path}: line {line}: has {len(row)} fields; give {len(header)}, as in the header")
    cells = dict(zip(header, zip(*rows, strict=True) if rows else itertools.repeat(()), strict=False))
    with within(f"{path}: "):
        columns = {name: _COLUMNS.get(name, _NUMBER).read(name, cells[name]) for name in header}
    frame, target = columns.pop("frame"), columns.pop("target")
    numbers = {name: torch.tensor(column, dtype=torch.float64) for name, column in columns.items()}
    pose = torch.stack([numbers.pop(name) for name in POSE], 1)
    return Truth(frame, target, pose[:, :3], pose[:, 3:], numbers)
