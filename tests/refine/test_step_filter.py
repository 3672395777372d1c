"""Matched filters of edges against supersampled pictures and Monte-Carlo noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from torchpose.geometry.blur import isotropic
from torchpose.refine.edges.step_filter import StepOffsets, step_offsets, window_correlation

F64 = torch.float64
PSF, FINE, SIZE = 0.8, 15, 33
BLUR = math.sqrt(PSF**2 + 1 / 12)


def disc(radius: float, center: tuple[float, float], dark: float = 30.0, light: float = 220.0) -> Tensor:
    """Picture (1, 33, 33) of a dark disc, sampled 15 x 15 times a pixel."""
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    outside = np.clip((np.hypot(at[None] - center[0], at[:, None] - center[1]) - radius) * FINE + 0.5, 0, 1)
    sharp = dark + (light - dark) * outside
    soft = gaussian_filter(sharp, PSF * FINE, mode="nearest")
    return torch.from_numpy(soft.reshape(SIZE, FINE, SIZE, FINE).mean((1, 3)))[None]


def measured(
    frame: Tensor, radius: float, center: tuple[float, float], error: float, blur: float = BLUR
) -> StepOffsets:
    """Offsets at pixels all along a circle that is too small by ``error``."""
    angle = torch.linspace(0, 2 * math.pi, 41, dtype=F64)[:-1]
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    at = torch.tensor(center, dtype=F64)
    pixel = (at + radius * direction).round()
    arm = pixel - at
    distance = arm.norm(dim=-1)
    normal = arm / distance[:, None]
    one = torch.ones_like(distance)
    bend = one / radius
    zero = torch.zeros(len(angle), dtype=torch.int64)
    curve = (normal, distance - (radius - error), bend)
    return step_offsets(frame, zero, pixel.long(), curve, isotropic(blur * one))


@pytest.mark.parametrize(("radius", "offset", "blur"), [(5.0, 0.003, 0.008), (11.0, 0.0015, 0.002)])
def test_offsets_and_blur_of_discs(radius: float, offset: float, blur: float) -> None:
    """To first order: the smaller the disc, the sooner the curvature's square shows."""
    center = (16.2, 15.7)
    found = measured(disc(radius, center), radius, center, 0.04)
    assert (found.error - 0.04).abs().max() < 2 * offset
    assert found.error.mean() == pytest.approx(0.04, abs=offset)
    assert found.step == pytest.approx(190.0, rel=0.02)
    wide = measured(disc(radius, center), radius, center, 0.0, BLUR - 0.03)
    mean = (wide.widening * wide.blur_information).sum() / wide.blur_information.sum()
    assert mean == pytest.approx(BLUR**2 - (BLUR - 0.03) ** 2, abs=2 * BLUR * blur)


def test_grey_levels_are_free() -> None:
    center = (16.4, 16.1)
    frame = disc(9.0, center)
    plain, other = (measured(f, 9.0, center, 0.02) for f in (frame, 250 - 0.5 * frame))
    torch.testing.assert_close(other.error, plain.error, rtol=0, atol=1e-4)
    torch.testing.assert_close(other.step, -0.5 * plain.step, rtol=1e-4, atol=0)


def test_noise_of_an_offset_is_as_told() -> None:
    g = torch.Generator().manual_seed(1)
    center = (16.4, 16.1)
    frame = disc(10.0, center)
    trials = torch.stack([
        measured(frame + 4 * torch.randn(frame.shape, dtype=F64, generator=g), 10.0, center, 0.0).error
        for _ in range(300)
    ])  # fmt: skip
    clean = measured(frame, 10.0, center, 0.0)
    told = (4 / clean.step) ** 2 / clean.information
    assert (trials.var(0) / told).mean() == pytest.approx(1.0, abs=0.05)


def test_neighbouring_windows_share_noise() -> None:
    """Variance of the mean over a straight edge at 20 degrees, against that of single windows."""
    g = torch.Generator().manual_seed(2)
    length, count = 200, 400
    slope = math.tan(math.radians(20))
    u = torch.arange(length, dtype=F64) + 6
    v = 10 + slope * u
    pixel = torch.stack([u, v.round()], -1).long()
    normal = torch.tensor([-math.sin(math.radians(20)), math.cos(math.radians(20))], dtype=F64).expand(length, 2)
    distance = (v.round() - v) * math.cos(math.radians(20))
    bend, blur = torch.zeros(length, dtype=F64), isotropic(torch.full((length,), 0.75, dtype=F64))
    grid_v, grid_u = torch.meshgrid(torch.arange(100, dtype=F64), torch.arange(220, dtype=F64), indexing="ij")
    off = (grid_v - 10 - slope * grid_u) * math.cos(math.radians(20))
    clean = 190 * 0.5 * torch.erfc(-off / (0.75 * math.sqrt(2)))
    means, singles = [], []
    for _ in range(count):
        frame = (clean + 2 * torch.randn(clean.shape, dtype=F64, generator=g))[None]
        found = step_offsets(frame, torch.zeros(length, dtype=torch.int64), pixel, (normal, distance, bend), blur)
        weight = found.information / found.information.sum()
        means.append((weight * found.error).sum())
        singles.append(found.error)
    weight2 = weight.square()
    alone = (weight2 * torch.stack(singles).var(0)).sum()
    assert torch.stack(means).var() / alone == pytest.approx(window_correlation(), rel=0.25)  # 7 % by chance
