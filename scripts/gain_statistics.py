"""Prints with dot gain: how many frames are found, and whether their rings keep their names.

    python scripts/gain_statistics.py --frames 12
    python scripts/gain_statistics.py --target quad8 --key none --hide 1

2 MP frames of quad40 and quad8, noise 2, tilt to 40 degrees. The frames show a print whose dark areas have grown by the
gain: outer radius + gain, inner radius - gain. The estimator gets the nominal file: ``--key stated`` with an
``edge_gain_sigma`` of half of the largest gain, ``--key none`` without any. Near frames have outer radii of about 30 to
40 px, far ones of 11 to 18. ``--hide`` leaves the first markers of the target out of the print. A row:

    ok        frames with a pose of status ok, of all
    right     of these, those in which every ring is the marker that it is
    wrong     of these, those in which some ring is taken for another marker
    depth um  RMS error of the depth, of the right ones
    worst     largest |error| / claimed sigma of any right one
    NEES      mean squared error of the right ones by their covariance; 6 where it is right
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import torch
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_errors
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import Pose
from torchpose.sim import add_noise, render

F64 = torch.float64
FOCAL, WIDTH, HEIGHT = 1111.11, 1824, 1216
# of the printed gains, mm, and of the distances, in units of the targets' spread
GAINS = {"quad40": (0.05, 0.1, 0.2, 0.3, 0.4), "quad8": (0.02, 0.04, 0.06, 0.08)}
DISTANCES = {"near": (3.5, 4.75), "far": (7.5, 12.0)}
SIDE = {"quad40": 40.0, "quad8": 8.0}
BATCH = 6


def camera() -> tp.Camera:
    matrix = torch.tensor([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], dtype=F64)
    return tp.Camera(width=WIDTH, height=HEIGHT, matrix=matrix, distortion=torch.zeros(4, dtype=F64))


def views(count: int, distance: tuple[float, float], side: float, seed: int) -> tuple[Tensor, Tensor]:
    """Poses (count, 3, 3), (count, 3) of a target of that side, mm: tilt to 40 degrees, any roll."""
    g = torch.Generator().manual_seed(seed)
    lean, azimuth, roll, x, y, z = torch.rand(6, count, dtype=F64, generator=g)
    lean, azimuth, roll = math.radians(40) * lean, 2 * math.pi * azimuth, 2 * math.pi * roll
    zero = torch.zeros_like(lean)
    tilt = rotations.exp(torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), zero], -1))
    near, far = distance
    t = side * torch.stack([0.7 * (x - 0.5), 0.35 * (y - 0.5), near + z * (far - near)], -1)
    return tilt @ rotations.exp(torch.stack([zero, zero, roll], -1)), t


def printed(target: tp.Target, gain: float, hidden: int = 0) -> tp.Target:
    """What is on the part: every edge of the dark areas moved outwards by ``gain`` mm, without the first markers."""
    outwards = gain if target.background == "light" else -gain
    radii = target.radii + outwards * target.radii.new_tensor([1.0, -1.0])
    fields = {name: getattr(target, name)[hidden:] for name in ("ids", "centers", "normals")}
    return replace(target, radii=radii[hidden:], **fields)


def stating(target: tp.Target, sigma: float) -> tp.Target:
    """The target with an ``edge_gain_sigma``, mm."""
    covariance = torch.zeros(3 * len(target) + 1, 3 * len(target) + 1, dtype=F64)
    covariance[-1, -1] = sigma**2
    return replace(target, covariance=covariance)


def named_right(poses: tp.Poses, target: tp.Target, lens: tp.Camera, r: Tensor, t: Tensor) -> Tensor:
    """Frames (B,) bool in which every detection lies where its marker is, to half of the outer radius."""
    seen = poses.detections
    number = (seen.marker[:, None] == target.ids).int().argmax(1)
    x = (r[seen.frame] @ target.centers[number, :, None]).squeeze(-1) + t[seen.frame]
    off = torch.linalg.vector_norm(lens.project(x) - seen.center, dim=-1)
    bad = off > 0.5 * lens.matrix[0, 0] * target.radii[number, 0] / x[:, 2]
    return torch.bincount(seen.frame[bad], minlength=len(t)) == 0


def run(name: str, gain: float, distance: str, frames: int, hidden: int, keys: list[str]) -> list[str]:
    """Table rows, one for each key."""
    target, lens = tp.Target.load(name), camera()
    files = {"none": target, "stated": stating(target, max(GAINS[name]) / 2)}
    r, t = views(frames, DISTANCES[distance], SIDE[name], seed=17)
    shown = printed(target, gain, hidden)
    parts: dict[str, list[Tensor]] = {key: [] for key in keys}
    for first in range(0, frames, BATCH):
        s = slice(first, first + BATCH)
        clean = render(lens, shown, r[s], t[s], psf_sigma=0.7, dark=30.0, light=220.0)
        pictures = add_noise(clean, 2.0, seed=5, index=torch.arange(first, first + len(clean)))
        for key in keys:
            poses = tp.PoseEstimator(lens, files[key])(pictures)
            right = named_right(poses, target, lens, r[s], t[s])
            errors = pose_errors(poses, Pose(r[s], t[s]))
            claimed = (torch.cat([errors.translation, errors.rotation], -1).abs() / poses.std).amax(1)
            columns = [poses.ok.double(), right.double(), errors.translation[:, 2], claimed, errors.nees]
            parts[key].append(torch.stack(columns, 1))
    out = []
    for key in keys:
        ok, right, depth, worst, nees = torch.cat(parts[key]).unbind(1)
        good = (ok > 0) & (right > 0)
        told = ""
        if good.any():
            rms, most = 1e3 * depth[good].square().mean().sqrt(), worst[good].max()
            told = f"{rms:8.1f} {most:7.1f} {nees[good].mean():7.1f}"
        wrong = int(((ok > 0) & (right == 0)).sum())
        out.append(
            f"{name:7} {1e3 * gain:6.0f} {distance:5} {key:7} {int(ok.sum()):3}/{frames} {int(good.sum()):5} "
            f"{wrong:5} {told}"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", nargs="+", default=list(GAINS), choices=list(GAINS))
    parser.add_argument("--distance", nargs="+", default=["near"], choices=list(DISTANCES))
    parser.add_argument("--key", nargs="+", default=["stated", "none"], choices=["stated", "none"])
    parser.add_argument("--gains-um", nargs="+", type=float, help="instead of all")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--hide", type=int, default=0, choices=[0, 1], help="markers that are not printed")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("target  gain um dist key     ok    right wrong depth um  worst    NEES", flush=True)
    for name in options.target:
        all_gains = sorted({s * g for g in GAINS[name] for s in (-1, 0, 1)})
        gains = all_gains if options.gains_um is None else [g / 1e3 for g in options.gains_um]
        for distance in options.distance:
            for gain in gains:
                for line in run(name, gain, distance, options.frames, options.hide, options.key):
                    print(line, flush=True)


if __name__ == "__main__":
    main()
