"""Direct ellipse fits on short arcs beside the geometric fit, which minimises the distances of the points (scipy).

    python scripts/arc_statistics.py

Ellipse of 30 x 22 px, a point a px along an arc anywhere on it, noise of some px in u and v. Columns, for `ellipse.fit`
with "taubin", with "halir-flusser" and for the geometric fit: median error of the centre, px; median of sqrt(a b) over
the true one, less 1, %; for the two direct ones the largest ratio of RMS distance over that of the geometric fit, and
the fits that found a hyperbola (NaN). The geometric fit starts from the true ellipse.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from torchpose import ellipse
from torchpose.geometry import conics

AXES = (30.0, 22.0)
METHODS: tuple[ellipse.Method, ...] = ("taubin", "halir-flusser")
Array = NDArray[np.float64]


def foot(params: Array, xy: Array) -> tuple[Array, Array, Array]:
    """Distances (P,) of points to an ellipse, normals (P, 2) at the feet and their eccentric angles, by Newton."""
    cx, cy, a, b, theta = params
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    x, y = ((xy - [cx, cy]) @ turn).T
    angle = np.arctan2(y * a, x * b)
    for _ in range(12):
        cos, sin = np.cos(angle), np.sin(angle)
        off = (x - a * cos) * a * sin - (y - b * sin) * b * cos
        slope = (a * sin) ** 2 + (b * cos) ** 2 + (x - a * cos) * a * cos + (y - b * sin) * b * sin
        angle = angle - np.clip(off / np.maximum(slope, 1e-9), -0.3, 0.3)
    cos, sin = np.cos(angle), np.sin(angle)
    normal = np.stack([b * cos, a * sin], 1) / np.hypot(b * cos, a * sin)[:, None]
    return ((np.stack([x - a * cos, y - b * sin], 1)) * normal).sum(1), normal @ turn.T, angle


def geometric(xy: Array, start: Array) -> Array:
    """The ellipse (5,) with the least sum of squared distances to points (P, 2)."""

    def jacobian(params: Array) -> Array:
        _, normal, angle = foot(params, xy)
        _, _, a, b, theta = params
        one = np.array([math.cos(theta), math.sin(theta)])
        two = np.array([-one[1], one[0]])
        by_one, by_two = normal @ one, normal @ two
        cos, sin = np.cos(angle), np.sin(angle)
        turned = by_two * a * cos - by_one * b * sin
        return -np.stack([normal[:, 0], normal[:, 1], by_one * cos, by_two * sin, turned], 1)

    bounds = ([-np.inf, -np.inf, 1e-3, 1e-3, -np.inf], np.inf)
    options = {"x_scale": "jac", "ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12, "max_nfev": 300}
    found = least_squares(lambda p: foot(p, xy)[0], start, jacobian, bounds, **options)
    return np.asarray(found.x)


def line(arc_deg: float, noise: float, trials: int) -> str:
    """A row of the table."""
    rng, (a, b) = np.random.default_rng(1), AXES
    count = max(12, round(math.radians(arc_deg) * 0.5 * (a + b)))
    truth = np.array([[50 + u, 50 + v, a, b, math.pi * w] for u, v, w in rng.random((trials, 3))])
    angle = 2 * math.pi * rng.random((trials, 1)) + math.radians(arc_deg) * np.arange(count) / count
    exact = conics.points_on(torch.from_numpy(truth)[:, None].expand(-1, count, -1), torch.from_numpy(angle))
    xy = exact.numpy() + noise * rng.standard_normal((trials, count, 2))
    best = np.stack([geometric(points, start) for points, start in zip(xy, truth, strict=True)])
    least = np.array([np.square(foot(*pair)[0]).sum() for pair in zip(best, xy, strict=True)])
    cells = [f"{arc_deg:g}", f"{noise:g}"]
    for method in METHODS:
        found = ellipse.fit_blocks(torch.from_numpy(xy), method=method).numpy()
        there = np.isfinite(found).all(1)
        cost = np.array([np.square(foot(*pair)[0]).sum() for pair in zip(found[there], xy[there], strict=True)])
        most = np.sqrt(cost / least[there]).max()
        cells += [*errors(found[there], truth[there]), f"{most:.3f}", f"{(~there).sum()}"]
    return "| " + " | ".join([*cells, *errors(best, truth)]) + " |"


def errors(found: Array, truth: Array) -> tuple[str, str]:
    """Median error of the centre, and of the size in percent."""
    off = np.hypot(*(found[:, :2] - truth[:, :2]).T)
    size = np.sqrt(found[:, 2:4].prod(1) / truth[:, 2:4].prod(1)) - 1
    return f"{np.median(off):.2g}", f"{100 * np.median(size):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--arcs", type=float, nargs="+", default=[180, 120, 90, 60, 45])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.05, 0.1, 0.3])
    options = parser.parse_args()
    columns = ["center", "size %", "RMS over geometric, at most", "NaN"]
    heads = ["arc", "noise", *(f"{m}: {c}" for m in METHODS for c in columns), "geometric: center", "size %"]
    print("| " + " | ".join(heads) + " |\n" + "| --- " * len(heads) + "|")
    for arc in options.arcs:
        for noise in options.noise:
            print(line(arc, noise, options.trials), flush=True)


if __name__ == "__main__":
    main()
