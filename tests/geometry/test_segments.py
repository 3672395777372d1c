"""Ragged sums against plain Python over the groups."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.geometry.segments import ragged_arange, rank_in_group, segment_mean, segment_sum

no_deadline = settings(deadline=None)
groups = st.lists(st.integers(0, 5), max_size=40)


@no_deadline
@given(groups)
def test_sum_and_mean(members):
    index = torch.tensor(members, dtype=torch.int64)
    values = torch.arange(2.0 * len(members), dtype=torch.float64).reshape(-1, 2).sin()
    weights = torch.arange(len(members), dtype=torch.float64).cos() + 2
    total, mean = segment_sum(values, index, 6), segment_mean(values, index, 6, weights)
    for g in range(6):
        rows, w = values[index == g], weights[index == g]
        torch.testing.assert_close(total[g], rows.sum(0))
        expected = (rows * w[:, None]).sum(0) / w.sum() if len(rows) else torch.full((2,), torch.nan).double()
        torch.testing.assert_close(mean[g], expected, equal_nan=True)


def test_sum_is_differentiable():
    values = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    index = torch.tensor([2, 0, 2, 1, 0, 0, 2])
    assert torch.autograd.gradcheck(lambda v: segment_sum(v, index, 4), values)


@no_deadline
@given(st.lists(st.integers(0, 7), max_size=12))
def test_ragged_arange(sizes):
    group, position = ragged_arange(torch.tensor(sizes, dtype=torch.int64))
    expected = [(g, k) for g, size in enumerate(sizes) for k in range(size)]
    assert list(zip(group.tolist(), position.tolist(), strict=True)) == expected


@no_deadline
@given(groups)
def test_rank_in_group(members):
    rank = rank_in_group(torch.tensor(members, dtype=torch.int64), 6)
    assert rank.tolist() == [members[:i].count(g) for i, g in enumerate(members)]
