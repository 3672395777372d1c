"""Do the poses of `torchpose.pnp.solve` obey their covariance? Statistics over random planar scenes with known noise.

    python scripts/pnp_statistics.py --scenes 100000 --out docs/benchmarks/pnp_statistics.md

Every scene: 4 to 16 coplanar points, tilt 0 to 80 degrees, seen from either side, distance 5 to 100 target sizes, noise
0.02 to 1 px, focal length 1111 or 3333 px.

One row for each slice of tilt, noise and number of points. `decided`: there are two minima, and their chi-squared
differs by more than 20; of these the share called converged, and the mean squared Mahalanobis error (NEES), ideally 6.
`rest`: all others; what they are called, and of those called converged the median (ideally 5.35) and the shares beyond
the 99 % and 99.9 % quantiles of the chi-squared law. `wrong_per_10000`: poses called converged that are nearer to the
other minimum. Where the search of the other minimum was stopped because it is out of the question, it counts as one.

The last line is about how it is ruled out (`torchpose.pnp.iterative.RESERVE`): by how much the cost falls from the
start of a second minimum to its end, in terms of what the first step promises.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.pnp.first_pass import upright
from torchpose.pnp.iterative import RESERVE, minimise
from torchpose.pnp.normal_equations import COST, damped_step, normal_equations
from torchpose.pnp.problem import Inputs, prepare
from torchpose.pnp.starts import starts

SIZE_MM = 40.0
POINTS = (4, 5, 6, 8, 9, 12, 16)
FOCAL_PX = (1111.0, 3333.0)


@dataclass(frozen=True)
class Scenes:
    """B poses R (B, 3, 3), t (B, 3) mm, their tilt (B,) rad and noise (B,) px, points (B, N, 3) mm and (B, N, 2) px."""

    R: Tensor
    t: Tensor
    tilt: Tensor
    sigma: Tensor
    object_points: Tensor
    image_points: Tensor
    matrix: Tensor


def random_scenes(batch: int, points: int, focal: float, generator: torch.Generator) -> Scenes:
    """Coplanar points scattered over a square of `SIZE_MM` (four: its corners, moved at random)."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    corners = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64) * 0.5 * SIZE_MM
    scattered = (uniform(batch, points, 2) - 0.5) * SIZE_MM
    scattered[:, :4] = corners + 0.2 * scattered[:, :4]
    object_points = torch.cat([scattered, torch.zeros(batch, points, 1, dtype=torch.float64)], -1)

    tilt, azimuth, roll = math.radians(80) * uniform(batch), 2 * math.pi * uniform(batch), 2 * math.pi * uniform(batch)
    zero = torch.zeros_like(tilt)
    r = rotations.exp(torch.stack([azimuth.cos(), azimuth.sin(), zero], -1) * tilt[:, None])
    r = r @ rotations.exp(torch.stack([zero, zero, roll], -1))
    behind = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    r = torch.where((uniform(batch) < 0.5)[:, None, None], r @ behind, r)
    depth = SIZE_MM * 5 * 20 ** uniform(batch)
    t = torch.stack([0.4 * (uniform(batch) - 0.5) * depth, 0.4 * (uniform(batch) - 0.5) * depth, depth], -1)

    matrix = torch.tensor([[focal, 0, 640], [0, focal, 480], [0, 0, 1]], dtype=torch.float64)
    camera_points = object_points @ r.mT + t[:, None]
    pixels = focal * camera_points[..., :2] / camera_points[..., 2:] + matrix[:2, 2]
    sigma = 0.02 * 50 ** uniform(batch)
    pixels = pixels + sigma[:, None, None] * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return Scenes(r, t, tilt, sigma, object_points, pixels, matrix)


@dataclass(frozen=True)
class Statistics:
    """One row a scene: code, squared Mahalanobis errors of both minima, difference of chi-squared."""

    scenes: Scenes
    points: int
    code: Tensor
    nees: Tensor
    nees_alt: Tensor
    difference: Tensor
    two_minima: Tensor


def evaluate(scenes: Scenes, compile: bool) -> Statistics:
    """Solves the scenes, each with its own noise given as weights."""
    count = scenes.image_points.shape[1]
    result = pnp.solve(
        scenes.object_points,
        scenes.image_points,
        scenes.matrix,
        weights=scenes.sigma[:, None].pow(-2).expand(-1, count),
        compile=compile,
    )
    # both errors by the covariance of the pose given: it decides which minimum is the true one
    information = torch.linalg.inv(torch.where(result.covariance.isnan(), torch.eye(6).double(), result.covariance))

    def squared(r: Tensor, t: Tensor) -> Tensor:
        error = torch.cat([scenes.t - t, rotations.log(scenes.R @ r.mT)], -1)[..., None]
        return (error.mT @ information @ error).flatten()

    return Statistics(
        scenes,
        count,
        result.code,
        squared(result.R, result.t),
        squared(result.R_alt, result.t_alt),
        result.chi2_alt - result.chi2,
        ~result.chi2_alt.isnan(),
    )


def summarise(name: str, runs: list[Statistics], select: list[Tensor]) -> dict[str, Any]:
    """One row of the table, over the scenes selected in every run."""

    def gather(attribute: str) -> Tensor:
        return torch.cat([getattr(run, attribute)[pick] for run, pick in zip(runs, select, strict=True)])

    code, nees, nees_alt, difference = (gather(k) for k in ("code", "nees", "nees_alt", "difference"))
    two, converged = gather("two_minima"), code == pnp.PnPCode.CONVERGED
    decided = two & (difference > 20)
    rest = ~decided
    single = rest & converged
    wrong = converged & two & (nees_alt < nees)
    n = max(len(code), 1)

    def share(picked: Tensor, of: Tensor) -> float:
        return float(picked[of].double().mean()) if bool(of.any()) else math.nan

    # quantiles of chi-squared with six degrees of freedom
    tail99, tail999 = 16.812, 22.458
    return {
        "slice": name,
        "scenes": len(code),
        "decided": float(decided.double().mean()) if len(code) else math.nan,
        "decided_converged": share(converged, decided),
        "decided_nees": float(nees[decided & converged].mean()),
        "rest_converged": share(converged, rest),
        "rest_ambiguous": share(code == pnp.PnPCode.AMBIGUOUS, rest),
        "rest_failed": share(code > pnp.PnPCode.AMBIGUOUS, rest),
        "rest_nees_median": float(nees[single].median()) if bool(single.any()) else math.nan,
        "rest_beyond_99": share(nees > tail99, single),
        "rest_beyond_999": share(nees > tail999, single),
        "wrong_per_10000": float(1e4 * wrong.sum() / n),
    }


def table(runs: list[Statistics]) -> list[dict[str, Any]]:
    """All scenes, then slices by tilt, noise and number of points."""
    rows = [summarise("all", runs, [torch.ones_like(run.code, dtype=torch.bool) for run in runs])]
    for low, high in ((0, 5), (5, 15), (15, 30), (30, 60), (60, 80)):
        picks = [(run.scenes.tilt >= math.radians(low)) & (run.scenes.tilt < math.radians(high)) for run in runs]
        rows.append(summarise(f"tilt {low}-{high} deg", runs, picks))
    for low_px, high_px in ((0.02, 0.05), (0.05, 0.1), (0.1, 0.3), (0.3, 1.0)):
        picks = [(run.scenes.sigma >= low_px) & (run.scenes.sigma < high_px) for run in runs]
        rows.append(summarise(f"noise {low_px}-{high_px} px", runs, picks))
    for count in POINTS:
        picks = [torch.full_like(run.code, run.points == count, dtype=torch.bool) for run in runs]
        rows.append(summarise(f"{count} points", runs, picks))
    return rows


def fall(scenes: Scenes) -> Tensor:
    """(M,): decreases from the start of each second minimum to its end, over that promised by the first step."""
    count = scenes.image_points.shape[1]
    weights = scenes.sigma[:, None].pow(-2).expand(-1, count)
    inputs = Inputs(scenes.object_points, scenes.image_points, scenes.matrix, 1.0, None, weights, None, None)
    problem = prepare(inputs)
    poses = upright(starts(problem).double())
    normal = normal_equations(problem.observed.each(), poses)
    _, promised, _ = damped_step(normal)
    every = problem.observed.select(torch.arange(poses.shape[3]).repeat(2))
    found = minimise(every, poses.flatten(2), max_iterations=300)
    end = found.normal[COST].unflatten(0, (2, -1))
    best, other = end.amin(0), end.amax(0)
    # the same minimum, up to the accuracy of its cost, is no second one
    second = found.converged.unflatten(0, (2, -1)).all(0) & (other > (1 + 1e-6) * best + 1e-6)
    ratio = ((normal[COST] - end) / promised).gather(0, end.argmax(0)[None])[0]
    return ratio[second]


def run(scenes: int, seed: int, compile: bool = False) -> list[Statistics]:
    """About ``scenes`` scenes, equally many for each number of points and focal length."""
    generator = torch.Generator().manual_seed(seed)
    each = math.ceil(scenes / (len(POINTS) * len(FOCAL_PX)))
    scenes_of = (random_scenes(each, count, focal, generator) for count in POINTS for focal in FOCAL_PX)
    return [evaluate(part, compile) for part in scenes_of]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compile", action="store_true", help="the poses of compiled code")
    parser.add_argument("--out", type=Path, help="CSV or Markdown file")
    args = parser.parse_args()
    runs = run(args.scenes, args.seed, args.compile)
    rows = table(runs)
    writer = csv.DictWriter(sys.stdout, rows[0].keys(), delimiter="\t")
    writer.writeheader()
    writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    ratios = torch.cat([fall(part.scenes) for part in runs]).sort().values
    quantiles = ", ".join(f"{ratios[int(q * (len(ratios) - 1))]:.2f}" for q in (0.5, 0.99, 0.9999))
    falls = f"Costs of {len(ratios)} second minima fall by {quantiles} (median, 99 %, 99.99 %) and at most "
    falls += f"{ratios[-1]:.2f} times what the first step promises; {RESERVE:g} times are allowed for."
    print(falls)
    if args.out is not None and args.out.suffix == ".md":
        cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
        lines = [list(rows[0]), ["---"] * len(rows[0]), *cells]
        about = __doc__[__doc__.index("Every scene") :].strip()
        text = "# Batched PnP: do poses obey their covariance?\n\nBy `scripts/pnp_statistics.py`, "
        text += f"{args.scenes} scenes, seed {args.seed}{', compiled' if args.compile else ''}.\n\n{about}\n\n"
        args.out.write_text(text + "\n".join("| " + " | ".join(line) + " |" for line in lines) + f"\n\n{falls}\n")
    elif args.out is not None:
        with args.out.open("w", newline="") as file:
            out = csv.DictWriter(file, rows[0].keys())
            out.writeheader()
            out.writerows(rows)


if __name__ == "__main__":
    main()
