"""The paper's Fig. 2: errors of position and orientation against pixel noise and the time of 1000 solves, by method.

    python scripts/fig02_pnp_comparison.py --out out/fig02

One simulated set for all: a square target of nine points, 40 mm wide, tilt 5 to 40 degrees, 150 to 300 mm away,
f = 1111 px. Lines against points: the four corners of the square as points, and its four sides as lines, each fitted
to 25 edge points; every corner and every edge point has the same noise, so the lines use more of the image.
Writes fig02.png, fig02.csv (errors) and fig02_times.csv.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib
import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations

matplotlib.use("Agg")
import matplotlib.pyplot as plt

MATRIX = torch.tensor([[1111.0, 0, 912], [0, 1111.0, 608], [0, 0, 1]], dtype=torch.float64)
POINTS = torch.tensor([[x, y, 0.0] for y in (-20, 0, 20) for x in (-20, 0, 20)], dtype=torch.float64)
CORNERS = POINTS[[0, 2, 8, 6]]
SAMPLES = 25
Poses = tuple[Tensor, Tensor]


def poses(count: int, generator: torch.Generator) -> Poses:
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


def ours(method: pnp.Method) -> Callable[[Tensor], Poses]:
    def run(pixels: Tensor) -> Poses:
        result = pnp.solve(POINTS, pixels, MATRIX, method=method)
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
        return torch.stack([torch.from_numpy(p.R) for p in found]), torch.stack([torch.from_numpy(p.t) for p in found])

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/fig02"))
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.02, 0.05, 0.1, 0.2, 0.5, 1.0], help="px")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    methods: dict[str, Callable[[Tensor], Poses]] = {
        "torchpose iterative": ours("iterative"),
        "torchpose planar": ours("planar"),
        "torchpose epnp": ours("epnp"),
        "torchpose p3p": ours("p3p"),
        "torchpose posit": ours("posit"),
        "cv2 ITERATIVE": opencv(cv2.SOLVEPNP_ITERATIVE),
        "cv2 EPNP": opencv(cv2.SOLVEPNP_EPNP),
        "cv2 IPPE": opencv(cv2.SOLVEPNP_IPPE),
        "cv2 SQPNP": opencv(cv2.SOLVEPNP_SQPNP),
        "cv2 P3P": opencv(cv2.SOLVEPNP_P3P),
    }
    if (loop := poselib_loop()) is not None:
        methods["PoseLib"] = loop

    generator = torch.Generator().manual_seed(0)
    truth = poses(args.poses, generator)
    along = torch.linspace(0, 1, SAMPLES, dtype=torch.float64)[:, None]
    sides = torch.stack([a + along * (b - a) for a, b in zip(CORNERS, CORNERS.roll(-1, 0), strict=True)])
    rows: list[dict[str, object]] = []
    times: dict[str, list[float]] = {name: [] for name in methods}
    for sigma in args.noise:
        noise = sigma * torch.randn(args.poses, 9, 2, generator=generator, dtype=torch.float64)
        pixels = project(POINTS, *truth) + noise
        for name, solve in methods.items():
            rows.append({"noise_px": sigma, "method": name, **errors(solve(pixels), truth)})
        edges = project(sides.flatten(0, 1), *truth).unflatten(1, (4, SAMPLES))
        edges = edges + sigma * torch.randn(edges.shape, generator=generator, dtype=torch.float64)
        corners = by_points(pixels[:, [0, 2, 8, 6]])
        rows.append({"noise_px": sigma, "method": "4 corners as points", **errors(corners, truth)})
        rows.append({"noise_px": sigma, "method": "4 sides as lines", **errors(by_lines(edges), truth)})
    thousand = project(POINTS, *truth) + 0.1 * torch.randn(args.poses, 9, 2, generator=generator, dtype=torch.float64)
    thousand = thousand[torch.arange(1000) % args.poses]
    for _ in range(args.rounds):
        for name, solve in methods.items():
            start = time.perf_counter()
            solve(thousand)
            times[name].append(time.perf_counter() - start)

    args.out.mkdir(parents=True, exist_ok=True)
    with (args.out / "fig02.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    seconds = {name: statistics.median(values) for name, values in times.items()}
    with (args.out / "fig02_times.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["method", "seconds_for_1000"])
        table.writerows(seconds.items())
    for row in rows:
        print("  ".join(f"{v:.4g}" if isinstance(v, float) else str(v).ljust(22) for v in row.values()))
    for name, value in seconds.items():
        print(f"{name.ljust(22)} {1e3 * value:.1f} ms for 1000 poses")
    plot(rows, seconds, args.out / "fig02.png")


def plot(rows: list[dict[str, object]], seconds: dict[str, float], path: Path) -> None:
    """Errors against noise for all methods and for lines against points, and the times."""
    figure, axes = plt.subplots(2, 3, figsize=(15, 8.5), constrained_layout=True)
    names = list(seconds)
    style = {name: ("-" if name.startswith("torchpose") else "--") for name in names}
    palette = plt.get_cmap("tab20")
    colours = {name: palette(i) for i, name in enumerate(names)}
    for row_axes, group in ((axes[0], names), (axes[1], ["4 corners as points", "4 sides as lines"])):
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
    base = {row["noise_px"]: float(str(row["orientation_rms_deg"])) for row in rows if row["method"] == names[0]}
    for name in names:
        part = [row for row in rows if row["method"] == name]
        ratio = [float(str(row["orientation_rms_deg"])) / base[row["noise_px"]] for row in part]
        noise = [row["noise_px"] for row in part]
        axes[1, 2].semilogx(noise, ratio, style[name], marker="o", markersize=3, color=colours[name], label=name)
    axes[1, 2].set_ylim(0.95, 1.5)
    axes[1, 2].set_xlabel("noise of the image points [px]")
    axes[1, 2].set_ylabel(f"orientation error, rms, over that of {names[0]}")
    axes[1, 2].grid(True, which="both", alpha=0.3)
    axes[1, 2].legend(fontsize=7)
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
