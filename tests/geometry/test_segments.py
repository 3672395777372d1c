"""Ragged sums against plain Python over the groups."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.geometry.segments import (
    Tiles,
    near_pairs,
    positions,
    ragged_arange,
    rank_in_group,
    segment_mean,
    segment_sum,
    values_at,
)

no_deadline = settings(deadline=None)
groups = st.lists(st.integers(0, 5), max_size=40)


@no_deadline
@given(groups)
def test_sum_and_mean(members: list[int]) -> None:
    index = torch.tensor(members, dtype=torch.int64)
    values = torch.arange(2.0 * len(members), dtype=torch.float64).reshape(-1, 2).sin()
    weights = torch.arange(len(members), dtype=torch.float64).cos() + 2
    total, mean = segment_sum(values, index, 6), segment_mean(values, index, 6, weights)
    for g in range(6):
        rows, w = values[index == g], weights[index == g]
        torch.testing.assert_close(total[g], rows.sum(0))
        expected = (rows * w[:, None]).sum(0) / w.sum() if len(rows) else torch.full((2,), torch.nan).double()
        torch.testing.assert_close(mean[g], expected, equal_nan=True)


def test_sum_is_differentiable() -> None:
    values = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    index = torch.tensor([2, 0, 2, 1, 0, 0, 2])
    assert torch.autograd.gradcheck(lambda v: segment_sum(v, index, 4), values)


@no_deadline
@given(groups, st.integers(1, 7))
def test_tiles_sum_the_same_and_give_the_values_back(members: list[int], size: int) -> None:
    index = torch.tensor(members, dtype=torch.int64)
    values = torch.arange(2.0 * len(members), dtype=torch.float64).reshape(-1, 2).sin()
    tiles = Tiles.of(index, 6, size)
    planes = tiles.planes(*values.unbind(-1))
    assert planes.shape == (len(tiles.group), 2, size)
    torch.testing.assert_close(tiles.sums(planes.sum(-1)), segment_sum(values, index, 6))
    products = segment_sum(values[:, :, None] * values[:, None], index, 6)
    torch.testing.assert_close(tiles.sums(planes @ planes.mT), products)
    assert torch.equal(torch.stack([tiles.flat(plane) for plane in planes.unbind(1)], -1), values)


@no_deadline
@given(st.lists(st.booleans(), max_size=40))
def test_positions(mask: list[bool]) -> None:
    assert positions(torch.tensor(mask, dtype=torch.bool)).tolist() == [i for i, true in enumerate(mask) if true]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float16, torch.float32, torch.float64])
def test_values_of_every_dtype(dtype: torch.dtype) -> None:
    most = 60_000 if dtype in (torch.uint16, torch.float32, torch.float64) else 250
    frames = torch.linspace(0, most, 60).to(dtype).view(2, 5, 6)
    cell = torch.tensor([[0, 59, 7], [30, 30, 1]])
    found = values_at(frames, cell)
    assert found.dtype == torch.float32
    assert torch.equal(found, frames.float().flatten()[cell])


@no_deadline
@given(st.lists(st.integers(0, 7), max_size=12))
def test_ragged_arange(sizes: list[int]) -> None:
    group, position = ragged_arange(torch.tensor(sizes, dtype=torch.int64))
    expected = [(g, k) for g, size in enumerate(sizes) for k in range(size)]
    assert list(zip(group.tolist(), position.tolist(), strict=True)) == expected


@no_deadline
@given(groups)
def test_rank_in_group(members: list[int]) -> None:
    rank = rank_in_group(torch.tensor(members, dtype=torch.int64), 6)
    assert rank.tolist() == [members[:i].count(g) for i, g in enumerate(members)]


@pytest.mark.parametrize(("reach", "size"), [(0.5, 300), (8.0, 300), (300.0, 300), (300.0, 60)])
@pytest.mark.parametrize("seed", range(5))
def test_near_pairs_are_all_that_are_near(seed: int, reach: float, size: int) -> None:
    generator = torch.Generator().manual_seed(seed)

    def points(count: int) -> torch.Tensor:
        spread = torch.tensor([900.0, 600.0], dtype=torch.float64)
        some = torch.rand(count, 2, generator=generator, dtype=torch.float64) * spread - 40
        # some on whole numbers, some at the same place, some nowhere
        some[::3] = some[::3].round()
        some[1::7] = some[0]
        some[2::11, 1] = torch.nan
        return some

    first, second = points(size), points(size + 100)
    second[: size // 4] = first[: size // 4] + 0.1
    group, other = (torch.randint(0, 3, (n,), generator=generator) for n in (size, size + 100))
    span = reach * torch.rand(size, generator=generator, dtype=torch.float64).pow(3)
    i, j = near_pairs(first, second, span, (group, other))
    near = (first[:, None] - second).abs().amax(-1) <= span[:, None]
    near &= group[:, None] == other
    found = torch.zeros_like(near)
    found[i, j] = True
    assert found.sum() == len(i) > 0  # each once
    assert not (near & ~found).any()
    # what else is there lies no farther off than a row is wide
    beyond = (first[i] - second[j]).abs().amax(-1) - span[i]
    assert (group[i] == other[j]).all()
    assert (beyond <= 2.1 * span.median() + 1).all()


def test_near_pairs_of_nothing() -> None:
    none, one = torch.zeros(0, 2, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    for first, second in ((none, one), (one, none), (none, none)):
        groups = (torch.zeros(len(first), dtype=torch.int64), torch.zeros(len(second), dtype=torch.int64))
        i, j = near_pairs(first, second, torch.ones(len(first), dtype=torch.float64), groups)
        assert len(i) == len(j) == 0
