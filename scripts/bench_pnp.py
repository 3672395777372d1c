"""Poses per second of `torchpose.pnp.solve` beside OpenCV and PoseLib called in a loop, wins and losses alike.

    python scripts/bench_pnp.py --out bench_pnp.csv            # batches 1 to 1,000,000; minutes
    python scripts/bench_pnp.py --batches 1 64 4096 --no-compile

Every round times every contestant once, so that a change of the machine's speed meets all of them; the table gives the
median and the quartiles of the rounds. Loops are timed on at most `LOOP` poses. PyTorch3D, PyPose and Kornia take part
where they can be imported. `peak_mb` is the rise of the process's high-water mark during the first call, in a fresh
process's order of growing batches: with chunks it stays flat but for the results themselves.
"""

from __future__ import annotations

import argparse
import csv
import math
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations

LOOP = 1000
SIGMA_PX = 0.1
MATRIX = torch.tensor([[1111.0, 0, 912], [0, 1111.0, 608], [0, 0, 1]], dtype=torch.float64)
TARGETS = {
    4: torch.tensor([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], dtype=torch.float64),
    9: torch.tensor([[x, y, 0.0] for y in (-20, 0, 20) for x in (-20, 0, 20)], dtype=torch.float64),
}


def scene(points: Tensor, batch: int, seed: int = 0) -> Tensor:
    """Pixels (B, N, 2): tilt 10 to 60 degrees, distance 5 to 20 target sizes, noise `SIGMA_PX`."""
    g = torch.Generator().manual_seed(seed)
    tilt, azimuth, roll, x, y, z = torch.rand(6, batch, generator=g, dtype=torch.float64)
    tilt, zero = math.radians(10) + math.radians(50) * tilt, torch.zeros(batch, dtype=torch.float64)
    axis = torch.stack([(2 * math.pi * azimuth).cos(), (2 * math.pi * azimuth).sin(), zero], -1)
    r = rotations.exp(axis * tilt[:, None]) @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * roll], -1))
    depth = 40 * (5 + 15 * z)
    t = torch.stack([0.4 * (x - 0.5) * depth, 0.4 * (y - 0.5) * depth, depth], -1)
    camera_points = points @ r.mT + t[:, None]
    pixels = camera_points[..., :2] / camera_points[..., 2:] * 1111.0 + MATRIX[:2, 2]
    return pixels + SIGMA_PX * torch.randn(pixels.shape, generator=g, dtype=torch.float64)


def opencv(flag: int) -> Callable[[Tensor, Tensor], None]:
    """A loop of cv2.solvePnP."""
    matrix = MATRIX.numpy()

    def run(points: Tensor, pixels: Tensor) -> None:
        model = points.numpy()
        for image in pixels.numpy():
            cv2.solvePnP(model, image, matrix, None, flags=flag)

    return run


def poselib_loop() -> Callable[[Tensor, Tensor], None] | None:
    """A loop of PoseLib's estimator, which has its RANSAC around the minimal solver and the refinement."""
    try:
        import poselib
    except ImportError:
        return None
    camera = {"model": "PINHOLE", "width": 1824, "height": 1216, "params": [1111.0, 1111.0, 912.0, 608.0]}

    def run(points: Tensor, pixels: Tensor) -> None:
        model = points.numpy()
        for image in pixels.numpy():
            poselib.estimate_absolute_pose(image, model, camera, {}, {})

    return run


def torch_peers() -> dict[str, Callable[[Tensor, Tensor], None]]:
    """Batched solvers of other torch libraries, where they can be imported."""
    peers: dict[str, Callable[[Tensor, Tensor], None]] = {}
    try:
        from pytorch3d.ops import efficient_pnp
    except ImportError:
        pass
    else:

        def pytorch3d(points: Tensor, pixels: Tensor) -> None:
            xy = (pixels - MATRIX[:2, 2]) / MATRIX[0, 0]
            efficient_pnp(points.expand(len(pixels), -1, -1), xy)

        peers["pytorch3d efficient_pnp"] = pytorch3d
    try:
        from pypose.module import EPnP
    except ImportError:
        pass
    else:

        def pypose(points: Tensor, pixels: Tensor) -> None:
            EPnP(intrinsics=MATRIX)(points.expand(len(pixels), -1, -1), pixels)

        peers["pypose EPnP"] = pypose
    from kornia.geometry import solve_pnp_dlt

    def kornia(points: Tensor, pixels: Tensor) -> None:
        solve_pnp_dlt(points.expand(len(pixels), -1, -1), pixels, MATRIX.expand(len(pixels), 3, 3))

    peers["kornia solve_pnp_dlt"] = kornia
    return peers


def contestants(compile: bool) -> dict[str, tuple[Callable[[Tensor, Tensor], object], int | None]]:
    """Name: function of (points, pixels), and the most poses it is timed on."""

    def ours(method: pnp.Method, fast: bool) -> Callable[[Tensor, Tensor], object]:
        return lambda points, pixels: pnp.solve(points, pixels, MATRIX, method=method, sigma_px=SIGMA_PX, compile=fast)

    table: dict[str, tuple[Callable[[Tensor, Tensor], object], int | None]] = {
        "torchpose iterative": (ours("iterative", False), None),
        **({"torchpose iterative, compiled": (ours("iterative", True), None)} if compile else {}),
        "torchpose planar": (ours("planar", False), None),
        "torchpose epnp": (ours("epnp", False), None),
        "cv2 ITERATIVE": (opencv(cv2.SOLVEPNP_ITERATIVE), LOOP),
        "cv2 EPNP": (opencv(cv2.SOLVEPNP_EPNP), LOOP),
        "cv2 IPPE": (opencv(cv2.SOLVEPNP_IPPE), LOOP),
        "cv2 SQPNP": (opencv(cv2.SOLVEPNP_SQPNP), LOOP),
    }
    if (loop := poselib_loop()) is not None:
        table["PoseLib estimate_absolute_pose"] = (loop, LOOP)
    table.update({name: (function, 65536) for name, function in torch_peers().items()})
    return table


def measure(points: Tensor, batch: int, rounds: int, compile: bool) -> list[dict[str, object]]:
    """Rows of the table for one batch size."""
    pixels = scene(points, batch)
    table = contestants(compile)
    times: dict[str, list[float]] = {}
    failed: dict[str, str] = {}
    peak: dict[str, float] = {}
    for name, (function, most) in table.items():  # not timed: caches, compilation
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            function(points, pixels[:most])
        except Exception as error:  # a peer that rejects planar points is a result, not a fault of the benchmark
            failed[name] = str(error).splitlines()[0][:60] if str(error) else type(error).__name__
        peak[name] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    for _ in range(rounds):
        for name, (function, most) in table.items():
            if name in failed:
                continue
            part = pixels[:most]
            start = time.perf_counter()
            function(points, part)
            times.setdefault(name, []).append((time.perf_counter() - start) / len(part))
    base = statistics.median(times["cv2 ITERATIVE"])
    rows = []
    for name in table:
        row: dict[str, object] = {"points": len(points), "batch": batch, "method": name}
        if name in failed:
            rows.append(row | {"note": failed[name]})
            continue
        low, middle, high = np.percentile(times[name], [25, 50, 75])
        rows.append(
            row
            | {
                "us_per_pose": 1e6 * middle,
                "us_quartiles": f"{1e6 * low:.3g}..{1e6 * high:.3g}",
                "poses_per_s": 1 / middle,
                "times_cv2_iterative": base / middle,
                "peak_mb": peak[name],
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 64, 256, 4096, 65536, 1_000_000])
    parser.add_argument("--points", type=int, nargs="+", choices=TARGETS, default=[4, 9])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-compile", dest="compile", action="store_false")
    parser.add_argument("--out", type=Path, help="CSV file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(1)
    print(
        f"# {platform.processor() or platform.machine()}, {args.threads} threads, torch {torch.__version__}, "
        f"OpenCV {cv2.__version__}, {args.rounds} rounds"
    )
    names = [
        "points",
        "batch",
        "method",
        "us_per_pose",
        "us_quartiles",
        "poses_per_s",
        "times_cv2_iterative",
        "peak_mb",
        "note",
    ]
    screen = csv.DictWriter(sys.stdout, names, delimiter="\t")
    screen.writeheader()
    rows = []
    for count in args.points:
        for batch in args.batches:
            for row in measure(TARGETS[count], batch, args.rounds, args.compile):
                rows.append(row)
                screen.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})
                sys.stdout.flush()
    if args.out is not None:
        with args.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
