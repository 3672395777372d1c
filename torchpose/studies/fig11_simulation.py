"""The paper's Figs. 10 and 11: errors of 875 simulated frames, with the camera known and a focal length 0.25 % wrong.

Every combination of -5, -2.5, 0, 2.5 and 5 degrees about each axis, at the origin and 10 mm off it along each axis, of
the target quad40 at 160 mm, 2 MP, PSF 0.7 px, noise of 2 grey levels. As bars stand beside the errors what the
estimates claim and the Cramer-Rao bound.
"""

from dataclasses import astuple, replace

import cv2
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.analysis.evaluation import BOUND, Estimates, Evaluation, evaluate
from torchpose.camera import Camera
from torchpose.datasets.dataset import Renderer, analytic, bounds, plan_truth, simulated_frames
from torchpose.datasets.plan import Plan, load_plan
from torchpose.io.rows import Row
from torchpose.pipeline import PoseEstimator
from torchpose.report.evaluation import plot_consistency, plot_errors
from torchpose.report.figures import frames as sheet_of
from torchpose.report.overlay import Overlay
from torchpose.results import Poses, Status
from torchpose.studies.study import DATA, Comparison, Picture, Progress, StudyResult, Table, ignore_progress

NAME = "fig11_simulation"
TITLE = "Figs. 10 and 11: poses of the simulated frames"
FOCAL_ERROR = 1.0025
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
    part = plan[order[: frames or (len(plan) if full else QUICK_FRAMES)].sort().values]
    wrong = replace(plan.camera, matrix=plan.camera.matrix.clone())
    wrong.matrix[[0, 1], [0, 1]] *= FOCAL_ERROR  # the principal point stays
    share, rendered = (0.6, len(plan) // blender) if blender else (0.95, 0)
    known, mistaken = _evaluated(part, analytic(part), [plan.camera, wrong], lambda done: progress(share * done))
    results = {"analytic": known, "analytic, focal length 0.25 % too long": mistaken}
    if blender:
        from torchpose.datasets.blender import blender as render

        some = plan[torch.arange(0, len(plan), blender)]
        (results["Blender"],) = _evaluated(some, render(some), [plan.camera], ignore_progress)
    pictures = [Picture("fig10", "Fig. 10: a frame, what was found in it, and some of the set", _frames(plan))]
    for name, result in results.items():
        stem = name.split(",")[0].lower() + ("_wrong_focal" if "focal" in name else "")
        pictures.append(Picture(f"{stem}_errors", f"Errors, {name}", plot_errors(result, name)))
        pictures.append(Picture(f"{stem}_consistency", f"Errors and claims, {name}", plot_consistency(result, name)))
    rows = [row for name, result in results.items() for row in _rows(name, result)]
    return StudyResult(
        tables=[Table("fig11", "Errors per axis: estimate - truth, frames with the status ok", rows)],
        pictures=pictures,
        comparisons=[Comparison(f"{a.axis}, RMS error", a.unit, None, a.rms, a.bound) for a in known.axes],
        statements=_statements(known, mistaken, len(part)),
        settings={"frames": len(part), "noise": 2, "psf_sigma_px": 0.7, "blender_frames": rendered},
    )


def paper_plan() -> Plan:
    """The 875 frames of the paper: configs/plans/paper_grid.yaml, which an installed package does not have."""
    return load_plan(DATA / "paper_grid.yaml")


def _evaluated(plan: Plan, renderer: Renderer, cameras: list[Camera], progress: Progress) -> list[Evaluation]:
    """Errors of the plan's frames as estimated with each of the cameras."""
    estimators = [PoseEstimator(camera, plan.target) for camera in cameras]
    limits: list[Tensor] = []
    poses: list[list[Poses]] = [[] for _ in cameras]
    for which in torch.arange(len(plan)).split(_BATCH):
        images = simulated_frames(plan, renderer, which)
        limits.append(bounds(plan, which))
        for estimator, found in zip(estimators, poses, strict=True):
            found.append(estimator(images))
        progress(float(which[-1] + 1) / len(plan))
    truth = plan_truth(plan)
    truth.extra.update(zip(BOUND, torch.cat(limits).T, strict=True))
    return [evaluate(_estimates(found), truth) for found in poses]


def _estimates(parts: list[Poses]) -> Estimates:
    status, R, t, covariance = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("status", "R", "t", "covariance")
    )
    words = [Status(code).name.lower() for code in status.tolist()]
    return Estimates(words, R, t, covariance, full_covariance=True)


def _statements(known: Evaluation, mistaken: Evaluation, count: int) -> list[str]:
    return [
        f"{known.counts['ok']} of {count} frames are ok; mean NEES {known.nees:.2f} "
        f"({known.nees_interval[0]:.2f} to {known.nees_interval[1]:.2f} where the covariances are right).",
        f"A focal length 0.25 % too long shifts the depth by {mistaken.axes[2].bias:.0f} um at 160 mm; eq. (5): "
        f"{160e3 * (FOCAL_ERROR - 1):.0f} um.",
        "The paper prints its Fig. 11 as a plot without figures, so that there is none to stand beside ours.",
    ]


def _rows(name: str, result: Evaluation) -> list[Row]:
    columns = ("axis", "unit", "bias", "spread", "rms", "largest", "claimed_sigma", "bound_sigma")
    totals = {"nees": result.nees, "ok": result.counts["ok"], "of": sum(result.counts.values())}
    return [{"frames": name} | dict(zip(columns, astuple(axis), strict=True)) | totals for axis in result.axes]


def _frames(plan: Plan) -> Figure:
    """Fig. 10: a rendered frame, the same processed, and a sheet of others."""
    which = torch.tensor([0, 124, 186, 310, 372, 496, 558, 682, 744, 868])
    first, *others = simulated_frames(plan, analytic(plan), which)
    poses = PoseEstimator(plan.camera, plan.target)(first[None])
    drawn = Overlay(plan.camera, [plan.target]).draw(first, poses, "frame 0")
    tiles = [cv2.resize(frame.numpy(), (228, 152), interpolation=cv2.INTER_AREA) for frame in others]
    sheet = cv2.vconcat([cv2.hconcat(tiles[k : k + 3]) for k in (0, 3, 6)])
    titles = ("(a) rendered", "(b) processed", "(c) of the test set")
    pictures = (first.numpy(), cv2.cvtColor(drawn, cv2.COLOR_BGR2RGB), sheet)
    return sheet_of(list(zip(titles, pictures, strict=True)), 1, (15, 3.8))
