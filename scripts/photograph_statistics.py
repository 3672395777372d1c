"""Photographs of a real board of discs or rings: what is found, and how well centres agree with a camera and the board.

    python scripts/photograph_statistics.py FOLDER --board rings:10x7:20mm:7mm:3.5mm

Prints the marks found, the tone that they tell, and chi-squared over freedom of the centres by the grey values, with
the covariance that the frames give them and none added: for the board as it is named, flat and regular, and with the
places of its marks freed in three dimensions. The second is 1 where centres err by no more than they claim; the first
says how far the print is off. Places are freed by turns with camera and poses, until chi-squared falls by less than
1e-4 of itself.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.bundle import adjust
from torchpose.calibration.grids import Grid, find_marks, measure_marks
from torchpose.calibration.intrinsics import start_cameras
from torchpose.calibration.session import frames_tone
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.segments import segment_sum
from torchpose.io.images import decode

LENS = "brown5"
ROUNDS = 300
GAUGE = 7  # a board that is freed may be moved, turned and scaled together with its poses
OUTLIER = 27.6  # chi-squared of a centre, as in `torchpose.calibration.intrinsics`: 1e-6 of good ones


def freed(views: Views, camera: object, R: Tensor, t: Tensor, count: int) -> tuple[float, Views]:
    """Chi-squared with free places, and the views with them."""
    bundle = adjust(views, camera, R, t)  # type: ignore[arg-type]
    last = float("inf")
    for _ in range(ROUNDS):
        arm = (bundle.R[views.view] @ views.points[..., None])[..., 0] + bundle.t[views.view]
        xy = arm[:, :2] / arm[:, 2:]
        by_place = bundle.camera.J_distort(xy) @ image_by_point(xy, arm[:, 2]) @ bundle.R[views.view]
        whiten = torch.linalg.inv(torch.linalg.cholesky(views.covariance))
        row, residual = whiten @ by_place, whiten @ bundle.residual[..., None]
        normal = segment_sum(row.mT @ row, views.point, count)
        right = segment_sum((row.mT @ residual)[..., 0], views.point, count)
        seen = torch.bincount(views.point, minlength=count) > 1
        eye = torch.eye(3, dtype=normal.dtype)
        step = torch.linalg.solve(torch.where(seen[:, None, None], normal, eye), right) * seen[:, None]
        views = replace(views, points=views.points + step[views.point])
        bundle = adjust(views, bundle.camera, bundle.R, bundle.t)
        chi2 = float(bundle.chi2.sum())
        if chi2 > (1 - 1e-4) * last:
            break
        last = chi2
    return chi2, views


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--board", required=True)
    options = parser.parse_args()
    files = sorted(path for path in options.folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".tif", ".bmp"))
    frames = torch.stack([torch.from_numpy(decode(path)) for path in files])
    grid = Grid.parse(options.board)
    assert grid is not None, "--board: circles, acircles or rings"
    cv2.setNumThreads(1)
    names, (height, width) = [path.name for path in files], frames.shape[1:]
    starts = start_cameras(width, height, LENS)
    marks = find_marks(names, frames, grid, starts[1])
    print(f"{len(marks)} of {len(files) * len(grid.points)} marks found in {len(files)} frames")
    rough = calibrate_intrinsics(marks.views(grid), starts, lens=LENS)
    tone = frames_tone(lambda: [(names, frames)], grid, rough.camera)
    print(f"tone {tone}")
    linear = tone.linear(frames)
    views = measure_marks(names, linear, marks, grid, rough.camera)
    fit = calibrate_intrinsics(views, [rough.camera], lens=LENS)
    views = measure_marks(names, linear, marks, grid, fit.camera)
    print(f"{len(views.view)} centres by the grey values, claimed {float(sigma(views)):.4f} px an axis")
    fit = calibrate_intrinsics(views, [fit.camera], lens=LENS)
    used = fit.views
    bundle = adjust(used, fit.camera, fit.bundle.R, fit.bundle.t)
    degrees = 2 * len(used.view) - 6 * len(used) - len(fit.names)
    print(f"board as named: RMS {fit.rms_px:.4f} px, chi-squared over freedom {float(bundle.chi2.sum()) / degrees:.2f}")
    places = len(used.point.unique())
    chi2, shaped = freed(used, bundle.camera, bundle.R, bundle.t, len(grid.points))
    bundle = adjust(shaped, bundle.camera, bundle.R, bundle.t)
    good = bundle.chi2 < OUTLIER
    reduced = chi2 / (degrees - 3 * places + GAUGE)
    print(f"places freed: chi-squared over freedom {reduced:.2f}, {int((~good).sum())} centres beyond chance (1e-6)")


def sigma(views: Views) -> Tensor:
    return views.covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt()


if __name__ == "__main__":
    main()
