"""Would SQPnP's start lead to lower minima than those of `torchpose.pnp.solve`? OpenCV's, refined by ours, beside it.

    python scripts/pnp_starts.py --scenes 2000

Points scattered in a cube, in slabs and in a plane, noise 0.5 px, tilt 0 to 75 degrees, distance 3 to 12 sizes. The
columns are fractions of the scenes: those that ours fails in or calls ambiguous, those where either start ends in a
lower minimum, and poses called converged although SQPnP leads lower. The last line is the price of a batch of 9 x 9
eigenvalue problems.
"""

from __future__ import annotations

import argparse
import math
import time

import cv2
import torch

from torchpose import pnp
from torchpose.geometry import rotations

MATRIX = torch.tensor([[1111.0, 0, 640], [0, 1111.0, 480], [0, 0, 1]], dtype=torch.float64)
SIGMA_PX = 0.5


def row(thickness: float, count: int, scenes: int) -> dict[str, float]:
    g = torch.Generator().manual_seed(count)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    points = 40 * (uniform(scenes, count, 3) - 0.5) * torch.tensor([1, 1, thickness], dtype=torch.float64)
    azimuth, zero = 2 * math.pi * uniform(scenes), torch.zeros(scenes, dtype=torch.float64)
    axis = torch.stack([azimuth.cos(), azimuth.sin(), zero], -1)
    r = rotations.exp(axis * math.radians(75) * uniform(scenes, 1))
    r = r @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * uniform(scenes)], -1))
    depth = 40 * (3 + 9 * uniform(scenes, 1))
    t = torch.cat([0.6 * (uniform(scenes, 2) - 0.5) * depth, depth], 1)
    camera_points = points @ r.mT + t[:, None]
    image = (camera_points / camera_points[..., 2:] @ MATRIX.T)[..., :2]
    image = image + SIGMA_PX * torch.randn(image.shape, generator=g, dtype=torch.float64)

    ours = pnp.solve(points, image, MATRIX, sigma_px=SIGMA_PX)
    starts = []
    for model, pixels in zip(points.numpy(), image.numpy(), strict=True):
        _, rvec, tvec = cv2.solvePnP(model, pixels, MATRIX.numpy(), None, flags=cv2.SOLVEPNP_SQPNP)
        starts.append(torch.from_numpy(cv2.hconcat([cv2.Rodrigues(rvec)[0], tvec])))
    start = torch.stack(starts)
    theirs = pnp.solve(points, image, MATRIX, sigma_px=SIGMA_PX, initial=(start[..., :3], start[..., 3]))
    a, b = (found.chi2.nan_to_num(torch.inf) for found in (ours, theirs))
    lower = b < a - 1e-3
    fractions = {
        "ours_failed": ours.code > pnp.PnPCode.AMBIGUOUS,
        "ours_ambiguous": ours.code == pnp.PnPCode.AMBIGUOUS,
        "sqpnp_lower": lower,
        "ours_lower": a < b - 1e-3,
        "converged_but_sqpnp_lower": lower & ours.converged,
    }
    return {name: float(flag.double().mean()) for name, flag in fractions.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=2000)
    args = parser.parse_args()
    for name, thickness in (("cube", 1.0), ("slab 5 %", 0.05), ("slab 2 %", 0.02), ("plane", 0.0)):
        for count in (4, 5, 6, 10):
            fractions = row(thickness, count, args.scenes)
            print(f"{name:8s} {count:2d} points", *(f"{k} {v:.4f}" for k, v in fractions.items()), flush=True)
    matrices = torch.randn(16384, 9, 9, dtype=torch.float64)
    start = time.perf_counter()
    torch.linalg.eigh(matrices @ matrices.mT)
    print(f"eigh of 9 x 9: {1e6 * (time.perf_counter() - start) / len(matrices):.2f} us each")


if __name__ == "__main__":
    main()
