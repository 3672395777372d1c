"""Accuracy against cost of every method, beside OpenCV's blobs and ringgrid's proposals, on the same frames.

    python scripts/bench_precision.py --frames 64 --noise 2
    python scripts/bench_precision.py --distance 78 84

Simulated 2-megapixel frames of quad40, tilt up to 45 degrees; at 78 to 84 mm its rings have a radius of 70 px. Cost:
CPU milliseconds a frame on one thread, of the whole estimator and of the refinement alone (less what "centers" takes).
Peers measure centres, which cv2.solvePnP (IPPE, then iterative) turns into poses with the true correspondence:

- OpenCV: the blob detector that findCirclesGrid uses, blobs nearest to the markers;
- ringgrid (pip install ringgrid), where it is installed: proposals (first stage) nearest to the markers.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from precision_statistics import CASES, DARK, LIGHT, PLATE, TARGET, camera_of, tilted
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_crlb
from torchpose.geometry import rotations
from torchpose.pipeline import Method
from torchpose.sim import add_noise, render

METHODS: tuple[Method, ...] = ("paper", "centers", "edges", "photometric")
NEAR = 0.3  # of the outer radius within which a centre counts as the marker's


def blobs(frame: np.ndarray) -> np.ndarray:
    """Centres (K, 2) of dark blobs, of OpenCV's detector as findCirclesGrid uses it."""
    options = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5
    options.minArea, options.maxArea = 50.0, 1e5
    options.filterByColor = options.filterByInertia = options.filterByConvexity = False  # the middle of a ring is light
    detector = cv2.SimpleBlobDetector_create(options)  # type: ignore[attr-defined]  # missing in the stubs of OpenCV 5
    found = detector.detect(frame)
    return np.array([k.pt for k in found], dtype=np.float64).reshape(-1, 2)


def ringgrid_centers() -> Callable[[np.ndarray], np.ndarray] | None:
    """Centres by ringgrid's proposals, where it is installed."""
    if importlib.util.find_spec("ringgrid") is None:
        return None
    import ringgrid

    def centers(frame: np.ndarray) -> np.ndarray:
        return np.array([[p.x, p.y] for p in ringgrid.propose(frame)], dtype=np.float64).reshape(-1, 2)

    return centers if hasattr(ringgrid, "propose") else None


def poses_from_centers(centers: list[np.ndarray], uv: Tensor, reach: Tensor, camera: tp.Camera) -> tuple[Tensor, ...]:
    """R, t and whether all markers were seen; correspondence by the true projections ``uv`` (B, 4, 2)."""
    points, matrix = TARGET.centers.numpy(), camera.matrix.numpy()
    out_r, out_t, ok = [], [], []
    for found, truth, near in zip(centers, uv.numpy(), reach.tolist(), strict=True):
        r: np.ndarray = np.eye(3)
        t: np.ndarray = np.full(3, math.nan)
        good = False
        if len(found):
            distance = np.linalg.norm(truth[:, None] - found, axis=-1)
            pick = distance.argmin(1)
            if (distance.min(1) < near).all():
                good, rvec, tvec = cv2.solvePnP(points, found[pick], matrix, None, flags=cv2.SOLVEPNP_IPPE)
                rvec, tvec = cv2.solvePnPRefineLM(points, found[pick], matrix, None, rvec, tvec)
                r, t = cv2.Rodrigues(rvec)[0], tvec[:, 0]
        out_r.append(r)
        out_t.append(t)
        ok.append(bool(good))
    return torch.from_numpy(np.stack(out_r)), torch.from_numpy(np.stack(out_t)), torch.tensor(ok)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--noise", type=float, default=2.0)
    parser.add_argument("--distance", type=float, nargs=2, default=(140.0, 190.0), metavar=("NEAR", "FAR"), help="mm")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera, case = camera_of(0.0), CASES["tilt"]
    g = torch.Generator().manual_seed(3)
    near, far = options.distance
    r, t = tilted(45, near, far)(options.frames, g)
    t[:, :2] *= min(1.0, near / 140)  # all markers in view
    clean = render(camera, TARGET, r, t, psf_sigma=case.blur, plate=PLATE, dark=DARK, light=LIGHT)
    frames = add_noise(clean, options.noise, seed=3)
    bound = pose_crlb(camera, TARGET, r, t, psf_sigma=case.blur, dark=DARK, light=LIGHT, noise_sigma=options.noise)
    limit = bound.diagonal(dim1=-2, dim2=-1)
    uv = camera.project((r[:, None] @ TARGET.centers[..., None]).squeeze(-1) + t[:, None])
    reach = NEAR * camera.matrix[0, 0] * TARGET.radii[0, 0] / t[:, 2]

    estimators = {m: tp.PoseEstimator(camera, TARGET, method=m) for m in METHODS}
    cost: dict[str, float] = dict.fromkeys(METHODS, math.inf)
    found: dict[str, tuple[Tensor, ...]] = {}
    for _ in range(options.rounds + 1):  # the first warms up
        for m, estimator in estimators.items():
            start = time.process_time()
            poses = estimator(frames)
            cost[m] = min(cost[m], 1e3 * (time.process_time() - start) / options.frames)
            found[m] = (poses.R, poses.t, poses.ok)
    peers: dict[str, Callable[[np.ndarray], np.ndarray] | None] = {
        "opencv blobs": blobs,
        "ringgrid 1st": ringgrid_centers(),
    }
    for name, centers in peers.items():
        if centers is None:
            print(f"{name}: not installed")
            continue
        start = time.process_time()
        every = [centers(frame) for frame in frames.numpy()]
        cost[name] = 1e3 * (time.process_time() - start) / options.frames
        found[name] = poses_from_centers(every, uv, reach, camera)

    radius = float((camera.matrix[0, 0] * TARGET.radii[0, 0] / t[:, 2]).mean())
    print(f"mean outer radius {radius:.0f} px")
    print("method          frames   lateral um    depth um  rotation mdeg   x bound   CPU ms/frame   refinement")
    for name, (r_found, t_found, ok) in found.items():
        e = torch.cat([t_found - t, rotations.log(r_found @ r.mT)], -1)[ok].square()
        if not len(e):
            print(f"{name:14s} {0:7d}")
            continue
        of = [e.mean(0)[s].sum().sqrt() for s in (slice(0, 2), slice(2, 3), slice(3, 6))]
        ratio = float((e.mean(0) / limit[ok].mean(0)).mean().sqrt())
        extra = f"{cost[name] - cost['centers']:12.1f}" if name in ("edges", "photometric") else ""
        print(f"{name:14s} {int(ok.sum()):7d} {1e3 * of[0]:12.2f} {1e3 * of[1]:11.2f} {math.degrees(1e3 * of[2]):14.2f}"
              f" {ratio:9.2f} {cost[name]:14.1f} {extra}")  # fmt: skip


if __name__ == "__main__":
    main()
