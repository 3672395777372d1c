"""The paper's Fig. 2: errors of position and orientation against pixel noise and the time of 1000 solves, by method.

One simulated set for all: a square target of nine points, 40 mm wide, tilt 5 to 40 degrees, 150 to 300 mm away,
f = 1111 px. Lines against points: the four corners of the square as points, and its four sides as lines, each fitted
to 25 edge points; every corner and every edge point has the same noise, so the lines use more of the image.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cv2
import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.kernels import has_compiler
from torchpose.report.figures import subplots
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "fig02_pnp"
TITLE = "Fig. 2: methods of PnP, their errors and times"
NOISE_PX = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
MATRIX = torch.tensor([[1111.0, 0, 912], [0, 1111.0, 608], [0, 0, 1]], dtype=torch.float64)
POINTS = torch.tensor([[x, y, 0.0] for y in (-20, 0, 20) for x in (-20, 0, 20)], dtype=torch.float64)
CORNERS = POINTS[[0, 2, 8, 6]]
SAMPLES = 25
COMPILED = "torchpose iterative, compiled"
BY_POINTS, BY_LINES = "4 corners as points", "4 sides as lines"
Poses = tuple[Tensor, Tensor]  # R (B, 3, 3) and t (B, 3)


def random_poses(count: int, generator: torch.Generator) -> Poses:
    """R (count, 3, 3) and t (count, 3) mm."""
    tilt, azimuth, roll, x, y, z = torch.rand(6, count, generator=generator, dtype=torch.float64)
    tilt, azimuth, zero = math.radians(5) + math.radians(35) * tilt, 2 * math.pi * azimuth, torch.zeros_like(tilt)
    r = rotations.exp(torch.stack([azimuth.cos(), azimuth.sin(), zero], -1) * tilt[:, None])
    r = r @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * roll], -1))
    return r, torch.stack([40 * (x - 0.5), 30 * (y - 0.5), 150 + 150 * z], -1)


def project(points: Tensor, r: Tensor, t: Tensor) -> Tensor:
    """Pixels (B, N, 2)."""
    camera_points = points @ r.mT + t[:, None]
    return MATRIX[0, 0] * camera_points[..., :2] / camera_points[..., 2:] + MATRIX[:2, 2]


def ours(method: pnp.Method, compile: bool = False) -> Callable[[Tensor], Poses]:
    def run(pixels: Tensor) -> Poses:
        result = pnp.solve(POINTS, pixels, MATRIX, method=method, compile=compile)
        return result.R, result.t

    return run


def opencv(flag: int) -> Callable[[Tensor], Poses]:
    def run(pixels: Tensor) -> Poses:
        model, matrix = POINTS.numpy(), MATRIX.numpy()
        if flag == cv2.SOLVEPNP_P3P:
            model = CORNERS.numpy()
            pixels = pixels[:, [0, 2, 8, 6]]
        found = [cv2.solvePnP(model, image, matrix, None, flags=flag) for image in pixels.numpy()]
        r = torch.stack([torch.from_numpy(cv2.Rodrigues(rvec)[0]) for _, rvec, _ in found])
        return r, torch.stack([torch.from_numpy(tvec.ravel()) for _, _, tvec in found])

    return run


def poselib_loop() -> Callable[[Tensor], Poses] | None:
    try:
        import poselib
    except ImportError:
        return None
    camera = {"model": "PINHOLE", "width": 1824, "height": 1216, "params": [1111.0, 1111.0, 912.0, 608.0]}

    def run(pixels: Tensor) -> Poses:
        model = POINTS.numpy()
        found = [poselib.estimate_absolute_pose(image, model, camera, {}, {})[0] for image in pixels.numpy()]
        return torch.stack([torch.tensor(p.R) for p in found]), torch.stack([torch.tensor(p.t) for p in found])

    return run


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
    position, angle = position[have], angle[have]
    return {
        "position_median_mm": float(position.median()),
        "position_rms_mm": float(position.square().mean().sqrt()),
        "orientation_median_deg": float(angle.median()),
        "orientation_rms_deg": float(angle.square().mean().sqrt()),
        "without_pose": float(1 - have.double().mean()),
    }


def run(
    *, full: bool = False, seed: int = 0, progress: Progress = ignore_progress, poses: int | None = None
) -> StudyResult:
    """Errors of every method over the noise, times of 1000 solves, lines against points.

    Args:
        poses: simulated for each noise; by default 1000, or 300 for a quick run.
    """
    count = poses or (1000 if full else 300)
    methods = _methods()
    generator = torch.Generator().manual_seed(seed)
    truth = random_poses(count, generator)
    along = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)[:, None]
    sides = torch.stack([a + along * (b - a) for a, b in zip(CORNERS, CORNERS.roll(-1, 0), strict=True)])
    rows: list[dict[str, Any]] = []
    for done, sigma in enumerate(NOISE_PX):
        pixels = project(POINTS, *truth)
        pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        for name, solve in methods.items():
            rows.append({"noise_px": sigma, "method": name, **errors(solve(pixels), truth)})
        edges = project(sides.flatten(0, 1), *truth).unflatten(1, (4, SAMPLES))
        edges = edges + sigma * torch.randn(edges.shape, generator=generator, dtype=torch.float64)
        corners = by_points(pixels[:, [0, 2, 8, 6]])
        rows.append({"noise_px": sigma, "method": BY_POINTS, **errors(corners, truth)})
        rows.append({"noise_px": sigma, "method": BY_LINES, **errors(by_lines(edges), truth)})
        progress((done + 1) / (len(NOISE_PX) + 3))
    seconds = _times(methods, truth, generator, rounds=5 if full else 3)
    times: list[dict[str, Any]] = [{"method": name, "seconds_for_1000": value} for name, value in seconds.items()]
    ratio = _ratio(rows, BY_POINTS, BY_LINES)
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
            f"Four sides as lines, each fitted to {SAMPLES} edge points, give {ratio:.2f} times smaller orientation "
            "errors than four corners as points of the same noise.",
        ],
        settings={"poses": count, "rounds": 5 if full else 3, "torch_threads": torch.get_num_threads()},
    )


def _methods() -> dict[str, Callable[[Tensor], Poses]]:
    cv2.setNumThreads(1)
    methods: dict[str, Callable[[Tensor], Poses]] = {
        "torchpose iterative": ours("iterative"),
        "torchpose planar": ours("planar"),
        "torchpose epnp": ours("epnp"),
        "torchpose p3p": ours("p3p"),
        "torchpose posit": ours("posit"),
        **({COMPILED: ours("iterative", compile=True)} if has_compiler() else {}),
        "cv2 ITERATIVE": opencv(cv2.SOLVEPNP_ITERATIVE),
        "cv2 EPNP": opencv(cv2.SOLVEPNP_EPNP),
        "cv2 IPPE": opencv(cv2.SOLVEPNP_IPPE),
        "cv2 SQPNP": opencv(cv2.SOLVEPNP_SQPNP),
        "cv2 P3P": opencv(cv2.SOLVEPNP_P3P),
    }
    if (loop := poselib_loop()) is not None:
        methods["PoseLib"] = loop
    return methods


def _times(
    methods: dict[str, Callable[[Tensor], Poses]], truth: Poses, generator: torch.Generator, rounds: int
) -> dict[str, float]:
    """Median seconds of 1000 solves, the methods taking turns."""
    pixels = project(POINTS, *truth)
    pixels = pixels + 0.1 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    pixels = pixels[torch.arange(1000) % len(pixels)]
    spent: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(rounds):
        for name, solve in methods.items():
            start = time.perf_counter()
            solve(pixels)
            spent[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in spent.items()}


def _ratio(rows: list[dict[str, Any]], of: str, over: str) -> float:
    """Geometric mean over the noise of a method's median orientation error over another's."""
    by = {(row["method"], row["noise_px"]): math.log(row["orientation_median_deg"]) for row in rows}
    return math.exp(statistics.mean(by[of, sigma] - by[over, sigma] for sigma in NOISE_PX))


def plot(rows: list[dict[str, Any]], seconds: dict[str, float]) -> Figure:
    """Errors against noise for all methods and for lines against points, and the times."""
    from matplotlib import colormaps

    figure, axes = subplots(2, 3, (15, 8.5))
    names = list(seconds)
    style = {name: ("-" if name.startswith("torchpose") else "--") for name in names}
    palette = colormaps["tab20"]
    colours = {name: palette(i) for i, name in enumerate(names)}
    for row_axes, group in ((axes[0], names), (axes[1], [BY_POINTS, BY_LINES])):
        for axis, key, label in (
            (row_axes[0], "position_median_mm", "position error, median [mm]"),
            (row_axes[1], "orientation_median_deg", "orientation error, median [deg]"),
        ):
            for name in group:
                part = [row for row in rows if row["method"] == name]
                axis.loglog(
                    [row["noise_px"] for row in part],
                    [row[key] for row in part],
                    style.get(name, "-"),
                    marker="o",
                    markersize=3,
                    color=colours.get(name),
                    label=name,
                )
            axis.set_xlabel("noise of the image points [px]")
            axis.set_ylabel(label)
            axis.grid(True, which="both", alpha=0.3)
        row_axes[0].legend(fontsize=7)
    axes[0, 2].barh(names, [1e3 * seconds[name] for name in names], color=[colours[name] for name in names])
    axes[0, 2].axvline(300, color="k", linestyle=":", label="0.3 s (paper, iterative)")
    axes[0, 2].set_xscale("log")
    axes[0, 2].invert_yaxis()
    axes[0, 2].set_xlabel("time of 1000 poses [ms]")
    axes[0, 2].legend(fontsize=7)
    # the curves of the best methods coincide on logarithmic axes: the ratio tells them apart
    base = {row["noise_px"]: row["orientation_rms_deg"] for row in rows if row["method"] == names[0]}
    for name in names:
        part = [row for row in rows if row["method"] == name]
        ratio = [row["orientation_rms_deg"] / base[row["noise_px"]] for row in part]
        noise = [row["noise_px"] for row in part]
        axes[1, 2].semilogx(noise, ratio, style[name], marker="o", markersize=3, color=colours[name], label=name)
    axes[1, 2].set_ylim(0.95, 1.5)
    axes[1, 2].set_xlabel("noise of the image points [px]")
    axes[1, 2].set_ylabel(f"orientation error, rms, over that of {names[0]}")
    axes[1, 2].grid(True, which="both", alpha=0.3)
    return figure
