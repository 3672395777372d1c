"""What `torchpose.kernels.mapped` gives small dense problems of the pipeline: compiled beside eager, wins and losses.

    python scripts/bench_kernels.py --out docs/benchmarks/kernels.md

Every round times every contestant once, so that a change of the machine's speed meets all of them; the table gives the
median of the rounds, each of which repeats a call for `SLICE_S`. On one thread it is the CPU time of the process, which
other processes do not take part in; on several, the time that passes. `compile_s` is the first call, with nothing kept
of earlier ones.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import conics, rotations
from torchpose.geometry.least_squares import solve_scaled
from torchpose.kernels import mapped
from torchpose.pose.centers import exact

SLICE_S = 0.005
BATCHES = (1, 8, 64, 1024)
SQUARE = torch.tensor([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], dtype=torch.float64)
MATRIX = torch.tensor([[1111.0, 0, 640], [0, 1111.0, 480], [0, 0, 1]], dtype=torch.float64)


def circles(matrix: Tensor, rotation: Tensor, center: Tensor, radius: Tensor) -> Tensor:
    """`conics.circle_ellipse` in the plane of the target, without the choice of an axis, which looks at numbers."""
    to_ray = torch.linalg.inv(matrix)
    e1, e2 = rotation[..., 0], rotation[..., 1]
    adjugate = torch.stack(
        [torch.linalg.cross(e2, center), torch.linalg.cross(center, e1), torch.linalg.cross(e1, e2)], -2
    )
    weight = torch.stack([torch.ones_like(radius), torch.ones_like(radius), -radius.square()], -1)
    conic = adjugate.mT @ (weight[..., None] * adjugate)
    return conics.ellipse_from_conic(conics.from_matrix(to_ray.mT @ conic @ to_ray))


def solve_centers(image: Tensor, covariances: Tensor, r: Tensor, t: Tensor, compile: bool) -> Tensor:
    """The pose from marker centres, as the pipeline asks for it: two starts, a covariance for every centre."""
    starts = torch.stack([r, r], 1), torch.stack([t, 1.01 * t], 1)
    found = pnp.solve(SQUARE, image, MATRIX, covariances=covariances, initial=starts, compile=compile)
    return found.t


def problems(batch: int) -> dict[str, tuple[Callable[..., Any], Callable[..., Any], tuple[Any, ...]]]:
    """Name: eager, compiled, arguments."""
    g = torch.Generator().manual_seed(batch)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    root, right = uniform(batch, 7, 9), uniform(batch, 7, 8)
    size = 10 * (1 + uniform(batch))
    ellipses = torch.stack([*(300 * uniform(2, batch)), 2 * size, (1 + uniform(batch)) * size, 3 * uniform(batch)], -1)
    pair = torch.stack([ellipses, ellipses * torch.tensor([1, 1, 0.5, 0.5, 1], dtype=torch.float64)], 1)
    covariances = (0.01 * torch.eye(2, dtype=torch.float64)).expand(batch, 2, 2, 2)
    radii = torch.tensor([2.0, 1.0], dtype=torch.float64).expand(batch, 2)
    r = rotations.exp(0.6 * uniform(batch, 3))
    t = torch.cat([uniform(batch, 2) - 0.5, 8 + uniform(batch, 1)], 1)
    image = (SQUARE @ torch.eye(3, dtype=torch.float64) + 40 * t[:, None]) @ MATRIX.T
    image = image[..., :2] / image[..., 2:] + 0.1 * uniform(batch, 4, 2)
    upright = torch.eye(3, dtype=torch.float64).expand(batch, 3, 3)
    table: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "pose.centers.exact, two circles": (exact, (pair, covariances, radii)),
        "least_squares.solve_scaled, 7 x 7": (solve_scaled, (root @ root.mT, right)),
        "conics.conic_from_ellipse": (conics.conic_from_ellipse, (ellipses,)),
        "conics.ellipse_from_conic": (conics.ellipse_from_conic, (conics.conic_from_ellipse(ellipses),)),
        "image of a circle": (circles, (MATRIX.expand(batch, 3, 3), r, t, uniform(batch))),
    }
    rows = {name: (function, mapped(function), args) for name, (function, args) in table.items()}
    spread = (0.01 * torch.eye(2, dtype=torch.float64)).expand(batch, 4, 2, 2)
    rows["pnp.solve of four centres, two starts"] = (
        partial(solve_centers, compile=False),
        partial(solve_centers, compile=True),
        (image, spread, upright, 40 * t),
    )
    return rows


def once(call: Callable[[], object], repeat: int) -> float:
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    start = clock()
    for _ in range(repeat):
        call()
    return (clock() - start) / repeat


def measure(batch: int, rounds: int, threads: int) -> list[list[str]]:
    """Rows of the table for one batch size; the results of both are compared first."""
    torch.set_num_threads(threads)
    table = problems(batch)
    calls: dict[tuple[str, int], Callable[[], object]] = {}
    first: dict[str, float] = {}
    for name, (eager, fast, args) in table.items():
        start = time.perf_counter()
        fast(*args)
        first[name] = time.perf_counter() - start
        ours, theirs = (torch.utils._pytree.tree_leaves(f(*args)) for f in (fast, eager))
        for x, y in zip(ours, theirs, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-6, atol=1e-6, equal_nan=True)
        for k, function in enumerate((eager, fast)):
            calls[name, k] = lambda function=function, args=args: function(*args)  # type: ignore[misc]
    repeat = {key: max(1, int(SLICE_S / once(call, 3))) for key, call in calls.items()}
    times: dict[tuple[str, int], list[float]] = {key: [] for key in calls}
    for _ in range(rounds):
        for key, call in calls.items():
            times[key].append(once(call, repeat[key]))
    rows = []
    for name in table:
        plain, fast_s = (statistics.median(times[name, k]) for k in (0, 1))
        numbers = [f"{1e6 * plain:.4g}", f"{1e6 * fast_s:.4g}", f"{plain / fast_s:.2f}"]
        rows.append([name, str(batch), str(threads), *numbers, f"{first[name]:.1f}" if first[name] > 0.2 else ""])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, torch.get_num_threads()])
    parser.add_argument("--out", type=Path, help="Markdown file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        names = ["problem", "batch", "threads", "eager_us", "compiled_us", "times", "compile_s"]
        rows = [names, ["---"] * len(names)]
        for threads in sorted(set(args.threads)):
            for batch in BATCHES:
                rows += measure(batch, args.rounds, threads)
    machine = f"{platform.processor() or platform.machine()}, torch {torch.__version__}, {args.rounds} rounds"
    text = "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"
    print(f"{machine}\n{text}")
    if args.out is not None:
        about = "# Small dense problems: compiled beside eager\n\nBy `scripts/bench_kernels.py`: median time of a call."
        args.out.write_text(f"{about} {machine}.\n\n{text}")


if __name__ == "__main__":
    main()
