"""The paper's Figs. 10 and 11: errors of 875 simulated frames, with the camera known and a focal length 0.25 % wrong.

Every combination of -5, -2.5, 0, 2.5 and 5 degrees about each axis, at the origin and 10 mm off it along each axis, of
the target quad40 at 160 mm, 2 MP, PSF 0.7 px, noise of 2 grey levels. As bars stand beside the errors what the
estimates claim and the Cramer-Rao bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.analysis.evaluation import BOUND, Estimates, Evaluation, evaluate
from torchpose.camera import Camera
from torchpose.datasets.dataset import analytic, bounds, plan_truth, simulated_frames
from torchpose.datasets.plan import Plan, load_plan
from torchpose.io.truth import Truth
from torchpose.pipeline import PoseEstimator
from torchpose.report.evaluation import plot_consistency, plot_errors
from torchpose.report.figures import subplots
from torchpose.report.overlay import Overlay
from torchpose.results import Poses, Status
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, Value, ignore_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "fig11_simulation"
TITLE = "Figs. 10 and 11: poses of the simulated frames"
FOCAL_ERROR = 1.0025
# configs/plans/paper_grid.yaml, which an installed package does not have
PLAN = """
camera: camera.yaml
target: quad40
seed: 11
poses:
  grid:
    distance: 160
    angles_deg: [-5, -2.5, 0, 2.5, 5]
    positions: [[0, 0, 0], [10, 0, 0], [-10, 0, 0], [0, 10, 0], [0, -10, 0], [0, 0, 10], [0, 0, -10]]
imaging: {psf_sigma: 0.7, dark: 30, light: 220, plate: [70, 70], surround: 128}
sensor: {noise: 2, bits: 8}
"""
CAMERA = (1824, 1216, 1111.11)  # width, height, focal length, px
QUICK_FRAMES = 84
_BATCH = 6


def run(
    *,
    full: bool = False,
    seed: int = 0,
    progress: Progress = ignore_progress,
    frames: int | None = None,
    blender: int | None = None,
) -> StudyResult:
    """Renders and estimates the frames; errors, claims and bounds per axis.

    Args:
        frames: how many of the 875, drawn at random; by default all, or `QUICK_FRAMES` for a quick run.
        blender: every how many-th of the 875 frames is rendered with Blender as well (29: 31 frames); none by default.
    """
    plan = paper_plan()
    order = torch.randperm(len(plan), generator=torch.Generator().manual_seed(seed))
    some = order[: frames or (len(plan) if full else QUICK_FRAMES)].sort().values
    part = plan.rows(some)
    wrong = replace(plan.camera, matrix=plan.camera.matrix.clone())
    wrong.matrix[[0, 1], [0, 1]] *= FOCAL_ERROR  # the principal point stays
    truth = plan_truth(part)
    estimators = [PoseEstimator(plan.camera, plan.target), PoseEstimator(wrong, plan.target)]
    limits: list[Tensor] = []
    poses: list[list[Poses]] = [[], []]
    for which in _batches(len(part)):
        images = simulated_frames(part, analytic(part), which)
        limits.append(bounds(part, which))
        for estimator, found in zip(estimators, poses, strict=True):
            found.append(estimator(images))
        progress(float(which[-1] + 1) / len(part) * (0.6 if blender else 0.95))
    truth.extra.update(zip(BOUND, torch.cat(limits).T, strict=True))
    results = {
        "analytic": evaluate(_estimates(poses[0]), truth),
        "analytic, focal length 0.25 % too long": evaluate(_estimates(poses[1]), truth),
    }
    if blender:
        results["Blender"] = _by_blender(plan.rows(torch.arange(0, len(plan), blender)))
    rows = [row for name, result in results.items() for row in _rows(name, result)]
    pictures = [
        picture
        for name, result in results.items()
        for picture in (
            Picture(f"{_stem(name)}_errors", f"Errors, {name}", plot_errors(result, name)),
            Picture(f"{_stem(name)}_consistency", f"Errors and claims, {name}", plot_consistency(result, name)),
        )
    ]
    known, mistaken = list(results.values())[:2]
    return StudyResult(
        tables=[Table("fig11", "Errors per axis: estimate - truth, frames with the status ok", rows)],
        pictures=[
            Picture("fig10", "Fig. 10: a frame, what was found in it, and some of the set", _frames(plan)),
            *pictures,
        ],
        comparisons=[Comparison(f"{a.axis}, RMS error", a.unit, None, a.rms, a.bound) for a in known.axes],
        statements=[
            f"{known.counts['ok']} of {len(part)} frames are ok; mean NEES {known.nees:.2f} "
            f"({known.nees_interval[0]:.2f} to {known.nees_interval[1]:.2f} where the covariances are right).",
            f"A focal length 0.25 % too long shifts the depth by {mistaken.axes[2].bias:.0f} um at 160 mm; eq. (5): "
            f"{160e3 * (FOCAL_ERROR - 1):.0f} um.",
            "The paper prints its Fig. 11 as a plot without figures, so that there is none to stand beside ours.",
        ],
        settings={
            "frames": len(part),
            "noise": 2,
            "psf_sigma_px": 0.7,
            "blender_frames": len(plan) // blender if blender else 0,
        },
    )


def paper_plan() -> Plan:
    """The 875 frames of the paper."""
    with TemporaryDirectory() as folder:
        Camera.ideal(*CAMERA).save(Path(folder) / "camera.yaml")
        (Path(folder) / "plan.yaml").write_text(PLAN, encoding="utf-8")
        return load_plan(Path(folder) / "plan.yaml")


def _batches(count: int) -> Iterator[Tensor]:
    yield from torch.arange(count).split(_BATCH)


def _estimates(parts: list[Poses]) -> Estimates:
    def joined(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    status = [Status(code).name.lower() for code in joined("status").tolist()]
    return Estimates(status, joined("R"), joined("t"), joined("covariance"), full_covariance=True)


def _by_blender(plan: Plan) -> Evaluation:
    from torchpose.datasets.blender import blender

    renderer, estimator = blender(plan), PoseEstimator(plan.camera, plan.target)
    truth: Truth = plan_truth(plan)
    truth.extra.update(zip(BOUND, bounds(plan, torch.arange(len(plan))).T, strict=True))
    found = [estimator(simulated_frames(plan, renderer, which)) for which in _batches(len(plan))]
    return evaluate(_estimates(found), truth)


def _rows(name: str, result: Evaluation) -> list[dict[str, Value]]:
    return [
        {
            "frames": name, "axis": a.axis, "unit": a.unit, "bias": a.bias, "spread": a.spread, "rms": a.rms,
            "largest": a.worst, "claimed_sigma": a.predicted, "bound_sigma": a.bound, "nees": result.nees,
            "ok": result.counts["ok"], "of": sum(result.counts.values()),
        }
        for a in result.axes
    ]  # fmt: skip


def _stem(name: str) -> str:
    return name.split(",")[0].lower() + ("_wrong_focal" if "focal" in name else "")


def _frames(plan: Plan) -> Figure:
    """Fig. 10: a rendered frame, the same processed, and a sheet of others."""
    which = torch.tensor([0, 124, 186, 310, 372, 496, 558, 682, 744, 868])
    frames = simulated_frames(plan, analytic(plan), which)
    estimator = PoseEstimator(plan.camera, plan.target)
    with TemporaryDirectory() as folder:
        drawn = Overlay(plan.camera, [plan.target], Path(folder)).draw(frames[0], estimator(frames[:1]), "frame 0")
    height, width = 152, 228
    tiles = [cv2.resize(frame.numpy(), (width, height), interpolation=cv2.INTER_AREA) for frame in frames[1:]]
    sheet = (
        torch.from_numpy(np.stack(tiles)).view(3, 3, height, width).permute(0, 2, 1, 3).reshape(3 * height, 3 * width)
    )
    figure, (panels,) = subplots(1, 3, (15, 3.8))
    for panel, picture, title in zip(
        panels,
        (frames[0].numpy(), cv2.cvtColor(drawn, cv2.COLOR_BGR2RGB), sheet.numpy()),
        ("(a) rendered", "(b) processed", "(c) of the test set"),
        strict=True,
    ):
        panel.imshow(picture, cmap="gray", vmin=0, vmax=255)
        panel.set_title(title)
        panel.set_axis_off()
    return figure
