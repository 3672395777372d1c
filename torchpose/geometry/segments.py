"""Sums over ragged groups: flat values (E, ...) with a group index (E,), the convention of every flat result here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


def values_at(frames: Tensor, cell: Tensor) -> Tensor:
    """float32 values, of the shape of ``cell``, at flat positions of contiguous frames; a third of `frames[cell]`."""
    flat = frames.reshape(-1)
    wide = flat.dtype == torch.uint16  # which index_select does not know
    found = (flat.view(torch.int16) if wide else flat).index_select(0, cell.flatten())
    return (found.view(torch.uint16) if wide else found).view_as(cell).float()


def positions(mask: Tensor) -> Tensor:
    """Indices (K,) int64, rising, where a flat mask (E,) is True; NumPy searches several times as fast as torch."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]


def segment_sum(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sums (count, ...) of the rows of ``values`` (E, ...) that share an ``index`` (E,) in [0, count)."""
    out = torch.zeros(count, *values.shape[1:], dtype=values.dtype, device=values.device)
    return out.index_add(0, index, values)


def segment_mean(values: Tensor, index: Tensor, count: int, weights: Tensor | None = None) -> Tensor:
    """Weighted means (count, ...) of the groups; NaN for an empty group. ``weights`` is (E,)."""
    w = torch.ones_like(index, dtype=values.dtype) if weights is None else weights
    w_column = w.reshape(-1, *[1] * (values.ndim - 1))
    total = segment_sum(w, index, count).reshape(-1, *[1] * (values.ndim - 1))
    return segment_sum(values * w_column, index, count) / total


@dataclass(frozen=True, eq=False)
class Tiles:
    """Flat values laid out in K tiles of one group each, padded: sums of many columns become small matrix products.

    `segment_sum` adds row by row, which costs most where the columns are many and the groups few.

    Attributes:
        order: (E,) int64, which value comes first, second, ...; None where they are sorted by group already.
        place: (E,) int64, where in the tiles each goes. group: (K,) int64, the group of each tile.
        count: number of groups. size: places of a tile.
    """

    order: Tensor | None
    place: Tensor
    group: Tensor
    count: int
    size: int

    @classmethod
    def of(cls, index: Tensor, count: int, size: int = 32) -> Tiles:
        """Tiles for the groups ``index`` (E,) in [0, count)."""
        order = None
        if bool((index[1:] < index[:-1]).any()):
            index, order = index.sort(stable=True)
        sizes = torch.bincount(index, minlength=count)
        tiles = (sizes + size - 1) // size
        skip = size * (tiles.cumsum(0) - tiles) - (sizes.cumsum(0) - sizes)
        place = torch.arange(index.numel(), device=index.device) + skip.index_select(0, index)
        return cls(order, place, torch.repeat_interleave(tiles), count, size)

    def planes(self, *values: Tensor) -> Tensor:
        """(K, n, size) of n values (E,), 0 where padded."""
        out = values[0].new_zeros(len(values), self.group.numel() * self.size)
        for plane, value in zip(out, values, strict=True):
            plane.scatter_(0, self.place, value if self.order is None else value.index_select(0, self.order))
        return out.view(len(values), -1, self.size).transpose(0, 1)

    def flat(self, plane: Tensor) -> Tensor:
        """The values (E,) of a plane (K, size), in the order they came in."""
        values = plane.flatten().index_select(0, self.place)
        return values if self.order is None else torch.empty_like(values).scatter_(0, self.order, values)

    def sums(self, values: Tensor) -> Tensor:
        """Sums (count, ...) by group of what each tile (K, ...) has."""
        return segment_sum(values, self.group, self.count)


def ragged_arange(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Flat enumeration of groups of the given sizes (K,) int64: group index (E,) and position in the group (E,)."""
    total = counts.sum()
    group = torch.repeat_interleave(counts, output_size=int(total))
    starts = counts.cumsum(0) - counts
    return group, torch.arange(int(total), device=counts.device) - starts[group]


def rank_in_group(group: Tensor, count: int) -> Tensor:
    """Position (E,) of each element among those of its group, in order of appearance; ``group`` need not be sorted."""
    order = torch.argsort(group, stable=True)
    sizes = torch.bincount(group, minlength=count)
    starts = sizes.cumsum(0) - sizes
    rank = torch.empty_like(group)
    rank[order] = torch.arange(group.numel(), device=group.device) - starts[group[order]]
    return rank


def pairs_in_group(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """All pairs (i, j) int64 of the same group: first[i] == second[j]; ``second`` is sorted."""
    sizes = torch.bincount(second, minlength=int(first.max()) + 1 if first.numel() else 0)
    starts = sizes.cumsum(0) - sizes
    i, offset = ragged_arange(sizes[first])
    return i, starts[first[i]] + offset
