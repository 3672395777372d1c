"""Whole targets among clutter: how many get their pose, how many get a wrong one.

    python scripts/clutter_statistics.py [--frames 300] [--seed 0] [--motion] [--save DIR]

2 MP frames, each of its own seed: one of four targets (dark on light and light on dark), tilt 0 to 70 degrees, outer
circles from 6 px semi-minor axis to a third of the frame's height, blur 0.5 to 4 px, light that falls off by up to
12:1 across the frame, contrast down to 15 grey levels, noise; up to 40 discs, washers, discs with holes off centre,
rings of other proportions, screw heads, letters and words, figures, beside the markers or touching them; covers over up
to 35 % of a ring, glare; natural pictures around the plate in one frame of five. --motion drags each target by 2 to
8 px during the exposure instead: then no pose at all is right as well.

A pose is wrong if it errs by more than its covariance allows (NEES above 100; chance gives 22 once in a thousand) and
either puts a marker more than 0.3 px away or turns the target by more than 2 degrees.
Lines name each frame that is not `ok`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_errors
from torchpose.geometry import conics, rotations
from torchpose.sim import add_noise, render, shapes
from torchpose.sim.shapes import Circles, Shapes, Sides

F64 = torch.float64
WIDTH, HEIGHT, FOCAL = 1824, 1216, 1111.11
WORDS = ("O", "0", "8", "OO8", "B80", "0815", "QC", "REV B", "LOT 42", "M3x8", "OK")
NEES_LIMIT, MISS_PX, TURN_DEG = 100.0, 0.3, 2.0


@dataclass(frozen=True)
class Scene:
    """One frame (H, W) uint8 with the true pose of its target."""

    frame: Tensor
    target: tp.Target
    R: Tensor
    t: Tensor
    note: str


def lens() -> tp.Camera:
    matrix = torch.tensor([[FOCAL, 0, 911.5], [0, FOCAL, 607.5], [0, 0, 1]], dtype=F64)
    return tp.Camera(
        width=WIDTH, height=HEIGHT, matrix=matrix, distortion=torch.tensor([-0.05, 0.01, 2e-4, -1e-4], dtype=F64)
    )


def targets() -> list[tp.Target]:
    """The built-in ones, and four rings close together that may grow to a third of the frame."""
    wide = tp.Target.load("quad40")
    close = tp.Target(
        name="close",
        background="light",
        ids=wide.ids,
        centers=wide.centers * (6.6 / 20.0),
        normals=wide.normals,
        radii=wide.radii,
    )
    return [wide, tp.Target.load("quad40_dark"), tp.Target.load("hexa50"), close]


def scene(number: int, seed: int, camera: tp.Camera, choice: list[tp.Target], motion: bool = False) -> Scene:
    """A frame that depends on the seed and its number alone."""
    rng = np.random.default_rng([seed, number])
    target = choice[rng.choice(4, p=[0.4, 0.25, 0.2, 0.15])]
    r, t, circles = _pose(rng, camera, target)
    smallest = float(circles[:, 1, 3].min())
    psf = float(rng.uniform(0.5, max(0.7, min(4.0, 0.5 * smallest))))
    fall = math.exp(rng.uniform(0, math.log(12.0)))
    gain = _gain(rng, fall)
    at = circles[:, 0, :2].round().long()
    dimmest = float(gain[at[:, 1].clamp(0, HEIGHT - 1), at[:, 0].clamp(0, WIDTH - 1)].min())
    depth = rng.uniform(0.5, 0.92)  # contrast over light
    least = 15.0 / (depth * dimmest)
    light = float(math.exp(rng.uniform(math.log(least), math.log(250.0)))) if least < 250 else 250.0
    noise = float(rng.uniform(0.5, max(0.8, min(6.0, light * depth * dimmest / 12))))
    dark = light * (1 - depth)
    levels = (dark, light)
    plate: tuple[float, float] | None = None
    surround: float | Tensor = 0.5 * light
    extent = 2.2 * float(target.centers[:, :2].abs().max() + target.radii.max())
    if rng.random() < 0.2:
        plate, surround = (extent, extent), _picture(rng) * (light / 250)
    clutter = _clutter(rng, target, extent, levels) if rng.random() < 0.9 else None
    covers = _covers(rng, target, levels) if rng.random() < 0.35 else None
    drag = None
    if motion:
        way, length = rng.uniform(0, 2 * math.pi), rng.uniform(2, 8) * float(t[0, 2]) / FOCAL
        drag = torch.tensor(
            [[length * math.cos(way), length * math.sin(way), 0, 0, 0, rng.normal() * 0.005]], dtype=F64
        )
    clean = render(
        camera, target, r, t, psf_sigma=psf, dark=dark, light=light, plate=plate, surround=surround, clutter=clutter,
        covers=covers, motion=drag,
    )[0]  # fmt: skip
    clean = clean * gain
    if rng.random() < 0.3:
        clean = clean + _glare(rng, circles, light)
    frame = add_noise(clean[None], noise, seed * 1_000_003 + number)[0]
    outer = circles[:, 0, 3]
    note = (
        f"{target.name} outer {float(outer.min()):.1f}..{float(outer.max()):.1f} px inner {smallest:.1f} px "
        f"aspect {float((circles[:, 0, 3] / circles[:, 0, 2]).min()):.2f} blur {psf:.1f} fall {fall:.1f} "
        f"contrast {light * depth * dimmest:.0f} noise {noise:.1f}{' cover' if covers is not None else ''}"
        f"{' picture' if plate else ''}"
    )
    return Scene(frame, target, r[0], t[0], note)


def _pose(rng: np.random.Generator, camera: tp.Camera, target: tp.Target) -> tuple[Tensor, Tensor, Tensor]:
    """Pose with all rings in view and large enough; circles (M, 2, 5) in ideal pixels."""
    while True:
        tilt, way, roll = math.radians(rng.uniform(0, 70)), rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi)
        lean = torch.tensor([[tilt * math.cos(way), tilt * math.sin(way), 0]], dtype=F64)
        r = rotations.exp(lean) @ rotations.exp(torch.tensor([[0, 0, roll]], dtype=F64))
        z = FOCAL * 5.0 / math.exp(rng.uniform(math.log(7.0), math.log(210.0)))
        u, v = rng.uniform(0.1, 0.9) * WIDTH - 911.5, rng.uniform(0.1, 0.9) * HEIGHT - 607.5
        t = torch.tensor([[u * z / FOCAL, v * z / FOCAL, z]], dtype=F64)
        x = (r @ target.centers[..., None]).squeeze(-1) + t
        if bool((x[:, 2] < 0.2 * z).any()):
            continue
        circles = conics.circle_ellipse(camera.matrix, r[:, None], x[:, None], target.normals[:, None], target.radii)
        if not bool(circles.isfinite().all()):
            continue
        reach = circles[:, 0, 2] + 12
        inside = (circles[:, 0, :2] - reach[:, None] > 0) & (
            circles[:, 0, :2] + reach[:, None] < torch.tensor([WIDTH - 1.0, HEIGHT - 1.0])
        )
        if bool(inside.all()) and circles[:, 0, 3].min() >= 6 and circles[:, 1, 3].min() >= 1.9:
            return r, t, circles


def _gain(rng: np.random.Generator, fall: float) -> Tensor:
    """Light (H, W) float32, 1 at its brightest, falling by ``fall`` across the frame."""
    way = rng.uniform(0, 2 * math.pi)
    x = np.linspace(-1, 1, WIDTH)[None] * math.cos(way) + np.linspace(-1, 1, HEIGHT)[:, None] * math.sin(way)
    x = (x - x.min()) / (x.max() - x.min())
    return torch.from_numpy((fall ** (-(x ** rng.uniform(0.7, 1.5)))).astype(np.float32))


def _picture(rng: np.random.Generator) -> Tensor:
    import skimage.data

    name = str(rng.choice(["camera", "coins", "brick", "text", "page", "grass", "moon"]))
    return torch.from_numpy(cv2.resize(getattr(skimage.data, name)(), (WIDTH, HEIGHT)))[None].float()


def _clutter(rng: np.random.Generator, target: tp.Target, extent: float, levels: tuple[float, float]) -> Shapes:
    """Shapes on a lattice that leaves the markers free but may touch them."""
    centers, size = target.centers[:, :2].numpy(), float(target.radii.max())
    cell = 2.3 * size
    axis = np.arange(-1.3 * extent, 1.3 * extent, cell) + rng.uniform(0, cell)
    lattice = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    near = np.linalg.norm(lattice[:, None] - centers, axis=2).min(1)
    out = []
    for at in rng.permutation(lattice[near > 2.02 * size])[: rng.integers(1, 41)]:
        out.append(_shape(rng, at, size, target, levels))
    return shapes.cat(out)


def _shape(
    rng: np.random.Generator, at: np.ndarray, size: float, target: tp.Target, levels: tuple[float, float]
) -> Shapes:
    """One shape within 1.0 ``size`` of ``at``."""
    kind, turn, scale = rng.integers(10), rng.uniform(0, 2 * math.pi), size * rng.uniform(0.4, 1.0)
    dark, light = levels
    level = float(rng.uniform(0.8 * dark, light)) if rng.random() < 0.5 else float(rng.choice(levels))
    way, place = np.array([math.cos(turn), math.sin(turn)]), at.tolist()
    if kind == 0:
        return shapes.rectangle(place, 1.5 * scale, scale, turn, level)
    if kind == 1:
        return shapes.cross(place, 1.5 * scale, 0.4 * scale, turn, level)
    if kind == 2:
        return shapes.ring(place, scale, 0.0, level)
    if kind == 3:  # a washer
        return shapes.ring(place, scale, rng.uniform(0.5, 0.8) * scale, level)
    if kind == 4:  # a ring of other proportions
        own = (target.radii[:, 1] / target.radii[:, 0]).numpy()
        ratios = np.linspace(0.15, 0.9, 76)
        return shapes.ring(
            place, scale, float(rng.choice(ratios[abs(ratios[:, None] - own).min(1) > 0.04])) * scale, level
        )
    if kind == 5:  # a disc with its hole off centre
        disc = shapes.ring(place, scale, 0.0, level)
        inner = rng.uniform(0.2, 0.5)
        hole = shapes.ring((at + way * scale * rng.uniform(0.15, 0.95 - inner)).tolist(), inner * scale, 0.0, level)
        return _with_hole(disc, hole)
    if kind == 6:  # a screw head: a disc with a slot
        slot = shapes.rectangle(place, 1.4 * scale, 0.25 * scale, turn, level)
        return _with_hole(shapes.ring(place, scale, 0.0, level), slot)
    if kind == 7:
        sides = rng.integers(3, 9)
        angle = turn + 2 * math.pi * np.arange(sides) / sides
        return shapes.polygon([at + scale * np.stack([np.cos(angle), np.sin(angle)], 1)], level)
    if kind == 8:  # a figure as large as a marker
        return shapes.text(str(rng.choice(["O", "0", "8", "Q", "6"])), place, 1.1 * scale, turn, level)
    return shapes.text(str(rng.choice(WORDS)), place, 0.3 * scale, turn, level)


def _with_hole(shape: Shapes, hole: Shapes) -> Shapes:
    """One shape with the outline of another as its hole."""
    circles = Circles.cat([shape.circles, replace(hole.circles, sign=-hole.circles.sign)])
    sides = Sides.cat([shape.sides, replace(hole.sides, ends=hole.sides.ends.flip(1))])
    return replace(shape, circles=circles, sides=sides)


def _covers(rng: np.random.Generator, target: tp.Target, levels: tuple[float, float]) -> Shapes:
    """Strips over up to 35 % of the perimeter of one to all markers."""
    out = []
    share = rng.uniform(0.2, 1.0)
    for (x, y, _), (radius, _) in zip(target.centers.tolist(), target.radii.tolist(), strict=True):
        if rng.random() > share:
            continue
        near, turn = radius * math.cos(math.pi * rng.uniform(0.05, 0.35)), rng.uniform(0, 2 * math.pi)
        middle = 0.5 * (near + 1.25 * radius)
        at = (x + middle * math.cos(turn), y + middle * math.sin(turn))
        out.append(
            shapes.rectangle(
                at, 1.25 * radius - near, 2.1 * radius, turn, float(rng.uniform(0.5 * levels[0], levels[1]))
            )
        )
    return shapes.cat(out) if out else shapes.rectangle((0.0, 0.0), 1.0, 1.0)


def _glare(rng: np.random.Generator, circles: Tensor, light: float) -> Tensor:
    """Bright spots (H, W), some of them over an edge of a marker."""
    out = np.zeros((HEIGHT, WIDTH), np.float32)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    for _ in range(rng.integers(1, 5)):
        at, size = (rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT)), rng.uniform(10, 80)
        if rng.random() < 0.5:
            ring = circles[rng.integers(len(circles)), 0]
            way = rng.uniform(0, 2 * math.pi)
            edge = conics.points_on(ring, torch.tensor(way, dtype=F64)).numpy()
            away = ring[:2].numpy() + 1.15 * (edge - ring[:2].numpy())
            at, size = (away[0], away[1]), float(ring[3]) * rng.uniform(0.1, 0.3)
        d2 = ((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * size * size)
        out += rng.uniform(0.5, 2.0) * light * np.exp(-d2)
    return torch.from_numpy(out)


def marker_miss(poses: tp.Poses, truth: Scene, camera: tp.Camera) -> float:
    """Largest distance in px of a marker projected by the pose from where it is."""

    def project(r: Tensor, t: Tensor) -> Tensor:
        x = (r @ truth.target.centers[..., None]).squeeze(-1) + t
        return camera.distort(x[:, :2] / x[:, 2:])

    miss = project(poses.R[0], poses.t[0]) - project(truth.R, truth.t)
    return float(torch.linalg.vector_norm(miss, dim=-1).max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="number of the first frame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--motion", action="store_true")
    parser.add_argument("--save", type=Path, help="folder for the frames that did not get a right pose")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera, choice = lens(), targets()
    estimators = {target.name: tp.PoseEstimator(camera, target) for target in choice}
    statuses: Counter[str] = Counter()
    whole, wrong, nees = 0, 0, []
    for number in range(arguments.first, arguments.first + arguments.frames):
        made = scene(number, arguments.seed, camera, choice, arguments.motion)
        poses = estimators[made.target.name](made.frame[None])
        status = tp.Status(int(poses.status[0]))
        statuses[status.name.lower()] += 1
        found = status in (tp.Status.OK, tp.Status.AMBIGUOUS)
        bad = False
        if found:
            errors = pose_errors(poses, made)
            value = float(errors.nees[0])
            miss = marker_miss(poses, made, camera)
            nees.append(value)
            turn = math.degrees(float(errors.angle[0]))
            bad = value > NEES_LIMIT and (miss > MISS_PX or turn > TURN_DEG)
            wrong += bad
            whole += status == tp.Status.OK and not bad
        if status != tp.Status.OK or bad or value > NEES_LIMIT:
            detail = f"NEES {value:.0f} miss {miss:.2f} px{' WRONG' if bad else ''}" if found else ""
            markers = f"{int(poses.markers[0])}/{len(made.target)}"
            reason = poses.reason[0]
            print(f"{number:5d} {status.name.lower()} {int(reason)} {markers} {detail} | {made.note}", flush=True)
            if arguments.save:
                arguments.save.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(arguments.save / f"{number:05d}.png"), made.frame.numpy())
    print(f"frames {arguments.frames}: right pose {whole} ({100 * whole / arguments.frames:.2f} %), wrong {wrong}")
    print("status: " + ", ".join(f"{name} {n}" for name, n in statuses.most_common()))
    if nees:
        high = np.quantile(nees, 0.99)
        print(f"NEES (6 in the mean where the covariance holds): median {np.median(nees):.1f}, 99 % {high:.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
