"""A flat board of equal discs or rings on a grid, as people print them for OpenCV and others."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self, cast

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
_GRID = re.compile(rf"(circles|acircles|rings):(\d{{1,3}})x(\d{{1,3}}):{_LENGTH}(?::{_LENGTH})?(?::{_LENGTH})?")
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
        radii: outer and inner, mm, of rings; outer and 0 of discs, None where their size is not said: it is not needed
            to find them.
        missing: numbers of marks that the board does not have.
        upright: whether it is taken to have its rows to the right, within 90 degrees (a square one within 45), where it
            looks the same after a turn; no file says so.
    """

    kind: Kind
    columns: int
    rows: int
    pitch: float
    radii: tuple[float, float] | None = None
    missing: tuple[int, ...] = ()
    upright: bool = False

    @classmethod
    def parse(cls, text: str) -> Grid | None:
        """``circles:7x6:20mm``, ``acircles:4x11:20mm`` or ``rings:10x7:20mm:6mm:3mm``; None for another word in front.

        The radius of discs may follow: ``circles:7x6:20mm:4mm``.

        Raises:
            ConfigError: it is no such board.
        """
        if not cls.names(text):
            return None
        found = _GRID.fullmatch(text)
        if not found or (found[6] is None) == (found[1] == "rings"):
            raise ConfigError(f"{text}: is no grid; write {GRID_EXAMPLES}")
        columns, rows, pitch = int(found[2]), int(found[3]), float(found[4])
        radii = (float(found[5]), float(found[6] or 0.0)) if found[5] else None
        grid = cls(cast(Kind, found[1]), columns, rows, pitch, radii)
        if min(columns, rows) < _LEAST_SIDE or pitch <= 0:
            raise ConfigError(f"{text}: needs 3 x 3 marks and a pitch above 0 mm; take a larger board")
        if grid.radii is not None:
            _check_radii(text, grid, grid.radii)
        return grid

    @staticmethod
    def names(text: str) -> bool:
        """Whether a text begins as that of a grid does."""
        return text.split(":")[0] in ("circles", "acircles", "rings")

    def __str__(self) -> str:
        """As `parse` reads it."""
        sizes = (self.pitch, *(self.radii or ()))
        return ":".join([self.name, *(f"{size:.15g}mm" for size in sizes if size)])

    def __len__(self) -> int:
        """Number of marks."""
        return self.columns * self.rows - len(self.missing)

    @property
    def name(self) -> str:
        return f"{self.kind}:{self.columns}x{self.rows}"

    @property
    def discs(self) -> bool:
        return self.kind != "rings"

    def without(self, missing: tuple[int, ...]) -> Self:
        """The board that lacks these marks."""
        return replace(self, missing=missing)

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
        there = torch.ones(len(self.lattice), dtype=torch.bool)
        there[list(self.missing)] = False
        numbers = torch.where(there, torch.arange(len(there)), -1)
        return torch.where(self._every >= 0, numbers[self._every], -1)

    @cached_property
    def symmetries(self) -> Bool[Tensor, " 4"]:
        """Which quarter turns leave the whole grid, with the marks that are missing, as it is."""
        there = self._every >= 0
        turned = (torch.rot90(there, k) for k in range(4))
        return torch.tensor([one.shape == there.shape and bool((one == there).all()) for one in turned])

    @cached_property
    def turns(self) -> Int[Tensor, "S P"]:
        """Numbers that the marks, row by row, have after each of the turns of `symmetries` but the first."""
        every = self._every
        numbers = torch.arange(len(self.lattice)).repeat(4, 1)
        for k in self.symmetries.nonzero()[:, 0].tolist():
            numbers[k, every[every >= 0]] = torch.rot90(every, k)[every >= 0]
        return numbers[1:][self.symmetries[1:]]

    @cached_property
    def _every(self) -> Int[Tensor, "h w"]:
        """As `map`, with the marks that are missing."""
        size = self.lattice.amax(0) + 1
        numbers = torch.full((int(size[1]), int(size[0])), -1)
        numbers[self.lattice[:, 1], self.lattice[:, 0]] = torch.arange(len(self.lattice))
        return numbers


def _check_radii(text: str, grid: Grid, radii: tuple[float, float]) -> None:
    """
    Raises:
        ConfigError: marks that are none, or touch.
    """
    outer, inner = radii
    if not grid.discs and not 0 < inner < outer < grid.pitch / 2:
        raise ConfigError(f"{text}: give the outer radius, below half the pitch, and then the smaller inner one, in mm")
    if grid.discs and not 0 < outer < grid.spacing / 2:
        raise ConfigError(f"{text}: give a radius below half the distance of the discs, in mm")
