"""Views, frames and robot poses with known truth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchpose as tp
from torchpose.calibration import Views
from torchpose.camera.model import Model
from torchpose.geometry import rotations

F64 = torch.float64
Transform = tuple[Tensor, Tensor]


def camera(distortion: list[float] | None = None, *, model: Model = "brown_conrady", scale: float = 1.0) -> tp.Camera:
    """1824 x 1216 px at scale 1, no symmetry anywhere."""
    d = [-0.08, 0.03, 2e-4, -1.5e-4] if distortion is None else distortion
    k = scale * torch.tensor([[1503.0, 0, 905.3], [0, 1500, 612.8], [0, 0, 1 / scale]], dtype=F64)
    return tp.Camera(round(1824 * scale), round(1216 * scale), k, torch.tensor(d, dtype=F64), model)


def poses(cam: tp.Camera, count: int, *, seed: int = 0, tilt: tuple[float, float] = (10, 40)) -> Transform:
    """R (N, 3, 3), t (N, 3): tilted in all directions by ``tilt`` degrees, 150 to 200 mm away, around the middle."""
    u = torch.rand(count, 6, dtype=F64, generator=torch.Generator().manual_seed(seed))
    angle = (tilt[0] + (tilt[1] - tilt[0]) * u[:, 0]).deg2rad()
    azimuth, zero = 2 * math.pi * (torch.arange(count) + u[:, 1]) / count, torch.zeros(count, dtype=F64)
    r = rotations.exp(angle[:, None] * torch.stack([azimuth.cos(), azimuth.sin(), zero], -1))
    r = r @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * u[:, 2]], -1))
    size = torch.tensor([cam.width, cam.height], dtype=F64)
    xy = cam.undistort_points((0.3 + 0.4 * u[:, 3:5]) * size)
    depth = 150 + 50 * u[:, 5:]
    return r, torch.cat([xy * depth, depth], -1)


def views(
    cam: tp.Camera, pose: Transform, points: Tensor, *, sigma: float = 0.0, said: float | None = None, seed: int = 0
) -> Views:
    """Every point in every view, off by noise ``sigma`` px; the covariance says ``said`` (by default the same)."""
    r, t = pose
    n, m = len(t), len(points)
    pixels = cam.project(points @ r.mT + t[:, None]).flatten(0, 1)
    pixels = pixels + sigma * torch.randn(pixels.shape, dtype=F64, generator=torch.Generator().manual_seed(seed))
    variance = (sigma if said is None else said) ** 2
    return Views(
        torch.arange(n).repeat_interleave(m),
        torch.arange(m).repeat(n),
        points.repeat(n, 1),
        pixels,
        variance * torch.eye(2, dtype=F64).expand(n * m, 2, 2),
        tuple(f"{k}.png" for k in range(n)),
    )


def grid(step: float = 12.0, across: int = 5, down: int = 4) -> Tensor:
    """(across * down, 3) mm in the plane z = 0, about the origin."""
    x, y = torch.meshgrid(torch.arange(across, dtype=F64), torch.arange(down, dtype=F64), indexing="xy")
    flat = torch.stack([x.flatten() - (across - 1) / 2, y.flatten() - (down - 1) / 2], -1) * step
    return torch.nn.functional.pad(flat, (0, 1))


def intrinsics(cam: tp.Camera) -> Tensor:
    return torch.cat([cam.matrix.diagonal()[:2], cam.matrix[:2, 2], cam.distortion])


def rig(mount: str) -> tuple[Transform, Transform]:
    """X and Z of `torchpose.calibration.hand_eye`: the camera in its mount, the target on the other side."""

    def transform(r: list[float], t: list[float]) -> Transform:
        return rotations.exp(torch.tensor(r, dtype=F64)), torch.tensor(t, dtype=F64)

    if mount == "tool":
        return transform([0.02, -0.03, 1.5], [10, -60, 40]), transform([math.pi - 0.1, 0.05, 0.02], [450, -100, 20])
    return transform([3, 0.1, -0.2], [450, -80, 600]), transform([0.1, 0.05, 0.7], [5, -10, 60])


def robot_poses(mount: str, target: Transform) -> Transform:
    """base_from_tool under which the target has the given poses in the camera."""
    x, z = rig(mount)
    a = rotations.compose(*rotations.compose(*z, *rotations.inverse(*target)), *rotations.inverse(*x))
    return a if mount == "tool" else rotations.inverse(*a)
