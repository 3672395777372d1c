"""The paper's experiment (Algorithm 2, Figs. 12 and 13), here on the digital twin of its rig.

The twin speaks the robot's wire protocol to ur-rtde and shows rendered frames to the emulated Basler camera, so all of
the capture runs but optics and real motion. Its robot is exact: what is left is the error of the pose estimation.
``claimed``: from the poses' covariances; ``bound``: Cramer-Rao; ``normalised``: reduced chi-squared of the errors, 1
where the claim is right and the robot exact; ``scale``: how much longer the camera sees the moves along an axis.
"""

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import yaml
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.analysis import rms
from torchpose.analysis.crlb import pose_crlb
from torchpose.analysis.equations import depth_focal_error
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.io.images import decode
from torchpose.io.manifest import read_manifest
from torchpose.io.rows import POSE_SCHEMA, Row, pose_rows
from torchpose.io.writers import write_rows
from torchpose.pipeline import PoseEstimator
from torchpose.report.experiment import plot_experiment
from torchpose.report.figures import frames
from torchpose.rig.experiment import AXES, Experiment, evaluate_experiment, unit
from torchpose.studies.study import DATA, Comparison, Picture, Progress, StudyResult, Table, ignore_progress, load_data
from torchpose.target import Target

NAME = "fig13_experiment"
TITLE = "Figs. 12 and 13: the experiment, on the digital twin"
FOCAL_ERRORS = (0.0001, 0.0005, 0.0025)  # relative; the last is the paper's


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Captures the experiment on the twin and evaluates it; ``full``: with every angle and twice the static frames.

    Raises:
        ConfigError: pypylon or ur-rtde is not installed, or another twin runs.
    """
    for module, package in (("pypylon", "pypylon"), ("rtde_control", "ur-rtde")):
        if importlib.util.find_spec(module) is None:
            raise ConfigError(f"{package}: package: is not installed; pip install 'torchpose[rig]'")
    files = load_data("experiment.yaml")
    quick_steps = files.pop("quick_steps")
    if not full:
        files["plan"]["steps"] = quick_steps
    files["twin"]["seed"] = seed
    camera, target = Camera.load(DATA / "camera.yaml"), Target.load(files["twin"]["target"])
    noise, psf_sigma = files["twin"]["imaging"]["noise"], files["twin"]["imaging"]["psf_sigma"]
    with TemporaryDirectory(prefix="torchpose-experiment-") as place:
        folder = Path(place)
        camera.save(folder / "camera.yaml")
        for name, content in files.items():
            (folder / f"{name}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        manifest = captured(folder, lambda done: progress(0.8 * done))
        poses = estimated(manifest, camera, target)
        result = evaluated(manifest, poses, crlb(camera, target, noise, psf_sigma))
        result.pictures.insert(0, Picture("fig12", "Fig. 12: frames of the experiment", _sheet(manifest)))
        result.settings = {"noise": noise, "psf_sigma_px": psf_sigma, "frames": len(read_manifest(manifest))}
    return result


def evaluated(manifest: Path, poses: Path, bound: Callable[[Tensor, Tensor], Tensor] | None = None) -> StudyResult:
    """Tables, plot and statements of an experiment; arguments as of `evaluate_experiment`."""
    found = evaluate_experiment(manifest, poses, bound)
    moves = moves_table(found)
    return StudyResult(
        tables=[table for table in (static_table(found), moves, focal_table(found)) if table.rows],
        pictures=[Picture("fig13", "Fig. 13: the experiment", plot_experiment(found, "Experiment"))],
        # the paper plots its Fig. 13 without figures: what stands beside ours is the bound
        comparisons=[
            Comparison(
                f"{'angle' if m.turn else 'distance'}, {m.axis}, RMS error", row["unit"], None, row["rms"], row["bound"]
            )
            for m, row in zip(found.moves, moves.rows, strict=True)
        ],
        statements=statements(found),
    )


def crlb(camera: Camera, target: Target, noise: float, psf_sigma: float) -> Callable[[Tensor, Tensor], Tensor]:
    """The Cramer-Rao bound as a function of poses, for frames of this noise (grey levels) and blur (px)."""
    return lambda r, t: pose_crlb(camera, target, r, t, psf_sigma=psf_sigma, noise_sigma=noise)


def static_table(found: Experiment) -> Table:
    rows: list[Row] = []
    static, limit = found.static, None if found.bound is None else found.bound.static
    for k, axis in enumerate(("x", "y", "z", "rx", "ry", "rz") if static else ()):
        assert static is not None
        name, scale = unit(AXES[k])
        spread, claimed = scale * float(static.spread[k]), scale * float(static.claimed[k])
        rows.append(
            {
                "axis": axis,
                "unit": name,
                "frames": len(static.deviation),
                "spread": spread,
                "worst": scale * float(static.deviation[:, k].abs().max()),
                "claimed": claimed,
                "bound": None if limit is None else scale * float(limit.claimed[k]),
                "spread_over_claimed": spread / claimed,
            }
        )
    return Table("static", "At rest: standard deviation along and about the camera's axes", rows)


def moves_table(found: Experiment) -> Table:
    rows: list[Row] = []
    for k, m in enumerate(found.moves):
        name, scale = unit(m.axis)
        rows.append(
            {
                "axis": m.axis,
                "unit": name,
                "frames": len(m.error),
                "mean": scale * float(m.error.mean()),
                "rms": scale * float(rms(m.error)),
                "worst": scale * float(m.error.abs().max()),
                "claimed": scale * float(rms(m.sigma)),
                "bound": None if found.bound is None else scale * float(rms(found.bound.moves[k].sigma)),
                "normalised": m.reduced_chi2,
                "scale_ppm": 1e6 * m.scale[0],
                "scale_sigma_ppm": 1e6 * m.scale[1],
            }
        )
    note = load_data("notes.yaml")[NAME]["moves"]
    return Table("moves", "Distance and angle from the origin against the robot's", rows, note)


def focal_table(found: Experiment) -> Table:
    reach = max((float(m.robot.abs().max()) for m in found.moves if m.axis == "z"), default=math.nan)
    rows: list[Row] = [
        {
            "focal_error_percent": 100 * relative,
            "error_of_z_um": 1e3 * abs(float(depth_focal_error(found.distance, 1.0, 1.0 + relative))),
            "error_of_longest_move_along_z_um": 1e3 * relative * reach,
        }
        for relative in FOCAL_ERRORS
    ]
    note = load_data("notes.yaml")[NAME]["focal"]
    return Table("focal", f"Influence of the focal length at {found.distance:.1f} mm, eq. (5)", rows, note)


def statements(found: Experiment) -> list[str]:
    said = []
    if found.static is not None:
        ratio = float((found.static.spread / found.static.claimed).square().mean().sqrt())
        said.append(f"At rest the frames spread {ratio:.2f} times what their poses claim (all six axes).")
    for name, turn in (("moves", False), ("turns", True)):
        group = [m for m in found.moves if m.turn == turn]
        count = sum(len(m.error) for m in group)
        if group:
            pooled = math.sqrt(sum(m.reduced_chi2 * len(m.error) for m in group) / count)
            known = f"known to {1 / math.sqrt(2 * count):.0%}"
            said.append(
                f"Errors of the {name} are {pooled:.2f} times what their poses claim, {count} frames ({known})."
            )
    if found.unused:
        said.append(f"{len(found.unused)} frames without a pose: {', '.join(found.unused[:5])}.")
    if found.emulated:
        said.append("The rig was emulated: no optics, no real motion.")
    return said


def captured(folder: Path, progress: Progress) -> Path:
    """Runs the plan on the twin; the manifest."""
    from torchpose.rig.capture import capture, image_origin
    from torchpose.rig.plan import load_plan
    from torchpose.rig.session import Session
    from torchpose.rig.settings import load_rig
    from torchpose.rig.twin.scene import running_twin

    rig, plan = load_rig(folder / "rig.yaml"), load_plan(folder / "plan.yaml")
    session = Session(folder / "run", plan=plan.digest, images=image_origin(rig))
    with session, running_twin(folder / "twin.yaml", rig, plan.origin) as twin:
        total = len(plan.waypoints)
        capture(plan, twin.rig, session, scene=twin.look, on_frame=lambda *_: progress(len(session.done) / total))
    return session.manifest


def estimated(manifest: Path, camera: Camera, target: Target) -> Path:
    """Poses of the captured frames, as ``torchpose estimate`` writes them; the table."""
    estimator = PoseEstimator(camera, target)
    names = [frame.image for frame in read_manifest(manifest)]
    rows: list[Row] = []
    for first in range(0, len(names), 6):
        some = names[first : first + 6]
        images = torch.stack([torch.from_numpy(decode(manifest.parent / name)) for name in some])
        rows += pose_rows(estimator(images), some, [target.name])
    path = manifest.parent / "poses.jsonl"
    write_rows(path, rows, POSE_SCHEMA)
    return path


def _sheet(manifest: Path) -> Figure:
    """Fig. 12: some of the frames."""
    names = [frame.image for frame in read_manifest(manifest)]
    shown = [names[round(k * (len(names) - 1) / 5)] for k in range(6)]
    return frames([(Path(name).stem, decode(manifest.parent / name)[::2, ::2]) for name in shown], 2, (13, 6))
