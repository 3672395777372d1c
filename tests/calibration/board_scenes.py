"""Rendered boards of discs and rings with known truth."""

from __future__ import annotations

import torch
from torch import Tensor

import torchpose as tp
from torchpose.calibration.grids import Grid
from torchpose.sim import add_noise, render
from torchpose.sim.shapes import Shapes, ring

F64 = torch.float64


def middle(grid: Grid) -> Tensor:
    """(3,) mm."""
    return 0.5 * (grid.points.amin(0) + grid.points.amax(0))


def shapes(grid: Grid, outer: float, inner: float = 0.0, level: float = 30.0) -> Shapes:
    """The board as shapes about its middle."""
    places = (grid.points - middle(grid)).tolist()
    return Shapes.cat([ring((x, y), outer, inner, level) for x, y, _ in places])


def centers(camera: tp.Camera, grid: Grid, R: Tensor, t: Tensor) -> Tensor:
    """(N, P, 2) px: where the centres of the marks are seen."""
    return camera.project((grid.points - middle(grid)) @ R.mT + t[:, None])


def photographs(
    camera: tp.Camera, drawn: Shapes, R: Tensor, t: Tensor, *, paper: float = 220.0, noise: float = 1.0, seed: int = 0
) -> Tensor:
    """(N, H, W) uint8."""
    frames = [render(camera, drawn, R[k : k + 1], t[k : k + 1], light=paper, psf_sigma=0.7) for k in range(len(t))]
    return add_noise(torch.cat(frames), noise, seed)
