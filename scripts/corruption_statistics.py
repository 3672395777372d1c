"""The matrix of corruptions: how many frames are found, how far off, how far off by their own account, at what cost.

    python scripts/corruption_statistics.py --frames 12 --background both --target sample small --markdown
    python scripts/corruption_statistics.py --only motion defocus --method photometric centers --json motion.json

2 MP frames, noise 2, 8 bit, tilt to 40 degrees; target ``sample``: quad40 at 145 to 185 mm (rings of 30 to 38 px
radius), ``small``: at 300 to 480 mm (12 to 18 px). `corruptions.py` beside this file has the corruptions. A row is a
corruption, severity, target, background and method; its columns:

    ok        frames with a pose of status ok, of all; lines below the table name the others
    lateral, depth  RMS error over RMS bound, of the ok frames. The bound (`torchpose.analysis.pose_crlb`) knows blur,
              contrast, noise and bits; it does not know what covers a ring, clips, or acts on the stored grey values
    worst     largest |error| / claimed sigma of the six components of any ok row
    beyond 5  share of ok rows with a component beyond 5 claimed sigmas
    CPU       of the estimate, ms a frame on one thread, median

A person does not see the small rings in a row marked `unseen`; geometry hides the fault in one marked `hidden`.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from corruptions import CORRUPTIONS, DISTANCES, Background, Corruption, Shot, severity, shoot, view
from torch import Tensor

import torchpose as tp
from torchpose.analysis import pose_crlb, pose_errors
from torchpose.pipeline import Method

CAMERA = Path(__file__).parents[1] / "data" / "sample" / "camera.yaml"
FAR_OFF = 5.0  # claimed sigmas
COLUMNS = ("corruption", "severity", "target", "background", "method", "ok", "lateral", "depth", "worst", "beyond 5",
           "CPU ms", "")  # fmt: skip


@dataclass(frozen=True)
class Line:
    """One row of the matrix, without the method."""

    name: str
    value: Any
    kind: str
    background: Background

    @property
    def corruption(self) -> Corruption:
        return CORRUPTIONS[self.name]

    @property
    def severity(self) -> str:
        return "" if self.name == "none" else severity(self.value)

    @property
    def note(self) -> str:
        if self.corruption.hidden:
            return "hidden"
        return "" if self.corruption.visible(self.value, self.kind) else "unseen"


def lines(names: list[str], kinds: list[str], backgrounds: list[Background]) -> Iterator[Line]:
    """All rows of the matrix."""
    for name in names:
        for value in CORRUPTIONS[name].values:
            for kind in kinds:
                for background in backgrounds:
                    if background == "none" or not CORRUPTIONS[name].own_background:
                        yield Line(name, value, kind, background)


def bound(shot: Shot) -> Tensor:
    """(6,) variances that no unbiased estimator from this frame goes below."""
    full_well = shot.sensor.get("full_well")
    variance = shot.sensor["sigma"] ** 2 + (255.0 * 125.0 / full_well if full_well else 0.0)  # at medium grey
    covariance = pose_crlb(
        shot.camera, shot.target, shot.R[None], shot.t[None], **shot.blur.imaging(), dark=0.0, light=shot.contrast,
        noise_sigma=math.sqrt(variance), bits=shot.sensor.get("bits", 8),
    )  # fmt: skip
    return covariance[0].diagonal()


def measure(estimator: tp.PoseEstimator, shot: Shot, frame: Tensor) -> dict[str, Any]:
    """Status, errors and claimed sigmas of six components (mm, rad) and CPU ms of one frame."""
    start = time.process_time()
    poses = estimator(frame[None])
    cpu = 1e3 * (time.process_time() - start)
    errors = pose_errors(poses, shot)
    return {
        "status": tp.Status(int(poses.status[0])).name.lower(),
        "reason": int(poses.reason[0]),
        "markers": int(poses.markers[0]),
        "error": torch.cat([errors.translation, errors.rotation], -1)[0].tolist(),
        "claimed": poses.std[0].tolist(),
        "nees": float(errors.nees[0]),
        "cpu": cpu,
    }


def run(line: Line, camera: tp.Camera, estimators: dict[str, tp.PoseEstimator], count: int, seed: int) -> list[Any]:
    """A row for every method, with its frames."""
    frames: dict[str, list[dict[str, Any]]] = {method: [] for method in estimators}
    for number in range(count):
        shot = view(number, seed, camera, line.kind, line.background)
        shot, frame = shoot(shot, line.corruption, line.value, seed * 1_000_003 + number)
        limit = bound(shot).tolist()
        for method, estimator in estimators.items():
            frames[method].append({"frame": number, "bound": limit, **measure(estimator, shot, frame)})
    return [summary(line, method, of) for method, of in frames.items()]


def summary(line: Line, method: str, frames: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of the table."""
    ok = [f for f in frames if f["status"] == "ok"]
    squared = np.square([f["error"] for f in ok]).reshape(-1, 6).mean(0) if ok else np.full(6, math.nan)
    limit = np.array([f["bound"] for f in ok]).mean(0) if ok else np.full(6, math.nan)
    worst = [max(abs(e) / s for e, s in zip(f["error"], f["claimed"], strict=True)) for f in ok]
    return {
        "corruption": line.name,
        "severity": line.severity,
        "target": line.kind,
        "background": line.background,
        "method": method,
        "note": line.note,
        "frames": len(frames),
        "ok": len(ok),
        "lateral": math.sqrt(squared[:2].sum() / limit[:2].sum()),
        "depth": math.sqrt(squared[2] / limit[2]),
        "lateral_um": 1e3 * math.sqrt(squared[:2].sum()),
        "depth_um": 1e3 * math.sqrt(squared[2]),
        "worst": max(worst, default=math.nan),
        "beyond": sum(w > FAR_OFF for w in worst) / len(ok) if ok else math.nan,
        "cpu": statistics.median(f["cpu"] for f in frames),
        "each": frames,
    }


def cells(row: dict[str, Any]) -> list[str]:
    """The columns of `COLUMNS` of one row."""
    ok = f"{row['ok']} of {row['frames']}"
    figures = [f"{row[name]:.2f}" for name in ("lateral", "depth")] + [f"{row['worst']:.1f}", f"{row['beyond']:.0%}"]
    if not row["ok"]:
        figures = [""] * 4
    place = [row[name] for name in COLUMNS[:5]]
    return [*place, ok, *figures, f"{row['cpu']:.0f}", row["note"]]


def missed(row: dict[str, Any]) -> list[str]:
    """The frames of a row without an ok pose, and those far off, a line each."""
    place = " ".join(row[name] for name in COLUMNS[:5])
    out = []
    for f in row["each"]:
        far = max(abs(e) / s for e, s in zip(f["error"], f["claimed"], strict=True)) if f["status"] == "ok" else 0.0
        if f["status"] != "ok":
            out.append(f"{place}: frame {f['frame']} {f['status']} {tp.Reason(f['reason']).name.lower()}, "
                       f"{f['markers']} markers")  # fmt: skip
        elif far > FAR_OFF:
            out.append(f"{place}: frame {f['frame']} off by {far:.1f} claimed sigmas, NEES {f['nees']:.0f}")
    return out


def printed(values: list[str], markdown: bool) -> str:
    if markdown:
        return "| " + " | ".join(values) + " |"
    widths = (16, 9, 7, 11, 12, 9, 8, 8, 8, 9, 8, 0)
    return " ".join(f"{value:{width}s}" for value, width in zip(values, widths, strict=True)).rstrip()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=list(CORRUPTIONS), default=list(CORRUPTIONS))
    parser.add_argument("--method", nargs="+", choices=get_args(Method), default=["photometric"])
    parser.add_argument("--background", choices=["none", "photo", "both"], default="none")
    parser.add_argument("--target", nargs="+", choices=list(DISTANCES), default=["sample"])
    parser.add_argument("--json", type=Path, metavar="OUT", help="file of all rows with their frames")
    parser.add_argument("--markdown", action="store_true", help="a table of Markdown")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera, target = tp.Camera.load(CAMERA), tp.Target.load("quad40")
    estimators = {method: tp.PoseEstimator(camera, target, method=method) for method in options.method}
    backgrounds = list(get_args(Background)) if options.background == "both" else [options.background]
    run(Line("none", 0.0, "sample", "none"), camera, estimators, 1, options.seed)  # warms up
    rows: list[dict[str, Any]] = []
    print(printed(list(COLUMNS), options.markdown))
    if options.markdown:
        print(printed(["---"] * len(COLUMNS), True))
    for line in lines(options.only, options.target, backgrounds):
        for row in run(line, camera, estimators, options.frames, options.seed):
            rows.append(row)
            print(printed(cells(row), options.markdown), flush=True)
    print()
    for row in rows:
        print(*missed(row), sep="\n", end="\n" if missed(row) else "")
    if options.json:
        options.json.write_text(json.dumps(rows), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
