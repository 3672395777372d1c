"""The paper's experiment (Algorithm 2, Figs. 12 and 13), here on the digital twin of its rig.

The twin speaks the robot's wire protocol to ur-rtde and shows rendered frames to the emulated Basler camera, so all of
the capture runs but optics and real motion. Its robot is exact: what is left is the error of the pose estimation.
``claimed``: from the poses' covariances; ``bound``: Cramer-Rao; ``normalised``: reduced chi-squared of the errors, 1
where the claim is right and the robot exact; ``scale``: how much longer the camera sees the moves along an axis.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import torch
from torch import Tensor

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
from torchpose.report.figures import subplots
from torchpose.rig.experiment import AXES, Experiment, Moves, evaluate_experiment, unit
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, Value, ignore_progress
from torchpose.target import Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "fig13_experiment"
TITLE = "Figs. 12 and 13: the experiment, on the digital twin"
FOCAL_ERRORS = (0.0001, 0.0005, 0.0025)  # relative; the last is the paper's
NOISE, PSF_SIGMA = 1.0, 0.7
TARGET = "quad40"
CAMERA = (1824, 1216, 1111.11)  # width, height, focal length, px
HOST = "127.0.0.31"  # of the twin: not that of configs/rig, which may be running
RIG = """
robot:
  host: 192.168.0.10
  tcp: [0.0, 0.0, 60.0, 0.0, 0.0, 0.0]
  workspace: {min: [320.0, -80.0, 230.0], max: [480.0, 80.0, 340.0]}
  speed_mm_s: 100
  acceleration_mm_s2: 200
cameras:
  - {name: camera, width: 1824, height: 1216, pixel_format: Mono8, exposure_us: 10000}
dwell_s: 0.02
"""
TWIN = f"""
host: {HOST}
robot: {{repeatability_mm: 0.0, repeatability_deg: 0.0, reading_noise_mm: 0.0}}
cameras:
  - name: camera
    camera: camera.yaml
    base_from_camera: {{rotation: [0.012, -0.008, 0.02], translation: [401.5, -2.3, 138.0]}}
target: {TARGET}
tool_from_target: {{rotation: [3.141592653589793, 0.0, 0.0], translation: [0.3, -0.2, 0.4]}}
imaging: {{psf_sigma: {PSF_SIGMA}, dark: 30, light: 220, surround: 110, plate: [70, 70], noise: {NOISE}}}
"""
PLAN = """
name: paper_experiment
origin: {{translation: [400.0, 0.0, 300.0], rotation: [3.141592653589793, 0.0, 0.0]}}
axes: base
steps:
  - static: {{repeats: {repeats}}}
  - translation: {{values_mm: [1, 2, 3, 4, 5]}}
  - rotation: {{values_deg: {degrees}}}
"""


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Captures the experiment on the twin and evaluates it; ``full``: with every angle and twice the static frames.

    Raises:
        ConfigError: pypylon or ur-rtde is not installed, or another twin runs.
    """
    for module, package in (("pypylon", "pypylon"), ("rtde_control", "ur-rtde")):
        if importlib.util.find_spec(module) is None:
            raise ConfigError(f"{package}: package: is not installed; pip install 'torchpose[rig]'")
    degrees = [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5] if full else [-5, -2.5, 2.5, 5]
    with TemporaryDirectory(prefix="torchpose-experiment-") as place:
        folder = Path(place)
        camera = Camera.ideal(*CAMERA)
        camera.save(folder / "camera.yaml")
        for name, text in (
            ("rig.yaml", RIG),
            ("twin.yaml", f"{TWIN}seed: {seed}\n"),
            ("plan.yaml", PLAN.format(repeats=20 if full else 10, degrees=degrees)),
        ):
            (folder / name).write_text(text, encoding="utf-8")
        manifest = _capture(folder, lambda done: progress(0.8 * done))
        poses = _estimate(manifest, camera)
        bound = crlb(camera, Target.load(TARGET), NOISE, PSF_SIGMA)
        result = evaluated(manifest, poses, bound)
        result.pictures.insert(0, Picture("fig12", "Fig. 12: frames of the experiment", _sheet(manifest)))
        result.settings = {"noise": NOISE, "psf_sigma_px": PSF_SIGMA, "frames": len(read_manifest(manifest))}
    return result


def evaluated(manifest: Path, poses: Path, bound: Callable[[Tensor, Tensor], Tensor] | None = None) -> StudyResult:
    """Tables, plot and statements of an experiment; arguments as of `evaluate_experiment`."""
    e = evaluate_experiment(manifest, poses, bound)
    return StudyResult(
        tables=[table for table in (static_table(e), moves_table(e), focal_table(e)) if table.rows],
        pictures=[Picture("fig13", "Fig. 13: the experiment", plot_experiment(e, "Experiment"))],
        comparisons=_comparisons(e),
        statements=statements(e),
    )


def crlb(camera: Camera, target: Target, noise: float, psf_sigma: float) -> Callable[[Tensor, Tensor], Tensor]:
    """The Cramer-Rao bound as a function of poses, for frames of this noise (grey levels) and blur (px)."""
    return lambda r, t: pose_crlb(camera, target, r, t, psf_sigma=psf_sigma, noise_sigma=noise)


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
                "spread_over_claimed": spread / claimed,
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
                "rms": scale * rms(m.error),
                "worst": scale * float(m.error.abs().max()),
                "claimed": scale * rms(m.sigma),
                "bound": bound,
                "normalised": m.reduced_chi2,
                "scale_ppm": 1e6 * m.scale[0],
                "scale_sigma_ppm": 1e6 * m.scale[1],
            }
        )
    note = "camera - robot; the errors of an axis share the noise of its origin frame, which `normalised` allows for"
    return Table("moves", "Distance and angle from the origin against the robot's", rows, note)


def focal_table(e: Experiment) -> Table:
    reach = max((float(m.robot.abs().max()) for m in e.moves if m.axis == "z"), default=math.nan)
    rows: list[dict[str, Value]] = [
        {
            "focal_error_percent": 100 * relative,
            "error_of_z_um": 1e3 * abs(float(depth_focal_error(e.distance, 1.0, 1.0 + relative))),
            "error_of_longest_move_along_z_um": 1e3 * relative * reach,
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


def _comparisons(e: Experiment) -> list[Comparison]:
    """The paper plots its Fig. 13 without figures: what stands beside ours is the bound."""
    rows = []
    for k, m in enumerate(e.moves):
        name, scale = unit(m.axis)
        bound = None if e.bound is None else scale * rms(e.bound.moves[k].sigma)
        rows.append(Comparison(f"{'angle' if m.turn else 'distance'}, {m.axis}, RMS error", name, None,
                               scale * rms(m.error), bound))  # fmt: skip
    return rows


def _capture(folder: Path, progress: Progress) -> Path:
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


def _estimate(manifest: Path, camera: Camera) -> Path:
    """Poses of the captured frames, as ``torchpose estimate`` writes them; the table."""
    estimator = PoseEstimator(camera, Target.load(TARGET))
    names = [frame.image for frame in read_manifest(manifest)]
    rows: list[Row] = []
    for first in range(0, len(names), 6):
        some = names[first : first + 6]
        frames = torch.stack([torch.from_numpy(decode(manifest.parent / name)) for name in some])
        rows += pose_rows(estimator(frames), some, [TARGET])
    path = manifest.parent / "poses.jsonl"
    write_rows(path, rows, POSE_SCHEMA)
    return path


def _sheet(manifest: Path) -> Figure:
    """Fig. 12: some of the frames."""
    names = [frame.image for frame in read_manifest(manifest)]
    shown = [names[round(k * (len(names) - 1) / 5)] for k in range(6)]
    figure, panels = subplots(2, 3, (13, 6))
    for panel, name in zip(panels.flat, shown, strict=True):
        panel.imshow(decode(manifest.parent / name)[::2, ::2], cmap="gray", vmin=0, vmax=255)
        panel.set_title(Path(name).stem)
        panel.set_axis_off()
    return figure
