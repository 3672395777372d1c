"""The truth of simulated frames: one CSV row per frame and target."""

import csv
import io
import itertools
import os
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.config import format_number, read_text, write_text
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

NAMES = ("frame", "target")
POSE = ("tx", "ty", "tz", "rx", "ry", "rz")


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
    header, *rows = csv.reader(io.StringIO(read_text(path)))
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
    columns = {name: _numbers(path, name, cells[name]) for name in header if name not in NAMES}
    pose = torch.stack([columns.pop(name) for name in POSE], 1)
    return Truth(list(cells["frame"]), list(cells["target"]), pose[:, :3], pose[:, 3:], columns)


def _numbers(path: str | os.PathLike[str], name: str, cells: tuple[str, ...]) -> Tensor:
    numbers = []
    for line, cell in enumerate(cells, 2):
        try:
            numbers.append(float(cell))
        except ValueError:
            raise ConfigError(f"{path}: {name}: {cell!r} in line {line} is not a number; write one") from None
    return torch.tensor(numbers, dtype=torch.float64)
