"""Arcs across gaps, the likelier of two explanations, and what must not change the result."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from torchpose import ellipse
from torchpose.detect import Verdict, find_candidates, find_shapes
from torchpose.detect.arcs import fit_scatter, scatter_sums
from torchpose.geometry import conics
from torchpose.geometry.segments import segment_mean


def polygon(center: tuple[int, int], radius: int, sides: int, turn: float = 0.2) -> np.ndarray:
    angle = turn + 2 * np.pi * np.arange(sides) / sides
    return np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], 1)


def drawn(
    *polygons: np.ndarray,
    size: tuple[int, int] = (200, 300),
    ink: int = 40,
    paper: int = 200,
    blur: float = 0.8,
    noise: float = 1.0,
) -> torch.Tensor:
    picture = np.full(size, paper, np.uint8)
    for corners in polygons:
        cv2.fillPoly(picture, [np.round(np.asarray(corners) * 256).astype(np.int32)], ink, cv2.LINE_AA, 8)
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), blur)
    noisy = smooth + noise * np.random.default_rng(3).standard_normal(size)
    return torch.from_numpy(noisy.round().clip(0, 255).astype(np.uint8))[None]


def disc(u: int, v: int, a: int, b: int | None = None, theta: float = 0.0) -> np.ndarray:
    b = a if b is None else b
    angle = np.linspace(0, 2 * np.pi, 400)
    x, y = a * np.cos(angle), b * np.sin(angle)
    return np.stack([u + math.cos(theta) * x - math.sin(theta) * y, v + math.sin(theta) * x + math.cos(theta) * y], 1)


def fit_joint(xy: torch.Tensor, gradient: torch.Tensor, index: torch.Tensor, count: int) -> torch.Tensor:
    """Ellipses of points that weigh alike, about their means."""
    center = segment_mean(xy, index, count)
    return fit_scatter(scatter_sums(xy, gradient, index, center, torch.ones(len(xy))), center)


@pytest.mark.parametrize("degrees", [60, 90, 150, 360])
@pytest.mark.parametrize("theta", [0.0, 0.9])
def test_joint_fit_of_arcs(degrees: int, theta: float) -> None:
    truth = torch.tensor([[50.0, 40.0, 30.0, 18.0, theta]], dtype=torch.float64)
    angle = torch.linspace(0.3, 0.3 + math.radians(degrees), 200, dtype=torch.float64)
    xy = conics.points_on(truth.expand(200, -1), angle)
    inverse = torch.linalg.inv(conics.shape_matrix(truth[0]))
    normal = (xy - truth[0, :2]) @ (inverse @ inverse)
    index = torch.zeros(200, dtype=torch.int64)
    # the lengths of the gradients do not matter
    found = fit_joint(xy, normal * (1 + angle[:, None]), index, 1)
    torch.testing.assert_close(found[:, :2], truth[:, :2], rtol=0, atol=1e-6)
    torch.testing.assert_close(conics.shape_matrix(found), conics.shape_matrix(truth), rtol=0, atol=1e-6)


def test_directions_hold_an_arc() -> None:
    """A third of a circle with 0.3 px of noise: positions alone would miss by pixels."""
    g = torch.Generator().manual_seed(2)
    angle = torch.linspace(0, 2 * math.pi / 3, 80, dtype=torch.float64).repeat(50)
    normal = torch.stack([angle.cos(), angle.sin()], -1)
    xy = 100 + 30 * normal + 0.3 * torch.randn(4000, 2, dtype=torch.float64, generator=g)
    index = torch.arange(50).repeat_interleave(80)
    found = fit_joint(xy, normal, index, 50)
    positions = ellipse.fit(xy, index, 50)
    error, without = ((e[:, :2] - 100).norm(dim=-1).median() for e in (found, positions))
    assert error < 0.5 * without


@pytest.mark.parametrize("width", [6, 12])
def test_a_bar_across_a_disc(width: int) -> None:
    """Two arcs that only together are a circle."""
    bar = np.array([[60, 100 - width], [240, 100 - width], [240, 100 + width], [60, 100 + width]])
    picture = drawn(disc(150, 100, 40))
    cut = drawn(disc(150, 100, 40), noise=0.0)[0].numpy().copy()
    cv2.fillPoly(cut, [bar.astype(np.int32)], 120, cv2.LINE_AA)
    found = find_candidates(torch.from_numpy(cv2.GaussianBlur(cut, (0, 0), 0.8))[None], 1)
    error = (found.ellipse[:, :4] - torch.tensor([150.0, 100, 40, 40])).abs().amax(-1)
    # coarse: the stumps of the bar pull at it; it must come within the tolerance that counts as the same ellipse
    assert error.min() < 1 + 0.08 * 40
    assert len(find_candidates(picture, 1)) == 1


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8])
def test_a_polygon_is_no_ellipse(sides: int) -> None:
    corners = polygon((150, 100), 70, sides)
    shapes = find_shapes(drawn(corners), 1)
    assert len(shapes.ellipses) == 0
    assert (shapes.segments.chain == 0).sum() == sides
    at = shapes.segments.ends[shapes.segments.chain == 0].flatten(0, 1)
    near = torch.linalg.vector_norm(at[:, None] - torch.from_numpy(corners), dim=-1)
    assert near.amin(1).max() < 4.0
    assert shapes.segments.place[shapes.segments.chain == 0].sort().values.tolist() == list(range(sides))


def test_a_disc_is_no_polygon() -> None:
    shapes = find_shapes(drawn(disc(150, 100, 60, 40, 0.5)), 1)
    assert len(shapes.ellipses) == 1
    assert len(shapes.segments) == 0


def test_a_segment_has_the_light_on_its_left() -> None:
    frame = torch.full((1, 100, 120), 50, dtype=torch.uint8)
    frame[:, 60:] = 200  # light below
    segments = find_shapes(frame, 1).segments
    assert len(segments) == 1
    (u0, v0), (u1, v1) = segments.ends[0].tolist()
    assert (v0, v1) == pytest.approx((59.5, 59.5), abs=0.1)
    assert u1 < u0 - 100  # seen along -u, left is +v
    assert segments.chain.tolist() == [-1]


def test_no_line_in_noise() -> None:
    noise = 128 + 20 * torch.randn(20, 200, 300, generator=torch.Generator().manual_seed(5))
    shapes = find_shapes(noise.clamp(0, 255).to(torch.uint8))
    assert len(shapes.ellipses) == 0
    assert len(shapes.segments) <= 2  # less than one a frame is the promise


def test_explanations() -> None:
    picture = drawn(disc(60, 100, 30), polygon((180, 100), 50, 6))
    plain, explained = find_shapes(picture, 1), find_shapes(picture, 1, explain=True)
    verdict = explained.ellipses.verdict
    torch.testing.assert_close(explained.ellipses[verdict == Verdict.ACCEPTED].ellipse, plain.ellipses.ellipse)
    seen = set(verdict.tolist())
    assert {Verdict.ACCEPTED, Verdict.POLYGON} <= seen
    near = (explained.ellipses.ellipse[:, :2] - torch.tensor([180.0, 100])).norm(dim=-1) < 10
    assert (verdict[near] != Verdict.ACCEPTED).all()


SCENE = (disc(80, 70, 30, 20, 0.4), disc(80, 70, 9, 6, 0.4), disc(220, 120, 40), polygon((150, 160), 25, 4))


@pytest.mark.parametrize("change", ["flip_u", "flip_v", "transpose", "shift", "gain"])
def test_the_same_set_under(change: str) -> None:
    frame = drawn(*SCENE, noise=2.0)
    original = find_candidates(frame, 1)
    uv = original.ellipse[:, :2].clone()
    height, width = frame.shape[1:]
    if change == "flip_u":
        moved, uv[:, 0] = frame.flip(2), width - 1 - uv[:, 0]
    elif change == "flip_v":
        moved, uv[:, 1] = frame.flip(1), height - 1 - uv[:, 1]
    elif change == "transpose":
        moved, uv = frame.mT, uv.flip(1)
    elif change == "shift":
        moved, uv = torch.nn.functional.pad(frame, (6, 0, 4, 0), value=200), uv + torch.tensor([6.0, 4.0])
    else:
        moved = 0.5 * frame.float() + 60
    found = find_candidates(moved.contiguous(), 1)
    assert len(found) == len(original)
    apart = torch.linalg.vector_norm(found.ellipse[:, None, :2] - uv, dim=-1)
    assert apart.amin(0).max() < 0.05
    assert apart.amin(1).max() < 0.05
