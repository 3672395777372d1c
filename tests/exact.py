"""Exact measurements of a target without any image: the witness of the stages behind the edges."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics, rotations
from torchpose.geometry.blur import isotropic
from torchpose.geometry.sectors import SECTORS
from torchpose.rings import Rings
from torchpose.target import Target

F64 = torch.float64


def pinhole(focal: float = 1111.11, width: int = 1824, height: int = 1216) -> Camera:
    """The 2 MP camera without distortion."""
    k = [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    return Camera(width=width, height=height, matrix=torch.tensor(k, dtype=F64), distortion=torch.zeros(4, dtype=F64))


def random_poses(count: int, tilt_deg: float, distance: tuple[float, float], seed: int = 0) -> tuple[Tensor, Tensor]:
    """R (count, 3, 3), t (count, 3) mm: tilts up to ``tilt_deg`` about any axis, any roll, near the optical axis."""
    g = torch.Generator().manual_seed(seed)
    tilt, azimuth, roll, x, y, z = torch.rand(6, count, dtype=F64, generator=g)
    tilt, azimuth, roll = tilt * math.radians(tilt_deg), azimuth * 2 * math.pi, (2 * roll - 1) * math.pi
    zero = torch.zeros_like(tilt)
    lean = rotations.exp(torch.stack([tilt * azimuth.cos(), tilt * azimuth.sin(), zero], -1))
    turn = rotations.exp(torch.stack([zero, zero, roll], -1))
    t = torch.stack([(x - 0.5) * 30, (y - 0.5) * 15, distance[0] + z * (distance[1] - distance[0])], -1)
    return lean @ turn, t


def exact_ellipses(target: Target, camera: Camera, r: Tensor, t: Tensor) -> Tensor:
    """Projected outer and inner circles (B, M, 2, 5) of every marker, ideal px."""
    center = (r[:, None] @ target.centers[..., None]).squeeze(-1) + t[:, None]
    conic = conics.circle_image(
        r[:, None, None], center[:, :, None], target.normals[:, None], target.radii.expand(len(r), -1, -1)
    )
    to_px = torch.linalg.inv(camera.matrix)
    return conics.ellipse_from_conic(conics.from_matrix(to_px.T @ conic @ to_px))


def rings_of(ellipses: Tensor, frame: Tensor, sigma: float = 0.005, polarity: float = 1.0, seed: int = 0) -> Rings:
    """Rings (K, 2, 5) with edge noise of ``sigma`` px on centre and shape, as fits of 200 points would have."""
    g = torch.Generator().manual_seed(seed)
    count = ellipses.shape[0]
    spread = sigma * math.sqrt(2 / 200)
    covariance = torch.eye(5, dtype=F64).repeat(count, 1, 1) * spread**2
    covariance[:, 2:, 2:] *= 2

    def fit(params: Tensor) -> EllipseFit:
        noisy = params.clone()
        noisy[:, :2] += spread * torch.randn(count, 2, dtype=F64, generator=g)
        one = torch.ones(count, dtype=F64)
        return EllipseFit(noisy, covariance, sigma * one, 200 * one)

    outer, inner = fit(ellipses[:, 0]), fit(ellipses[:, 1])
    side, blur = torch.full((count,), polarity, dtype=F64), isotropic(torch.full((count,), 0.8, dtype=F64))
    seen = (frame >= 0)[:, None].expand(-1, SECTORS)
    return Rings(frame, side, outer.params, inner.params, outer, inner, blur, frame < 0, seen, frame < 0)
