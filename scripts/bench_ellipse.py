"""Speed of the batched ellipse fits beside OpenCV and scikit-image, one ellipse at a time.

    python scripts/bench_ellipse.py --ellipses 10000 --points 200

CPU time of this process on one thread, the least of interleaved rounds, microseconds an ellipse. ``equal``: all
ellipses have the same number of points; ``ragged``: between half and all of them. scikit-image is timed on a part.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import cv2
import torch
from skimage.measure import EllipseModel

from torchpose import ellipse
from torchpose.geometry import conics

SKIMAGE = 200  # ellipses: it takes hundreds of microseconds for each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ellipses", type=int, default=10_000)
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--compile", action="store_true", help="also through torch.compile")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    count, points = options.ellipses, options.points
    g = torch.Generator().manual_seed(0)
    u = torch.rand(count, 5, generator=g, dtype=torch.float64)
    a = 20 + 100 * u[:, 2]
    truth = torch.stack([4000 * u[:, 0], 3000 * u[:, 1], a, a * (0.4 + 0.6 * u[:, 3]), math.pi * u[:, 4]], -1)
    angle = torch.arange(points, dtype=torch.float64) * (2 * math.pi / points)
    xy = conics.points_on(truth[:, None].expand(-1, points, -1), angle.expand(count, -1))
    xy += 0.05 * torch.randn(xy.shape, generator=g, dtype=torch.float64)
    flat, index = xy.reshape(-1, 2), torch.arange(count).repeat_interleave(points)
    sizes = torch.randint(points // 2, points + 1, (count,), generator=g)
    some = (torch.arange(points) < sizes[:, None]).flatten()
    ragged, ragged_index = flat[some], index[some]
    plain = xy.numpy()
    single = plain.astype("float32")

    def skimage() -> None:
        for one in plain[:SKIMAGE]:
            if hasattr(EllipseModel, "from_estimate"):
                EllipseModel.from_estimate(one)
            else:
                EllipseModel().estimate(one)

    runs: dict[str, tuple[Callable[[], object], int]] = {
        "halir-flusser, equal": (lambda: ellipse.fit(flat, index, count), count),
        "halir-flusser, ragged": (lambda: ellipse.fit(ragged, ragged_index, count), count),
        "taubin, equal": (lambda: ellipse.fit(flat, index, count, method="taubin"), count),
        "cv2.fitEllipseDirect": (lambda: [cv2.fitEllipseDirect(one) for one in single], count),
        "skimage EllipseModel": (skimage, min(SKIMAGE, count)),
    }
    if options.compile:
        compiled = torch.compile(ellipse.fit_blocks, dynamic=False)
        runs["halir-flusser, compiled"] = (lambda: compiled(xy), count)
    best = dict.fromkeys(runs, math.inf)
    for _ in range(options.rounds + 1):  # the first warms up
        for name, (run, of) in runs.items():
            start = time.process_time()
            run()
            best[name] = min(best[name], 1e6 * (time.process_time() - start) / of)
    ours = best["halir-flusser, equal"]
    for name, cost in best.items():
        print(f"{name:26s} {cost:8.2f} us   {cost / ours:7.2f} x ours")


if __name__ == "__main__":
    main()
