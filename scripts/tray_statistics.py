"""Trays of equal parts: how many copies of a target get their pose, and whether any takes a ring from its neighbour.

    python scripts/tray_statistics.py [--frames 6] [--copies 2 6 20 48] [--seed 0] [--method photometric]

2 MP frames of quad40 on plates of 70 mm, tilt to 30 degrees, rings of 5 to 16 px semi-minor axis, blur 0.6 to 1.2 px,
noise 1 to 3, of three kinds in turn:

- touching: plates side by side, each turned by a multiple of 90 degrees;
- phantoms: 80 mm apart and turned alike, so that rings of four neighbours have the very layout of one copy;
- scattered: loose plates, each turned and tilted (to 20 degrees) its own way.

In every second frame a quarter of the copies is partly covered: one ring wholly and a quarter of the next. The CPU is
that of the identification alone, one thread, median, and beside it that of the whole estimate.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from statistics import median
from unittest import mock

import cv2
import numpy as np
import torch
from torch import Tensor

import torchpose as tp
from torchpose import pipeline
from torchpose.analysis import pose_errors
from torchpose.geometry import rotations
from torchpose.identify import Identified, identify
from torchpose.io.truth import Truth
from torchpose.sim import Shapes, add_noise, shapes
from torchpose.sim.trays import moved, render_tray

F64 = torch.float64
WIDTH, HEIGHT, FOCAL = 1824, 1216, 1111.11
PLATE = 70.0
KINDS = ("touching", "phantoms", "scattered")
NEES_LIMIT = 100.0  # as in clutter_statistics


@dataclass(frozen=True)
class Tray:
    """One frame (H, W) uint8 with the poses of K copies."""

    frame: Tensor
    R: Tensor
    t: Tensor
    covered: Tensor


def lens() -> tp.Camera:
    matrix = torch.tensor([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], dtype=F64)
    return tp.Camera(width=WIDTH, height=HEIGHT, matrix=matrix, distortion=torch.tensor([-0.05, 0.01, 0, 0], dtype=F64))


def tray(number: int, seed: int, copies: int, kind: str, camera: tp.Camera, target: tp.Target) -> Tray:
    """A frame that depends on its arguments alone."""
    rng = np.random.default_rng([seed, number, copies, KINDS.index(kind)])
    rows = max(1, round(math.sqrt(copies * 0.75)))
    columns = math.ceil(copies / rows)
    pitch = {"touching": PLATE, "phantoms": 80.0, "scattered": 1.5 * PLATE}[kind]
    i, j = np.divmod(np.arange(copies), rows)
    at = np.stack([(i - (columns - 1) / 2) * pitch, (j - (rows - 1) / 2) * pitch, 0 * i], 1)
    turn = np.zeros((copies, 3))
    lean = np.zeros((copies, 3))
    if kind == "touching":
        turn[:, 2] = rng.integers(0, 4, copies) * math.pi / 2
    if kind == "scattered":
        at[:, :2] += rng.uniform(-3, 3, (copies, 2))
        turn[:, 2] = rng.uniform(0, 2 * math.pi, copies)
        tilt, way = np.radians(rng.uniform(0, 20, copies)), rng.uniform(0, 2 * math.pi, copies)
        lean[:, 0], lean[:, 1] = tilt * np.cos(way), tilt * np.sin(way)
    slope, side, roll = math.radians(rng.uniform(0, 30)), rng.uniform(0, 2 * math.pi), rng.uniform(-0.1, 0.1)
    base = rotations.exp(torch.tensor([slope * math.cos(side), slope * math.sin(side), 0], dtype=F64))
    base = base @ rotations.exp(torch.tensor([0, 0, roll], dtype=F64))
    R = base @ rotations.exp(torch.from_numpy(lean)) @ rotations.exp(torch.from_numpy(turn))
    wide, high = columns * pitch + 20, rows * pitch + 20
    z = rng.uniform(1.12, 1.3) * max(wide * FOCAL / WIDTH, high * FOCAL / HEIGHT)
    t = torch.from_numpy(at) @ base.T + torch.tensor([0, 0, z], dtype=F64)
    while not _in_view(camera, target, R, t):
        t = t + 0.03 * z * torch.tensor([0, 0, 1.0], dtype=F64)
    hidden = torch.from_numpy(rng.random(copies) < 0.25) & bool(number % 2)
    covers = [moved(_cover(rng, target), *pose) for pose in zip(R[hidden], t[hidden], strict=True)]
    clean = render_tray(
        camera,
        target,
        R,
        t,
        plate=(PLATE, PLATE),
        covers=Shapes.cat(covers) if covers else None,
        psf_sigma=rng.uniform(0.6, 1.2),
    )
    frame = add_noise(clean[None], float(rng.uniform(1, 3)), seed * 1_000_003 + number)[0]
    return Tray(frame, R, t, hidden)


def _in_view(camera: tp.Camera, target: tp.Target, R: Tensor, t: Tensor) -> bool:
    """Whether the frame shows all rings of all copies."""
    x = (R[:, None] @ target.centers[..., None]).squeeze(-1) + t[:, None]
    reach = 1.5 * FOCAL * target.radii[:, 0] / x[..., 2] + 8
    edge = torch.tensor([WIDTH - 1.0, HEIGHT - 1.0], dtype=F64)
    uv = camera.project(x)
    return bool(((uv > reach[..., None]) & (uv < edge - reach[..., None])).all())


def _cover(rng: np.random.Generator, target: tp.Target) -> Shapes:
    """A square over one ring and a strip over a quarter of the next one's perimeter."""
    first = int(rng.integers(len(target)))
    (x, y, _), radius = target.centers[first].tolist(), float(target.radii[first, 0])
    square = shapes.rectangle((x, y), 2.3 * radius, 2.3 * radius, level=150.0)
    (x, y, _), turn = target.centers[(first + 1) % len(target)].tolist(), rng.uniform(0, 2 * math.pi)
    near = radius * math.cos(math.pi * 0.25)
    middle = 0.5 * (near + 1.2 * radius)
    place = (x + middle * math.cos(turn), y + middle * math.sin(turn))
    strip = shapes.rectangle(place, 1.2 * radius - near, 2.1 * radius, turn, level=120.0)
    return Shapes.cat([square, strip])


def judged(poses: tp.Poses, made: Tray, camera: tp.Camera, target: tp.Target) -> dict[str, int]:
    """Copies with their own rings and a right pose, and the others by what is the matter with them."""
    found = poses[poses.ok | (poses.status == tp.Status.AMBIGUOUS)]
    centers = camera.project((made.R[:, None] @ target.centers[..., None]).squeeze(-1) + made.t[:, None])  # (K, M, 2)
    seen = poses.detections
    owner = torch.cdist(seen.center, centers.flatten(0, 1)).argmin(1) // len(target)
    nearest = torch.cdist(found.t, made.t).argmin(1)
    truth = Truth([""] * len(found), [""] * len(found), made.t[nearest], rotations.log(made.R[nearest]))
    errors = pose_errors(found, truth)
    # a row and its detections share the number of the copy
    of_row = seen.instance[:, None] == found.instance
    mixed = ((owner[:, None] != nearest) & of_row).any(0)
    off = found.ok & (errors.nees > NEES_LIMIT) & ~mixed

    def copies(rows: Tensor) -> Tensor:
        return torch.bincount(nearest[rows], minlength=len(made.t))

    right, twofold, every = copies(found.ok & ~mixed & ~off), copies(~found.ok & ~mixed), copies(~mixed)
    return {
        "ok": int((right > 0).sum()),
        "ambiguous": int((twofold > 0).sum()),
        "lost": int((every == 0).sum()),
        "twice": int((every > 1).sum()),
        "mixed": int(mixed.sum()),
        "wrong": int(off.sum()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--copies", type=int, nargs="+", default=[2, 6, 20, 48])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", default="photometric")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera, target, spent = lens(), tp.Target.load("quad40"), list[float]()

    def timed(*words: object, **more: object) -> Identified:
        started = time.process_time()
        result = identify(*words, **more)  # type: ignore[arg-type]  # handed on as they come
        spent.append(1e3 * (time.process_time() - started))
        return result

    mock.patch.object(pipeline, "identify", timed).start()
    names = ("copies", "kind", "frames", "in all", "ok", "ambiguous", "lost", "twice", "mixed", "wrong")
    print("| " + " | ".join((*names, "ms identify", "ms all")) + " |")
    print("| --- " * 12 + "|")
    for copies in arguments.copies:
        estimator = tp.PoseEstimator(camera, target, instances=copies + 2, method=arguments.method)
        for kind in KINDS:
            total: dict[str, int] = {}
            whole = []
            spent.clear()
            for number in range(arguments.frames):
                made = tray(number, arguments.seed, copies, kind, camera, target)
                started = time.process_time()
                poses = estimator(made.frame[None])
                whole.append(1e3 * (time.process_time() - started))
                result = judged(poses, made, camera, target)
                if result["ok"] < copies or result["twice"] + result["mixed"] + result["wrong"]:
                    print(f"<!-- {copies} {kind} {number}: {result}, seen {int(poses.copies[0])} -->", flush=True)
                total = {name: total.get(name, 0) + count for name, count in result.items()}
            counts = " | ".join(str(count) for count in total.values())
            times = f"{median(spent):.1f} | {median(whole):.0f}"
            print(
                f"| {copies} | {kind} | {arguments.frames} | {arguments.frames * copies} | {counts} | {times} |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
