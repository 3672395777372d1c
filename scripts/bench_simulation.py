"""Costs of simulated frames: rendering and noise beside the encoding of the PNG, memory, and Blender where it is there.

python scripts/bench_simulation.py [--plan configs/plans/paper_grid.yaml] [--frames 64] [--blender 3]

All on one thread, so that the ratios do not depend on the cores. A figure is the median over batches, with the
quartiles. Run it on an otherwise idle machine.

    python scripts/bench_simulation.py --command [--rounds 3]

times `torchpose simulate` instead, with the Cramer-Rao bounds and without, on one core and on two: the difference
between many and few frames of random poses, so that no start is in it.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from itertools import product
from pathlib import Path

import cv2
import torch
import yaml

from torchpose.datasets.dataset import analytic
from torchpose.datasets.plan import Plan, load_plan
from torchpose.errors import ConfigError
from torchpose.sim.sensor import add_noise

RANDOM = Path(__file__).parents[1] / "configs" / "plans" / "random.yaml"
COUNTS = (20, 140)
BATCH = 3  # as the data set writer for 2 megapixels


def timed(work: Callable[[int], object], batches: int) -> list[float]:
    """Milliseconds a frame of each batch, without the first."""
    times = []
    for number in range(batches + 1):
        start = time.perf_counter()
        work(number)
        times.append(1e3 * (time.perf_counter() - start) / BATCH)
    return times[1:]


def show(name: str, times: list[float]) -> float:
    quartiles = statistics.quantiles(times, n=4) if len(times) > 1 else times * 3
    print(f"{name:28s} {quartiles[1]:9.2f} ms a frame  (quartiles {quartiles[0]:.2f}, {quartiles[2]:.2f})")
    return quartiles[1]


def peak() -> float:
    """Largest memory of the process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def blender_times(plan: Plan, frames: int) -> list[float]:
    from torchpose.datasets.blender import blender

    renderer = blender(plan, threads=1)
    times = []
    for number in range(frames + 1):
        start = time.perf_counter()
        renderer(torch.tensor([number]))
        times.append(1e3 * (time.perf_counter() - start))
    return times[1:]


def simulated(count: int, bounds: bool, cores: int) -> tuple[float, float]:
    """Seconds of CPU and of the clock of the command for so many frames of random poses."""
    plan = yaml.safe_load(RANDOM.read_text())
    plan["poses"]["random"]["count"] = count
    plan |= {"bounds": bounds, "camera": str((RANDOM.parent / plan["camera"]).resolve())}
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, "plan.yaml")
        file.write_text(yaml.safe_dump(plan))
        words = ["simulate", str(file), "--out", str(Path(scratch, "set")), "--quiet", "--threads", str(cores)]
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([sys.executable, "-m", "torchpose", *words], check=True)
        after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - start
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def bench_command(rounds: int) -> None:
    cpu: dict[tuple[bool, int], list[float]] = defaultdict(list)
    busy: dict[tuple[bool, int], list[float]] = defaultdict(list)
    few, many = COUNTS
    for _ in range(rounds):
        for bounds, cores in product((False, True), (1, 2)):
            short, long = simulated(few, bounds, cores), simulated(many, bounds, cores)
            spent, wall = (b - a for a, b in zip(short, long, strict=True))
            cpu[bounds, cores].append(1e3 * spent / (many - few))
            busy[bounds, cores].append(spent / wall)
    for (bounds, cores), times in cpu.items():
        what = f"{'with' if bounds else 'without'} bounds, {cores} core{'s' * (cores > 1)}"
        used = statistics.median(busy[bounds, cores])
        print(f"{what:28s} {statistics.median(times):9.2f} ms CPU a frame, {used:.2f} cores used")
    ratio = statistics.median(b / a for a, b in zip(cpu[False, 1], cpu[True, 1], strict=True))
    print(f"with / without {ratio:.2f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", type=Path, default=Path("configs/plans/paper_grid.yaml"))
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--blender", type=int, default=0, metavar="N", help="time N frames of Blender as well")
    parser.add_argument("--command", action="store_true", help="time the whole command with and without bounds")
    parser.add_argument("--rounds", type=int, default=3, help="of --command")
    options = parser.parse_args()
    if options.command:
        bench_command(options.rounds)
        return 0
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        plan = load_plan(options.plan)
        sensor, clean = plan.file.sensor.model_dump(exclude={"noise"}), analytic(plan)
        batches = max(2, min(options.frames, len(plan)) // BATCH)
        which = [(torch.arange(BATCH) + BATCH * i) % len(plan) for i in range(batches + 1)]
        pictures = [clean(w) for w in which[:2]]

        def noise(number: int) -> torch.Tensor:
            level = plan.conditions.noise[which[number]]
            return add_noise(pictures[number % 2], level, plan.file.seed, index=which[number], **sensor)

        noisy = [noise(i).numpy() for i in range(2)]
        print(f"{plan.camera.width} x {plan.camera.height}, {batches} batches of {BATCH} frames, one thread")
        memory = peak()
        rendering = show("rendering", timed(lambda i: clean(which[i]), batches))
        sensing = show("noise and rounding", timed(noise, batches))
        encoding = show("PNG encoding", timed(lambda i: [cv2.imencode(".png", f) for f in noisy[i % 2]], batches))
        print(f"(rendering + noise) / encoding {(rendering + sensing) / encoding:.2f}")
        print(f"memory grew by {peak() - memory:.0f} MiB over {batches * BATCH} frames")
        if options.blender:
            cycles = show("Blender Cycles", blender_times(plan, options.blender))
            print(f"Blender / rendering {cycles / rendering:.0f}")
    except ConfigError as error:
        print(f"bench_simulation: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
