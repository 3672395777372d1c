"""Calibration against known truth: errors of the intrinsics over rendered sets, and whether their covariance is right.

    python scripts/calibration_statistics.py --sets 40 --out statistics.csv

Every set: views of the built-in target hexa50 in frames of 1824 x 1216 px, blur 0.7 px, noise 1, 8 bit, tilted within
--tilt degrees in all directions, anywhere in the frame. The true camera has focal lengths 0.25 % off the nominal ones
that all methods start from, and distortion k1 k2 p1 p2 k3, of which they know nothing. Columns: RMS error of fx and fy
together, of cx and cy together (px), the same as claimed, and the mean NEES of fx fy cx cy and of all nine, with the
interval in which it lies with 95 % where the covariance is right.

- photometric: `torchpose calibrate`, centres of single markers from the grey values.
- centers: compensated centres (exact common centre of both ellipses, fitted without distortion), the same adjustment.
- predicted: centres of both ellipses of every ring against the predicted ones, the same adjustment.
- opencv ellipses: centres of the outer ellipses, sub-pixel, cv2.calibrateCamera.
- opencv blobs: cv2.SimpleBlobDetector, which cv2.findCirclesGrid takes its centres from, cv2.calibrateCamera.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

import torchpose as tp
from torchpose import ellipse
from torchpose.calibration import Calibration, Views, calibrate_intrinsics
from torchpose.calibration.rings import find_rings
from torchpose.calibration.session import calibrate_camera
from torchpose.detect import find_candidates
from torchpose.geometry import rotations
from torchpose.io.writers import write_rows
from torchpose.rings import measure_rings
from torchpose.sim import add_noise, render

F64 = torch.float64
WIDTH, HEIGHT, FOCAL = 1824, 1216, 1111.11
TRUE = tp.Camera(
    WIDTH,
    HEIGHT,
    torch.tensor([[1.0025 * FOCAL, 0, 905.3], [0, 1.0025 * FOCAL, 612.8], [0, 0, 1]], dtype=F64),
    torch.tensor([-0.08, 0.03, 2e-4, -1.5e-4, -0.01], dtype=F64),
)
START = replace(
    TRUE,
    matrix=torch.tensor([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], dtype=F64),
    distortion=torch.zeros(5, dtype=F64),
)
LENS = "brown5"
DISTANCE = (140.0, 200.0)  # mm
BORDER = 12.0  # px between rings and border


def intrinsics(camera: tp.Camera) -> Tensor:
    return torch.cat([camera.matrix.diagonal()[:2], camera.matrix[:2, 2], camera.distortion])


def draw_poses(target: tp.Target, count: int, tilt: tuple[float, float], seed: int) -> tuple[Tensor, Tensor]:
    """R (V, 3, 3), t (V, 3): all rings in view."""
    g = torch.Generator().manual_seed(seed)
    u = torch.rand(60 * count, 6, dtype=F64, generator=g)
    angle, azimuth, roll = (
        (tilt[0] + (tilt[1] - tilt[0]) * u[:, 0]).deg2rad(),
        2 * math.pi * u[:, 1],
        2 * math.pi * u[:, 2],
    )
    zero = torch.zeros_like(angle)
    r = rotations.exp(angle[:, None] * torch.stack([azimuth.cos(), azimuth.sin(), zero], -1))
    r = r @ rotations.exp(torch.stack([zero, zero, roll], -1))
    depth = DISTANCE[0] + (DISTANCE[1] - DISTANCE[0]) * u[:, 3]
    xy = TRUE.undistort_points(torch.stack([u[:, 4] * WIDTH, u[:, 5] * HEIGHT], -1))
    t = torch.cat([xy, torch.ones_like(xy[:, :1])], -1) * depth[:, None]
    around = 2 * math.pi * torch.arange(16, dtype=F64) / 16
    circle = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], -1)
    rims = (target.centers[:, None] + target.radii[:, :1, None] * circle).flatten(0, 1)
    uv = TRUE.project(rims @ r.mT + t[:, None])
    size = torch.tensor([WIDTH, HEIGHT], dtype=F64)
    inside = ((uv > BORDER) & (uv < size - BORDER)).all(-1).all(-1)
    chosen = inside.nonzero()[:count, 0]
    return r[chosen], t[chosen]


def ring_views(names: list[str], frames: Tensor, target: tp.Target, which: int) -> tuple[Views, Tensor, Tensor]:
    """Centres of the outer (0) or inner (1) ellipses in raw pixels as views, radii (K,) and the inner ellipses (K, 5).

    The markers are those of `find_rings`, told by their place.
    """
    marked = find_rings(names, frames, [START], target)[0]
    candidates = find_candidates(frames)
    rings = measure_rings(frames, candidates[candidates.polarity == 1], START)
    fits, raw = (rings.outer, rings.outer_raw) if which == 0 else (rings.inner, rings.inner_raw)
    apart = torch.cdist(marked.pixels, rings.outer_raw[:, :2]) + 1e6 * (marked.view[:, None] != rings.frame)
    at = apart.argmin(1)
    views = replace(marked, pixels=raw[at, :2], covariance=fits.center_covariance[at])
    return views, target.radii[views.point, which], rings.inner_raw[at]


def predicted_shift(views: Views, radius: Tensor, camera: tp.Camera, r: Tensor, t: Tensor) -> Tensor:
    """Centre of the ellipse fitted to the image of each circle, minus the image of its centre, (K, 2) px."""
    around = 2 * math.pi * torch.arange(64, dtype=F64) / 64
    circle = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], -1)
    rotation, translation = r[views.view], t[views.view]
    rim = views.points[:, None] + radius[:, None, None] * circle
    uv = camera.project(rim @ rotation.mT + translation[:, None])
    index = torch.arange(len(uv)).repeat_interleave(64)
    fitted = ellipse.fit(uv.flatten(0, 1), index, len(uv))[:, :2]
    return fitted - camera.project((rotation @ views.points[..., None])[..., 0] + translation)


def by_prediction(names: list[str], frames: Tensor, target: tp.Target) -> Calibration:
    """Residual: fitted minus predicted centre of every ellipse. The shift is renewed until it stands."""
    both = [ring_views(names, frames, target, which) for which in (0, 1)]
    views = Views.cat([both[0][0]])
    joined: dict[str, Any] = {
        name: torch.cat([getattr(part, name) for part, _, _ in both])
        for name in ("view", "point", "points", "pixels", "covariance")
    }
    views = replace(views, **joined)
    radius = torch.cat([size for _, size, _ in both])
    result = calibrate_intrinsics(views, [START], lens=LENS)
    for _ in range(3):
        # the adjustment may have left views or points out: their shift comes from the poses that there are
        place = {name: k for k, name in enumerate(result.views.names)}
        known = torch.tensor([place.get(name, -1) for name in views.names])
        kept = known[views.view] >= 0
        views, radius = views[kept], radius[kept]
        shift = predicted_shift(
            replace(views, view=known[views.view]), radius, result.camera, result.bundle.R, result.bundle.t
        )
        result = calibrate_intrinsics(replace(views, pixels=views.pixels - shift), [result.camera], lens=LENS)
    return result


def by_opencv(views: Views) -> Tensor:
    """Intrinsics by cv2.calibrateCamera from the same start."""
    objects = [views.points[views.view == k].float().numpy() for k in range(len(views))]
    images = [views.pixels[views.view == k].float().numpy()[:, None] for k in range(len(views))]
    pairs = [(o, i) for o, i in zip(objects, images, strict=True) if len(o) >= 4]
    done = cv2.calibrateCamera(
        [o for o, _ in pairs],
        [i for _, i in pairs],
        (WIDTH, HEIGHT),
        START.matrix.numpy().copy(),
        np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    k, d = done[1], done[2].ravel()
    return torch.tensor([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d[:5]], dtype=F64)


def blob_views(views: Views, frames: Tensor, target: tp.Target, holes: Tensor) -> Views:
    """The same markers where OpenCV's blob detector, with the settings of findCirclesGrid, sees their outer discs.

    It wants full discs: the holes (K, 5), inner ellipses, are painted over up to the middle of the ring.
    """
    parameters = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5
    parameters.maxArea = 1e5
    detector = cv2.SimpleBlobDetector_create(parameters)  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5
    pixels, found = views.pixels.clone(), torch.zeros(len(views.view), dtype=torch.bool)
    wider = 0.5 + 0.5 * target.radii[views.point, 0] / target.radii[views.point, 1]
    for k, frame in enumerate(frames):
        picture = frame.numpy().copy()
        mine = (views.view == k).nonzero()[:, 0]
        for (u, v, a, b, theta), scale in zip(holes[mine].tolist(), wider[mine].tolist(), strict=True):
            box = ((u, v), (2 * scale * a, 2 * scale * b), math.degrees(theta))
            cv2.ellipse(picture, box, int(picture.min()), cv2.FILLED)
        points = torch.tensor([p.pt for p in detector.detect(picture)], dtype=F64).reshape(-1, 2)
        if len(points):
            nearest, at = torch.cdist(views.pixels[mine], points).min(1)
            pixels[mine], found[mine] = points[at], nearest < 5
    return replace(views, pixels=pixels)[found]


def one_set(
    target: tp.Target, views: int, tilt: tuple[float, float], noise: float, seed: int
) -> dict[str, dict[str, Tensor]]:
    """Errors (9,) of each method and, where it claims one, its covariance (9, 9)."""
    pose = draw_poses(target, views, tilt, seed)
    frames = add_noise(render(TRUE, target, *pose, psf_sigma=0.7), noise, seed=seed)
    names = [str(k) for k in range(views)]
    outer, _, holes = ring_views(names, frames, target, 0)
    photometric = calibrate_camera(lambda: [(names, frames)], target, START, guess=False, lens=LENS)
    again = find_rings(names, frames, [photometric.camera], target)[0]
    fits = {
        "photometric": photometric,
        "centers": calibrate_intrinsics(again, [START], lens=LENS),
        "predicted": by_prediction(names, frames, target),
    }
    truth = intrinsics(TRUE)
    results = {
        name: {
            "error": intrinsics(fit.camera) - truth,
            "covariance": fit.covariance,
            "reduced": torch.tensor(fit.reduced_chi2),
        }
        for name, fit in fits.items()
    }
    results["opencv ellipses"] = {"error": by_opencv(outer) - truth}
    results["opencv blobs"] = {"error": by_opencv(blob_views(outer, frames, target, holes)) - truth}
    return results


def summary(method: str, sets: list[dict[str, Tensor]]) -> dict[str, float | str | int | None]:
    error = torch.stack([s["error"] for s in sets])
    row: dict[str, float | str | int | None] = {
        "method": method,
        "sets": len(sets),
        "focal_rms_px": float(error[:, :2].square().mean().sqrt()),
        "focal_bias_px": float(error[:, :2].mean()),
        "center_rms_px": float(error[:, 2:4].square().mean().sqrt()),
    }
    row |= dict.fromkeys(("focal_claimed_px", "center_claimed_px", "nees4", "nees9", "reduced_chi2"))
    if "covariance" in sets[0]:
        spread = torch.stack([s["covariance"] for s in sets])
        variance = spread.diagonal(dim1=-2, dim2=-1)

        def nees(n: int) -> float:
            e = error[:, :n, None]
            return float((e.mT @ torch.linalg.solve(spread[:, :n, :n], e)).mean())

        row |= {
            "focal_claimed_px": float(variance[:, :2].mean().sqrt()),
            "center_claimed_px": float(variance[:, 2:4].mean().sqrt()),
            "nees4": nees(4),
            "nees9": nees(9),
            "reduced_chi2": float(torch.stack([s["reduced"] for s in sets]).mean()),
        }
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=4)
    parser.add_argument("--views", type=int, default=18)
    parser.add_argument("--tilt", type=float, nargs=2, default=(10.0, 40.0), help="degrees, least and most")
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="CSV file of the table")
    options = parser.parse_args()
    target = tp.Target.load("hexa50")
    tilt = (options.tilt[0], options.tilt[1])
    sets: list[dict[str, dict[str, Tensor]]] = []
    rows = []
    for k in range(options.sets):
        sets.append(one_set(target, options.views, tilt, options.noise, options.seed * 1000 + k))
        rows = [summary(method, [s[method] for s in sets]) for method in sets[0]]
        if options.out:  # a run that is stopped keeps what it has
            write_rows(options.out, rows, {n: str if n == "method" else int if n == "sets" else float for n in rows[0]})
    print(f"{options.sets} sets of {options.views} views, tilt {options.tilt[0]:g} to {options.tilt[1]:g} degrees")
    for row in rows:
        print(
            "  ".join(
                f"{name} {value:.4g}" if isinstance(value, float) else f"{value!s:>16}" for name, value in row.items()
            )
        )
    for n in (4, 9):
        low, high = (chi2.ppf(p, n * options.sets) / options.sets for p in (0.025, 0.975))
        print(f"mean NEES of {n}: {low:.2f} to {high:.2f} where the covariance is right")


if __name__ == "__main__":
    main()
