"""Boards of discs and rings in rendered frames: marks found, errors of centres, and whether covariances are right.

    python scripts/board_statistics.py

Views of 912 x 608 px, f = 751 px, distorted, tilted by 35 degrees in all directions, blur 0.7 px, noise 1, 8 bit.
Columns: diameter of a mark in px, marks found of those there are, marks fitted to the grey values, RMS length of errors
of centres (px), the same as claimed, mean chi-squared of a centre over its 2 degrees of freedom.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

import torchpose as tp
from torchpose.calibration.grids import Grid, find_marks, measure_marks
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render
from torchpose.sim.shapes import Shapes, ring

F64 = torch.float64
CAMERA = tp.Camera(912, 608, [[751.5, 0, 452.6], [0, 750, 306.4], [0, 0, 1]], [-0.2, 0.05, 2e-4, -1.5e-4])
DISTANCE, TILT_DEG = 165.0, 35.0
BOARDS = (
    *(("circles:9x7:8mm", radius, 0.0) for radius in (2.4, 1.0, 0.77, 0.66, 0.58)),
    ("acircles:4x11:5mm", 2.0, 0.0),
    ("rings:9x7:8mm:3mm:1.5mm", 3.0, 1.5),
)


def line(text: str, outer: float, inner: float, views: int) -> str:
    grid = Grid.parse(text)
    assert grid is not None
    azimuth = 2 * torch.pi * torch.arange(views, dtype=F64) / views
    R = rotations.exp(np.deg2rad(TILT_DEG) * torch.stack([azimuth.cos(), azimuth.sin(), 0.4 * azimuth.sin()], -1))
    t = torch.tensor([[0, 0, DISTANCE]], dtype=F64).expand(views, 3)
    middle = 0.5 * (grid.points.amin(0) + grid.points.amax(0))
    drawn = Shapes.cat([ring((x, y), outer, inner) for x, y, _ in (grid.points - middle).tolist()])
    frames = torch.cat([render(CAMERA, drawn, R[k : k + 1], t[k : k + 1]) for k in range(views)])
    frames, names = add_noise(frames, 1.0), [str(k) for k in range(views)]
    marks = find_marks(names, frames, grid, tp.Camera.ideal(CAMERA.width, CAMERA.height, CAMERA.width))
    found = measure_marks(names, frames, marks, grid, CAMERA)
    error = found.pixels - CAMERA.project((grid.points - middle) @ R.mT + t[:, None])[found.view, found.point]
    chi2 = (error * torch.linalg.solve(found.covariance, error)).sum(-1).mean() / 2
    rms = error.square().sum(-1).mean().sqrt()
    claimed = found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()
    diameter = 2 * outer * float(CAMERA.matrix[0, 0]) / DISTANCE
    return (
        f"| {grid.name} | {diameter:.1f} | {len(marks)} of {views * len(grid.points)} | {len(found.view)} | "
        f"{rms:.4f} | {claimed:.4f} | {chi2:.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=6)
    options = parser.parse_args()
    print("| board | diameter px | found | fitted | RMS px | claimed | chi-squared over freedom |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for board in BOARDS:
        print(line(*board, options.views), flush=True)


if __name__ == "__main__":
    main()
