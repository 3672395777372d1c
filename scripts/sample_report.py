"""Compares estimated poses with the truth of simulated frames; exits with 1 where the requirement is not met.

python scripts/sample_report.py --poses out/sample/poses.jsonl --truth data/sample/truth.csv [--markdown]

Tilt in degrees, noise in grey levels. Lateral is across the optical axis, rotation is the angle between estimate and
truth; a cell holds the error, its predicted standard deviation and its Cramer-Rao bound.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

import torch
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchpose.analysis import pose_errors, rms
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.truth import Truth, read_truth

REQUIRED = torch.tensor([2e-3, 6e-3, math.radians(0.01)], dtype=torch.float64)  # RMS over frames: mm, mm, rad
BOUND_FACTOR = 2.0  # a frame whose Cramer-Rao bound times this is larger is held to that instead
SHOWN = torch.tensor([1e3, 1e3, math.degrees(1e3)], dtype=torch.float64)  # um, um, mdeg
BOUND = ("sx", "sy", "sz", "srx", "sry", "srz")
CONDITIONS = ("tilt_deg", "noise_sigma")
HEADER = ("frame", "tilt", "noise", "status", "lateral um", "depth um", "rotation mdeg", "NEES")


class Estimated(NamedTuple):
    status: list[str]
    R: Tensor
    t: Tensor
    covariance: Tensor


def read_poses(path: Path, truth: Truth) -> Estimated:
    """Rows of a JSON-lines table of ``torchpose estimate`` in the order of the truth; NaN where there is no pose."""
    nothing = [[math.nan] * 6] * 6
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        found = {(row["frame"], row["target"]): row for row in rows}
        ordered = [found[key] for key in zip(truth.frame, truth.target, strict=True)]
        vectors = [
            [math.nan if row[c] is None else row[c] for c in ("tx", "ty", "tz", "rx", "ry", "rz")] for row in ordered
        ]
        covariance = torch.tensor([row["covariance"] or nothing for row in ordered], dtype=torch.float64)
        status = [row["status"] for row in ordered]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: --poses: does not hold the frames of the truth file ({error!r}); "
            "give the .jsonl that torchpose estimate wrote for them"
        ) from None
    pose = torch.tensor(vectors, dtype=torch.float64)
    return Estimated(status, rotations.exp(pose[:, 3:]), pose[:, :3], covariance)


def grouped(std: Tensor) -> Tensor:
    """(N, 6) standard deviations of t and rotation as (N, 3): lateral, depth, angle."""
    return torch.stack([std[:, :2].norm(dim=1), std[:, 2], std[:, 3:].norm(dim=1)], 1)


def show(rows: list[list[str]], markdown: bool) -> None:
    """Prints rows of `HEADER`; the last two are those over all frames."""
    if markdown:
        lines = (HEADER, ["---"] * len(HEADER), *rows)
        print("\n".join(f"| {' | '.join(cells)} |" for cells in lines))
        return
    console = Console(width=max(Console().width, 100))  # a pipe counts as 80 columns, which would cut the numbers
    table = Table(box=box.SIMPLE_HEAD, padding=0, title="error, predicted sigma, Cramer-Rao bound")
    for name in HEADER:
        table.add_column(name, justify="left" if name in ("frame", "status") else "right", no_wrap=True)
    for number, cells in enumerate(rows, 1):
        table.add_row(*cells, end_section=number == len(rows) - 2)
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=Path, required=True, help="table of torchpose estimate, .jsonl")
    parser.add_argument("--truth", type=Path, required=True, help="truth of the same frames, .csv")
    parser.add_argument("--markdown", action="store_true", help="print the table for a Markdown page")
    options = parser.parse_args()
    try:
        truth = read_truth(options.truth)
        absent = [name for name in (*BOUND, *CONDITIONS) if name not in truth.extra]
        if absent or not len(truth):
            fault = f"{absent[0]}: column is missing" if absent else "frame: no row"
            raise ConfigError(f"{options.truth}: {fault}; use what scripts/make_sample.py wrote")
        estimated = read_poses(options.poses, truth)
    except ConfigError as refused:
        print(f"sample_report: error: {refused}", file=sys.stderr)
        return 2
    tilt, noise = (truth.extra[name] for name in CONDITIONS)
    bound = grouped(torch.stack([truth.extra[name] for name in BOUND], 1))
    errors = pose_errors(estimated, truth)
    error = torch.stack([errors.lateral, errors.depth.abs(), errors.angle], 1)
    sigma = grouped(estimated.covariance.diagonal(dim1=1, dim2=2).sqrt())
    allowed = torch.fmax(REQUIRED, BOUND_FACTOR * bound)

    separator = " / " if options.markdown else " "

    def cells(values: Tensor) -> list[str]:
        return [separator.join(f"{value:.2f}" for value in group) for group in (values * SHOWN[:, None]).tolist()]

    each = torch.stack([error, sigma, bound], -1)
    rows = [
        [frame, f"{tilt[i]:.0f}", f"{noise[i]:.1f}", estimated.status[i], *cells(each[i]), f"{errors.nees[i]:.1f}"]
        for i, frame in enumerate(truth.frame)
    ]
    rows.append(["RMS", "", "", "", *cells(rms(each)), ""])
    rows.append(["allowed", "", "", "", *cells(rms(allowed)[:, None]), ""])
    show(rows, options.markdown)

    solved = sum(status == "ok" for status in estimated.status)
    # each frame against its own allowance, so that one noisy frame does not lend its own to the others
    met = solved == len(truth) and bool((rms(error / allowed) <= 1).all())
    print(
        f"{solved} of {len(truth)} frames ok; errors {'within' if met else 'BEYOND'} what is allowed; "
        f"mean NEES {errors.nees.nanmean():.1f} (6 if the covariances are right)"
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
