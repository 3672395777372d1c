"""Exact views of points, the ground truth of the tests of this folder."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpose.geometry import rotations

F64 = torch.float64
FOCAL = 1111.0
MATRIX = torch.tensor([[FOCAL, 0, 640], [0, FOCAL, 480], [0, 0, 1]], dtype=F64)
SQUARE = torch.tensor([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], dtype=F64)
GRID = torch.tensor([[x, y, 0.0] for y in (-20, 0, 20) for x in (-20, 0, 20)], dtype=F64)
CUBOID = torch.tensor([[x, y, z] for x in (-20, 20) for y in (-15, 15) for z in (-10, 10)], dtype=F64)
CUBOID = CUBOID + torch.tensor([[1.0, 2, 3]], dtype=F64) * torch.arange(8, dtype=F64)[:, None].sin()


def views(
    points: Tensor,
    batch: int,
    *,
    tilt_deg: tuple[float, float] = (5, 70),
    near: float = 4,
    far: float = 12,
    seed: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """R (B, 3, 3), t (B, 3) and normalised image points (B, N, 2); half of the planes are seen from behind."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(batch, generator=g, dtype=F64)

    tilt, azimuth, roll = (
        uniform(*(math.radians(a) for a in tilt_deg)),
        uniform(0, 2 * math.pi),
        uniform(0, 2 * math.pi),
    )
    zero = torch.zeros_like(tilt)
    r = rotations.exp(torch.stack([azimuth.cos(), azimuth.sin(), zero], -1) * tilt[:, None])
    r = r @ rotations.exp(torch.stack([zero, zero, roll], -1))
    turned = r @ torch.diag(torch.tensor([1.0, -1, -1], dtype=F64))
    r = torch.where((torch.arange(batch) % 2 == 0)[:, None, None], r, turned)
    depth = 40 * uniform(near, far)
    t = torch.stack([uniform(-0.3, 0.3) * depth, uniform(-0.3, 0.3) * depth, depth], -1)
    return r, t, project(points, r, t)


def project(points: Tensor, r: Tensor, t: Tensor) -> Tensor:
    """Normalised image points (B, N, 2)."""
    camera_points = points @ r.mT + t[:, None]
    return camera_points[..., :2] / camera_points[..., 2:]


def pixels(xy: Tensor, sigma: float = 0.0, seed: int = 1) -> Tensor:
    """Pixels of normalised points through `MATRIX`, with noise."""
    noise = torch.randn(xy.shape, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return FOCAL * xy + MATRIX[:2, 2] + sigma * noise


def errors(r: Tensor, t: Tensor, r_true: Tensor, t_true: Tensor) -> tuple[Tensor, Tensor]:
    """Angle in rad and relative error of the translation."""
    return rotations.angle_between(r, r_true), (t - t_true).norm(dim=-1) / t_true.norm(dim=-1)
