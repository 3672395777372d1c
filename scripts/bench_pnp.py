"""Poses per second of `torchpose.pnp.solve` beside OpenCV and PoseLib called in a loop, wins and losses alike.

    python scripts/bench_pnp.py --out docs/benchmarks/pnp.md   # batches 1 to 1,000,000
    python scripts/bench_pnp.py --batches 1 64 4096 --no-compile

Every round times every contestant once, so that a change of the machine's speed meets all of them; the table gives the
median and the quartiles of the rounds. A contestant that has used up `--seconds` at a batch size sits out the rounds
that are left. Loops are timed on at most `LOOP` poses, other torch libraries on at most `PEERS`. PyTorch3D, PyPose and
Kornia take part where they can be imported. `result_mb` are the tensors returned, which no chunking can avoid,
`working_mb` is what a call needs besides: the process's high-water mark over its size before. What bounds the eager
code follows at the end: the bytes that its operations read and write, and the rate at which one operation alone does
so; then the operations and compiled functions that take most of the time. `--profile` prints only that.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import torchpose as tp
from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.kernels import has_compiler

LOOP = 1000
PEERS = 4096
# batches from which the first call counts as a round
LARGE = 65536
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
        "torchpose epnp": (ours("epnp", False), LARGE),
        "cv2 ITERATIVE": (opencv(cv2.SOLVEPNP_ITERATIVE), LOOP),
        "cv2 EPNP": (opencv(cv2.SOLVEPNP_EPNP), LOOP),
        "cv2 IPPE": (opencv(cv2.SOLVEPNP_IPPE), LOOP),
        "cv2 SQPNP": (opencv(cv2.SOLVEPNP_SQPNP), LOOP),
    }
    if (loop := poselib_loop()) is not None:
        table["PoseLib estimate_absolute_pose"] = (loop, LOOP)
    table.update({name: (function, PEERS) for name, function in torch_peers().items()})
    return table


def measure(points: Tensor, batch: int, rounds: int, seconds: float, compile: bool) -> list[dict[str, object]]:
    """Rows of the table for one batch size."""
    pixels = scene(points, batch)
    table = contestants(compile)
    times: dict[str, list[float]] = {}
    spent = dict.fromkeys(table, 0.0)
    failed: dict[str, str] = {}
    size: dict[str, float] = {}

    def once(name: str) -> None:
        function, most = table[name]
        part = pixels[:most]
        start = time.perf_counter()
        result = function(points, part)
        elapsed = time.perf_counter() - start
        if isinstance(result, pnp.PnPResult):
            size[name] = sum(v.nbytes for v in vars(result).values()) / 2**20
        spent[name] += elapsed
        times.setdefault(name, []).append(elapsed / len(part))

    for name in table:  # caches, compilation
        try:
            once(name)
        except Exception as error:  # a peer that rejects planar points is a result, not a fault of the benchmark
            failed[name] = str(error).splitlines()[0][:60] if str(error) else type(error).__name__
        if batch <= LARGE:
            times.pop(name, None)
            spent[name] = 0.0
    for k in range(rounds):
        for name in table:
            if name not in failed and (spent[name] < seconds or (k == 0 and name not in times)):
                once(name)
    peak = {
        name: working_mb(partial(table[name][0], points, pixels[: table[name][1]]))
        for name in table
        if name.startswith("torchpose")
    }
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
                "rounds": len(times[name]),
                "poses_per_s": 1 / middle,
                "times_cv2_iterative": base / middle,
                **({"working_mb": peak[name], "result_mb": size[name]} if name in size else {}),
            }
        )
    return rows


def working_mb(call: Callable[[], object]) -> float:
    """What a call needs besides its result, MB; NaN where the system does not tell."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return math.nan

    def status(key: str) -> float:
        return int(Path("/proc/self/status").read_text().split(key + ":")[1].split()[0]) / 1024

    before = status("VmRSS")
    result = call()
    size = sum(v.nbytes for v in vars(result).values()) / 2**20 if isinstance(result, pnp.PnPResult) else 0.0
    return status("VmHWM") - before - size


class Traffic(TorchDispatchMode):
    """Counts the operations, and the bytes of the tensors that they read and write, of views none."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # of torch
        self.calls = self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.calls += 1
        if not func.is_view:
            leaves = tree_leaves((args, kwargs, result))
            tensors = {id(v): v for v in leaves if isinstance(v, Tensor)}
            self.bytes += sum(v.numel() * v.element_size() for v in tensors.values())
        return result


def bound(points: Tensor) -> dict[str, object]:
    """The eager solve of `LARGE` poses beside its traffic at the rate of one operation repeated in the same chunks."""
    pixels = scene(points, LARGE)

    def run() -> None:
        pnp.solve(points, pixels, MATRIX, sigma_px=SIGMA_PX)

    with Traffic() as traffic:
        run()
    # a typical operation of a chunk, 8 vectors in float64, into memory at hand; and the least that any call takes
    a, b, c = (torch.rand(8, 16384, dtype=torch.float64) for _ in range(3))
    least = torch.rand(1, dtype=torch.float64)

    def median_s(call: Callable[[], object], repeat: int) -> float:
        times = []
        for _ in range(9):
            start = time.perf_counter()
            for _ in range(repeat):
                call()
            times.append((time.perf_counter() - start) / repeat)
        return statistics.median(times)

    per_call = median_s(lambda: least.add_(least), 2000)
    per_byte = (median_s(lambda: c.addcmul_(a, b), 200) - per_call) / (4 * a.nbytes)
    return {
        "points": len(points),
        "threads": torch.get_num_threads(),
        "calls": traffic.calls,
        "kb_per_pose": traffic.bytes / LARGE / 1000,
        "us_per_call": 1e6 * per_call,
        "gb_per_s": 1e-9 / per_byte,
        "bound_us_per_pose": 1e6 * (traffic.calls * per_call + traffic.bytes * per_byte) / LARGE,
        "us_per_pose": 1e6 * median_s(run, 1) / LARGE,
    }


def profile(points: Tensor, compile: bool, most: int = 12) -> list[dict[str, object]]:
    """The operations that take most of the CPU time of `LARGE` poses on one thread."""
    pixels = scene(points, LARGE)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        pnp.solve(points, pixels, MATRIX, sigma_px=SIGMA_PX, compile=compile)  # compiles
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as record:
            pnp.solve(points, pixels, MATRIX, sigma_px=SIGMA_PX, compile=compile)
    finally:
        torch.set_num_threads(threads)
    events = record.key_averages()
    total = sum(e.self_cpu_time_total for e in events)
    rows: list[dict[str, object]] = []
    for e in sorted(events, key=lambda e: e.self_cpu_time_total, reverse=True)[:most]:
        row: dict[str, object] = {"points": len(points), "compile": compile, "operation": e.key[:60], "calls": e.count}
        rows.append(row | {"us_per_pose": e.self_cpu_time_total / LARGE, "share": e.self_cpu_time_total / total})
    return rows


def several(batch: int, rounds: int) -> list[dict[str, object]]:
    """Generalised poses: points that three cameras share, beside PoseLib's estimator, one by one."""
    camera = tp.Camera(1824, 1216, MATRIX, [])
    turns = rotations.exp(torch.tensor([[0.0, math.radians(a), 0.0] for a in (0, 35, -35)], dtype=torch.float64))
    middle = torch.tensor([0.0, 0.0, 500.0], dtype=torch.float64)
    shifts = middle - turns @ middle
    shifts[0] = 0
    rig = tp.CameraRig([camera] * 3, turns, shifts)
    rows: list[dict[str, object]] = []
    for count, points in ((8, TARGETS[9][:8]), (12, torch.cat([TARGETS[4], TARGETS[4], TARGETS[4]]))):
        index = torch.arange(count) // (count // 4) % 3 if count == 8 else torch.arange(12) // 4
        g = torch.Generator().manual_seed(count)
        R = rotations.exp(0.3 * torch.randn(batch, 3, dtype=torch.float64, generator=g))
        t = middle + 40 * (torch.rand(batch, 3, dtype=torch.float64, generator=g) - 0.5)
        at = (points @ R.mT + t[:, None])[:, :, None]
        at = (turns @ at[..., None])[..., 0] + shifts
        pixels = camera.project(at)[:, torch.arange(count), index]
        pixels = pixels + SIGMA_PX * torch.randn(pixels.shape, dtype=torch.float64, generator=g)
        calls: dict[str, Callable[[], object]] = {
            "torchpose, rig": partial(pnp.solve, points, pixels, rig, camera_index=index, sigma_px=SIGMA_PX)
        }
        if (loop := poselib_rig(rig, points, pixels[:LOOP], index)) is not None:
            calls["PoseLib estimate_generalized_absolute_pose"] = loop
        times: dict[str, list[float]] = {name: [] for name in calls}
        for _ in range(rounds):
            for name, call in calls.items():
                start = time.process_time()
                call()
                size = batch if name.startswith("torchpose") else min(batch, LOOP)
                times[name].append((time.process_time() - start) / size)
        for name, each in times.items():
            rows.append({"points": count, "batch": batch, "method": name, "us_per_pose": 1e6 * statistics.median(each)})
    return rows


def poselib_rig(rig: tp.CameraRig, points: Tensor, pixels: Tensor, index: Tensor) -> Callable[[], None] | None:
    """A loop of PoseLib's estimator for several cameras."""
    try:
        import poselib
    except ImportError:
        return None
    lens = {"model": "PINHOLE", "width": 1824, "height": 1216, "params": [1111.0, 1111.0, 912.0, 608.0]}
    places = []
    for R, t in zip(rig.R, rig.t, strict=True):
        place = poselib.CameraPose()
        place.R, place.t = R.numpy(), t.numpy()
        places.append(place)
    own = [(index == n).numpy() for n in range(len(rig))]
    model = [points.numpy()[some] for some in own]

    def run() -> None:
        for image in pixels.numpy():
            parts = [image[some] for some in own]
            poselib.estimate_generalized_absolute_pose(parts, model, places, [lens] * len(places), {}, {})

    return run


def markdown(rows: list[dict[str, object]], names: list[str]) -> str:
    def cell(value: object) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    lines = [names, ["---"] * len(names), *([cell(row.get(name, "")) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 64, 256, 4096, 65536, 1_000_000])
    parser.add_argument("--points", type=int, nargs="+", choices=TARGETS, default=[4, 9])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="most time of a contestant at one batch size")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-compile", dest="compile", action="store_false")
    parser.add_argument("--profile", action="store_true", help="only what bounds it")
    parser.add_argument("--several", type=int, nargs="*", help="batches of generalised poses; only these are timed")
    parser.add_argument("--out", type=Path, help="Markdown file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(1)
    compile = args.compile and has_compiler()
    machine = (
        f"{platform.processor() or platform.machine()}, {args.threads} threads, torch {torch.__version__}, "
        f"OpenCV {cv2.__version__}, at most {args.rounds} rounds, sigma {SIGMA_PX} px"
        + ("" if compile else ", nothing compiled")
    )
    print(machine)
    if args.several is not None:
        for batch in args.several or [1, 64, 1024]:
            print(markdown(several(batch, args.rounds), ["points", "batch", "method", "us_per_pose"]), flush=True)
        return
    names = ["points", "batch", "method", "us_per_pose", "us_quartiles", "rounds", "poses_per_s"]
    names += ["times_cv2_iterative", "working_mb", "result_mb", "note"]
    rows: list[dict[str, object]] = []
    for batch in () if args.profile else sorted(args.batches):
        for count in args.points:
            part = measure(TARGETS[count], batch, args.rounds, args.seconds, compile)
            print(markdown(part, names), flush=True)
            rows += part
    operations: list[dict[str, object]] = []
    for fast in (False, True) if compile else (False,):
        for count in args.points:
            operations += profile(TARGETS[count], fast)
    limits: list[dict[str, object]] = []
    for threads in sorted({1, args.threads}):
        torch.set_num_threads(threads)
        limits += [bound(TARGETS[count]) for count in args.points]
    limit_columns = ["points", "threads", "calls", "kb_per_pose", "us_per_call", "gb_per_s", "bound_us_per_pose"]
    limit_columns.append("us_per_pose")
    print(markdown(limits, limit_columns))
    columns = ["points", "compile", "operation", "calls", "us_per_pose", "share"]
    print(markdown(operations, columns))
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        text = f"# Batched PnP: time of a pose\n\nBy `scripts/bench_pnp.py`. {machine}.\n\n{markdown(rows, names)}\n"
        text += (
            f"## What bounds it\n\nThe eager solve of {LARGE} poses: operations, the bytes that they read and write,"
            " and what these take at the rate of `addcmul_` on eight vectors of a chunk in float64, repeated.\n\n"
            f"{markdown(limits, limit_columns)}\n"
            f"CPU time of {LARGE} poses on one thread, by operation or compiled function, profiler included.\n\n"
        )
        args.out.write_text(text + markdown(operations, columns))


if __name__ == "__main__":
    main()
