"""Edge points along rough ellipses of rendered discs."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.special import ndtr

from torchpose import ellipse
from torchpose.geometry import conics
from torchpose.rings.edges import REACH, edge_pixels, ring_edges

CENTER = torch.tensor([[60.3, 45.8], [50.6, 52.1]], dtype=torch.float64)
RADIUS = torch.tensor([25.4, 12.7], dtype=torch.float64)
TRUTH = torch.cat([CENTER, RADIUS[:, None].expand(2, 2), torch.zeros(2, 1, dtype=torch.float64)], -1)
FRAME = torch.tensor([0, 1])


def disc_frames(
    dark_inside: bool = True, height: int = 96, width: int = 120, psf: float = 0.7, sub: int = 3
) -> torch.Tensor:
    """Two frames of one blurred disc each (straight-edge profile along the radius, averaged over the pixel)."""
    fine = (torch.arange(height * sub, dtype=torch.float64) + 0.5) / sub - 0.5
    v, u = fine[:, None], ((torch.arange(width * sub, dtype=torch.float64) + 0.5) / sub - 0.5)[None]
    frames = []
    for (cx, cy), radius in zip(CENTER.tolist(), RADIUS.tolist(), strict=True):
        outside = torch.from_numpy(ndtr(((torch.hypot(u - cx, v - cy) - radius) / psf).numpy()))
        frames.append(outside.unflatten(0, (height, sub)).unflatten(2, (width, sub)).mean((1, 3)))
    light = torch.stack(frames)
    return (40 + 160 * (light if dark_inside else 1 - light)).float()


def rough(offset: float = 1.5) -> torch.Tensor:
    """The true circles, moved and blown up by a pixel or two."""
    return TRUTH + torch.tensor([offset, -offset, 0.5, 0.5, 0.3])


OUTWARD = torch.ones(2, dtype=torch.float64)
REACHES = torch.full((2,), float(REACH), dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_edge_pixels_follow_the_circle(dtype: torch.dtype) -> None:
    pixels, ring = edge_pixels(disc_frames().round().to(dtype), FRAME, rough(), OUTWARD, REACHES)
    assert torch.equal(ring, ring.sort().values)
    assert torch.unique(torch.cat([ring[:, None], pixels], -1), dim=0).shape[0] == len(ring)
    assert ellipse.distance(pixels, ring, TRUTH).abs().max() < 1.5
    # a closed chain of pixels has 0.9 pixels a pixel of length on average
    length = conics.perimeter(TRUTH)
    assert (torch.bincount(ring) > 0.8 * length).all()
    # no gap: every direction has a pixel near it
    for k in range(2):
        d = (pixels[ring == k] - CENTER[k]).double()
        gap = torch.atan2(d[:, 1], d[:, 0]).sort().values.diff().max()
        assert gap * RADIUS[k] < 2.5


@pytest.mark.parametrize("dark_inside", [True, False])
def test_points_lie_on_the_circle(dark_inside: bool) -> None:
    sign = 1.0 if dark_inside else -1.0
    found = ring_edges(disc_frames(dark_inside), FRAME, rough(), sign * OUTWARD, REACHES)
    assert torch.equal(found.ring, found.ring.sort().values)
    r = ellipse.distance(found.points, found.ring, TRUTH)
    # curvature pushes the points out by 1.4 / R, blur leaves a wave within the pixel
    for k in range(2):
        assert r[found.ring == k].mean() == pytest.approx(1.35 / float(RADIUS[k]), rel=0.15)
        assert r[found.ring == k].std() < 0.08
    outward = found.points - CENTER[found.ring]
    outward = outward / outward.norm(dim=-1, keepdim=True)
    assert (sign * (found.normal * outward).sum(-1) > 0.99).all()
    torch.testing.assert_close(found.step, torch.full_like(found.step, 160.0), rtol=0.25, atol=0)
    # each point was measured from the window of its own pixel
    pixel = found.points - found.offset[:, None] * found.normal
    torch.testing.assert_close(pixel, pixel.round(), rtol=0, atol=1e-9)
    assert ((found.points - pixel).abs() <= 0.5 + 1e-9).all()
    key = torch.cat([found.ring[:, None], pixel.round().long()], -1)
    assert torch.unique(key, dim=0).shape[0] == len(key)


def test_wrong_polarity_finds_next_to_nothing() -> None:
    found = ring_edges(disc_frames(), FRAME, rough(), -OUTWARD, REACHES)
    assert len(found.ring) == 0


def test_reach_is_kept() -> None:
    far = rough(0.0) + torch.tensor([0, 0, 5.0, 5.0, 0])
    near = torch.full((2,), 2.0, dtype=torch.float64)
    pixels, ring = edge_pixels(disc_frames(), FRAME, far, OUTWARD, near)
    assert ellipse.distance(pixels, ring, far).abs().max() < 2 + math.sqrt(0.5)
    assert len(ring_edges(disc_frames(), FRAME, far, OUTWARD, near).ring) == 0


def test_batch_equals_single_frames() -> None:
    frames = disc_frames()
    together = ring_edges(frames, FRAME, rough(), OUTWARD, REACHES)
    for k in range(2):
        alone = ring_edges(
            frames[k : k + 1], torch.zeros(1, dtype=torch.int64), rough()[k : k + 1], OUTWARD[:1], REACHES[:1]
        )
        mine = together.ring == k
        torch.testing.assert_close(alone.points, together.points[mine], rtol=0, atol=1e-6)
        torch.testing.assert_close(alone.step, together.step[mine], rtol=0, atol=1e-3)


def test_margin_to_the_border() -> None:
    frames = disc_frames()[:, 30:, :]
    moved = TRUTH - torch.tensor([0.0, 30, 0, 0, 0])
    found = ring_edges(frames, FRAME, moved, OUTWARD, REACHES)
    assert found.points[:, 1].min() > 2.4
    upper = moved[0, 1] - moved[0, 2]
    assert upper < 0  # the first circle is cut
    assert set(found.ring.tolist()) == {0, 1}


def test_nan_pixels_lose_their_windows_only() -> None:
    frames = disc_frames()
    whole = ring_edges(frames, FRAME, rough(), OUTWARD, REACHES)
    frames[0, 45, 34] = math.nan  # on the left end of the first circle
    broken = ring_edges(frames, FRAME, rough(), OUTWARD, REACHES)
    assert broken.points.isfinite().all()
    lost = len(whole.ring) - len(broken.ring)
    assert 0 < lost < 16


@pytest.mark.parametrize("shape", [(2, 5, 5), (2, 1, 40), (2, 40, 1), (2, 1, 1)])
def test_frames_smaller_than_the_mask(shape: tuple[int, int, int]) -> None:
    found = ring_edges(torch.rand(shape), FRAME, rough(), OUTWARD, REACHES)
    assert found.points.shape == (0, 2)


def test_no_rings() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    found = ring_edges(disc_frames(), none, torch.zeros(0, 5).double(), OUTWARD[:0], REACHES[:0])
    assert found.points.shape == (0, 2)
    assert found.step.shape == (0,)
