"""Photographs of a real board of discs or rings: what is found, and how well centres agree with a camera and the board.

    python scripts/photograph_statistics.py FOLDER --board rings:10x7:20mm:7mm:3.5mm [--out board.yaml]

Prints the marks found, the tone that they tell, and chi-squared over freedom of the centres by the grey values, with
the covariance that the frames give them and none added: for the board as it is named, flat and regular, and for the
board measured together with the camera (`torchpose calibrate --board ... --measure-target`). The second is 1 where
centres err by no more than they claim; the first says how far the print is off. The adjustment leaves out rings that
contradict the others beyond chance; these are listed, and chi-squared over freedom is given with them, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import torch

from torchpose.calibration import Calibration
from torchpose.calibration.grids import Grid
from torchpose.calibration.intrinsics import start_cameras
from torchpose.calibration.session import Measurement, calibrate_camera, measure_target
from torchpose.io.images import decode

LENS = "brown5"


def described(fit: Calibration) -> str:
    """Residuals of a fit, and chi-squared over freedom by the covariances of the frames alone."""
    residual, covariance = fit.bundle.residual, fit.views.covariance
    chi2 = float((residual * torch.linalg.solve(covariance, residual)).sum()) / fit.degrees
    claimed = float(covariance.diagonal(dim1=-2, dim2=-1).mean(-1).median().sqrt())
    return (
        f"{len(fit.views.view)} centres, {fit.left_out} left out, RMS {fit.rms_px:.4f} px, claimed {claimed:.4f} px an "
        f"axis (median), chi-squared over freedom {chi2:.2f}, common error {fit.common_sigma_px:.4f} px"
    )


def with_left_out(found: Measurement) -> str:
    """The same of all rings that were fitted, and those that the adjustment left out, with their residuals."""
    fit, target, seen = found.calibration, found.target, found.calibration.seen
    assert seen is not None  # what was measured
    lost = [name for name in seen.names if name not in fit.views.names]
    seen = seen.of_views(torch.tensor([name not in lost for name in seen.names]))
    view = torch.tensor([fit.views.names.index(name) for name in seen.names])[seen.view]
    place = target.centers[(seen.point[:, None] == target.ids).int().argmax(1)]
    at = (fit.bundle.R[view] @ place[..., None]).squeeze(-1) + fit.bundle.t[view]
    residual = seen.pixels - found.camera.project(at)
    chi2 = (residual * torch.linalg.solve(seen.covariance, residual)).sum(-1)
    used = set(zip(fit.views.view.tolist(), fit.views.point.tolist(), strict=True))
    out = [k for k, one in enumerate(zip(view.tolist(), seen.point.tolist(), strict=True)) if one not in used]
    named = [
        f"{seen.names[int(seen.view[k])]} mark {int(seen.point[k])} ({float(residual[k].norm()):.3f} px, "
        f"{float(chi2[k]):.0f})"
        for k in out
    ]
    share = float(chi2.sum()) / (fit.degrees + 2 * len(out))
    return (
        f"with all {len(chi2)}: chi-squared over freedom {share:.2f}; left out were {', '.join(named + lost) or 'none'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--board", required=True)
    parser.add_argument("--out", type=Path, help="file of the measured board to write")
    options = parser.parse_args()
    files = sorted(path for path in options.folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".tif", ".bmp"))
    frames = torch.stack([torch.from_numpy(decode(path)) for path in files])
    grid = Grid.parse(options.board)
    assert grid is not None, "--board: circles, acircles or rings"
    cv2.setNumThreads(1)
    names, (height, width) = [path.name for path in files], frames.shape[1:]
    start = start_cameras(width, height, LENS)[0]
    named = calibrate_camera(lambda: [(names, frames)], grid, start, guess=True, lens=LENS)
    print(f"{len(files) * len(grid)} marks in {len(files)} frames, tone {named.camera.tone}")
    print(f"board as named: {described(named)}", flush=True)
    found = measure_target(lambda: [(names, frames)], grid, start, given="size", lens=LENS)
    print(f"board measured: {described(found.calibration)}")
    print(with_left_out(found))
    for warning in found.calibration.warnings:
        print(f"warning: {warning}")
    off = 1e3 * (found.target.centers - found.nominal.centers).square().mean(0).sqrt()
    radii = found.target.printed_radii.mean(0)
    for what, unit, values in (("places off by", "um RMS", off), ("radii", "mm", radii)):
        print(f"{what} {', '.join(f'{value:.5g}' for value in values.tolist())} {unit}")
    if options.out is not None:
        found.target.save(options.out)


if __name__ == "__main__":
    main()
