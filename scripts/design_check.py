"""Designed targets rendered all over their working volume and measured: is the precision as predicted?

    python scripts/design_check.py --frames 600 --out out/design_check.csv [--markdown]

One row a design and axis: RMS error over the predicted standard deviation of the same pose (1 where the prediction is
right; the statistical error of 600 frames is 3 %), and the RMS error beside the RMS prediction. Poses are drawn evenly
from the volume (`WorkingVolume.random`); frames have the noise and blur of the design and 8 bits.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import torchpose as tp
from torchpose.analysis import pose_errors
from torchpose.analysis.evaluation import AXES, SCALE, UNITS
from torchpose.design import Imaging, Need, WorkingVolume, design_target, deviations, predicted_covariance
from torchpose.io.writers import write_rows
from torchpose.sim import Defocus, add_noise, render

CAMERAS = Path(__file__).parents[1] / "configs" / "cameras"
BATCH = 4
SURROUND = 128.0  # grey level beyond the plate


@dataclass(frozen=True)
class Case:
    """A design task; plate in mm."""

    camera: str
    volume: WorkingVolume
    plate: tuple[float, float]
    need: Need
    imaging: Imaging = field(default_factory=Imaging)
    background: str = "light"
    markers: int | None = None


CASES = {
    "robot": Case("acA5472_8mm_third", WorkingVolume((150, 170), (10, 5), math.radians(20)), (70, 70), Need(0.5, 2.0)),
    "oblong": Case(
        "acA5472_8mm_third",
        WorkingVolume((180, 260), (20, 10), math.radians(40)),
        (80, 50),
        Need(1.0, 8.0),
        Imaging(psf_sigma=0.9, noise=4.0),
        "dark",
        6,
    ),
    "deep": Case(
        "acA5472_8mm_third",
        WorkingVolume((140, 190), (5, 5), math.radians(20)),
        (50, 50),
        Need(1.0, 5.0),
        Imaging(noise=1.0, lens=Defocus(4.0, 8.0, 160.0)),
        "light",
        6,
    ),
    "defocused": Case(
        "acA5472_8mm_third",
        WorkingVolume((120, 240), (5, 5), math.radians(30)),
        (50, 50),
        Need(1.0, 5.0),
        Imaging(noise=1.0, lens=Defocus(4.0, 8.0, 160.0)),
        "light",
        6,
    ),
    "full": Case("acA5472_8mm", WorkingVolume((150, 170), (10, 5), math.radians(20)), (70, 70), Need(0.1, 0.5)),
}


@dataclass(frozen=True)
class Truth:
    R: torch.Tensor
    t: torch.Tensor


def run(name: str, case: Case, frames: int, seed: int) -> list[dict[str, Any]]:
    camera = tp.Camera.load(CAMERAS / f"{case.camera}.yaml")
    made = design_target(
        camera,
        case.volume,
        case.plate,
        case.need,
        case.imaging,
        background=case.background,
        markers=case.markers,
    )
    R, t = case.volume.random(frames, torch.Generator().manual_seed(seed))
    estimator = tp.PoseEstimator(camera, made.target)
    imaging = case.imaging
    errors, ok, nees = [], [], []
    for a in range(0, frames, BATCH):
        s = slice(a, a + BATCH)
        clean = render(
            camera,
            made.target,
            R[s],
            t[s],
            psf_sigma=imaging.psf_sigma,
            dark=imaging.dark,
            light=imaging.light,
            plate=case.plate,
            surround=SURROUND,
            defocus=imaging.lens,
        )
        poses = estimator(add_noise(clean, imaging.noise, seed=seed, index=torch.arange(a, a + len(clean))))
        e = pose_errors(poses, Truth(R[s], t[s]))
        errors.append(torch.cat([e.translation, e.rotation], 1) * SCALE)
        ok.append(poses.status == tp.Status.OK)
        nees.append(e.nees)
        if sys.stderr.isatty():
            print(f"\r{name}: {a + len(clean)} of {frames}", end="", file=sys.stderr)
    found = torch.cat(ok)
    error = torch.cat(errors)[found]
    predicted = deviations(predicted_covariance(camera, made.target, R[found], t[found], imaging))
    rows: list[dict[str, Any]] = []
    for i, axis in enumerate(AXES):
        rows.append({
            "design": name,
            "rings": len(made.target),
            "axis": axis,
            "unit": UNITS[i],
            "frames": frames,
            "ok": int(found.sum()),
            "ratio": float((error[:, i] / predicted[:, i]).square().mean().sqrt()),
            "rms_error": float(error[:, i].square().mean().sqrt()),
            "predicted": float(predicted[:, i].square().mean().sqrt()),
            "worst_predicted": float(made.precision.worst[i]),
            "largest_predicted": float(predicted[:, i].max()),
            "mean_nees": float(torch.cat(nees)[found].mean()),
        })  # fmt: skip
    return rows


def markdown(rows: list[dict[str, Any]]) -> list[str]:
    """One line a design: ratios by axis."""
    lines = [f"| design | rings | ok | {' | '.join(AXES)} | NEES |", "| --- " * (len(AXES) + 4) + "|"]
    for name in dict.fromkeys(str(row["design"]) for row in rows):
        mine = [row for row in rows if row["design"] == name]
        ratios = " | ".join(f"{row['ratio']:.2f}" for row in mine)
        first = mine[0]
        ok = f"{first['ok']} of {first['frames']}"
        lines.append(f"| {name} | {first['rings']} | {ok} | {ratios} | {first['mean_nees']:.2f} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=["robot", "oblong", "deep", "defocused"], choices=[*CASES, "all"])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="CSV file of the rows")
    parser.add_argument("--markdown", action="store_true", help="print a table for the documentation")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in list(CASES) if "all" in options.case else options.case:
        found = run(name, CASES[name], options.frames, options.seed)
        rows += found
        for row in found:
            print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
    if options.out:
        write_rows(options.out, rows, {name: type(value) for name, value in rows[0].items()})
    if options.markdown:
        print("\n".join(markdown(rows)))


if __name__ == "__main__":
    main()
