"""Candidate ellipses of rendered rings, of noise, and of awkward frames."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from torchpose.detect import Candidates, find_candidates
from torchpose.detect.reduce import reduction_factor
from torchpose.geometry import conics


def ellipse_frames(
    ellipses: torch.Tensor,
    height: int = 120,
    width: int = 160,
    inside: float = 50.0,
    outside: float = 200.0,
    sub: int = 8,
) -> torch.Tensor:
    """Frames (B, H, W) of one filled ellipse each, by supersampling."""
    fine_v = (torch.arange(height * sub, dtype=torch.float64) + 0.5) / sub - 0.5
    fine_u = (torch.arange(width * sub, dtype=torch.float64) + 0.5) / sub - 0.5
    inverse = torch.linalg.inv(conics.shape_matrix(ellipses))
    out = []
    for k in range(len(ellipses)):
        x, y = (fine_u - ellipses[k, 0])[None], (fine_v - ellipses[k, 1])[:, None]
        m = inverse[k]
        rho = torch.hypot(m[0, 0] * x + m[0, 1] * y, m[1, 0] * x + m[1, 1] * y)
        covered = (rho <= 1).float().unflatten(0, (height, sub)).unflatten(2, (width, sub)).mean((1, 3))
        out.append(outside + (inside - outside) * covered)
    return torch.stack(out)


ELLIPSES = torch.tensor(
    [[80.3, 60.7, 30, 30, 0], [70.1, 55.5, 40, 20, 0.6], [90.8, 62.2, 25, 9, 2.0], [60.0, 70.0, 6, 5, 1.0]],
    dtype=torch.float64,
)


def best(found: Candidates, frame: int, truth: torch.Tensor) -> int:
    """Index of the candidate nearest to an ellipse among those of a frame."""
    far = (found.ellipse[:, :4] - truth[:4]).norm(dim=-1).masked_fill(found.frame != frame, torch.inf)
    return int(far.argmin())


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32, torch.float64])
@pytest.mark.parametrize(("inside", "outside", "polarity"), [(50, 200, 1.0), (200, 50, -1.0)])
def test_found_with_polarity(dtype: torch.dtype, inside: int, outside: int, polarity: float) -> None:
    frames = ellipse_frames(ELLIPSES, inside=inside, outside=outside).round().to(dtype)
    found = find_candidates(frames)
    for k, truth in enumerate(ELLIPSES):
        i = best(found, k, truth)
        torch.testing.assert_close(found.ellipse[i, :2], truth[:2], rtol=0, atol=0.1)
        shape = conics.shape_matrix(found.ellipse[i])
        torch.testing.assert_close(shape, conics.shape_matrix(truth), rtol=0, atol=0.4)
        assert found.polarity[i] == polarity
        assert found.log10_nfa[i] < -5
        assert found.cover[i] > 0.9


def test_found_in_noise() -> None:
    clean = ellipse_frames(ELLIPSES[:3])
    noisy = clean + 15 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    found = find_candidates(noisy)
    for k, truth in enumerate(ELLIPSES[:3]):
        i = best(found, k, truth)
        torch.testing.assert_close(found.ellipse[i, :2], truth[:2], rtol=0, atol=0.5)
        assert found.polarity[i] == 1


@pytest.mark.parametrize("correlation", [0.0, 0.7, 1.5])
def test_nothing_in_noise(correlation: float) -> None:
    """Less than one false alarm a frame is the promise; smooth noise has real blobs but no large ellipses."""
    generator = torch.Generator().manual_seed(12)
    noise = torch.randn(40, 240, 320, generator=generator)
    if correlation:
        smooth = gaussian_filter(noise.numpy(), (0, correlation, correlation))
        noise = torch.from_numpy(smooth / smooth.std())
    sigma = torch.tensor([1.0, 4.0, 12.0, 30.0]).repeat(10)[:, None, None]
    assert len(find_candidates((128 + sigma * noise).clamp(0, 255).round().to(torch.uint8))) == 0


@pytest.mark.parametrize("value", [0, 77, 255])
def test_nothing_in_flat_frames(value: int) -> None:
    assert len(find_candidates(torch.full((2, 90, 70), value, dtype=torch.uint8))) == 0


@pytest.mark.parametrize("kind", ["step", "square", "stripes"])
def test_straight_edges_are_no_ellipses(kind: str) -> None:
    frame = torch.full((1, 120, 160), 60.0)
    if kind == "step":
        frame[:, :, 70:] = 180
    elif kind == "square":
        frame[:, 30:90, 40:100] = 180
    else:
        frame[:, :, ::8] = 180
    assert len(find_candidates(frame)) == 0


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [(240, 320), (241, 322), (243, 319)])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_pixel_convention_of_the_reduction(factor: int, size: tuple[int, int], dtype: torch.dtype) -> None:
    truth = torch.tensor([[151.3, 118.6, 70, 55, 0.4]], dtype=torch.float64)
    frame = ellipse_frames(truth, *size, sub=4).round().to(dtype)
    found = find_candidates(frame, factor)
    i = best(found, 0, truth[0])
    torch.testing.assert_close(found.ellipse[i, :2], truth[0, :2], rtol=0, atol=0.1)
    torch.testing.assert_close(found.ellipse[i, 2:4], truth[0, 2:4], rtol=0, atol=0.3)


def test_batch_equals_single_frames() -> None:
    frames = ellipse_frames(ELLIPSES)
    frames = frames + 3 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(5))
    together = find_candidates(frames)
    for k in range(len(frames)):
        alone, mine = find_candidates(frames[k : k + 1]), together[together.frame == k]
        assert len(alone) == len(mine)
        for name in ("ellipse", "polarity", "log10_nfa", "cover"):
            torch.testing.assert_close(getattr(alone, name), getattr(mine, name), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("factor", [None, 1, 3])
@pytest.mark.parametrize("shape", [(0, 40, 50), (2, 0, 5), (2, 1, 40), (2, 40, 1), (1, 1, 1), (2, 5, 5)])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32, torch.bool])
def test_tiny_frames(shape: tuple[int, int, int], dtype: torch.dtype, factor: int | None) -> None:
    found = find_candidates(torch.ones(shape).to(dtype), factor)
    assert found.ellipse.shape == (0, 5)
    assert found.log10_nfa.dtype == torch.float64


def test_broken_pixels() -> None:
    frames = ellipse_frames(ELLIPSES[:1])
    whole = find_candidates(frames)
    frames[0, 5, 5], frames[0, 110, 3] = math.nan, math.inf
    torch.testing.assert_close(find_candidates(frames).ellipse, whole.ellipse)


def test_selection() -> None:
    found = find_candidates(ellipse_frames(ELLIPSES))
    large = found[found.ellipse[:, 2] > 20]
    assert isinstance(large, Candidates)
    assert 0 < len(large) < len(found)
    assert (large.ellipse[:, 2] > 20).all()


def test_large_frames_are_reduced() -> None:
    """The factor chosen for a 5 megapixel frame keeps the pixel convention, too."""
    truth = torch.tensor([[1000.4, 901.2, 200, 150, 1.0]], dtype=torch.float64)
    frame = torch.full((1, 2048, 2448), 200.0)
    local = truth - torch.tensor([700.0, 600, 0, 0, 0])
    frame[0, 600:1200, 700:1300] = ellipse_frames(local, 600, 600, sub=3)[0]
    assert reduction_factor(*frame.shape[1:]) > 1
    found = find_candidates(frame.round().to(torch.uint8))
    i = best(found, 0, truth[0])
    torch.testing.assert_close(found.ellipse[i, :2], truth[0, :2], rtol=0, atol=0.1)
