"""Poses from several cameras beside their joint Cramer-Rao bound, and whether the covariance explains the errors.

    python scripts/rig_statistics.py --moments 100 --processes 2 --out rigs.csv
    python scripts/rig_statistics.py --case three-35 knocked-5 --moments 60

Simulated frames of quad40, as much of 2 megapixels as the target is in, 8 bit, noise 2, blur 0.7 px; cameras of one rig
look at one place, 160 mm away, from angles that a case names, the first of which is 0. One row a case: moments with a
pose, RMS error over RMS bound across and along the axis of the first camera and of the rotation, RMS errors, share of
rows that claim 1.3 times the bound in depth or more, mean NEES (ideal 6) and the deviation of that mean,
consistency (mean chi-squared between the cameras over its freedom, ideal 1). A last row has all cases together whose
rigs are as they say: of ratios the root mean square over the cases.

Cases end in `-places` where the rig states a covariance of its places (20 um, 0.2 mrad a camera) and every call has
places of its own from it, as a rig has that was calibrated once; in `-loose` every moment has, which is no rig: what
`moments.places` says of such calls is too wide. `two-markers`: each camera sees two
markers of the four, at opposite corners in turns.
`missing`: one camera has no picture, each in turn. `knocked-N`: the second camera is turned by N deviations of the
centre of a ring at the noise of the frames, which the rig does not know; `-first` the first one, in whose axes the
poses are. What a call says of a rig depends on how many moments it has: `--batch`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_errors, rig_crlb
from torchpose.analysis.errors import rms
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import Pose
from torchpose.io.writers import write_rows
from torchpose.sim import add_noise, render

F64 = torch.float64
FOCAL, WIDTH, HEIGHT = 1111.11, 800, 720
DISTANCE = 160.0
NOISE, BLUR, DARK, LIGHT = 2.0, 0.7, 30.0, 220.0
PLACE = (0.02, 2e-4)  # mm and rad, of the places of a rig that states them
CENTER = 0.0012  # px, deviation of the centre of a ring at this noise (docs/precision.md)
BATCH = 16
_WIDE = 1.3  # times the bound: a claimed deviation beyond is that of a row whose cameras hardly agree
TARGET = tp.Target.load("quad40")


@dataclass(frozen=True)
class Case:
    """Angles of the cameras; ``places``: uncertain; what is missing; deviations by which one camera is turned, the
    first or the second; whether every moment has places of its own."""

    angles_deg: tuple[float, ...]
    places: bool = False
    missing: bool = False
    two_markers: bool = False
    knocked: float = 0.0
    first: bool = False
    loose: bool = False


CASES = {
    **{f"two-{a}": Case((0, a)) for a in (5, 20, 35, 60, 90, 120)},
    "three-35": Case((0, 35, -35)),
    "three-60": Case((0, 60, -60)),
    "four-40": Case((0, 40, -40, 80)),
    **{f"two-{a}-places": Case((0, a), places=True) for a in (5, 35, 90)},
    "three-35-places": Case((0, 35, -35), places=True),
    "four-40-places": Case((0, 40, -40, 80), places=True),
    "three-35-missing": Case((0, 35, -35), missing=True),
    "three-35-two-markers": Case((0, 35, -35), two_markers=True),
    "three-35-places-loose": Case((0, 35, -35), places=True, loose=True),
    **{f"knocked-{n}": Case((0, 35, -35), knocked=float(n)) for n in (1, 2, 5, 20)},
    "knocked-5-first": Case((0, 35, -35), knocked=5.0, first=True),
}


def rig_of(case: Case) -> tp.CameraRig:
    """Cameras about the place where the target is."""
    turns = torch.tensor([[0.0, math.radians(a), 0.0] for a in case.angles_deg], dtype=F64)
    R, middle = rotations.exp(turns), torch.tensor([0.0, 0.0, DISTANCE], dtype=F64)
    t = middle - R @ middle
    t[0] = 0
    others = len(case.angles_deg) - 1
    size = torch.tensor([*[PLACE[0]] * 3, *[PLACE[1]] * 3] * others, dtype=F64)
    camera = tp.Camera.ideal(WIDTH, HEIGHT, FOCAL)
    return tp.CameraRig([camera] * (others + 1), R, t, torch.diag(size.square()) if case.places else None)


def poses(case: Case, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Turned so that all cameras see it at less than 70 degrees from its normal."""
    middle = math.radians(0.5 * (max(case.angles_deg) + min(case.angles_deg)))
    room = 68 - 0.5 * (max(case.angles_deg) - min(case.angles_deg))
    lean, azimuth, roll, x, y, z = torch.rand(6, count, dtype=F64, generator=generator)
    lean, azimuth, roll = lean * math.radians(min(room, 25)), azimuth * 2 * math.pi, roll * 2 * math.pi
    zero = torch.zeros_like(lean)
    R = rotations.exp(torch.tensor([0.0, -middle, 0.0], dtype=F64)) @ rotations.exp(
        torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), zero], -1)
    )
    R = R @ rotations.exp(torch.stack([zero, zero, roll], -1))
    return R, torch.stack([(x - 0.5) * 20, (y - 0.5) * 12, DISTANCE + (z - 0.5) * 20], -1)


def in_view(rig: tp.CameraRig, camera: int, R: Tensor, t: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Poses as a camera sees them whose place is off by (B, 6)."""
    own_R, own_t = rig.seen_by(camera, R, t)
    turn, shift = rotations.exp(moved[:, 3:]), rig.t[camera]
    return turn @ own_R, (turn @ (own_t - shift)[..., None])[..., 0] + shift + moved[:, :3]


def targets_of(case: Case, camera: int) -> list[tp.Target]:
    """What a camera sees of the target: all, or two markers, turn by turn."""
    if not case.two_markers:
        return [TARGET]
    pairs = ((0, 2), (1, 3), (0, 1), (2, 3))
    seen = [pairs[(camera + k) % len(pairs)] for k in range(2)]
    return [part_of(pair) for pair in seen]


def part_of(markers: Sequence[int]) -> tp.Target:
    """The target with some of its markers alone in sight: the others are behind the cameras."""
    centers = 1e3 * TARGET.centers - torch.tensor([0.0, 0.0, 1e5], dtype=F64)
    index = torch.tensor(markers)
    return replace(TARGET, centers=centers.index_copy(0, index, TARGET.centers[index]))


def pictures(case: Case, rig: tp.CameraRig, R: Tensor, t: Tensor, moved: Tensor, seed: int) -> list[Tensor]:
    """Frames (B, H, W) of every camera."""
    frames = []
    for camera, lens in enumerate(rig.cameras):
        own = in_view(rig, camera, R, t, moved[:, 6 * camera : 6 * camera + 6])
        seen, imaging = targets_of(case, camera), {"psf_sigma": BLUR, "dark": DARK, "light": LIGHT}
        parts = [slice(k, None, len(seen)) for k in range(len(seen))]
        images = torch.empty(len(t), HEIGHT, WIDTH)
        for part, target in zip(parts, seen, strict=True):
            images[part] = render(lens, target, own[0][part], own[1][part], **imaging)
        frames.append(add_noise(images, NOISE, seed=seed + camera))
    return frames


def bounds(case: Case, rig: tp.CameraRig, R: Tensor, t: Tensor, first: int) -> Tensor:
    """Joint bounds (B, 6, 6); without those of cameras that have no picture, and of markers that are hidden."""
    if not (case.missing or case.two_markers):
        return rig_crlb(rig, TARGET, R, t, psf_sigma=BLUR, dark=DARK, light=LIGHT, noise_sigma=NOISE)
    out = []
    for k in range(len(t)):
        rest = [n for n in range(len(rig)) if not case.missing or n != (first + k) % len(rig)]
        information = torch.zeros(6, 6, dtype=F64)
        for n in rest:
            seen = targets_of(case, n)
            alone = tp.CameraRig.alone(rig.cameras[n])
            own = [x[None] for x in rig.seen_by(n, R[k], t[k])]
            whole = _fisher_of(alone, seen[k % len(seen)], own[0], own[1])
            turn = torch.block_diag(rig.R[n], rig.R[n])
            information += turn.T @ whole @ turn
        out.append(torch.linalg.inv(information))
    return torch.stack(out)


def _fisher_of(rig: tp.CameraRig, target: tp.Target, R: Tensor, t: Tensor) -> Tensor:
    bound = rig_crlb(rig, target, R, t, psf_sigma=BLUR, dark=DARK, light=LIGHT, noise_sigma=NOISE)
    return torch.linalg.inv(bound[0])


def measure(name: str, case: Case, moments: int, seed: int, batch: int = BATCH) -> dict[str, Any]:
    """The row of a case."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(seed)
    rig = rig_of(case)
    estimator = tp.PoseEstimator(rig, TARGET)
    found, truth, bound = [], [], []
    for first in range(0, moments, batch):
        count = min(batch, moments - first)
        R, t = poses(case, count, generator)
        moved = torch.zeros(count, 6 * len(rig), dtype=F64)
        if case.places and rig.covariance is not None:
            drawn = torch.randn(count, 6 * (len(rig) - 1), dtype=F64, generator=generator)
            moved[:, 6:] = (drawn if case.loose else drawn[:1]) * rig.covariance.diagonal().sqrt()
        if case.knocked:
            moved[:, 4 if case.first else 10] = case.knocked * CENTER / FOCAL
        seen = torch.ones(len(rig), count, dtype=torch.bool)
        if case.missing:
            seen[(first + torch.arange(count)) % len(rig), torch.arange(count)] = False
        frames = pictures(case, rig, R, t, moved, seed + 1000 * first)
        found.append(estimator(frames, seen))
        truth.append(in_view(rig, 0, R, t, moved[:, :6]))
        bound.append(bounds(case, rig, R, t, first))
        print(f"{name}: {first + count} of {moments}", file=sys.stderr, flush=True)
    return row_of(name, tp.Poses.cat(found), truth, torch.cat(bound))


def row_of(name: str, found: tp.Poses, truth: list[tuple[Tensor, Tensor]], bound: Tensor) -> dict[str, Any]:
    R, t = (torch.cat(parts) for parts in zip(*truth, strict=True))
    good = found.ok.nonzero()[:, 0]
    errors = pose_errors(found[good], Pose(R[good], t[good]))
    variance = bound[good].diagonal(dim1=-2, dim2=-1)
    least = [variance[:, :2].sum(-1), variance[:, 2], variance[:, 3:].sum(-1)]
    errs = [rms(errors.lateral), rms(errors.depth), rms(errors.angle)]
    ratios = [float(e / v.mean().sqrt()) for e, v in zip(errs, least, strict=True)]
    disagree = int((found.reason == tp.Reason.CAMERAS_DISAGREE).sum())
    assert found.consistency is not None
    chi2, freedom = found.consistency[good].sum(0).tolist()
    return {
        "case": name,
        "moments": len(found),
        "ok": len(good),
        "disagree": disagree,
        "lateral": ratios[0],
        "depth": ratios[1],
        "rotation": ratios[2],
        "lateral_um": 1e3 * float(errs[0]),
        "depth_um": 1e3 * float(errs[1]),
        "rotation_deg": math.degrees(float(errs[2])),
        "widened": float((found.std[good, 2] > _WIDE * variance[:, 2].sqrt()).double().mean()),
        "nees": float(errors.nees.mean()) if len(good) else math.nan,
        "nees_deviation": float(errors.nees.std() / len(good) ** 0.5) if len(good) else math.nan,
        "consistency": chi2 / freedom if freedom else math.nan,
        "worst": float(errors.nees.max()) if len(good) else math.nan,
    }


def _measured(name: str, moments: int, seed: int, batch: int) -> dict[str, Any]:
    return measure(name, CASES[name], moments, seed, batch)


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One row of several cases."""
    number = {key: torch.tensor([float(row[key]) for row in rows], dtype=F64) for key in rows[0] if key != "case"}
    share = number["ok"] / number["ok"].sum()
    row: dict[str, Any] = {key: float((share * values).sum()) for key, values in number.items()}
    for key in ("lateral", "depth", "rotation", "lateral_um", "depth_um", "rotation_deg"):
        row[key] = float((share * number[key].square()).sum().sqrt())
    row["nees_deviation"] = float((share * number["nees_deviation"]).square().sum().sqrt())
    counts = {key: int(number[key].sum()) for key in ("moments", "ok", "disagree")}
    return {"case": "all as filed"} | row | counts | {"worst": float(number["worst"].max())}


def shown(row: dict[str, Any]) -> str:
    return "  ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", choices=[*CASES, "all"], default=["all"])
    parser.add_argument("--moments", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--batch", type=int, default=BATCH, help="moments a call")
    parser.add_argument("--processes", type=int, default=1, help="cases side by side")
    parser.add_argument("--out", type=Path, help="Table: .csv, .jsonl or .parquet")
    parser.add_argument("--markdown", action="store_true", help="print a table for the documentation")
    args = parser.parse_args()
    names = list(CASES) if "all" in args.case else args.case
    row_of_case = partial(_measured, moments=args.moments, seed=args.seed, batch=args.batch)
    rows = []
    if args.processes > 1:
        with ProcessPoolExecutor(args.processes, get_context("spawn")) as pool:
            for row in pool.map(row_of_case, names):
                print(shown(row), flush=True)
                rows.append(row)
    else:
        for name in names:
            rows.append(row_of_case(name))
            print(shown(rows[-1]), flush=True)
    if len(as_filed := [row for row in rows if not CASES[row["case"]].knocked]) > 1:
        rows.append(together(as_filed))
        print(shown(rows[-1]), flush=True)
    if args.markdown:
        print("| " + " | ".join(rows[0]) + " |\n|" + " --- |" * len(rows[0]))
        for row in rows:
            print("| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")
    if args.out is not None:
        write_rows(args.out, rows, {key: type(value) for key, value in rows[0].items()})


if __name__ == "__main__":
    main()
