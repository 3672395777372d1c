"""The paper's Fig. 2: errors of position and orientation against pixel noise and the time of 1000 solves, by method.

One simulated set for all: a square target of nine points, 40 mm wide, tilt 5 to 40 degrees, 150 to 300 mm away,
f = 1111 px. Lines against points: the four corners of the square as points, and its four sides as lines, each fitted
to 25 edge points; every corner and every edge point has the same noise, so the lines use more of the image.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import torch
from matplotlib import colormaps
from matplotlib.figure import Figure
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.io.rows import Row
from torchpose.kernels import has_compiler
from torchpose.report.figures import GREY, curve, legend_below, subplots
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress
from torchpose.studies.views import turned

NAME = "fig02_pnp"
TITLE = "Fig. 2: methods of PnP, their errors and times"
NOISE_PX = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
MATRIX = torch.tensor([[1111.0, 0, 912], [0, 1111.0, 608], [0, 0, 1]], dtype=torch.float64)
POINTS = torch.tensor([[x, y, 0.0] for y in (-20, 0, 20) for x in (-20, 0, 20)], dtype=torch.float64)
_CORNER = [0, 2, 8, 6]  # of the points
CORNERS = POINTS[_CORNER]
SAMPLES = 25
OURS: tuple[pnp.Method, ...] = ("iterative", "planar", "epnp", "p3p", "posit")
OPENCV = ("ITERATIVE", "EPNP", "IPPE", "SQPNP", "P3P")
COMPILED = "torchpose iterative, compiled"
BY_POINTS, BY_LINES = "4 corners as points", "4 sides as lines"
Poses = tuple[Tensor, Tensor]  # R (B, 3, 3) and t (B, 3)
Solve = Callable[[Tensor], Poses]  # of pixels (B, 9, 2)


def random_poses(count: int, generator: torch.Generator) -> Poses:
    """R (count, 3, 3) and t (count, 3) mm."""
    tilt, azimuth, roll, x, y, z = torch.rand(6, count, generator=generator, dtype=torch.float64)
    R = turned(math.radians(5) + math.radians(35) * tilt, azimuth, roll)
    return R, torch.stack([40 * (x - 0.5), 30 * (y - 0.5), 150 + 150 * z], -1)


def seen(points: Tensor, poses: Poses, sigma: float, generator: torch.Generator) -> Tensor:
    """Pixels (B, N, 2) of points (N, 3) with noise."""
    R, t = poses
    camera_points = points @ R.mT + t[:, None]
    pixels = MATRIX[0, 0] * camera_points[..., :2] / camera_points[..., 2:] + MATRIX[:2, 2]
    return pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def ours(method: pnp.Method, compile: bool = False) -> Solve:
    def run(pixels: Tensor) -> Poses:
        result = pnp.solve(POINTS, pixels, MATRIX, method=method, compile=compile)
        return result.R, result.t

    return run


def opencv(name: str) -> Solve:
    def run(pixels: Tensor) -> Poses:
        model, matrix, flag = POINTS.numpy(), MATRIX.numpy(), getattr(cv2, f"SOLVEPNP_{name}")
        if name == "P3P":
            model, pixels = CORNERS.numpy(), pixels[:, _CORNER]
        found = [cv2.solvePnP(model, image, matrix, None, flags=flag) for image in pixels.numpy()]
        R = torch.stack([torch.from_numpy(cv2.Rodrigues(rvec)[0]) for _, rvec, _ in found])
        return R, torch.stack([torch.from_numpy(tvec.ravel()) for _, _, tvec in found])

    return run


def poselib_loop() -> dict[str, Solve]:
    """PoseLib by its name, where it is installed."""
    try:
        import poselib
    except ImportError:
        return {}
    camera = {"model": "PINHOLE", "width": 1824, "height": 1216, "params": [1111.0, 1111.0, 912.0, 608.0]}

    def run(pixels: Tensor) -> Poses:
        model = POINTS.numpy()
        found = [poselib.estimate_absolute_pose(image, model, camera, {}, {})[0] for image in pixels.numpy()]
        return torch.stack([torch.tensor(p.R) for p in found]), torch.stack([torch.tensor(p.t) for p in found])

    return {"PoseLib": run}


def by_points(pixels: Tensor) -> Poses:
    """From the four corners."""
    result = pnp.solve(CORNERS, pixels, MATRIX)
    return result.R, result.t


def by_lines(edges: Tensor) -> Poses:
    """From the four sides, each a line fitted to its edge points (B, 4, SAMPLES, 2)."""
    xy = (edges - MATRIX[:2, 2]) / MATRIX[0, 0]
    mean = xy.mean(2, keepdim=True)
    offset = xy - mean
    direction = torch.linalg.eigh(offset.mT @ offset).eigenvectors[..., 1]
    half = 0.5 * (xy[:, :, -1] - xy[:, :, 0]).norm(dim=-1, keepdim=True) * direction
    segments = torch.stack([mean[:, :, 0] - half, mean[:, :, 0] + half], 2)
    found = pnp.lines(torch.stack([CORNERS, CORNERS.roll(-1, 0)], 1), segments)
    return found.R[:, 0], found.t[:, 0]


def errors(found: Poses, truth: Poses) -> dict[str, float]:
    """Medians and root mean squares over the poses found; a missing pose counts as such."""
    position = (found[1] - truth[1]).norm(dim=-1)
    angle = torch.rad2deg(rotations.angle_between(found[0], truth[0]))
    have = position.isfinite() & angle.isfinite()
    row = {}
    for name, unit, error in (("position", "mm", position[have]), ("orientation", "deg", angle[have])):
        row[f"{name}_median_{unit}"] = float(error.median())
        row[f"{name}_rms_{unit}"] = float(error.square().mean().sqrt())
    return row | {"without_pose": float(1 - have.double().mean())}


def run(
    *, full: bool = False, seed: int = 0, progress: Progress = ignore_progress, poses: int | None = None
) -> StudyResult:
    """Errors of every method over the noise, times of 1000 solves, lines against points.

    Args:
        poses: simulated for each noise; by default 1000, or 300 for a quick run.
    """
    count, rounds = poses or (1000 if full else 300), 5 if full else 3
    cv2.setNumThreads(1)
    methods = {f"torchpose {name}": ours(name) for name in OURS}
    methods |= {COMPILED: ours("iterative", compile=True)} if has_compiler() else {}
    methods |= {f"cv2 {name}": opencv(name) for name in OPENCV} | poselib_loop()
    generator = torch.Generator().manual_seed(seed)
    truth = random_poses(count, generator)
    along = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)[:, None]
    sides = torch.cat([a + along * (b - a) for a, b in zip(CORNERS, CORNERS.roll(-1, 0), strict=True)])
    rows: list[Row] = []
    for done, sigma in enumerate(NOISE_PX):
        pixels = seen(POINTS, truth, sigma, generator)
        found = {name: solve(pixels) for name, solve in methods.items()}
        found[BY_POINTS] = by_points(pixels[:, _CORNER])
        found[BY_LINES] = by_lines(seen(sides, truth, sigma, generator).unflatten(1, (4, SAMPLES)))
        rows += [{"noise_px": sigma, "method": name, **errors(some, truth)} for name, some in found.items()]
        progress((done + 1) / (len(NOISE_PX) + 3))
    seconds = _times(methods, seen(POINTS, truth, 0.1, generator), rounds)
    times: list[Row] = [{"method": name, "seconds_for_1000": value} for name, value in seconds.items()]
    fastest = seconds["torchpose iterative"]
    return StudyResult(
        tables=[
            Table("errors", "Errors by method and noise", rows),
            Table("times", "Time of 1000 poses of nine points", times, "Threads: torch's, one for OpenCV and PoseLib."),
        ],
        pictures=[Picture("fig02", "Errors against noise, times, and lines against points", plot(rows, seconds))],
        comparisons=[
            Comparison("1000 poses by the iterative method", "s", "< 0.3", fastest),
            *(Comparison("the same, compiled", "s", "< 0.3", seconds[name]) for name in seconds if name == COMPILED),
        ],
        statements=[
            f"torchpose's iterative method takes {1e3 * fastest:.1f} ms for 1000 poses, OpenCV's, called 1000 times, "
            f"{1e3 * seconds['cv2 ITERATIVE']:.0f} ms.",
            f"Four sides as lines, each fitted to {SAMPLES} edge points, give {_ratio(rows, BY_POINTS, BY_LINES):.2f} "
            "times smaller orientation errors than four corners as points of the same noise.",
        ],
        settings={"poses": count, "rounds": rounds, "torch_threads": torch.get_num_threads()},
    )


def _times(methods: Mapping[str, Solve], pixels: Tensor, rounds: int) -> dict[str, float]:
    """Median seconds of 1000 solves, the methods taking turns."""
    pixels = pixels[torch.arange(1000) % len(pixels)]
    spent: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(rounds):
        for name, solve in methods.items():
            start = time.perf_counter()
            solve(pixels)
            spent[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in spent.items()}


def _ratio(rows: list[Row], of: str, over: str) -> float:
    """Geometric mean over the noise of a method's median orientation error over another's."""
    by = {(row["method"], row["noise_px"]): math.log(row["orientation_median_deg"]) for row in rows}
    return math.exp(statistics.mean(by[of, sigma] - by[over, sigma] for sigma in NOISE_PX))


def plot(rows: list[Row], seconds: dict[str, float]) -> Figure:
    """Errors against noise for all methods and for lines against points, and the times."""
    figure, axes = subplots(2, 3, (15, 8.5))
    names = list(seconds)
    colours: dict[str, Any] = {name: colormaps["tab20"](i) for i, name in enumerate(names)}
    colours |= {BY_POINTS: "black", BY_LINES: GREY}  # in one legend with the methods

    def curves(panel: Any, some: Sequence[Row], group: Sequence[str], key: str, label: str) -> None:
        for name in group:
            style = "--" if name in names and not name.startswith("torchpose") else "-"
            part = [row for row in some if row["method"] == name]
            curve(panel, part, "noise_px", key, f"{style}o", ms=3, color=colours[name], label=name)
        panel.set(xlabel="noise of the image points [px]", ylabel=label, xscale="log")
        panel.grid(True, which="both", alpha=0.3)

    for (position, orientation, _), group in ((axes[0], names), (axes[1], [BY_POINTS, BY_LINES])):
        curves(position, rows, group, "position_median_mm", "position error, median [mm]")
        curves(orientation, rows, group, "orientation_median_deg", "orientation error, median [deg]")
        position.set_yscale("log")
        orientation.set_yscale("log")
    bars, ratio = axes[:, 2]
    bars.barh(names, [1e3 * seconds[name] for name in names], color=[colours[name] for name in names])
    bars.axvline(300, color="k", linestyle=":")
    bars.set_title("dotted: the paper's 0.3 s, iterative", fontsize=9)
    bars.set_yticks(range(len(names)), [name.replace(", ", ",\n") for name in names], fontsize=8)
    bars.set(xscale="log", xlabel="time of 1000 poses [ms]")
    bars.invert_yaxis()
    # the curves of the best methods coincide on logarithmic axes: the ratio tells them apart
    base = {row["noise_px"]: row["orientation_rms_deg"] for row in rows if row["method"] == names[0]}
    over = [row | {"ratio": row["orientation_rms_deg"] / base[row["noise_px"]]} for row in rows]
    curves(ratio, over, names, "ratio", "orientation error, RMS, over that of\ntorchpose iterative")
    ratio.set_yscale("log")
    legend_below(figure, axes[:, 0], 6)
    return figure
