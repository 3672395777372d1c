"""Small rendered moments of a rig of three cameras."""

import math
from functools import cache

import torch
from torch import Tensor

import torchpose as tp
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
NOISE, BLUR, DISTANCE = 2.0, 0.7, 120.0
TARGET = tp.Target.load("quad40")


def rig(*angles_deg: float, covariance: Tensor | None = None) -> tp.CameraRig:
    """Cameras about one place; the second is smaller than the others, and its lens bends."""
    first = tp.Camera.ideal(640, 480, 620.0)
    bent = tp.Camera(600, 440, [[560.0, 0, 300], [0, 560, 220], [0, 0, 1]], [-0.1, 0.02, 1e-4, -2e-4])
    R = rotations.exp(torch.tensor([[0.0, math.radians(a), 0.0] for a in angles_deg], dtype=F64))
    middle = torch.tensor([0.0, 0.0, DISTANCE], dtype=F64)
    t = middle - R @ middle
    t[0] = 0
    return tp.CameraRig([bent if n == 1 else first for n in range(len(angles_deg))], R, t, covariance)


def poses(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    lean, azimuth, roll, x, y, z = torch.rand(6, count, dtype=F64, generator=g)
    lean, azimuth, zero = math.radians(20) * lean, 2 * math.pi * azimuth, torch.zeros(count, dtype=F64)
    R = rotations.exp(torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), zero], -1))
    R = R @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * roll], -1))
    return R, torch.stack([(x - 0.5) * 10, (y - 0.5) * 8, DISTANCE + (z - 0.5) * 8], -1)


def pictures(cameras: tp.CameraRig, R: Tensor, t: Tensor, moved: Tensor | None = None, seed: int = 0) -> list[Tensor]:
    """Frames (B, H, W) of each camera; ``moved`` (C, 6): by how far each is beside its place."""
    frames = []
    for number, camera in enumerate(cameras.cameras):
        own_R, own_t = cameras.seen_by(number, R, t)
        if moved is not None:
            turn = rotations.exp(moved[number, 3:])
            own_R, own_t = turn @ own_R, own_t @ turn.T + moved[number, :3]
        frames.append(add_noise(render(camera, TARGET, own_R, own_t, psf_sigma=BLUR), NOISE, seed=seed + number))
    return frames


def hidden(frames: Tensor, camera: tp.Camera, pose: tuple[Tensor, Tensor], markers: list[int]) -> Tensor:
    """The frames with some markers under paper."""
    out = frames.clone()
    at = camera.project(TARGET.centers[markers] @ pose[0].mT + pose[1][:, None])
    for k, places in enumerate(at.round().long().tolist()):
        for u, v in places:
            out[k, max(v - 40, 0) : v + 41, max(u - 40, 0) : u + 41] = 220
    return out


RIG = rig(0, 35, -35)


@cache
def estimator() -> tp.PoseEstimator:
    return tp.PoseEstimator(RIG, TARGET)


def errors(found: tp.Poses, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Errors (N, 6) and NEES (N,)."""
    error = torch.cat([found.t - t, rotations.log(found.R @ R.mT)], -1)
    return error, (error * torch.linalg.solve(found.covariance, error)).sum(-1)
