"""What a pose costs: CPU time of every stage beside decoding, beside plain OpenCV, and peak memory.

    python scripts/bench_pipeline.py [--out docs/benchmarks/pipeline.md]

Frames: quad40 at the 20 MP camera and at its third (2 MP), noise sigma 2, 8 poses each, rendered here. CPU time is that
of the whole process (time.process_time), one thread for torch and OpenCV alike; every round times decoding, torchpose
and OpenCV one after the other, and the ratios are medians over the rounds. `torchpose estimate` is run as a process of
its own, start and all, on few and on many frames: the difference is what a frame costs, decoding, tables and all, and
what is left of the few is its start, with modules compiled as they are from a user's second run on. Memory is the
largest resident set of any of its processes. The load of the machine stands beside: frames/s say nothing where others
work.

    python scripts/bench_pipeline.py --operations [1 8]

counts dispatched tensor operations instead, of a batch of each size, by the functions of the package in which they are
made and those that called these: counts do not depend on the load. `syncs` are those after which a GPU would be waited
for: numbers read, sizes that depend on values.

    python scripts/bench_pipeline.py --one [--rounds 15]

times single frames of 2 MP beside ArUco's detector on the same frames: searched, searched with compiled small problems,
and near a pose that is 12 px and a degree off (`PoseEstimator`, ``near``).
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import torchpose as tp
from torchpose import pipeline
from torchpose.detect import reduce
from torchpose.geometry import rotations
from torchpose.io import images
from torchpose.refine import METHODS
from torchpose.sim import add_noise, render

SIZES = {"2 MP": (1824, 1216, 1111.11), "20 MP": (5472, 3648, 3333.33)}
FRAMES = 8
_LISTED = 500  # operations of a function that the whole report lists
COUNTS = {"2 MP": (16, 144), "20 MP": (4, 28)}  # frames of a short and a long run of the command, whole batches
REFINEMENT = "refine_photometric"
STAGES = (
    "find_coarse",
    "find_candidates",
    "find_circles",
    "measure_circles",
    "identify",
    "solve_poses",
    REFINEMENT,
)


def camera_of(width: int, height: int, focal: float) -> tp.Camera:
    matrix = [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    return tp.Camera(width, height, torch.tensor(matrix, dtype=torch.float64), torch.zeros(4, dtype=torch.float64))


def make_frames(camera: tp.Camera, target: tp.Target) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Frames (8, H, W) uint8 with their poses: tilt 0 to 35 degrees."""
    k = torch.arange(FRAMES, dtype=torch.float64)
    vector = torch.stack([0.6 * k / FRAMES * (2.4 * k).cos(), 0.6 * k / FRAMES * (2.4 * k).sin(), 0.3 * k], -1)
    rotation = rotations.exp(vector)
    translation = torch.stack([6 * (k % 3 - 1), 4 * (k % 2), 160 + 2 * k], -1)
    frames = [
        add_noise(render(camera, target, rotation[i : i + 1], translation[i : i + 1], plate=(70.0, 70.0)), 2.0, seed=i)
        for i in range(FRAMES)
    ]
    return torch.cat(frames), rotation, translation


def plain_opencv(frame: np.ndarray, target: tp.Target, matrix: np.ndarray) -> np.ndarray | None:
    """Otsu threshold, contours, direct ellipses, nearest code, solvePnP of the mean centres: t (3,) or None."""
    _, binary = cv2.threshold(frame, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    ellipses = []
    for contour in contours:
        if len(contour) >= 20:
            (u, v), (a, b), _ = cv2.fitEllipseDirect(contour)
            area = cv2.contourArea(contour)
            if area > 0 and abs(np.pi * a * b / 4 / area - 1) < 0.1:
                ellipses.append((u, v, a * b))
    ratios = (target.radii[:, 1] / target.radii[:, 0]).numpy()
    centers = np.full((len(ratios), 2), np.nan)
    for u, v, size in ellipses:
        for x, y, inner in ellipses:
            if inner < 0.8 * size and (u - x) ** 2 + (v - y) ** 2 < 0.01 * size:
                centers[np.argmin(abs(ratios - np.sqrt(inner / size)))] = (u + x) / 2, (v + y) / 2
    if not np.isfinite(centers).all():
        return None
    _, _, t = cv2.solvePnP(target.centers.numpy(), centers, matrix, None, flags=cv2.SOLVEPNP_ITERATIVE)
    return t[:, 0]


def clocked(stage: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """The stage, which adds its CPU time to ``spent``."""

    def run(*args: object, **kwargs: object) -> Any:
        start = time.process_time()
        result = stage(*args, **kwargs)
        spent[name] += time.process_time() - start
        return result

    return run


def timed(module: ModuleType, name: str, spent: dict[str, float]) -> Callable[[], None]:
    """Adds the CPU time of a stage to ``spent``; returns what takes the clock off again."""
    if name == REFINEMENT:  # the last step of the method
        recipe = METHODS["photometric"]
        *steps, last = recipe.steps
        METHODS["photometric"] = replace(recipe, steps=(*steps, clocked(last, name, spent)))
        return lambda: METHODS.update(photometric=recipe)
    original = getattr(module, name)
    setattr(module, name, clocked(original, name, spent))
    return lambda: setattr(module, name, original)


def with_numpy(data: bytes) -> np.ndarray:
    """By OpenCV, as whoever has no other decoder does it."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def bench_decoders(folder: Path, rounds: int, report: list[str]) -> None:
    """CPU of decoding the frames by each decoder, and by torchpose with all that it checks."""
    from kornia_rs import io

    paths = sorted(folder.iterdir())
    plain = [path.read_bytes() for path in paths]
    shape = with_numpy(plain[0]).shape
    jpeg = [cv2.imencode(".jpg", with_numpy(data))[1].tobytes() for data in plain]
    (folder.parent / "jpeg").mkdir()
    files = [folder.parent / "jpeg" / f"{i}.jpg" for i in range(len(jpeg))]
    for path, data in zip(files, jpeg, strict=True):
        path.write_bytes(data)
    work: dict[str, Callable[[], object]] = {
        "PNG, OpenCV": lambda: [with_numpy(data) for data in plain],
        "PNG, kornia_rs": lambda: [io.decode_image_png_u8(data, shape, "mono") for data in plain],
        "PNG, torchpose": lambda: [images.decode(path) for path in paths],
        "JPEG, OpenCV": lambda: [with_numpy(data) for data in jpeg],
        "JPEG, kornia_rs": lambda: [io.decode_image_jpegturbo(data, "mono") for data in jpeg],
        "JPEG, torchpose": lambda: [images.decode(path) for path in files],
    }
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, function in work.items():
            times[name].append(cpu(function))
    report += ["| decoder | CPU ms a frame | of OpenCV, PNG |", "|---|---|---|"]
    for name, spent in times.items():
        of = statistics.median(a / b for a, b in zip(spent, times["PNG, OpenCV"], strict=True))
        report += [f"| {name} | {1e3 * statistics.median(spent) / len(paths):.1f} | {of:.2f} |"]
    report += [""]


def cpu(function: Callable[[], object]) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def bench_size(label: str, rounds: int, folder: Path, report: list[str]) -> None:
    width, height, focal = SIZES[label]
    camera, target = camera_of(width, height, focal), tp.Target.load("quad40")
    frames, _, truth = make_frames(camera, target)
    encoded = [cv2.imencode(".png", f.numpy())[1] for f in frames]
    for i, data in enumerate(encoded):
        (folder / f"{i}.png").write_bytes(data.tobytes())
    camera.save(folder.parent / "camera.yaml")
    estimator = tp.PoseEstimator(camera, target)
    matrix = camera.matrix.numpy()
    poses = estimator(frames)
    plain = [plain_opencv(f.numpy(), target, matrix) for f in frames]
    spent: dict[str, float] = defaultdict(float)
    undo = [timed(pipeline, name, spent) for name in STAGES]
    rows: dict[str, list[float]] = defaultdict(list)
    for _ in range(rounds):
        spent.clear()
        rows["decode PNG"].append(cpu(lambda: [cv2.imdecode(e, cv2.IMREAD_UNCHANGED) for e in encoded]))
        rows["torchpose"].append(cpu(lambda: estimator(frames)))
        rows["OpenCV"].append(cpu(lambda: [plain_opencv(f.numpy(), target, matrix) for f in frames]))
        for name in STAGES:
            rows[name].append(spent[name])
    for u in undo:
        u()

    def ms(name: str) -> float:
        return 1e3 * statistics.median(rows[name]) / FRAMES

    def ratio(a: str, b: str) -> float:
        return statistics.median(x / y for x, y in zip(rows[a], rows[b], strict=True))

    report += [f"## {label} ({width} x {height}), batch of {FRAMES}, {rounds} rounds", ""]
    report += ["| step | CPU ms a frame | of decoding |", "|---|---|---|"]
    report += [f"| {name} | {ms(name):.1f} | {ratio(name, 'decode PNG'):.2f} |" for name in rows]
    ok = poses.ok
    error = (poses.t - truth)[ok].square().mean(0).sqrt() * 1e3
    found = [i for i, t in enumerate(plain) if t is not None]
    theirs = torch.tensor(np.array([plain[i] for i in found])) - truth[found]
    line = theirs.square().mean(0).sqrt() * 1e3
    ours_um, opencv_um = (", ".join(f"{e:.2f}" for e in v.tolist()) for v in (error, line))
    report += ["", f"RMS error x, y, z, um: torchpose {ours_um} ({int(ok.sum())} of {FRAMES} ok);"]
    report += [f"OpenCV {opencv_um} ({len(found)} of {FRAMES} found).", ""]


def bench_reduction(rounds: int, report: list[str]) -> None:
    """Why the one full-size pass is OpenCV's: torch's own area reduction converts to float first."""
    frames = torch.randint(0, 256, (4, 3648, 5472), dtype=torch.uint8)
    ours, torchs = [], []
    for _ in range(rounds):
        ours.append(cpu(lambda: reduce.area_reduce(frames, 4)))
        torchs.append(cpu(lambda: torch.nn.functional.avg_pool2d(frames[:, None].float(), 4)))
    ratio = statistics.median(b / a for a, b in zip(ours, torchs, strict=True))
    report += [f"Area reduction of 20 MP frames by 4: avg_pool2d takes {ratio:.1f} times the CPU of cv2.resize.", ""]


class Run(NamedTuple):
    """A run of the command: seconds of CPU and of the clock, and the largest resident set of its processes, MB."""

    cpu: float
    wall: float
    memory: float


def keeping() -> dict[str, str]:
    """The environment, without the word that modules are compiled anew by every process."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def run(*words: str) -> Run:
    start = time.perf_counter()
    command = [sys.executable, "-m", "torchpose", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=keeping())
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"torchpose {words[0]} failed")
    return Run(usage.ru_utime + usage.ru_stime, time.perf_counter() - start, usage.ru_maxrss / 1024)


def estimated(folder: Path, count: int, threads: int) -> Run:
    """`torchpose estimate` on ``count`` frames."""
    many, camera = folder.parent / f"many{count}", folder.parent / "camera.yaml"
    if not many.exists():
        many.mkdir()
        for i in range(count):
            os.link(folder / f"{i % FRAMES}.png", many / f"{i:04d}.png")
    out = str(folder.parent / f"{count}.csv")
    options = ["--camera", str(camera), "--target", "quad40", "--out", out, "--threads", str(threads), "--quiet"]
    return run("estimate", str(many), *options)


_DECODING = """
import sys, time, cv2, numpy as np
cv2.setNumThreads(1)
plain = [np.fromfile(name, np.uint8) for name in sys.argv[1:]]
for again in range(3):
    start = time.process_time()
    for data in plain:
        cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
print((time.process_time() - start) / len(plain))
"""


def decoding_alone(folder: Path) -> float:
    """CPU of a frame in a program that only decodes with OpenCV: none keeps memory for it, as torchpose does."""
    command = [sys.executable, "-c", _DECODING, *map(str, sorted(folder.iterdir()))]
    return float(subprocess.run(command, capture_output=True, check=True).stdout)


def bench_command(label: str, rounds: int, folder: Path, report: list[str]) -> None:
    """The whole command beside OpenCV's decoding of the same files, on one core and on two."""
    few, many = COUNTS[label]
    rows: dict[str, list[float]] = defaultdict(list)
    estimated(folder, few, 1)  # the first run compiles modules
    for _ in range(rounds):
        for threads in (1, 2):
            decoding = decoding_alone(folder)
            short, long = estimated(folder, few, threads), estimated(folder, many, threads)
            frame = (long.cpu - short.cpu) / (many - few)
            rows[f"frame {threads}"].append(frame)
            rows[f"of decoding {threads}"].append(frame / decoding)
            rows[f"start {threads}"].append(short.cpu - few * frame)
            rows[f"rate {threads}"].append((many - few) / (long.wall - short.wall))
            rows[f"memory {threads}"].append(long.memory)
    of = {name: statistics.median(values) for name, values in rows.items()}
    report += ["| `torchpose estimate` on | CPU ms a frame | of OpenCV's decoding | frames/s | start, CPU s | MB |"]
    report += ["|---|---|---|---|---|---|"]
    for threads in (1, 2):
        frame, ratio, rate, start, memory = (
            of[f"{name} {threads}"] for name in ("frame", "of decoding", "rate", "start", "memory")
        )
        cores = "one core" if threads == 1 else "two cores"
        report += [f"| {cores} | {1e3 * frame:.1f} | {ratio:.2f} | {rate:.1f} | {start:.2f} | {memory:.0f} |"]
    gain = statistics.median(b / a for a, b in zip(rows["rate 1"], rows["rate 2"], strict=True))
    report += ["", f"{many} frames; two cores give {gain:.2f} times the frames/s of one. {loaded()}", ""]


def bench_start(rounds: int, report: list[str]) -> None:
    """CPU of commands that have nothing to do, beside that of importing torch alone."""
    imports = [python_cpu("import torch") for _ in range(rounds)]
    helps = [run("--help").cpu for _ in range(rounds)]
    stages = [python_cpu("import torchpose.pipeline, torchpose.io.store") for _ in range(rounds)]
    times = (statistics.median(times) for times in (helps, imports, stages))
    text = "CPU of `torchpose --help` {:.2f} s, of `import torch` {:.2f} s, of all that `estimate` imports {:.2f} s."
    report += [text.format(*times), ""]


def python_cpu(code: str) -> float:
    process = subprocess.Popen([sys.executable, "-c", code], env=keeping())
    usage = os.wait4(process.pid, 0)[2]
    return usage.ru_utime + usage.ru_stime


class Operations(TorchDispatchMode):
    """Counts dispatched operations by the functions of torchpose on the stack, outermost first."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # of torch
        self.by_chain: Counter[tuple[str, ...]] = Counter()
        self.kinds: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with self:  # in inference mode compound operations arrive whole
            parts = func.decompose(*args, **(kwargs or {}))
        if parts is not NotImplemented:
            return parts
        chain, frame = [], sys._getframe(1)
        while frame is not None:
            if (name := _function(frame.f_code)) is not None:
                chain.append(name)
            frame = frame.f_back  # type: ignore[assignment]
        self.by_chain[tuple(reversed(chain))] += 1
        self.kinds[func.overloadpacket.__name__] += 1
        return func(*args, **(kwargs or {}))

    @property
    def total(self) -> int:
        return self.by_chain.total()

    def tree(self, least: int) -> list[str]:
        """Lines of an indented list: all operations under a function that make up ``least`` or more."""
        under: Counter[tuple[str, ...]] = Counter()
        for chain, count in self.by_chain.items():
            for end in range(1, len(chain) + 1):
                under[chain[:end]] += count
        first = {chain: number for number, chain in enumerate(under)}  # in the order of the calls

        def below(chain: tuple[str, ...]) -> list[str]:
            inner = [c for c in under if c[:-1] == chain and under[c] >= least]
            lines = []
            for c in sorted(inner, key=first.__getitem__):
                lines += [f"{'    ' * len(chain)}- {c[-1]}: {under[c]}", *below(c)]
            return lines

        return below(())


SYNCS = ("_local_scalar_dense", "nonzero", "equal", "_unique2", "unique_dim", "repeat_interleave")


def _function(code: CodeType) -> str | None:
    """Module and name of a function of the package; None of what only checks or selects."""
    _, package, path = code.co_filename.rpartition("/torchpose/")
    plumbing = path in ("geometry/arguments.py", "geometry/rows.py")
    if not package or plumbing or code.co_name.startswith("<"):
        return None
    return f"{path.removesuffix('.py').replace('/', '.')}.{code.co_qualname}"


def bench_operations(batches: list[int], least: int, report: list[str]) -> None:
    camera, target = camera_of(*SIZES["2 MP"]), tp.Target.load("quad40")
    frames, _, _ = make_frames(camera, target)
    estimator = tp.PoseEstimator(camera, target)
    for batch in batches:
        some = frames[torch.arange(batch) % FRAMES].contiguous()
        estimator(some)
        with Operations() as operations:
            estimator(some)
        syncs = sum(operations.kinds[kind] for kind in SYNCS)
        report += [f"## Operations of a batch of {batch}: {operations.total}, {syncs} of them syncs", ""]
        report += [*operations.tree(least), ""]
        kinds = ", ".join(f"{name} {count}" for name, count in operations.kinds.most_common(24))
        report += [f"Most: {kinds}.", ""]


MOVE_PX, TURN_RAD = 12.0, 0.017  # of the poses that frames are looked for near


def bench_one(rounds: int, report: list[str]) -> None:
    """CPU of frames alone beside ArUco's detector: the median of the ratios of all frames and rounds, and the ratio of
    the means of each frame's quickest round, which what else the machine does reaches least."""
    camera, target = camera_of(*SIZES["2 MP"]), tp.Target.load("quad40")
    frames, R, t = make_frames(camera, target)
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    plain, compiled = (tp.PoseEstimator(camera, target, compile=on) for on in (False, True))
    turn = rotations.exp(torch.tensor([0.0, TURN_RAD, 0.0], dtype=torch.float64))
    along = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    near = turn @ R, t + MOVE_PX * t[:, 2:] / camera.matrix[0, 0] * along
    works: dict[str, Callable[[int], object]] = {
        "ArUco": lambda i: aruco.detectMarkers(frames[i].numpy()),
        "searched": lambda i: plain(frames[i]),
        "searched, compiled": lambda i: compiled(frames[i]),
        "near the last pose": lambda i: plain(frames[i], near=(near[0][i][None, None], near[1][i][None, None])),
    }
    times: dict[str, list[list[float]]] = {name: [] for name in works}
    for work in works.values():
        work(0)  # warms up
    for _ in range(rounds):
        for name in works:
            times[name].append([])
        for i in range(FRAMES):  # one after the other on each frame: what else the machine does meets all alike
            for name, work in works.items():
                times[name][-1].append(cpu(lambda work=work, i=i: work(i)))  # type: ignore[misc]
    ms = {name: 1e3 * np.array(spent) for name, spent in times.items()}
    report += ["| one frame | CPU ms | of ArUco, median | of ArUco, quickest rounds |", "|---|---|---|---|"]
    for name, spent in ms.items():
        of, least = np.median(spent / ms["ArUco"]), spent.min(0).mean() / ms["ArUco"].min(0).mean()
        report += [f"| {name} | {np.median(spent):.1f} | {of:.2f} | {least:.2f} |"]
    counts = []
    for name in ("searched", "near the last pose"):
        with Operations() as operations:
            works[name](0)
        counts.append(f"{operations.total} {name}")
    report += ["", f"Operations of the first one: {', '.join(counts)}. {loaded()}", ""]


def loaded() -> str:
    return f"Load of the machine (1 minute): {os.getloadavg()[0]:.1f}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, help="also write the report to this Markdown file")
    parser.add_argument("--operations", type=int, nargs="*", metavar="BATCH", help="count operations of such batches")
    parser.add_argument("--one", action="store_true", help="only time single frames beside ArUco")
    parser.add_argument("--least", type=int, default=100, help="operations of a function that is listed")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if options.operations is not None or options.one:
        lines: list[str] = []
        if options.one:
            bench_one(options.rounds, lines)
        if options.operations is not None:
            bench_operations(options.operations or [1], options.least, lines)
        print("\n".join(lines))
        return
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    report = [
        "# Pipeline benchmark",
        "",
        f"Made by `scripts/bench_pipeline.py` at commit {commit}; Python {platform.python_version()}, torch "
        f"{torch.__version__}, OpenCV {cv2.__version__}, {os.cpu_count()} cores; one thread each, medians. {loaded()}",
        "",
    ]
    with tempfile.TemporaryDirectory() as scratch:
        for label in SIZES:
            folder = Path(scratch) / label.replace(" ", "") / "frames"
            folder.mkdir(parents=True)
            bench_size(label, options.rounds, folder, report)
            bench_decoders(folder, options.rounds, report)
            bench_command(label, min(3, options.rounds), folder, report)
    bench_one(options.rounds, report)
    bench_operations([1, FRAMES], _LISTED, report)
    bench_start(min(3, options.rounds), report)
    bench_reduction(options.rounds, report)
    text = "\n".join(report)
    print(text)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(text)


if __name__ == "__main__":
    main()
