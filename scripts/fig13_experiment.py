"""The paper's experiment (Algorithm 2, Fig. 13) from a capture manifest and the poses estimated from its frames.

    torchpose capture configs/rig/paper_plan.yaml --rig configs/rig/ur5_20mp.yaml --out run
    torchpose estimate run/manifest.jsonl --camera camera.yaml --target quad40 --out run/poses.jsonl
    python scripts/fig13_experiment.py run/manifest.jsonl run/poses.jsonl --out out/fig13

Tables: repeatability at rest; distance and angle differences against the robot per axis; influence of the focal length
on Z (eq. 5). ``claimed``: from the poses' covariances. With --camera and --target the Cramer-Rao bound stands beside
it, for the noise and blur given. ``normalised``: reduced chi-squared of the errors, 1 where the claim is right and the
robot exact; ``scale``: how much longer the camera sees the moves along an axis.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from torchpose.analysis.crlb import pose_crlb
from torchpose.analysis.equations import depth_focal_error
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.report.experiment import plot_experiment
from torchpose.rig.experiment import AXES, Experiment, Moves, evaluate_experiment, unit
from torchpose.studies.script import show
from torchpose.studies.study import Picture, StudyResult, Table, Value
from torchpose.target import Target

FOCAL_ERRORS = (0.0001, 0.0005, 0.0025)  # relative; the last is the paper's


def static_table(e: Experiment) -> Table:
    rows: list[dict[str, Value]] = []
    for k, axis in enumerate(("x", "y", "z", "rx", "ry", "rz") if e.static else ()):
        assert e.static is not None
        name, scale = unit(AXES[k])
        bound = None if e.bound is None or e.bound.static is None else scale * float(e.bound.static.claimed[k])
        spread, claimed = scale * float(e.static.spread[k]), scale * float(e.static.claimed[k])
        rows.append(
            {
                "axis": axis,
                "unit": name,
                "frames": len(e.static.deviation),
                "spread": spread,
                "worst": scale * float(e.static.deviation[:, k].abs().max()),
                "claimed": claimed,
                "bound": bound,
                "spread / claimed": spread / claimed,
            }
        )
    return Table("static", "At rest: standard deviation along and about the camera's axes", rows)


def moves_table(e: Experiment) -> Table:
    rows: list[dict[str, Value]] = []
    for k, m in enumerate(e.moves):
        name, scale = unit(m.axis)
        bound = None if e.bound is None else rms(e.bound.moves[k].sigma) * scale
        rows.append(
            {
                "axis": m.axis,
                "unit": name,
                "frames": len(m.error),
                "mean": scale * float(m.error.mean()),
                "RMS": scale * rms(m.error),
                "worst": scale * float(m.error.abs().max()),
                "claimed": scale * rms(m.sigma),
                "bound": bound,
                "normalised": m.reduced_chi2,
                "scale, ppm": 1e6 * m.scale[0],
                "scale sigma, ppm": 1e6 * m.scale[1],
            }
        )
    note = "camera - robot; the errors of an axis share the noise of its origin frame, which `normalised` allows for"
    return Table("moves", "Distance and angle from the origin against the robot's", rows, note)


def focal_table(e: Experiment) -> Table:
    reach = max((float(m.robot.abs().max()) for m in e.moves if m.axis == "z"), default=math.nan)
    rows: list[dict[str, Value]] = [
        {
            "focal error, %": 100 * relative,
            "error of Z, um": 1e3 * abs(float(depth_focal_error(e.distance, 1.0, 1.0 + relative))),
            "error of the longest move along Z, um": 1e3 * relative * reach,
        }
        for relative in FOCAL_ERRORS
    ]
    return Table(
        "focal",
        f"Influence of the focal length at {e.distance:.1f} mm, eq. (5)",
        rows,
        "distances between two poses hide it, as the paper says: only the difference in depth is scaled",
    )


def rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def pooled(moves: list[Moves]) -> float:
    return math.sqrt(sum(m.reduced_chi2 * len(m.error) for m in moves) / sum(len(m.error) for m in moves))


def statements(e: Experiment) -> list[str]:
    said = []
    if e.static is not None:
        ratio = float((e.static.spread / e.static.claimed).square().mean().sqrt())
        said.append(f"At rest the frames spread {ratio:.2f} times what their poses claim (all six axes).")
    for name, group in (("moves", [m for m in e.moves if not m.turn]), ("turns", [m for m in e.moves if m.turn])):
        if group:
            count = sum(len(m.error) for m in group)
            said.append(
                f"Errors of the {name} are {pooled(group):.2f} times what their poses claim, {count} frames "
                f"(known to {1 / math.sqrt(2 * count):.0%})."
            )
    if e.unused:
        said.append(f"{len(e.unused)} frames without a pose: {', '.join(e.unused[:5])}.")
    if e.emulated:
        said.append("The rig was emulated: no optics, no real motion.")
    return said


def crlb(camera: Path, target: str, noise: float, psf: float) -> Callable[[Tensor, Tensor], Tensor]:
    known, shown = Camera.load(camera), Target.load(target)
    return lambda r, t: pose_crlb(known, shown, r, t, psf_sigma=psf, noise_sigma=noise)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest", type=Path)
    parser.add_argument("poses", type=Path)
    parser.add_argument("--out", type=Path, help="folder for tables (.csv) and the plot (.png)")
    parser.add_argument("--camera", type=Path, help="for the bound")
    parser.add_argument("--target", help="for the bound")
    parser.add_argument("--noise", type=float, default=1.0, help="grey levels of 0..255")
    parser.add_argument("--psf", type=float, default=0.7, help="standard deviation of the blur, px")
    options = parser.parse_args()
    try:
        known = options.camera is not None and options.target is not None
        bound = crlb(options.camera, options.target, options.noise, options.psf) if known else None
        e = evaluate_experiment(options.manifest, options.poses, bound)
        result = StudyResult(
            tables=[table for table in (static_table(e), moves_table(e), focal_table(e)) if table.rows],
            pictures=[Picture("fig13", "Fig. 13: the experiment", plot_experiment(e, "Experiment"))],
            statements=statements(e),
            settings={"manifest": str(options.manifest), "poses": str(options.poses)},
        )
        show(result)
        if options.out:
            for path in result.save(options.out):
                print(path)
    except ConfigError as error:
        print(f"fig13_experiment: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
