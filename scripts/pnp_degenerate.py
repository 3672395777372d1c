"""Point sets that hardly fix a pose: how often `torchpose.pnp.solve` misses the best minimum, and its third pass.

    python scripts/pnp_degenerate.py --sets 2000

Random sets in a square of 40 mm, seen from 80 to 800 mm, tilted by up to 70 degrees, focal length 1111 px. The first
table, by kind and noise (px): poses given as an answer though there is a better minimum, or, without noise, another
pose than the true one; and poses that have none. The second, of sets of five to eight points in a plane with 0.3 px, by
the firmness of their homography (`torchpose.pnp.third_pass.firm`; 4 for a square): sets; poses of which the first two
passes miss the better minimum that all starts find or the true pose leads to, in 10,000; and how many of them the third
pass finds.
"""

from __future__ import annotations

import argparse
import math

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.pnp import PnPCode, PnPResult, third_pass
from torchpose.pnp.problem import Inputs, prepare

F64 = torch.float64
MATRIX = torch.tensor([[1111.0, 0, 640], [0, 1111, 480], [0, 0, 1]], dtype=F64)
KINDS = (
    "two of four coincide",
    "three of four on a line",
    "three of four on a line but for 0.3 mm",
    "five of six on a line",
    "four, 0.1 mm from a plane",
    "four in a plane",
)
FIRMNESS = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, math.inf)
POINTS = (5, 6, 7, 8)
NOISE = 0.3


def uniform(*shape: int, generator: torch.Generator) -> Tensor:
    return torch.rand(*shape, generator=generator, dtype=F64)


def flat(sets: int, points: int, generator: torch.Generator) -> Tensor:
    """Points (B, N, 3) anywhere in a square."""
    return torch.nn.functional.pad(40 * uniform(sets, points, 2, generator=generator) - 20, (0, 1))


def of_kind(kind: str, sets: int, generator: torch.Generator) -> Tensor:
    points, share = flat(sets, 4, generator), uniform(sets, 3, 1, generator=generator)
    first, along = points[:, :1], points[:, 1:2] - points[:, :1]
    across = torch.stack([-along[..., 1], along[..., 0], along[..., 2]], -1) / along.norm(dim=-1, keepdim=True)
    on_line = first + share * along
    if kind == "two of four coincide":
        return torch.cat([points[:, :3], first], 1)
    if kind == "three of four on a line":
        return torch.cat([points[:, :3], on_line[:, :1]], 1)
    if kind == "three of four on a line but for 0.3 mm":
        return torch.cat([points[:, :3], on_line[:, :1] + 0.3 * across], 1)
    if kind == "five of six on a line":
        return torch.cat([points[:, :3], on_line], 1)
    if kind == "four, 0.1 mm from a plane":
        points[..., 2] = 0.2 * uniform(sets, 4, generator=generator) - 0.1
    return points


def poses(sets: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    lean, azimuth, roll, depth, u, v = uniform(6, sets, generator=generator).unbind(0)
    lean, azimuth, roll, zero = math.radians(70) * lean, 2 * math.pi * azimuth, 2 * math.pi * roll, 0 * lean
    R = rotations.exp(torch.stack([azimuth.cos(), azimuth.sin(), zero], -1) * lean[:, None])
    depth = 80 * 10**depth
    t = torch.stack([0.4 * (u - 0.5) * depth, 0.4 * (v - 0.5) * depth, depth], -1)
    return R @ rotations.exp(torch.stack([zero, zero, roll], -1)), t


def image(points: Tensor, R: Tensor, t: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    at = points @ R.mT + t[:, None]
    pixels = MATRIX[0, 0] * at[..., :2] / at[..., 2:] + MATRIX[:2, 2]
    return pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=F64)


def better(least: PnPResult, found: PnPResult) -> Tensor:
    """Sets (B,) bool of which ``least`` has the better minimum, beyond where a search ends."""
    return (least.code <= PnPCode.AMBIGUOUS) & (least.chi2 + 1e-3 + 1e-4 * least.chi2 < found.chi2)


def kinds(sets: int) -> None:
    print("| kind | noise, px | wrong or missed | failed | of these `TOO_FEW` |\n| --- | --- | --- | --- | --- |")
    for kind in KINDS:
        for noise in (0.0, NOISE):
            g = torch.Generator().manual_seed(0)
            points, (R, t) = of_kind(kind, sets, g), poses(sets, g)
            pixels, sigma = image(points, R, t, noise, g), noise or 1e-3
            found = pnp.solve(points, pixels, MATRIX, sigma_px=sigma)
            bad = better(pnp.solve(points, pixels, MATRIX, sigma_px=sigma, initial=(R, t)), found)
            if noise == 0:
                bad |= found.converged & (rotations.log(found.R @ R.mT).norm(dim=-1) > 1e-3)
            failed = found.code > PnPCode.AMBIGUOUS
            few = int((found.code == PnPCode.TOO_FEW).sum())
            print(f"| {kind} | {noise:g} | {int((bad & ~failed).sum())} | {int(failed.sum())} | {few} |", flush=True)


def solved(firmness: float, points: Tensor, pixels: Tensor) -> PnPResult:
    """With the third pass for sets in a plane that are no firmer than that."""
    usual = third_pass._FIRMNESS
    try:
        third_pass._FIRMNESS = firmness
        return pnp.solve(points, pixels, MATRIX, sigma_px=NOISE)
    finally:
        third_pass._FIRMNESS = usual


def firmer(points: Tensor, pixels: Tensor, least: float) -> Tensor:
    usual = third_pass._FIRMNESS
    try:
        third_pass._FIRMNESS = least
        body = prepare(Inputs(points, pixels, MATRIX, NOISE, None, None, None, None)).body
        return third_pass.firm(body, None)
    finally:
        third_pass._FIRMNESS = usual


def firmness(sets: int) -> None:
    g, counts = torch.Generator().manual_seed(1), torch.zeros(3, len(FIRMNESS) - 1, dtype=torch.int64)
    for number in POINTS:
        points, (R, t) = flat(sets, number, g), poses(sets, g)
        pixels = image(points, R, t, NOISE, g)
        without, every = solved(0.0, points, pixels), solved(math.inf, points, pixels)
        true = pnp.solve(points, pixels, MATRIX, sigma_px=NOISE, initial=(R, t))
        answered = without.code <= PnPCode.AMBIGUOUS
        missed = answered & (better(every, without) | better(true, without))
        above = torch.stack([firmer(points, pixels, least) for least in FIRMNESS])
        inside = above[:-1] & ~above[1:]
        counts += torch.stack([inside.sum(1), (inside & missed).sum(1), (inside & better(every, without)).sum(1)])
    print("\n| firmness | sets | missed by two passes, in 10,000 | found by the third |\n| --- | --- | --- | --- |")
    for k, (count, missed, found) in enumerate(counts.mT.tolist()):
        rate = f"{1e4 * missed / count:.1f}" if count else "-"
        print(f"| {FIRMNESS[k]:g} to {FIRMNESS[k + 1]:g} | {count} | {rate} | {found} of {missed} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=2000, help="of each kind")
    parser.add_argument("--plane", type=int, default=20_000, help="in a plane, of each number of points")
    options = parser.parse_args()
    kinds(options.sets)
    firmness(options.plane)


if __name__ == "__main__":
    main()
