"""Gradient, noise threshold and region growing against SciPy and single frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as scipy_components

from torchpose.detect.regions import (
    Gradient,
    Regions,
    connected_components,
    gradient,
    level_line_regions,
    region_polarity,
    strong_cells,
)


def regions_of(grad: Gradient, min_pixels: int) -> Regions:
    return level_line_regions(grad, strong_cells(grad), min_pixels)


def gradient_at(grad: Gradient, cells: torch.Tensor) -> torch.Tensor:
    return torch.stack(grad.components(cells), -1)


def discs(count: int = 3, size: int = 64, noise: float = 2.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Blurred dark discs of random place and radius on light ground, one a frame."""
    generator = torch.Generator().manual_seed(1)
    center = 24 + 16 * torch.rand(count, 2, generator=generator)
    radius = 6 + 12 * torch.rand(count, generator=generator)
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    distance = torch.hypot(x - center[:, 0, None, None], y - center[:, 1, None, None]) - radius[:, None, None]
    frames = 40 + 160 * torch.sigmoid(2 * distance) + noise * torch.randn(count, size, size, generator=generator)
    return frames, center, radius


@settings(deadline=None)
@given(st.integers(0, 60), st.integers(0, 120), st.integers(0, 2**31))
def test_components_equal_scipy(nodes: int, edges: int, seed: int) -> None:
    edges = edges if nodes else 0
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.randint(0, max(nodes, 1), (2, edges), generator=generator)
    label = connected_components(a, b, nodes)
    expected = torch.zeros(0, dtype=torch.int64)
    if nodes:
        graph = coo_matrix((np.ones(edges), (a.numpy(), b.numpy())), (nodes, nodes))
        number, member = scipy_components(graph, directed=False)
        smallest = torch.tensor([np.flatnonzero(member == k)[0] for k in range(number)])
        expected = smallest[torch.from_numpy(member).long()]
    assert torch.equal(label, expected)


@pytest.mark.parametrize("shuffled", [False, True])
def test_long_chain(shuffled: bool) -> None:
    n = 5000
    order = torch.randperm(n, generator=torch.Generator().manual_seed(2)) if shuffled else torch.arange(n)
    assert not connected_components(order[:-1], order[1:], n).any()


def test_gradient_of_a_ramp() -> None:
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
    grad = gradient((3 * x - 2 * y)[None])
    cells = (torch.arange(8)[:, None] * 11 + torch.arange(10)).flatten()
    torch.testing.assert_close(gradient_at(grad, cells), torch.tensor([3.0, -2.0]).expand(80, 2))
    # the last row and column have none
    assert torch.equal(strong_cells(Gradient(grad.frames, torch.zeros(1))), cells)


def test_threshold_follows_the_noise() -> None:
    generator = torch.Generator().manual_seed(4)
    sigma = torch.tensor([1.0, 4.0, 16.0])
    noise = sigma[:, None, None] * torch.randn(3, 300, 300, generator=generator)
    grad = gradient(noise)
    torch.testing.assert_close(grad.threshold, 3.7 * sigma, rtol=0.03, atol=0)
    cells = torch.arange(noise.numel()).view_as(noise)[:, :-1, :-1]
    strong = torch.zeros_like(noise, dtype=torch.bool)
    g = torch.linalg.vector_norm(gradient_at(grad, cells.flatten()), dim=-1).view_as(cells)
    strong[:, :-1, :-1] = g > grad.threshold[:, None, None]
    assert torch.equal(strong.flatten().nonzero()[:, 0], strong_cells(grad))
    # exp(-3.7^2 / 2) = 1.06e-3 of a Rayleigh distribution
    assert strong.double().mean() == pytest.approx(1.06e-3, rel=0.2)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 500.0), (4.0, 0.0), (257.0, -30.0)])
def test_gain_and_offset_change_nothing(gain: float, offset: float) -> None:
    frames, _, _ = discs(noise=3.0)
    one, other = gradient(frames), gradient(gain * frames + offset)
    torch.testing.assert_close(other.threshold, gain * one.threshold, rtol=1e-3, atol=0)
    a, b = regions_of(one, 10), regions_of(other, 10)
    assert torch.equal(a.cell, b.cell)
    assert torch.equal(a.region, b.region)


def test_quantisation_is_no_region() -> None:
    y, x = torch.meshgrid(torch.arange(100.0), torch.arange(100.0), indexing="ij")
    frames = (100 + 0.05 * x + 0.02 * y).round()[None]
    assert regions_of(gradient(frames), 10).cell.numel() == 0


def test_discs_are_one_region_each() -> None:
    frames, center, radius = discs()
    regions = regions_of(gradient(frames), 10)
    assert regions.frame.tolist() == [0, 1, 2]
    assert torch.equal(torch.bincount(regions.region), torch.bincount(regions.frame[regions.region]))
    inside = regions.cell % (64 * 64)
    xy = torch.stack([inside % 64, inside // 64], -1) + 0.5
    distance = (xy - center[regions.region]).norm(dim=-1) - radius[regions.region]
    assert distance.abs().max() < 3
    assert (region_polarity(regions, center, xy) > 0.9).all()
    inverse = regions_of(gradient(255 - frames), 10)
    assert (region_polarity(inverse, center, xy) < -0.9).all()


def test_batch_equals_single_frames() -> None:
    frames, _, _ = discs()
    together = regions_of(gradient(frames), 5)
    for k in range(3):
        alone = regions_of(gradient(frames[k : k + 1]), 5)
        mine = together.frame[together.region] == k
        assert torch.equal(together.cell[mine] - k * 64 * 64, alone.cell)
        assert torch.equal(together.region[mine] - together.region[mine].min(), alone.region)
        assert torch.equal(together.gradient[mine], alone.gradient)


def test_edges_at_the_border_do_not_wrap_around() -> None:
    """A step in the last column and one in the first of the next row are neighbours in memory only."""
    frames = torch.full((2, 40, 40), 50.0)
    frames[:, :, -1] = 200
    frames[:, :, 0] = 200
    regions = regions_of(gradient(frames), 5)
    assert regions.frame.tolist() == [0, 0, 1, 1]
    for k in range(4):
        assert torch.unique(regions.cell[regions.region == k] % 40).numel() == 1


@pytest.mark.parametrize("shape", [(0, 8, 8), (2, 0, 8), (2, 1, 8), (2, 8, 1), (1, 1, 1), (2, 2, 2)])
def test_tiny_frames(shape: tuple[int, int, int]) -> None:
    regions = regions_of(gradient(torch.rand(shape) * 255), 3)
    assert regions.cell.numel() == regions.frame.numel() == 0


def test_broken_pixels_only_lose_their_own_cells() -> None:
    frames, _, _ = discs()
    whole = regions_of(gradient(frames), 10)
    frames[0, 2, 3], frames[1, 4, 4], frames[2, 60, 60] = torch.nan, torch.inf, -torch.inf
    broken = gradient(frames)
    assert broken.threshold.isfinite().all()
    assert torch.equal(regions_of(broken, 10).cell, whole.cell)
    assert gradient(torch.full((1, 5, 5), torch.nan)).threshold.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_directions_at_the_limit_never_join(dtype: torch.dtype) -> None:
    """(3, 1) beside (3, -1) have the cosine 0.8: rounding would join them at one contrast and not at another."""
    y, x = torch.meshgrid(torch.arange(12), torch.arange(12), indexing="ij")
    cells = (torch.arange(11)[:, None] * 12 + torch.arange(11)).flatten()
    for scale in range(1, 6):
        frame = (scale * (3 * x - (y - 6).abs()) + 40).to(dtype)[None]
        regions = level_line_regions(Gradient(frame, torch.ones(1)), cells, 10)
        assert regions.frame.numel() == 2
        assert regions.cell.numel() == 11 * 11
