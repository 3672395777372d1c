"""Sums over ragged groups: flat values (E, ...) with a group index (E,), the convention of every flat result here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, Real, Shaped
from torch import Tensor

_MOST_ROWS = 4096  # of a grid of near points: more would cost more than they save


def values_at(frames: Real[Tensor, "B H W"], cell: Int[Tensor, "*S"]) -> Float32[Tensor, "*S"]:
    """Values at flat positions of contiguous frames, in a third of the time of `frames[cell]`."""
    flat = frames.reshape(-1)
    wide = flat.dtype == torch.uint16  # which index_select does not know
    found = (flat.view(torch.int16) if wide else flat).index_select(0, cell.flatten())
    return (found.view(torch.uint16) if wide else found).view_as(cell).float()


def as_array(values: Tensor) -> np.ndarray | None:
    """A tensor's values without a copy, for calls that cost a fraction of torch's where there are few of them.

    None on other devices, and within torch's function transforms (`torch.func.grad`), where there are none to look at.
    """
    if values.device.type != "cpu":
        return None
    try:
        return values.numpy()
    except RuntimeError:
        return None


def positions(mask: Bool[Tensor, " E"]) -> Int[Tensor, " K"]:
    """Where a mask is True, rising; NumPy searches several times as fast as torch."""
    if (known := as_array(mask)) is not None:
        return torch.from_numpy(np.flatnonzero(known))
    return mask.nonzero()[:, 0]


def marked(index: Int[Tensor, " K"], count: int) -> Bool[Tensor, " count"]:
    """The mask that is True at these positions, which may repeat."""
    return torch.zeros(count, dtype=torch.bool, device=index.device).index_fill_(0, index, True)


def segment_sum(values: Shaped[Tensor, "E ..."], index: Int[Tensor, " E"], count: int) -> Shaped[Tensor, "count ..."]:
    """Sums of the rows of ``values`` that share an ``index`` in [0, count)."""
    if count == 1:
        return values.sum(0, keepdim=True, dtype=values.dtype)
    out = torch.zeros(count, *values.shape[1:], dtype=values.dtype, device=values.device)
    return out.index_add(0, index, values)


def run_sums(values: Float64[Tensor, "N E"], size: Int[Tensor, " count"]) -> Float64[Tensor, "N count"]:
    """Sums of runs of so many values that follow each other, none of them empty; NumPy adds them as they lie."""
    if values.device.type == "cpu":
        if size.numel() == 0:
            return values[:, :0]
        return torch.from_numpy(np.add.reduceat(values.numpy(), (size.cumsum(0) - size).numpy(), axis=1))
    group = torch.repeat_interleave(size, output_size=values.shape[1])
    return values.new_zeros(len(values), size.numel()).index_add_(1, group, values)


def segment_mean(
    values: Shaped[Tensor, "E ..."], index: Int[Tensor, " E"], count: int, weights: Shaped[Tensor, " E"] | None = None
) -> Shaped[Tensor, "count ..."]:
    """Weighted means of the groups; NaN for an empty group."""
    w = torch.ones_like(index, dtype=values.dtype) if weights is None else weights
    w_column = w.reshape(-1, *[1] * (values.ndim - 1))
    total = segment_sum(w, index, count).reshape(-1, *[1] * (values.ndim - 1))
    return segment_sum(values * w_column, index, count) / total


@dataclass(frozen=True, eq=False)
class Tiles:
    """Flat values laid out in K tiles of one group each, padded: sums of many columns become small matrix products.

    `segment_sum` adds row by row, which costs most where the columns are many and the groups few.
    """

    order: Int[Tensor, " E"] | None  # which value comes first, second, ...; None where they are sorted by group already
    place: Int[Tensor, " E"]  # where in the tiles each value goes
    group: Int[Tensor, " K"]  # of each tile
    count: int  # of groups
    size: int  # places of a tile

    @classmethod
    def of(cls, index: Int[Tensor, " E"], count: int, size: int = 32) -> Tiles:
        """Tiles for the groups ``index`` in [0, count)."""
        if (known := as_array(index)) is not None:
            return cls._by_numpy(known, count, size)
        order = None
        if bool((index[1:] < index[:-1]).any()):
            index, order = index.sort(stable=True)
        sizes = torch.bincount(index, minlength=count)
        tiles = (sizes + size - 1) // size
        skip = size * (tiles.cumsum(0) - tiles) - (sizes.cumsum(0) - sizes)
        place = torch.arange(index.numel(), device=index.device) + skip.index_select(0, index)
        return cls(order, place, torch.repeat_interleave(tiles), count, size)

    @classmethod
    def _by_numpy(cls, index: np.ndarray, count: int, size: int) -> Tiles:
        """The same, in calls that cost a fraction of torch's where there are few values."""
        order = None
        if (index[1:] < index[:-1]).any():
            order = index.argsort(kind="stable")
        sizes = np.bincount(index, minlength=count)
        tiles = (sizes + size - 1) // size
        skip = size * (tiles.cumsum() - tiles) - (sizes.cumsum() - sizes)
        place = np.arange(len(index)) + skip.repeat(sizes)
        given = None if order is None else torch.from_numpy(order)
        return cls(given, torch.from_numpy(place), torch.from_numpy(np.arange(count).repeat(tiles)), count, size)

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


def ragged_arange(counts: Int[Tensor, " K"]) -> tuple[Int[Tensor, " E"], Int[Tensor, " E"]]:
    """Flat enumeration of groups of the given sizes: the group of each element and its position in the group."""
    if (size := as_array(counts)) is not None:
        which = np.arange(len(size)).repeat(size)
        offset = np.arange(len(which)) - (size.cumsum() - size).repeat(size)
        return torch.from_numpy(which), torch.from_numpy(offset)
    total = int(counts.sum())
    group = torch.repeat_interleave(counts, output_size=total)
    starts = counts.cumsum(0) - counts
    return group, torch.arange(total, device=counts.device) - starts[group]


def rank_in_group(
    group: Int[Tensor, " E"], count: int = 0, *, by: Real[Tensor, " E"] | None = None
) -> Int[Tensor, " E"]:
    """Position of each element among those of its group, by rising ``by`` and then in order of appearance."""
    if (own := as_array(group)) is not None:
        turn = own.argsort(kind="stable") if by is None else np.lexsort((by.detach().numpy(), own))
        size = np.bincount(own, minlength=count)
        rank = np.empty_like(own)
        rank[turn] = np.arange(len(own)) - (size.cumsum() - size)[own[turn]]
        return torch.from_numpy(rank)
    order = torch.argsort(group if by is None else by, stable=True)
    if by is not None:
        order = order[torch.argsort(group[order], stable=True)]
    sizes = torch.bincount(group, minlength=count)
    starts = sizes.cumsum(0) - sizes
    return torch.empty_like(group).scatter_(
        0, order, torch.arange(group.numel(), device=group.device) - starts[group[order]]
    )


def members(size: Int[Tensor, " K"], group: Int[Tensor, " P"]) -> tuple[Int[Tensor, " E"], Int[Tensor, " E"]]:
    """Elements of the groups asked for, all sorted by group: for each its place in ``group`` and its own index."""
    which, offset = ragged_arange(size[group])
    return which, (size.cumsum(0) - size)[group][which] + offset


def pairs_in_group(first: Int[Tensor, " E"], second: Int[Tensor, " F"]) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """All pairs (i, j) of the same group: first[i] == second[j]; ``second`` is sorted."""
    return members(torch.bincount(second, minlength=int(first.max()) + 1 if first.numel() else 0), first)


def earlier_in_group(group: Int[Tensor, " E"]) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """All pairs (i, j) of the same group with j < i; ``group`` is sorted."""
    size = torch.bincount(group)
    start = (size.cumsum(0) - size)[group]
    i, offset = ragged_arange(torch.arange(len(group), device=group.device) - start)
    return i, start[i] + offset


def near_pairs(
    first: Float64[Tensor, "E 2"],
    second: Float64[Tensor, "F 2"],
    reach: Float64[Tensor, " E"],
    groups: tuple[Int[Tensor, " E"], Int[Tensor, " F"]],
) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """All pairs (i, j) of the same group of which neither coordinate differs by more than reach[i], and few others.

    Points may be NaN, which are near nothing. The second points are laid in rows of about the usual reach, sorted along
    each: what is near a first point is one run in each of the rows that it reaches. So the work grows with the pairs
    found, not with the square of the points.
    """
    if not len(first) * len(second) // (4 * _MOST_ROWS):  # each pair is looked at sooner than a hundred calls are made
        away = (first[:, None] - second).abs().amax(-1)
        i, j = ((away <= reach[:, None]) & (groups[0][:, None] == groups[1])).nonzero().unbind(-1)
        return i, j
    sound, known = positions((first.sum(-1) + reach).isfinite()), positions(second.isfinite().all(-1))
    if sound.numel() == 0 or known.numel() == 0:
        return sound[:0], known[:0]
    (x, y), span = first[sound].unbind(-1), reach[sound]
    other_x, other_y = second[known].unbind(-1)
    left, top = other_x.amin(), other_y.amin()
    x, y, other_x, other_y = x - left, y - top, other_x - left, other_y - top
    width, height = float(other_x.amax()) + 1, float(other_y.amax())
    step = max(2 * float(span.median()), height / _MOST_ROWS, 1e-9)
    rows = int(height / step) + 1

    def place(group: Tensor, row: Tensor, along: Tensor) -> Tensor:
        return (group * rows + row) * width + along

    key, order = place(groups[1][known], (other_y / step).long(), other_x).sort()
    upper = ((y - span) / step).floor().clamp(0, rows - 1).long()
    lower = ((y + span) / step).floor().clamp(0, rows - 1).long()
    i, down = ragged_arange(lower - upper + 1)
    group, row = groups[0][sound[i]], upper[i] + down
    slack = 1e-15 * float(key[-1])  # what the keys' rounding could hide
    from_left = torch.searchsorted(key, place(group, row, (x - span)[i].clamp(0, width - 0.5) - slack))
    to_right = torch.searchsorted(key, place(group, row, (x + span)[i].clamp(0, width - 0.5) + slack), right=True)
    run, offset = ragged_arange((to_right - from_left).clamp_min(0))
    return sound[i[run]], known[order[from_left[run] + offset]]
