"""Sums over ragged groups: flat values (E, ...) with a group index (E,), the convention of every flat result here."""

from __future__ import annotations

import torch
from torch import Tensor


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
