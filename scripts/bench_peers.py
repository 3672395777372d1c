"""torchpose beside AprilTag 3, OpenCV's ArUco, ChArUco, chessboard SB and circle grid: error, recall and CPU.

    python scripts/bench_peers.py --frames 12 --out out/peers              # sweeps: table, figure, short table
    python scripts/bench_peers.py --ratios --frames 3 --out out/peers      # CPU beside AprilTag 3 and ArUco's detector

One 70 mm plate, printed as each peer needs it (`peer_boards.py`): 4 rings of quad40; 4 tags as large and in the same
places (tag36h11, and 4 x 4 for ArUco; --tag-mm prints larger ones); a ChArUco board of 63 mm; a chessboard of 8 x 7
inner corners, 63 mm; an asymmetric circle grid of 4 x 11. Same camera (that of the sample, with distortion), poses,
noise of 2 grey levels, blur of 0.7 px. One thing varies at a time over: tilt, size of the plate in px, blur, motion,
noise, contrast, what is around the plate; elsewhere tilt to 45 degrees at 140 to 190 mm. All prints are polygons and
circles, drawn as exactly as the rings by the boundary integrals of `torchpose.sim` (docs/decisions/0003-renderer.md).

A pose counts as right within 1 mm across, 10 mm in depth, both per 160 mm of distance, and 3 degrees; errors are RMS
over those. Of the two poses of a board that looks the same upside down the one nearer to the truth counts. Every
frame is measured alone on one thread; CPU is the median, after a frame to warm up, from grey values to pose.

AprilTag 3 needs `pip install torchpose[peers]` (pupil-apriltags); without it its rows are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from corruptions import BLURS, CORRUPTIONS, F64, LIGHT, PLATE_MM, SCENE, Shot, even, photograph, severity, shoot, tilted
from peer_boards import DARK, NO_APRILTAG, TAG_MM, Contender, Pose, apriltag_detector, contenders, has_apriltag, prints

import torchpose as tp
from torchpose.geometry import rotations
from torchpose.report.figures import PlainLog
from torchpose.sim import shapes

CAMERA = Path(__file__).parents[1] / "data" / "sample" / "camera.yaml"
NEAR_MM, DEPTH_MM, TURN_DEG, AT_MM = 1.0, 10.0, 3.0, 160.0  # a right pose, and the distance that the lengths are for
TILT_DEG, DISTANCE_MM = 45.0, (140.0, 190.0)
LATERAL_MM = (10.0, 5.0)  # the whole plate stays in view at any tilt
# what the ratios may be: torchpose over AprilTag 3, and over ArUco's detector, whichever allows more
OVER_APRILTAG, OVER_ARUCO = 0.5, 6.0
NO_TARGET, TRAY_NAME = "photographs, no target", "tray of 48 plates"
TRAY, TRAY_PITCH_MM, TRAY_DISTANCE_MM = (8, 6), 100.0, 555.0  # plates of 140 px, rings of 10 px radius


@dataclass(frozen=True)
class Point:
    """Conditions of one point of the sweeps; a corruption and its severity, or a pose."""

    axis: str
    value: float | str
    corruption: str = "none"
    severity: Any = 0.0
    tilt_deg: float | None = None
    distance: float | None = None
    photo: bool = False


def sweep(axis: str, corruption: str, values: Iterable[float]) -> list[Point]:
    return [Point(axis, value, corruption, value) for value in values]


def plate_px(camera: tp.Camera, distance: float) -> float:
    """Width of the plate in px at that distance."""
    return round(float(camera.matrix[0, 0]) * PLATE_MM / distance)


def points(camera: tp.Camera) -> list[Point]:
    """All points of the sweeps; the first is what the short table shows."""
    distances = (150.0, 220.0, 320.0, 480.0, 700.0, 1000.0)
    return [
        Point("background", "even"),
        Point("background", "photograph", photo=True),
        Point("background", "1,000 discs", "discs", 1000.0),
        Point("background", "10,000 specks", "specks", 10_000.0),
        *[Point("tilt, degrees", tilt, tilt_deg=tilt) for tilt in (0.0, 15.0, 30.0, 45.0, 60.0, 70.0)],
        *[Point("plate, px", plate_px(camera, d), distance=d) for d in distances],
        *sweep("blur, px", "gaussian blur", (0.7, 1.0, 1.5, 2.0, 3.0, 5.0)),
        *sweep("motion, px", "motion", (1.0, 3.0, 6.0, 9.0, 12.0)),
        *sweep("noise, grey levels", "noise", (0.5, 2.0, 5.0, 15.0, 30.0, 45.0)),
        *sweep("contrast, share of range", "low contrast", (0.75, 0.3, 0.15, 0.06)),
    ]


def view(camera: tp.Camera, printed: Any, point: Point, number: int, seed: int) -> Shot:
    """The shot of a frame, the same for every print."""
    rng = np.random.default_rng([seed, number])
    tilt, distance = rng.uniform(0, TILT_DEG), rng.uniform(*DISTANCE_MM)
    tilt = tilt if point.tilt_deg is None else point.tilt_deg
    distance = distance if point.distance is None else point.distance
    turn = tilted(math.radians(tilt), *rng.uniform(0, 2 * math.pi, 2))
    place = torch.tensor([*(rng.uniform(-1, 1, 2) * LATERAL_MM), distance], dtype=F64)
    around = photograph(number, camera) if point.photo else even(camera)
    return Shot(camera, printed, turn, place, rng, SCENE | {"surround": around})


def errors(shot: Shot, found: list[Pose]) -> tuple[float, float, float] | None:
    """Error across and along the axis in um and angle in mdeg of the pose nearest to the truth, None without one."""
    best: tuple[float, float, float] | None = None
    for turn, place in found:
        off = 1e3 * (torch.from_numpy(place).to(F64) - shot.t)
        angle = 1e3 * math.degrees(float(rotations.log(torch.from_numpy(turn).to(F64) @ shot.R.mT).norm()))
        if best is None or angle < best[2]:
            best = float(off[:2].norm()), abs(float(off[2])), angle
    return best


def right(shot: Shot, off: tuple[float, float, float] | None) -> bool:
    scale = 1e3 * float(shot.t[2]) / AT_MM
    limits = NEAR_MM * scale, DEPTH_MM * scale, 1e3 * TURN_DEG
    return off is not None and all(have < limit for have, limit in zip(off, limits, strict=True))


def measured(
    camera: tp.Camera, who: list[Contender], every: dict[str, Any], point: Point, count: int, seed: int
) -> list[dict[str, Any]]:
    """A row for each contender at one point, ``every`` of whose prints is given by name."""
    each: dict[str, list[tuple[Any, bool, float]]] = {c.name: [] for c in who}
    for number in range(count):
        frames = {}
        for name in {c.print for c in who}:
            shot = view(camera, every[name], point, number, seed)
            frames[name] = shoot(shot, CORRUPTIONS[point.corruption], point.severity, seed * 1_000_003 + number)[1]
        for c in who:
            found, cpu = timed(c.measure, frames[c.print].numpy())
            off = errors(shot, found)
            each[c.name].append((off, right(shot, off), cpu))
    return [row(point, name, of) for name, of in each.items()]


def timed(work: Callable[[np.ndarray], Any], frame: np.ndarray) -> tuple[Any, float]:
    """What it returns, and its CPU in ms."""
    start = time.process_time()
    out = work(frame)
    return out, 1e3 * (time.process_time() - start)


def row(point: Point, name: str, each: list[tuple[Any, bool, float]]) -> dict[str, Any]:
    good = np.array([off for off, fine, _ in each if fine]).reshape(-1, 3)
    rms = np.sqrt(np.square(good).mean(0)) if len(good) else np.full(3, math.nan)
    return {
        "axis": point.axis,
        "value": point.value,
        "peer": name,
        "frames": len(each),
        "right": len(good),
        "wrong": sum(off is not None and not fine for off, fine, _ in each),
        "lateral_um": float(rms[0]),
        "depth_um": float(rms[1]),
        "rotation_mdeg": float(rms[2]),
        "cpu_ms": statistics.median(cpu for _, _, cpu in each),
    }


# tables and figure


def table(rows: list[dict[str, Any]], leading: tuple[str, ...] = ("axis", "value")) -> str:
    """A table of Markdown."""
    heads = [*leading, "peer", "right", "wrong", "lateral um", "depth um", "rotation mdeg", "CPU ms"]
    out = ["| " + " | ".join(heads) + " |", "| " + " | ".join(["---"] * len(heads)) + " |"]
    for r in rows:
        figures = [f"{r[k]:.3g}" if r["right"] else "" for k in ("lateral_um", "depth_um", "rotation_mdeg")]
        values = [f"{r[k]:g}" if isinstance(r[k], float) else r[k] for k in leading]
        cells = [*values, r["peer"], f"{r['right']} of {r['frames']}", r["wrong"], *figures, f"{r['cpu_ms']:.0f}"]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(out)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Lateral error over every axis, a panel each; open marks where not every frame got a right pose."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    axes = list(dict.fromkeys(r["axis"] for r in rows))
    names = list(dict.fromkeys(r["peer"] for r in rows))
    figure, panels = plt.subplots(2, 4, figsize=(16, 7.5), sharey=True, squeeze=False)
    for panel, axis in zip(panels.flat, axes, strict=False):
        for i, name in enumerate(names):
            of = [r for r in rows if r["axis"] == axis and r["peer"] == name]
            at = [r["value"] if isinstance(r["value"], float | int) else str(r["value"]) for r in of]
            error = [r["lateral_um"] if 2 * r["right"] >= r["frames"] else math.nan for r in of]
            style = {"color": f"C{i}", "marker": "o", "markersize": 4}
            panel.plot(at, error, linestyle="none" if axis == "background" else "-", label=name, **style)
            part = [(x, y) for x, y, r in zip(at, error, of, strict=True) if r["right"] < r["frames"]]
            if part:
                panel.plot(*zip(*part, strict=True), linestyle="none", **style | {"markerfacecolor": "white"})
        panel.set(xlabel=axis, yscale="log")
        panel.yaxis.set_major_formatter(PlainLog())
        if axis.startswith(("plate", "contrast")):
            panel.set_xscale("log")
            values = sorted({r["value"] for r in rows if r["axis"] == axis})
            panel.set_xticks(values, [f"{value:g}" for value in values])
            panel.minorticks_off()
        panel.tick_params(axis="x", labelsize=8)
        panel.grid(alpha=0.3, which="both")
    for panel in panels.flat[len(axes) : -1]:
        panel.axis("off")
    for panel in panels[:, 0]:
        panel.set_ylabel("RMS error across the axis, um")
    last = panels.flat[-1]
    last.axis("off")
    last.legend(*panels.flat[0].get_legend_handles_labels(), loc="center", title="filled: every frame right\n"
                "open: half of them or more", frameon=False)  # fmt: skip
    figure.tight_layout()
    figure.savefig(path, dpi=110)


# cost on the same frames


def tray(camera: tp.Camera) -> tuple[Shot, np.ndarray]:
    """48 plates, each with the rings of quad40."""
    target = tp.Target.load("quad40")
    offsets = [(TRAY_PITCH_MM * i, TRAY_PITCH_MM * j) for i in range(TRAY[0]) for j in range(TRAY[1])][1:]
    plates = shapes.cat([shapes.rectangle(at, PLATE_MM, PLATE_MM, level=LIGHT) for at in offsets])
    marks = zip(target.centers[:, :2].tolist(), target.radii.tolist(), strict=True)
    rings = [(x, y, *radii) for (x, y), radii in marks]
    copies = [shapes.ring((a + x, b + y), r, s, DARK) for a, b in offsets for x, y, r, s in rings]
    first = -0.5 * TRAY_PITCH_MM * torch.tensor([TRAY[0] - 1.0, TRAY[1] - 1.0, 0.0], dtype=F64)
    place = first + torch.tensor([0.0, 0.0, TRAY_DISTANCE_MM], dtype=F64)
    imaging = SCENE | {"surround": even(camera), "clutter": plates, "covers": shapes.cat(copies)}
    shot = Shot(camera, target, torch.eye(3, dtype=F64), place, np.random.default_rng(0), imaging)
    shot, frame = shoot(shot, CORRUPTIONS["none"], 0.0, 1)
    return shot, frame.numpy()


def cases(camera: tp.Camera, count: int, seed: int, only: list[str]) -> Iterable[tuple[str, list[np.ndarray]]]:
    """Frames of the plate with rings, by name; ``only`` those with one of these words, all without any."""

    def asked(name: str) -> bool:
        return not only or any(word in name for word in only)

    target = tp.Target.load("quad40")
    wanted = [
        ("clean", Point("", "")),
        ("before photographs", Point("", "", photo=True)),
        ("1,000 discs", Point("", "", "discs", 1000.0)),
        ("10,000 specks", Point("", "", "specks", 10_000.0)),
        *[(f"{name} {severity(value)}", Point("", "", name, value)) for name, c in BLURS.items() for value in c.values],
    ]
    for name, point in wanted:
        if asked(name):
            made = [view(camera, target, point, number, seed) for number in range(count)]
            shots = [shoot(shot, CORRUPTIONS[point.corruption], point.severity, i) for i, shot in enumerate(made)]
            yield name, [frame.numpy() for _, frame in shots]
    if asked(NO_TARGET):
        yield NO_TARGET, [photograph(number, camera).astype(np.uint8) for number in range(count)]
    if asked(TRAY_NAME):
        yield TRAY_NAME, [tray(camera)[1]]


def large(seed: int) -> tuple[tp.Camera, np.ndarray]:
    """The 20 MP camera and a frame before a photograph."""
    matrix = [[3333.33, 0, 2735.5], [0, 3333.33, 1823.5], [0, 0, 1]]
    camera = tp.Camera(5472, 3648, torch.tensor(matrix, dtype=F64), torch.zeros(4, dtype=F64))
    shot = view(camera, tp.Target.load("quad40"), Point("", "", photo=True), 0, seed)
    return camera, shoot(shot, CORRUPTIONS["none"], 0.0, 1)[1].numpy()


def ratio(name: str, camera: tp.Camera, frames: list[np.ndarray], rounds: int) -> dict[str, Any]:
    """CPU of torchpose's default method beside AprilTag 3 and ArUco's detector, ms a frame, medians."""
    target = tp.Target.load("quad40")
    estimator = tp.PoseEstimator(camera, target)
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    works: dict[str, Callable[[np.ndarray], Any]] = {
        "torchpose": lambda frame: estimator(torch.from_numpy(frame)[None]),
        "aruco": aruco.detectMarkers,
    }
    if has_apriltag():
        works["apriltag"] = apriltag_detector().detect
    times: dict[str, list[float]] = {key: [] for key in works}
    for work in works.values():
        work(frames[0])  # warms up
    for frame in frames * rounds:  # one after the other on each frame: what else the machine does meets all alike
        for key, work in works.items():
            times[key].append(timed(work, frame)[1])
    ms = {"apriltag": math.nan} | {key: statistics.median(of) for key, of in times.items()}
    allowed = np.nanmax([OVER_APRILTAG * ms["apriltag"], OVER_ARUCO * ms["aruco"]]).item()
    return {"case": name, "frames": len(frames), **ms, "allowed": allowed}


def ratio_table(rows: list[dict[str, Any]]) -> str:
    heads = ["frames", "torchpose ms", "AprilTag 3 ms", "ArUco ms", "over AprilTag 3", "over ArUco", "allowed ms", ""]
    out = ["| " + " | ".join(heads) + " |", "| " + " | ".join(["---"] * len(heads)) + " |"]
    for r in rows:
        ms = [f"{r[k]:.0f}" for k in ("torchpose", "apriltag", "aruco")]
        over = [f"{r['torchpose'] / r['apriltag']:.2f}", f"{r['torchpose'] / r['aruco']:.1f}"]
        verdict = "" if r["torchpose"] <= r["allowed"] else "beyond"
        out.append("| " + " | ".join([r["case"], *ms, *over, f"{r['allowed']:.0f}", verdict]) + " |")
    return "\n".join(out)


def peak_memory(camera: tp.Camera, frame: np.ndarray) -> float:
    """Largest resident set of `torchpose estimate` on the frame, a process of its own, in MB."""
    with tempfile.TemporaryDirectory() as folder:
        camera.save(Path(folder) / "camera.yaml")
        cv2.imwrite(f"{folder}/frame.png", frame)
        command = [sys.executable, "-m", "torchpose", "estimate", f"{folder}/frame.png", "--camera",
                   f"{folder}/camera.yaml", "--target", "quad40", "--out", f"{folder}/poses.csv"]  # fmt: skip
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
        _, status, usage = os.wait4(child.pid, 0)
        if status:
            raise RuntimeError("torchpose estimate failed on the 20 MP frame")
        return usage.ru_maxrss / 1024


def ratios(camera: tp.Camera, options: argparse.Namespace) -> None:
    """Prints the two ratios for every case, and the memory of a large frame."""
    if not has_apriltag():
        print(NO_APRILTAG)
    rows = []
    for name, frames in cases(camera, options.frames, options.seed, options.only):
        rows.append(ratio(name, camera, frames, options.rounds))
        print(ratio_table(rows[-1:]).splitlines()[-1], flush=True)
    if not options.small:
        big, frame = large(options.seed)
        rows.append(ratio("20 MP before a photograph", big, [frame], options.rounds))
        print(f"20 MP before a photograph: {peak_memory(big, frame):.0f} MB at most, one process")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "ratios.md").write_text(ratio_table(rows) + "\n", encoding="utf-8")
    (options.out / "ratios.json").write_text(json.dumps(rows), encoding="utf-8")
    print(ratio_table(rows))


def sweeps(camera: tp.Camera, options: argparse.Namespace) -> None:
    """Measures every point, writes tables and figure."""
    who = [c for c in contenders(camera, options.tag_mm) if not options.peer or c.name in options.peer]
    every = points(camera)
    wanted = [p for p in every if not options.only or any(word in f"{p.axis} {p.value}" for word in options.only)]
    drawn = prints(options.tag_mm)
    measured(camera, who, drawn, Point("", ""), 1, options.seed)  # warms up
    rows: list[dict[str, Any]] = []
    for point in wanted:
        rows += measured(camera, who, drawn, point, options.frames, options.seed)
        print(table(rows[-len(who) :]).split("\n", 2)[2], flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    short = table([r for r in rows if r["value"] == "even"], leading=())
    (options.out / "peers.json").write_text(json.dumps(rows), encoding="utf-8")
    (options.out / "peers.md").write_text(f"{table(rows)}\n\n{short}\n", encoding="utf-8")
    draw(rows, options.figure or options.out / "peers.png")
    print(f"\n{short}")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12, help="of every point")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="folder of tables, figure and json")
    parser.add_argument("--figure", type=Path, help="file of the figure, in place of the one in --out")
    parser.add_argument("--only", nargs="+", metavar="WORD", default=[], help="points or cases with such a word")
    parser.add_argument("--peer", nargs="+", metavar="NAME", help="these alone")
    parser.add_argument("--tag-mm", type=float, default=TAG_MM, help="side of the tags, up to 30")
    parser.add_argument("--ratios", action="store_true", help="CPU on equal frames in place of the sweeps")
    parser.add_argument("--rounds", type=int, default=3, help="of --ratios over the frames")
    parser.add_argument("--small", action="store_true", help="--ratios without the 20 MP frame")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera = tp.Camera.load(CAMERA)
    (ratios if options.ratios else sweeps)(camera, options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
