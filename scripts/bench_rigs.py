"""CPU time of a moment of several cameras beside that of as many single frames, on one thread.

    python scripts/bench_rigs.py --rounds 7

Rendered frames of quad40 of 2 megapixels; medians, in one run, taking turns. The frames of a camera are
one batch, in both.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import rig_statistics as rigs
import torch

import torchpose as tp
from torchpose.sim import add_noise, render

CASES = {2: (0.0, 35.0), 3: (0.0, 35.0, -35.0), 4: (0.0, 40.0, -40.0, 80.0)}


def cpu(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def measure(angles: tuple[float, ...], moments: int, rounds: int) -> str:
    """A row of the table."""
    case = rigs.Case(angles)
    rig = rigs.rig_of(case)
    R, t = rigs.poses(case, moments, torch.Generator().manual_seed(1))
    frames = []
    for number, camera in enumerate(rig.cameras):
        own = rig.seen_by(number, R, t)
        image = render(camera, rigs.TARGET, *own, psf_sigma=rigs.BLUR, dark=rigs.DARK, light=rigs.LIGHT)
        frames.append(add_noise(image, rigs.NOISE, seed=number))
    together, single = tp.PoseEstimator(rig, rigs.TARGET), tp.PoseEstimator(rig.cameras[0], rigs.TARGET)
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        times[0].append(cpu(lambda: together(frames)))
        times[1].append(cpu(lambda: [single(of_camera) for of_camera in frames]))
    both, alone = (1e3 * statistics.median(of) / moments for of in times)
    ratio = statistics.median(a / b for a, b in zip(*times, strict=True))
    return f"| {len(rig)} | {moments} | {both:.0f} | {alone:.0f} | {ratio:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--moments", type=int, nargs="+", default=[1, 4])
    args = parser.parse_args()
    torch.set_num_threads(1)
    rigs.WIDTH, rigs.HEIGHT = 1824, 1216
    print("| cameras | moments a call | ms a moment | ms, single frames | ratio |\n| --- | --- | --- | --- | --- |")
    for angles in CASES.values():
        for moments in args.moments:
            print(measure(angles, moments, args.rounds), flush=True)


if __name__ == "__main__":
    main()
