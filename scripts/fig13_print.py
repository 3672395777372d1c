"""The paper's experiment (Fig. 13) with a printed target, measured first and not, on the digital twin.

    python scripts/fig13_print.py --out out/fig13_print

The target that the twin shows is a print: its places are off by --sigma mm rms in all three directions. The camera
takes --views varied views of it, from which `torchpose calibrate --measure-target` measures it, and then the paper's
translations and rotations. These are estimated with: the nominal file, which claims a perfect target; the same with the
deviation of the print as its `center_sigma`; the measured file, whose millimetre is that of the nominal places; and the
measured file with one distance between two markers given (--distance), known to --distance-sigma mm. Beside them, an
exact print with its file.

The camera file is exact and held, or with --calibrate found from the same views, with whatever target file the row
uses. --rendered shows the same frames without robot and camera emulator, where these are not installed.

rms: error of distance or angle from the origin against the robot's; claimed: from the poses' covariances; scale: how
much longer the camera sees the moves; without_scale: rms beside that line. reduced chi2: 1 where the claim is right.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import cv2
import torch
import yaml
from torch import Tensor

from torchpose.analysis import rms
from torchpose.calibration.measured import Distance
from torchpose.calibration.session import calibrate_camera, measure_target
from torchpose.camera import Camera
from torchpose.errors import TorchposeError
from torchpose.io.images import decode
from torchpose.io.manifest import read_manifest
from torchpose.io.rows import Row
from torchpose.rig.experiment import Experiment, Moves, evaluate_experiment, unit
from torchpose.rig.plan import load_plan
from torchpose.rig.twin.scene import Scene
from torchpose.sim.prints import PrintErrors, printed
from torchpose.studies.fig13_experiment import captured, estimated
from torchpose.studies.script import finish
from torchpose.studies.study import DATA, StudyResult, Table, load_data
from torchpose.target import Target

BATCH = 6  # frames that are held in memory at a time
ENDS = (0, 2)  # markers of the distance that is measured: across the plate
LENS = "brown4"
# of configs/rig/calibration_plan.yaml: all over the frame, near and far, tilted in every direction
VIEWS = {"x_mm": [-50, 50], "y_mm": [-30, 30], "z_mm": [-40, 10], "tilt_deg": [5, 30], "roll_deg": [-60, 60]}
STEPS: list[dict[str, Any]] = [
    {"translation": {"values_mm": [1, 2, 3, 4, 5]}},
    {"rotation": {"values_deg": [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5]}},
]
"""The paper's, without its frames at rest, in which a print does nothing."""


@dataclass(frozen=True)
class Settings:
    """What an experiment is made of, as the options say."""

    sigma: float = 0.05
    gain: float = 0.0
    seed: int = 1
    views: int = 28
    distance_sigma: float = 0.005
    calibrate: bool = False
    rendered: bool = False
    steps: tuple[dict[str, Any], ...] = tuple(STEPS)


@dataclass(frozen=True, eq=False)
class Case:
    """Files that the experiment's frames are estimated with, and what is said of them."""

    name: str
    manifest: Path
    camera: Camera
    target: Target


def taken(folder: Path, shown: Target, steps: list[dict[str, Any]], settings: Settings, seed: int) -> Path:
    """Lets the twin capture a plan with a target; the manifest. ``seed`` is that of the frames' noise."""
    folder.mkdir()
    files = load_data("experiment.yaml")
    files["plan"]["steps"] = steps
    shown.save(folder / "print.yaml")
    files["twin"] |= {"seed": seed, "target": "print.yaml"}
    Camera.load(DATA / "camera.yaml").save(folder / "camera.yaml")
    for name in ("rig", "twin", "plan"):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(files[name]), encoding="utf-8")
    return rendered(folder) if settings.rendered else captured(folder, lambda _: None)


def rendered(folder: Path) -> Path:
    """The frames of an exact twin, and the manifest, without its robot and its camera."""
    scene, plan = Scene.load(folder / "twin.yaml"), load_plan(folder / "plan.yaml")
    records: list[Row] = [{"record": "session", "units": {"length": "mm"}, "emulated": True}]
    for number, waypoint in enumerate(plan.waypoints, start=1):
        image, pose = f"{waypoint.id}.png", list(waypoint.pose)
        cv2.imwrite(str(folder / image), scene.frame("camera", pose, number, 8).numpy())
        label = waypoint.model_dump(exclude={"pose"})
        records.append({"record": "frame", "id": waypoint.id, "image": image, "robot_pose": pose, "waypoint": label})
    manifest = folder / "manifest.jsonl"
    manifest.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")
    return manifest


def batches(manifest: Path) -> Iterator[tuple[list[str], Tensor]]:
    """Names and frames (B, H, W) of a capture."""
    names = [frame.image for frame in read_manifest(manifest)]
    for first in range(0, len(names), BATCH):
        some = names[first : first + BATCH]
        yield some, torch.stack([torch.from_numpy(decode(manifest.parent / name)) for name in some])


def cases(folder: Path, settings: Settings) -> list[Case]:
    """Captures with an exact print and with one that is off, and the files of all cases."""
    exact = Target.load("quad40")
    generator = torch.Generator().manual_seed(settings.seed)
    off = printed(exact, PrintErrors(center_sigma=settings.sigma, gain=settings.gain), generator=generator).as_target()
    length = float((off.centers[ENDS[0]] - off.centers[ENDS[1]]).norm())
    length += settings.distance_sigma * float(torch.randn((), generator=generator, dtype=torch.float64))
    distance = Distance(*ENDS, length, settings.distance_sigma)
    steps, varied = list(settings.steps), [{"calibration": VIEWS | {"count": settings.views}}]
    # views and moves differ in their noise, the moves of both prints do not
    views = taken(folder / "views", off, varied, settings, 2 * settings.seed)
    moves = taken(folder / "moves", off, steps, settings, 2 * settings.seed + 1)
    ideal = taken(folder / "exact", exact, steps, settings, 2 * settings.seed + 1)
    true = Camera.load(DATA / "camera.yaml")
    variance = torch.full((3 * len(exact) + 1,), settings.sigma**2, dtype=torch.float64)
    variance[-1] = settings.gain**2
    stated = replace(exact, covariance=variance.diag())
    found = [Case("exact print", ideal, true, exact)]
    for name, target in (("nominal", exact), (f"nominal, center_sigma {settings.sigma:g}", stated)):
        camera = true
        if settings.calibrate:
            camera = calibrate_camera(lambda: batches(views), target, true, guess=False, lens=LENS).camera
        found.append(Case(name, moves, camera, target))
    for name, scale in (("measured", None), (f"measured, distance to {settings.distance_sigma:g}", distance)):
        given: Literal["start", "camera"] = "start" if settings.calibrate else "camera"
        both = measure_target(lambda: batches(views), exact, true, given=given, lens=LENS, distance=scale)
        found.append(Case(name, moves, both.camera, both.target))
    return found


def evaluate(case: Case) -> Experiment:
    return evaluate_experiment(case.manifest, estimated(case.manifest, case.camera, case.target))


def pooled(values: list[Tensor]) -> float:
    """Root mean square of all of them."""
    return float(rms(torch.cat(values)))


def axis_row(case: str, moves: list[Moves]) -> Row:
    """Figures of the moves along, or turns about, one axis; one entry a print."""
    name, units = unit(moves[0].axis)
    scales = torch.tensor([one.scale for one in moves], dtype=torch.float64)
    return {
        "case": case,
        "axis": moves[0].axis,
        "unit": name,
        "rms": units * pooled([one.error for one in moves]),
        "claimed": units * pooled([one.sigma for one in moves]),
        "reduced_chi2": sum(one.reduced_chi2 for one in moves) / len(moves),
        "scale_ppm": 1e6 * float(rms(scales[:, 0])),
        "scale_claimed_ppm": 1e6 * float(rms(scales[:, 1])),
        "without_scale": units * pooled([one.error - one.scale[0] * one.robot for one in moves]),
    }


def summary(case: str, found: list[Experiment]) -> Row:
    """Moves, and turns, of all axes together; one experiment a print."""
    row: Row = {"case": case}
    for name, turn, units in (("moves_um", False, unit("x")[1]), ("turns_mdeg", True, unit("roll")[1])):
        group = [moves for one in found for moves in one.moves if moves.turn == turn]
        count = sum(len(moves.error) for moves in group)
        row[f"{name}_rms"] = units * pooled([moves.error for moves in group])
        row[f"{name}_claimed"] = units * pooled([moves.sigma for moves in group])
        row[f"{name.split('_')[0]}_reduced_chi2"] = sum(m.reduced_chi2 * len(m.error) for m in group) / count
    return row | {"frames_without_pose": sum(len(one.unused) for one in found)}


def experiments(settings: Settings, prints: int) -> dict[str, list[Experiment]]:
    """The experiment by case, once for each of as many prints."""
    found: dict[str, list[Experiment]] = {}
    for number in range(prints):
        with TemporaryDirectory(prefix="torchpose-print-") as place:
            for case in cases(Path(place), replace(settings, seed=settings.seed + number)):
                found.setdefault(case.name, []).append(evaluate(case))
    return found


def run(settings: Settings, prints: int = 1) -> StudyResult:
    """The tables of all cases."""
    found = experiments(settings, prints)
    title = f"Fig. 13 with places off by {1e3 * settings.sigma:g} um rms, prints: {prints}"
    together = Table("together", title, [summary(name, every) for name, every in found.items()])
    axes = [
        axis_row(name, [one.moves[k] for one in every])
        for name, every in found.items()
        for k in range(len(every[0].moves))
    ]
    return StudyResult(tables=[together, Table("by_axis", "By axis", axes)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sigma", type=float, default=Settings.sigma, help="of the print's places, mm")
    parser.add_argument("--gain", type=float, default=Settings.gain, help="dot gain, mm, its sigma where stated")
    parser.add_argument("--seed", type=int, default=Settings.seed, help="of the print and of the noise")
    parser.add_argument("--views", type=int, default=Settings.views, help="that the target is measured from")
    parser.add_argument("--distance-sigma", type=float, default=Settings.distance_sigma, help="mm")
    parser.add_argument("--calibrate", action="store_true", help="find the camera from the views, too")
    parser.add_argument("--rendered", action="store_true", help="without robot and camera emulator")
    parser.add_argument("--prints", type=int, default=1, help="of consecutive seeds, pooled")
    parser.add_argument("--out", type=Path, help="folder for tables (.csv)")
    options = vars(parser.parse_args())
    out, prints = options.pop("out"), options.pop("prints")
    try:
        finish(run(Settings(**options), prints), out)
    except TorchposeError as error:
        print(f"fig13_print: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
