"""Blurs as covariances, and what they make of edges, against sampled pictures and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.exact import F64
from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import Edge, Kind, Spread

SIGMAS = st.floats(0.2, 8.0)


def matrix(blur: Tensor) -> Tensor:
    s11, s12, s22 = blur.unbind(-1)
    return torch.stack([s11, s12, s12, s22], -1).unflatten(-1, (2, 2))


def turned(minor: float, major: float, angle: float) -> Tensor:
    """Blur (1, 3) of these standard deviations, the major one at an angle from u."""
    axis = torch.tensor([math.cos(angle), math.sin(angle)], dtype=F64)
    found = minor**2 * torch.eye(2, dtype=F64) + (major**2 - minor**2) * torch.outer(axis, axis)
    return found.flatten()[[0, 1, 3]][None]


@settings(deadline=None)
@given(SIGMAS, SIGMAS, st.floats(0, math.pi), st.floats(0, math.pi))
def test_of_a_matrix(one: float, other: float, angle: float, way: float) -> None:
    minor, major = sorted((one, other))
    blur = turned(minor, major, angle)
    values = torch.linalg.eigvalsh(matrix(blur))
    torch.testing.assert_close(torch.stack(blurs.axes(blur), -1), values, rtol=1e-9, atol=1e-9)
    normal = torch.tensor([math.cos(way), math.sin(way)], dtype=F64)
    expected = normal @ matrix(blur)[0] @ normal
    torch.testing.assert_close(blurs.across(blur, normal[0], normal[1])[0], expected, rtol=1e-9, atol=1e-9)
    assert float(blurs.size(blur)) == pytest.approx(math.sqrt(minor * major))
    kept = blurs.limited(blur, 0.5, 30.0)
    torch.testing.assert_close(torch.linalg.eigvalsh(matrix(kept)), values.clamp(0.5, 30.0), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(blurs.enlarged(blurs.reduced(blur, 4), 4), blur, rtol=1e-9, atol=1e-9)


def picture_of(kind: Kind, values: Tensor, radius: float, at: Tensor) -> Tensor:
    """Share outside of a disc about the origin at points (P, 2), by averaging over a sampled point-spread function."""
    core = math.sqrt(values[0])
    if kind == "gauss":  # a grid of narrow Gaussians
        core = 0.35
        x = torch.linspace(-5, 5, 141, dtype=F64)
        w = torch.exp(-0.5 * x.square())
        root = torch.linalg.cholesky(matrix(values[None])[0] - core**2 * torch.eye(2, dtype=F64))
        shift = torch.cartesian_prod(x, x) @ root.T
        share = torch.cartesian_prod(w, w).prod(-1) / w.sum() ** 2
    elif kind == "line":
        place = (torch.arange(800, dtype=F64) + 0.5) / 800 - 0.5
        shift, share = place[:, None] * values[1:], torch.full((800,), 1 / 800, dtype=F64)
    else:
        grid = (torch.arange(81, dtype=F64) + 0.5) / 40.5 - 1
        shift = torch.cartesian_prod(grid, grid)
        shift = shift[shift.norm(dim=-1) < 1] * values[1]
        share = torch.full((len(shift),), 1 / len(shift), dtype=F64)
    # a narrow core: the law of the exact circle along its own radius, to second order beside it
    off = torch.linalg.vector_norm(at[:, None] + shift, dim=-1)
    return (share * torch.special.ndtr((off - radius + core**2 / (2 * off)) / core)).sum(-1)


@pytest.mark.parametrize(
    ("kind", "values", "tolerance"),
    [
        ("gauss", (1.0, 0.0, 1.0), 0.001),
        ("gauss", (1.5, 1.2, 3.0), 0.001),
        ("gauss", (4.0, 0.0, 14.0), 0.002),
        ("line", (0.5, 5.0, 2.0), 0.001),
        ("line", (0.5, 0.0, 11.0), 0.003),
        ("disc", (0.4, 2.0, 0.0), 0.001),
        ("disc", (0.4, 7.0, 0.0), 0.002),
    ],
)
def test_edges_of_a_disc(kind: Kind, values: tuple[float, float, float], tolerance: float) -> None:
    """Pixels beside a circle of 30 px in all directions; what is left is of second order in the curvature."""
    numbers, radius = torch.tensor(values, dtype=F64), 30.0
    angle = torch.arange(24, dtype=F64) * (2 * math.pi / 24)
    off = torch.linspace(-12, 12, 25, dtype=F64)
    nu, nv = (f.repeat_interleave(25)[None] for f in (angle.cos(), angle.sin()))
    distance = off.repeat(24)[None]
    at = torch.stack([nu, nv], -1)[0] * (radius + distance)[0, :, None]
    expected = picture_of(kind, numbers, radius, at)
    # the blur as it is, without the square of a pixel
    edge = Spread(numbers[None], kind).at(torch.zeros(1, dtype=torch.int64), nu.float(), nv.float())
    found = edge(distance.float(), 1 / (radius + distance).float())
    assert (found.fraction[0] - expected).abs().max() < tolerance


@pytest.mark.parametrize(
    ("kind", "values", "tolerance"), [("line", (0.6, 8.5, 8.5), 0.001), ("disc", (0.6, 9.0, 0.0), 0.004)]
)
def test_edges_of_a_small_disc_under_a_wide_blur_lie_where_they_are(
    kind: Kind, values: tuple[float, float, float], tolerance: float
) -> None:
    """Mean displacement of the model's edges beside a circle of 18 px: to second order alone 0.0011 and 0.031 px."""
    numbers, radius = torch.tensor(values, dtype=F64), 18.0
    off, angle = torch.linspace(-10, 14, 25, dtype=F64), torch.arange(8, dtype=F64) * (math.pi / 4)
    nu, nv = (f.repeat_interleave(25)[None] for f in (angle.cos(), angle.sin()))
    distance = off.repeat(8)[None]
    expected = picture_of(kind, numbers, radius, torch.stack([nu, nv], -1)[0] * (radius + distance)[0, :, None])
    edge = Spread(numbers[None], kind).at(torch.zeros(1, dtype=torch.int64), nu.float(), nv.float())
    found = edge(distance.float(), 1 / (radius + distance).float())
    shift = ((found.fraction - expected) * found.by_distance).sum() / found.by_distance.square().sum()
    assert abs(float(shift)) < tolerance


@pytest.mark.parametrize(
    ("kind", "values"), [("gauss", (1.5, 0.4, 3.0)), ("line", (0.6, 5.0, 2.0)), ("disc", (0.6, 4.0, 0.0))]
)
def test_derivatives_of_edges(kind: Kind, values: tuple[float, float, float]) -> None:
    g = torch.Generator().manual_seed(1)
    angle = 6.3 * torch.rand(1, 60, generator=g)
    nu, nv = angle.cos(), angle.sin()
    distance, bend = 6 * torch.rand(1, 60, generator=g) - 3, torch.full((1, 60), 0.05)

    def edge(numbers: Tensor, distance: Tensor) -> Tensor:
        return Spread(numbers[None], kind).at(torch.zeros(1, dtype=torch.int64), nu, nv)(distance, bend).fraction

    numbers = torch.tensor(values, dtype=F64)
    found = Spread(numbers[None], kind).at(torch.zeros(1, dtype=torch.int64), nu, nv)(distance, bend)
    step = 0.02
    by_distance = (edge(numbers, distance + step) - edge(numbers, distance - step)) / (2 * step)
    torch.testing.assert_close(found.by_distance, by_distance, rtol=0, atol=2e-3)
    for k in range(2 if kind == "disc" else 3):
        move = torch.zeros(3, dtype=F64)
        move[k] = step
        by_number = (edge(numbers + move, distance) - edge(numbers - move, distance)) / (2 * step)
        torch.testing.assert_close(found.by_blur[k], by_number, rtol=0, atol=5e-3)  # skewness is taken as given


@pytest.mark.parametrize(("kind", "values"), [("line", (4.0, 5.0, 2.0)), ("disc", (4.0, 5.0, 0.0))])
def test_a_wider_core_moves_a_curved_edge(kind: Kind, values: tuple[float, float, float]) -> None:
    """Derivatives by the core where it is wide and the edge is bent, by finite differences."""
    g = torch.Generator().manual_seed(1)
    angle, distance = 6.3 * torch.rand(1, 60, generator=g), 6 * torch.rand(1, 60, generator=g) - 3
    nu, nv, bend = angle.cos(), angle.sin(), torch.full((1, 60), 0.1)

    def edge(core: float) -> Edge:
        numbers = torch.tensor([[core, *values[1:]]], dtype=F64)
        return Spread(numbers, kind).at(torch.zeros(1, dtype=torch.int64), nu, nv)(distance, bend)

    step = 0.05
    by_core = (edge(values[0] + step).fraction - edge(values[0] - step).fraction) / (2 * step)
    torch.testing.assert_close(edge(values[0]).by_blur[0], by_core, rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", ["gauss", "line", "disc"])
def test_a_spread_has_the_covariance_it_was_made_of(kind: Kind) -> None:
    blur = torch.cat([turned(0.8, 3.0, 1.0), turned(1.0, 2.0, 2.5)])
    if kind == "disc":
        blur = blurs.isotropic(torch.tensor([1.5, 4.0], dtype=F64))
    torch.testing.assert_close(Spread.of(blur, kind).covariance, blur, rtol=1e-9, atol=1e-9)


def test_steps_of_a_spread_stay_a_blur() -> None:
    start = Spread(turned(0.5, 0.6, 0.3))
    moved = start.moved(torch.tensor([[-50.0, 30.0, -60.0]], dtype=F64))
    assert blurs.axes(moved.values)[0] >= 0.3**2 - 1e-12


@pytest.mark.parametrize("sigma", [0.9, 1.25, 2.0])
def test_steps_come_to_rest_at_a_blur_that_is_no_disc(sigma: float) -> None:
    """Gauss-Newton on noisy edges under a Gaussian: the disc shrinks to nothing, and the sum is known all the way."""
    count, pixels = 20, 300
    g = torch.Generator().manual_seed(2)
    distance = (10 * torch.rand(count, pixels, generator=g) - 5).double()
    shown = 0.5 * torch.erfc(-distance / (sigma * math.sqrt(2))) + 0.015 * torch.randn(count, pixels, generator=g)
    row, flat = torch.arange(count), torch.zeros(count, pixels)
    spread = Spread.of(blurs.isotropic(torch.full((count,), sigma, dtype=F64)), "disc")
    for _ in range(12):
        edge = spread.at(row, flat, flat)(distance.float(), flat)
        jacobian = torch.stack(edge.by_blur[:2], -1).double()
        information = jacobian.mT @ jacobian + 1e-4 * 0.015**2 * torch.eye(2, dtype=F64)
        right = jacobian.mT @ (shown - edge.fraction)[..., None]
        step = torch.linalg.solve(information, right).squeeze(-1)
        spread = spread.moved(torch.nn.functional.pad(step, (0, 1)))
        assert ((spread.covariance[:, 0] / sigma**2 - 1).abs() < 0.3).all()
    assert (spread.covariance[:, 0] / sigma**2 - 1).abs().mean() < 0.04
