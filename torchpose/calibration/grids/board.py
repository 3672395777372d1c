"""A flat board of equal discs or rings on a grid, as people print them for OpenCV and others."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.errors import ConfigError

GRID_EXAMPLES = (
    "circles:7x6:20mm (columns, rows, pitch), acircles:4x11:20mm (OpenCV's asymmetric grid) or "
    "rings:10x7:20mm:6mm:3mm (columns, rows, pitch, radii)"
)
# up to three digits a side and six a length: a thousand marks across, a kilometre
_LENGTH = r"(\d{1,6}\.?\d{0,9}|\.\d{1,9})(?:mm)?"
_GRID = re.compile(rf"(circles|acircles|rings):(\d{{1,3}})x(\d{{1,3}}):{_LENGTH}(?::{_LENGTH}:{_LENGTH})?")
_LEAST_SIDE = 3  # marks across and down: fewer leave the tilt of a view open

Kind = Literal["circles", "acircles", "rings"]


@dataclass(frozen=True)
class Grid:
    """Equal marks on a grid, dark on light or light on dark.

    All kinds are parts of a square lattice; that of ``acircles`` is turned by 45 degrees against the board.

    Attributes:
        kind: discs on a square grid; discs in OpenCV's asymmetric grid, every second row moved by one pitch; rings.
        columns: marks of a row.
        rows: of marks.
        pitch: mm, from column to column; of ``acircles`` from row to row, and half of it from mark to mark in a row.
        radii: outer and inner, mm, of rings; None of discs, whose size is not needed.
    """

    kind: Kind
    columns: int
    rows: int
    pitch: float
    radii: tuple[float, float] | None = None

    @classmethod
    def parse(cls, text: str) -> Grid | None:
        """``circles:7x6:20mm``, ``acircles:4x11:20mm`` or ``rings:10x7:20mm:6mm:3mm``; None for another word in front.

        Raises:
            ConfigError: it is no such board.
        """
        if text.split(":")[0] not in ("circles", "acircles", "rings"):
            return None
        found = _GRID.fullmatch(text)
        if not found or (found[5] is None) == (found[1] == "rings"):
            raise ConfigError(f"--board: {text}: is no grid; write {GRID_EXAMPLES}")
        columns, rows, pitch = int(found[2]), int(found[3]), float(found[4])
        grid = cls(cast(Kind, found[1]), columns, rows, pitch, (float(found[5]), float(found[6])) if found[5] else None)
        if min(columns, rows) < _LEAST_SIDE or pitch <= 0:
            raise ConfigError(f"--board: {text}: needs 3 x 3 marks and a pitch above 0 mm; take a larger board")
        if grid.radii is not None and not 0 < grid.radii[1] < grid.radii[0] < pitch / 2:
            raise ConfigError(
                f"--board: {text}: give the outer radius, below half the pitch, and then the smaller inner one, in mm"
            )
        return grid

    @property
    def name(self) -> str:
        return f"{self.kind}:{self.columns}x{self.rows}"

    @property
    def spacing(self) -> float:
        """Distance between neighbours of the square lattice, mm."""
        return self.pitch * 2**0.5 if self.kind == "acircles" else self.pitch

    @cached_property
    def lattice(self) -> Int[Tensor, "P 2"]:
        """Places of the marks, row by row, in the square lattice, from 0."""
        row, column = torch.meshgrid(torch.arange(self.rows), torch.arange(self.columns), indexing="ij")
        at = torch.stack([column, row], -1).flatten(0, 1)
        if self.kind == "acircles":
            x, y = 2 * at[:, 0] + at[:, 1] % 2, at[:, 1]
            at = torch.stack([(x + y) // 2, (y - x) // 2], -1)  # x = first - second, y = first + second
        return at - at.amin(0)

    @cached_property
    def points(self) -> Float[Tensor, "P 3"]:
        """Centres of the marks, row by row, mm: x along the rows, y down, z into the board."""
        row, column = torch.meshgrid(torch.arange(self.rows), torch.arange(self.columns), indexing="ij")
        x = 2 * column + row % 2 if self.kind == "acircles" else column
        return self.pitch * torch.stack([x, row, torch.zeros_like(row)], -1).flatten(0, 1).double()

    @cached_property
    def map(self) -> Int[Tensor, "h w"]:
        """Number of the mark at each place (second, first) of the lattice, -1 where there is none."""
        size = self.lattice.amax(0) + 1
        numbers = torch.full((int(size[1]), int(size[0])), -1)
        numbers[self.lattice[:, 1], self.lattice[:, 0]] = torch.arange(len(self.lattice))
        return numbers

    @cached_property
    def symmetries(self) -> Bool[Tensor, " 4"]:
        """Which quarter turns leave the grid as it is."""
        return torch.tensor([self._looks_like(torch.rot90(self.map >= 0, k)) for k in range(4)])

    def _looks_like(self, turned: Tensor) -> bool:
        return turned.shape == self.map.shape and bool((turned == (self.map >= 0)).all())
