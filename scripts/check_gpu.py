"""Whether a GPU gives what the CPU gives, and how fast: frames/s of the pipeline and poses/s of PnP by batch size.

    python scripts/check_gpu.py [--device cuda] [--seconds 3]

The sample frames are estimated on both. Statuses have to be equal, poses to agree within 0.1 of their standard
deviations; else the exit code is 1. Then frames of 2 megapixels (the sample's, repeated) and PnP problems of 8 points
are timed, a batch size a line, with the CPU beside it. Takes under three minutes. Without such a device it says so in
one line and ends with 0.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchpose as tp
from torchpose.geometry import rotations
from torchpose.io.images import decode

SAMPLE = Path(__file__).parents[1] / "data" / "sample"
AGREEMENT = 0.1  # standard deviations
FRAMES = (1, 8, 32, 128)
PROBLEMS = (1_000, 100_000, 1_000_000)


def sample() -> tuple[tp.Camera, tp.Target, Tensor]:
    """Camera, target and frames (B, H, W)."""
    camera, target = tp.Camera.load(SAMPLE / "camera.yaml"), tp.Target.load(SAMPLE / "target.yaml")
    images = [decode(path) for path in sorted((SAMPLE / "frames").iterdir())]
    return camera, target, torch.from_numpy(np.stack(images))


def disagreement(one: tp.Poses, other: tp.Poses) -> tuple[int, float]:
    """Rows whose statuses differ, and the largest difference of poses with equal ones in standard deviations."""
    same = one.status == other.status
    some = same & one.t.isfinite().all(1)
    off = torch.cat([one.t - other.t, rotations.log(one.R @ other.R.mT)], 1)[some] / one.noise_std[some]
    return int((~same).sum()), float(off.abs().amax()) if len(off) else 0.0


def rate(work: Callable[[], object], size: int, seconds: float, device: str) -> float:
    """Items a second of work on ``size`` of them, after a first call, for about so many seconds."""

    def wait() -> None:
        if device != "cpu":
            torch.accelerator.synchronize()

    work()
    wait()
    start, calls = time.perf_counter(), 0
    while calls == 0 or time.perf_counter() - start < seconds:
        work()
        wait()
        calls += 1
    return calls * size / (time.perf_counter() - start)


def problems(camera: tp.Camera, count: int) -> tuple[Tensor, Tensor]:
    """Points (8, 3) and their images (B, 8, 2) with noise of 0.1 px."""
    random = torch.Generator().manual_seed(1)
    points = 40 * torch.rand(8, 3, dtype=torch.float64, generator=random) - 20
    R = rotations.exp(0.5 * torch.randn(count, 3, dtype=torch.float64, generator=random))
    t = torch.tensor([0.0, 0.0, 250.0], dtype=torch.float64) + 5 * torch.randn(
        count, 3, dtype=torch.float64, generator=random
    )
    pixels = camera.project(points @ R.mT + t[:, None])
    return points, pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=random)


def table(title: str, sizes: tuple[int, ...], device: str, speed: Callable[[int, str], float]) -> None:
    print(f"\n{title:>12} {'cpu':>12} {device:>12}   ratio")
    for size in sizes:
        ours, theirs = speed(size, "cpu"), speed(size, device)
        print(f"{size:12,d} {ours:12,.1f} {theirs:12,.1f} {theirs / ours:7.2f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each timing")
    options = parser.parse_args()
    device: str = options.device
    if device == "cuda" and not torch.cuda.is_available():
        print("check_gpu: torch finds no CUDA device here; nothing was checked")
        return 0
    camera, target, frames = sample()
    estimators = {where: tp.PoseEstimator(camera, target).to(where) for where in ("cpu", device)}
    wrong, off = disagreement(estimators["cpu"](frames), estimators[device](frames.to(device)).cpu())
    print(f"sample: {wrong} of {len(frames)} statuses differ, poses by at most {off:.2g} standard deviations")
    shown = frames[torch.arange(max(FRAMES)) % len(frames)]

    def frames_a_second(size: int, where: str) -> float:
        batch = shown[:size].to(where)
        return rate(lambda: estimators[where](batch), size, options.seconds, where)

    def poses_a_second(size: int, where: str) -> float:
        points, pixels = (part.to(where) for part in problems(camera, size))
        lens = camera.to(where)
        return rate(lambda: tp.pnp.solve(points, pixels, lens, sigma_px=0.1), size, options.seconds, where)

    table("frames", FRAMES, device, frames_a_second)
    table("PnP problems", PROBLEMS, device, poses_a_second)
    return int(wrong > 0 or off > AGREEMENT)


if __name__ == "__main__":
    sys.exit(main())
