"""Errors of whole frames beside their Cramer-Rao bound, and whether the covariance explains them.

    python scripts/precision_statistics.py --case tilt --frames 5000 --out precision.csv
    python scripts/precision_statistics.py --case all --frames 200 --method photometric edges
    python scripts/precision_statistics.py --case faults --frames 60

Simulated 2-megapixel frames of the built-in target quad40, 8 bit. One row a case and method: frames with a pose, RMS
error over RMS bound across and along the optical axis and of the rotation, the claimed deviation across over the same
bound, the RMS errors and claimed deviations, mean NEES (ideal 6), the share inside the 99 % ellipsoid. Point-spread
functions outside the model are mixtures of shifted frames: a shift of the principal point is a shift of the picture.
The bound of a covered ring takes the covered part of that marker's information off; that of a foreign point-spread
function is the bound of a Gaussian of the same variance.

`faults` are what differs from the files, and what cameras do to pictures: `print`, `warp`, `gain`, `raster` and
`texture` have another print, on another piece of paper, in every frame, for the NEES is that over all prints; of one
print alone it is the mean square of a few numbers. `k1-off` has a camera file that is off. Column `file`: `perfect`
where the files claim nothing of it, `stated` where they say what they can: the target file the covariance of places (of
a bent plate that of saddles, of a raster how far its rims lie off) and `edge_gain_sigma`, the camera file the variance
of k1, or its tone. The bound is that of the nominal target and camera, without the fault.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import torch
from scipy.stats import chi2
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_crlb, pose_errors
from torchpose.camera import Tone
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import Pose
from torchpose.io.writers import write_rows
from torchpose.pipeline import Method
from torchpose.sim import (
    Disturbances,
    PrintErrors,
    Prints,
    Processing,
    SensorPattern,
    Texture,
    add_noise,
    disturbed,
    printed,
    processed,
    read_out,
    render,
)
from torchpose.sim.fields import keys_of
from torchpose.sim.raster import raster_sides
from torchpose.sim.sensor import toned

F64 = torch.float64
FOCAL, WIDTH, HEIGHT = 1111.11, 1824, 1216
PLATE = (70.0, 70.0)
DARK, LIGHT = 30.0, 220.0
BATCH = 8
COVER = 128.0  # grey level of what covers a ring
TARGET = tp.Target.load("quad40")


@dataclass(frozen=True)
class Case:
    """A family of frames; ``poses(count, generator)`` gives R, t. Blur in px, noise in grey levels of 255."""

    poses: Callable[[int, torch.Generator], tuple[Tensor, Tensor]]
    noise: float = 2.0
    blur: float = 0.7
    psf: str = "gauss"
    k1: float = 0.0
    bits: int = 8
    cover: float = 0.0
    missing: bool = False
    encoded: bool = False
    srgb: bool = False
    gamma: float = 1.0
    errors: PrintErrors | None = None
    k1_error: float = 0.0
    texture: tuple[float, float] | None = None  # share, px
    disturbances: dict[str, float] = field(default_factory=dict)
    pattern: SensorPattern = field(default_factory=SensorPattern)
    processing: Processing = field(default_factory=Processing)


def tilted(tilt_deg: float, near: float = 140.0, far: float = 190.0) -> Callable[..., tuple[Tensor, Tensor]]:
    """Any tilt up to ``tilt_deg`` about any axis, any roll, distance from ``near`` to ``far`` mm."""

    def draw(count: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
        lean, azimuth, roll, x, y, z = torch.rand(6, count, dtype=F64, generator=g)
        lean, azimuth, roll = lean * math.radians(tilt_deg), azimuth * 2 * math.pi, roll * 2 * math.pi
        zero = torch.zeros_like(lean)
        r = rotations.exp(torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), zero], -1))
        r = r @ rotations.exp(torch.stack([zero, zero, roll], -1))
        return r, torch.stack([(x - 0.5) * 30, (y - 0.5) * 15, near + z * (far - near)], -1)

    return draw


def grid(count: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Poses of the paper's grid of 875 (Fig. 11), in random order, again and again."""
    turns = torch.tensor([-5.0, -2.5, 0.0, 2.5, 5.0], dtype=F64).deg2rad()
    offsets = torch.cat([torch.zeros(1, 3, dtype=F64), 10 * torch.eye(3, dtype=F64), -10 * torch.eye(3, dtype=F64)])
    every = torch.cartesian_prod(turns, turns, turns)
    pick = torch.cat([torch.randperm(875, generator=g) for _ in range(1 + count // 875)])[:count]
    roll, yaw, pitch = every[pick % 125].unbind(-1)
    zero = torch.zeros_like(roll)
    r = rotations.exp(torch.stack([zero, zero, roll], -1)) @ rotations.exp(torch.stack([zero, yaw, zero], -1))
    r = r @ rotations.exp(torch.stack([pitch, zero, zero], -1))
    return r, offsets[pick // 125] + torch.tensor([0.0, 0.0, 160.0], dtype=F64)


CASES = {
    "grid": Case(grid),
    "tilt": Case(tilted(60)),
    "far": Case(tilted(60, 250, 400)),
    "noise-0": Case(tilted(60), noise=0.0),
    "noise-1": Case(tilted(60), noise=1.0),
    "noise-4": Case(tilted(60), noise=4.0),
    "noise-8": Case(tilted(60), noise=8.0),
    "noise-16": Case(tilted(45), noise=16.0),
    "blur-0.4": Case(tilted(60), blur=0.4),
    "blur-1.5": Case(tilted(60), blur=1.5),
    "16-bit": Case(tilted(60), noise=0.5, bits=16),
    "k1-0.1": Case(tilted(60), k1=-0.1),
    "k1-0.3": Case(tilted(60), k1=-0.3),
    "disc": Case(tilted(60), blur=0.35, psf="disc"),
    "motion": Case(tilted(60), blur=0.6, psf="motion"),
    "blackman-harris": Case(tilted(60), blur=0.5, psf="blackman-harris"),
    "cover-10": Case(tilted(45), cover=0.10),
    "cover-20": Case(tilted(45), cover=0.20),
    "cover-35": Case(tilted(45), cover=0.35),
    "missing": Case(tilted(45), missing=True),
    "srgb": Case(tilted(60), encoded=True, srgb=True),
    "srgb-as-linear": Case(tilted(60), encoded=True),
}
# what differs from the files of target and camera, and what cameras do to pictures
FAULTS = {
    "as-filed": Case(tilted(40)),
    "print-10": Case(tilted(40), errors=PrintErrors(center_sigma=0.010)),
    "print-50": Case(tilted(40), errors=PrintErrors(center_sigma=0.050)),
    "warp-50": Case(tilted(40), errors=PrintErrors(warp=0.050)),
    "gain-30": Case(tilted(40), errors=PrintErrors(gain=0.030)),
    "raster-600": Case(tilted(40), errors=PrintErrors(dpi=600.0)),
    "raster-150": Case(tilted(40), errors=PrintErrors(dpi=150.0)),
    "k1-off": Case(tilted(40), k1_error=0.002),
    "texture": Case(tilted(40), texture=(0.02, 4.0)),
    "coma": Case(tilted(40), disturbances={"coma_px": 2.0, "coma_deg": 30.0}),
    "haze": Case(tilted(40), disturbances={"haze_px": 0.1}),
    "haze-fine": Case(tilted(40), disturbances={"haze_px": 0.1, "haze_length": 10.0}),
    "ghost": Case(tilted(40), disturbances={"ghost": 15.0}),
    "speckle": Case(tilted(40), disturbances={"speckle": 0.05}),
    "flicker": Case(tilted(40), disturbances={"flicker": 0.05}),
    "prnu": Case(tilted(40), pattern=SensorPattern(prnu=0.01)),
    "columns": Case(tilted(40), pattern=SensorPattern(column_noise=2.0)),
    "jitter": Case(tilted(40), pattern=SensorPattern(line_jitter=0.1)),
    "coarse": Case(tilted(40), bits=4),
    "gamma-as-linear": Case(tilted(40), gamma=2.2),
    "bayer": Case(tilted(40), processing=Processing(bayer=True)),
    "denoise": Case(tilted(40), processing=Processing(denoise=10.0)),
    "sharpen": Case(tilted(40), processing=Processing(sharpen=1.0)),
    "jpeg-80": Case(tilted(40), processing=Processing(jpeg=80)),
}
INCH = 25.4  # mm
MIDDLE = 165.0  # mm, the distance at which a texture's length in mm is that in px


def camera_of(k1: float) -> tp.Camera:
    matrix = torch.tensor([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], dtype=F64)
    distortion = torch.tensor([k1, 0.0, 0.0, 0.0], dtype=F64)
    return tp.Camera(width=WIDTH, height=HEIGHT, matrix=matrix, distortion=distortion)


def spread(psf: str) -> Tensor:
    """Shifts (S, 2) in px whose mean frame is blurred by a foreign point-spread function."""
    if psf == "gauss":
        return torch.zeros(1, 2, dtype=F64)
    if psf == "motion":  # 1 px along u
        return torch.stack([torch.linspace(-0.4, 0.4, 5, dtype=F64), torch.zeros(5, dtype=F64)], -1)
    side = torch.linspace(-1, 1, 7, dtype=F64)
    square = torch.cartesian_prod(side, side)
    return 1.2 * square[square.norm(dim=-1) <= 1.01]  # a disc of radius 1.2 px


Drawn = tp.Target | Prints


def picture(
    case: Case,
    camera: tp.Camera,
    target: Drawn,
    r: Tensor,
    t: Tensor,
    *,
    index: Tensor | None = None,
    twist: tuple[float, ...] | None = None,
) -> Tensor:
    """Frames (B, H, W), free of noise.

    Args:
        index: numbers of the frames, each of which is of another piece of paper; None for the same one in all.
        twist: mm and rad by which the target moves during the exposure.
    """
    if case.psf == "blackman-harris":
        return filtered(case, camera, target, r, t)
    options = plate_of(case, len(t), index)
    if twist is not None:
        options |= {"motion": torch.tensor(twist, dtype=F64).expand(len(t), 6)}
    out = torch.zeros(len(t), camera.height, camera.width)
    shifts = spread(case.psf)
    for shift in shifts:
        matrix = camera.matrix.clone()
        matrix[:2, 2] += shift
        moved = replace(camera, matrix=matrix)
        out += render(moved, target, r, t, psf_sigma=case.blur, **options) / len(shifts)
    return out


def plate_of(case: Case, frames: int, index: Tensor | None = None) -> dict[str, Any]:
    """Options of `render`; ``index``: see `picture`."""
    options: dict[str, Any] = {"plate": PLATE, "dark": DARK, "light": LIGHT}
    if case.texture is None:
        return options
    share, length = case.texture
    key = keys_of(1, 0, "paper").expand(frames) if index is None else keys_of(frames, 0, "paper", index)
    return options | {"texture": Texture(key, share, length * MIDDLE / FOCAL)}


def filtered(case: Case, camera: tp.Camera, target: Drawn, r: Tensor, t: Tensor, finer: int = 3) -> Tensor:
    """Frames through a Blackman-Harris pixel filter 1.5 px wide in place of the pixel's square (Harris 1978)."""
    matrix = camera.matrix.clone()
    matrix[:2] *= finer
    matrix[:2, 2] += (finer - 1) / 2
    fine = replace(camera, width=finer * camera.width, height=finer * camera.height, matrix=matrix)
    reach = math.ceil(0.75 * finer)
    x = torch.arange(-reach, reach + 1, dtype=F64) / (1.5 * finer)
    phase = 2 * math.pi * (x + 0.5)
    window = 0.35875 - 0.48829 * phase.cos() + 0.14128 * (2 * phase).cos() - 0.01168 * (3 * phase).cos()
    window = torch.where(x.abs() <= 0.5, window, 0.0)
    kernel = (window[:, None] * window / window.sum().square())[None, None].float()
    pad = reach - (finer - 1) // 2
    sharp = render(fine, target, r, t, psf_sigma=finer * case.blur, **plate_of(case, len(t)))
    sharp = torch.nn.functional.pad(sharp[:, None], (pad, pad, pad, pad), mode="replicate")
    return torch.nn.functional.conv2d(sharp, kernel, stride=finer)[:, 0]


def covered(case: Case, camera: tp.Camera, frames: Tensor, r: Tensor, t: Tensor, g: torch.Generator) -> Tensor:
    """Frames with a sector of marker 0 covered."""
    at = camera.project((r @ TARGET.centers[0]) + t)
    reach = 1.3 * FOCAL * TARGET.radii[0, 0] / t[:, 2]
    start = 2 * math.pi * torch.rand(len(t), dtype=F64, generator=g)
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    du, dv = u - at[:, 0, None, None], v - at[:, 1, None, None]
    angle = torch.remainder(torch.atan2(dv, du) - start[:, None, None], 2 * math.pi)
    hidden = (torch.hypot(du, dv) < reach[:, None, None]) & (angle < 2 * math.pi * case.cover)
    return torch.where(hidden, COVER, frames)


def bound_of(case: Case, camera: tp.Camera, r: Tensor, t: Tensor) -> Tensor:
    variance = case.blur**2 + spread(case.psf).square().sum(-1).mean() / 2
    options: dict[str, Any] = {
        "psf_sigma": variance.sqrt(),
        "dark": DARK,
        "light": LIGHT,
        "noise_sigma": case.noise,
        "bits": case.bits,
    }
    full = pose_crlb(camera, TARGET, r, t, **options)
    if not case.cover and not case.missing:
        return full
    rest = pose_crlb(camera, without_first(TARGET), r, t, **options)
    seen = 0.0 if case.missing else 1 - case.cover
    return torch.linalg.inv(seen * torch.linalg.inv(full) + (1 - seen) * torch.linalg.inv(rest))


def without_first(target: tp.Target) -> tp.Target:
    return replace(
        target, ids=target.ids[1:], centers=target.centers[1:], normals=target.normals[1:], radii=target.radii[1:]
    )


def printed_anew(case: Case, frames: int, g: torch.Generator) -> Prints | None:
    """A print for every frame; plates are bent in any direction."""
    if case.errors is None:
        return None
    direction = math.pi * torch.rand(frames, dtype=F64, generator=g)
    return printed(TARGET, replace(case.errors, direction=direction), frames, g)


def stated(errors: PrintErrors) -> tp.Target:
    """The target with what its file may say of such prints."""
    sigma = torch.as_tensor(errors.center_sigma, dtype=F64).expand(3)
    rough, grown = raster_sigmas(errors.dpi) if errors.dpi is not None else (0.0, 0.0)
    places = torch.diag((sigma.square() + rough**2).repeat(len(TARGET)))
    # a saddle of any direction, whose axis and diagonal are each up by the same on average
    x, y = TARGET.centers[:, :2].T
    reach = (TARGET.centers.norm(dim=1) + TARGET.radii[:, 0]).max()
    saddles = torch.stack([x.square() - y.square(), 2 * x * y], -1) * (float(errors.warp) / reach.square())
    places[2::3, 2::3] += 0.5 * saddles @ saddles.T
    gain = torch.tensor([float(errors.gain) ** 2 + grown**2], dtype=F64)
    return replace(TARGET, covariance=torch.block_diag(places, torch.diag(gain)))


def files_of(case: Case) -> dict[str, tuple[tp.Camera, tp.Target]]:
    """Files of camera and target: those that claim nothing of what is amiss, and those that state it if they can."""
    filed = camera_of(case.k1 + case.k1_error)
    files = {"perfect": (filed, TARGET)}
    if case.errors is not None:
        files["stated"] = filed, stated(case.errors)
    if case.k1_error:
        covariance = torch.zeros(8, 8, dtype=F64)
        covariance[4, 4] = case.k1_error**2
        files["stated"] = replace(filed, covariance=covariance), TARGET
    if case.gamma != 1:
        files["stated"] = replace(filed, tone=Tone("gamma", case.gamma)), TARGET
    return files


@cache
def raster_sigmas(dpi: float, draws: int = 1000) -> tuple[float, float]:
    """How far a raster displaces the rings of the target along x or y, and their edges outwards, RMS in mm.

    Both of a rim's first harmonics are those of its area: how far the middle of what is black lies off, and by how much
    there is more of it. The edges of a ring count by their length.
    """
    g, cell = torch.Generator().manual_seed(0), INCH / dpi
    phase = cell * torch.rand(draws, 2, dtype=F64, generator=g)
    radii = TARGET.radii.flatten()
    center, radius = torch.zeros(draws * len(radii), 2, dtype=F64), radii.repeat(draws)
    circle, ends = raster_sides(center, radius, cell, phase.repeat_interleave(len(radii), 0))
    cross = ends[:, 0, 0] * ends[:, 1, 1] - ends[:, 1, 0] * ends[:, 0, 1]
    of = torch.zeros(len(radius), 3, dtype=F64)
    of.index_add_(0, circle, torch.cat([cross[:, None] / 2, cross[:, None] * ends.sum(1) / 6], -1))
    area = math.pi * radius.square()
    grown, moved = (of[:, 0] - area) / (2 * math.pi * radius), of[:, 1:] / area[:, None]
    share = TARGET.radii / TARGET.radii.sum(1, keepdim=True)
    moved = (share[..., None] * moved.view(draws, *TARGET.radii.shape, 2)).sum(2)
    sides = torch.tensor([1.0, -1.0], dtype=F64)
    grown = (share * sides * grown.view(draws, *TARGET.radii.shape)).sum(2)
    return float(moved.square().mean().sqrt()), float(grown.square().mean().sqrt())


def photographed(case: Case, clean: Tensor, seed: int, index: Tensor) -> Tensor:
    """Frames as the file has them, of those that fall on the lens: the camera's faults, noise and processing."""
    clean = disturbed(clean, Disturbances.of(len(clean), seed=seed, **case.disturbances), index)
    clean = read_out(clean, case.pattern, seed, index)
    if case.processing.wanted:
        raw = add_noise(clean, case.noise, seed=seed, index=index, bits=16)
        return processed(raw.float() * (255 / 65535), case.processing, case.bits, case.gamma)
    clean = toned(clean, "srgb") if case.encoded else clean  # with even noise in the file
    frames = add_noise(clean, case.noise, seed=seed, index=index, bits=case.bits, gamma=case.gamma)
    if case.bits < 8:  # files have 8
        frames = (frames * (255 / (2**case.bits - 1))).round().to(torch.uint8)
    return frames


def run(name: str, case: Case, methods: list[Method], frames: int, seed: int) -> list[dict[str, Any]]:
    g = torch.Generator().manual_seed(seed)
    camera = camera_of(case.k1)
    r, t = case.poses(frames, g)
    prints = printed_anew(case, frames, g)
    estimators = {
        (m, file): tp.PoseEstimator(filed, target, method=m, srgb=case.srgb)
        for m in methods
        for file, (filed, target) in files_of(case).items()
    }
    parts: dict[tuple[str, str], list[tuple[Tensor, ...]]] = {key: [] for key in estimators}
    bounds = []
    for a in range(0, frames, BATCH):
        s = slice(a, a + BATCH)
        drawn = without_first(TARGET) if case.missing else TARGET
        index = torch.arange(a, min(a + BATCH, frames))
        clean = picture(case, camera, drawn if prints is None else prints[s], r[s], t[s], index=index)
        if case.cover:
            clean = covered(case, camera, clean, r[s], t[s], g)
        noisy = photographed(case, clean, seed, index)
        bounds.append(bound_of(case, camera, r[s], t[s]))
        for key, estimator in estimators.items():
            poses = estimator(noisy)
            e = pose_errors(poses, Pose(r[s], t[s]))
            claimed = poses.covariance.diagonal(dim1=-2, dim2=-1)
            parts[key].append((poses.status, e.translation, e.rotation, e.nees, claimed))
        if sys.stderr.isatty():
            print(f"\r{name}: {a + len(clean)} of {frames}", end="", file=sys.stderr)
    bound = torch.cat(bounds).diagonal(dim1=-2, dim2=-1)
    limit = chi2.ppf(0.99, 6)
    rows = []
    for (m, file), part in parts.items():
        status, translation, rotation, nees, claimed = (torch.cat(x) for x in zip(*part, strict=True))
        ok = status == tp.Status.OK
        e2, b2 = torch.cat([translation, rotation], -1)[ok].square().mean(0), bound[ok].mean(0)
        ratio = [math.sqrt(e2[i].sum() / b2[i].sum()) for i in (slice(0, 2), slice(2, 3), slice(3, 6))]
        rows.append({
            "case": name,
            "method": m,
            "file": file,
            "frames": frames,
            "ok": int(ok.sum()),
            "lateral_ratio": ratio[0],
            "depth_ratio": ratio[1],
            "rotation_ratio": ratio[2],
            "claimed_ratio": math.sqrt(claimed[ok][:, :2].mean(0).sum() / b2[:2].sum()),
            "lateral_um": 1e3 * math.sqrt(e2[:2].sum()),
            "depth_um": 1e3 * math.sqrt(e2[2]),
            "claimed_lateral_um": 1e3 * math.sqrt(claimed[ok][:, :2].mean(0).sum()),
            "claimed_depth_um": 1e3 * math.sqrt(claimed[ok][:, 2].mean()),
            "rotation_mdeg": math.degrees(1e3 * math.sqrt(e2[3:].sum())),
            "nees": float(nees[ok].mean()),
            "nees_median": float(nees[ok].median()),
            "inside_99": float((nees[ok] < limit).double().mean()),
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=["tilt"], choices=[*CASES, *FAULTS, "all", "faults"])
    parser.add_argument("--method", nargs="+", default=["photometric"], choices=get_args(Method))
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="CSV file of the rows")
    options = parser.parse_args()
    families = {"all": list(CASES), "faults": list(FAULTS)}
    names = [name for case in options.case for name in families.get(case, [case])]
    rows: list[dict[str, Any]] = []
    for name in names:
        for row in run(name, (CASES | FAULTS)[name], options.method, options.frames, options.seed):
            rows.append(row)
            print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
    if options.out:
        write_rows(options.out, rows, {name: type(value) for name, value in rows[0].items()})


if __name__ == "__main__":
    main()
