"""The paper's Fig. 4: position errors of an 8 mm target against the distance, by pixel noise and a wrong focal length.

The centres of the four markers are projected, noise is added, and `torchpose.pnp.solve` finds the pose; every draw
has Gaussian noise of 0.2 or 1 px on each coordinate. With focal error the lens has 8.02 mm and the solver 8 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpose.analysis.sensitivity import Uncertainty
from torchpose.analysis.sweep import Sweep, fit, sweep
from torchpose.camera import Camera
from torchpose.report.sensitivity import AXES, POWERS, SCALE, UNITS, plot_budget, plot_sweeps
from torchpose.studies.study import Comparison, Picture, Progress, StudyResult, Table, ignore_progress
from torchpose.target import Target

NAME = "fig04_sensitivity"
TITLE = "Fig. 4: position errors against the distance"
PITCH_MM, FOCAL_MM, TRUE_FOCAL_MM = 2.4e-3, 8.0, 8.02
FOCAL_ERROR = TRUE_FOCAL_MM / FOCAL_MM - 1
SIGMAS_PX = (0.2, 1.0)
DISTANCES_MM = (12.0, 32.0)


def paper_camera() -> Camera:
    """Basler acA5472-17um, 2.4 um pixels, with an 8 mm lens without distortion."""
    return Camera.ideal(5472, 3648, FOCAL_MM / PITCH_MM)


def run(*, full: bool = False, seed: int = 0, progress: Progress = ignore_progress) -> StudyResult:
    """Fig. 4 (a), (b) and (c): 0.2 px, 1 px, and 0.2 px with the focal length wrong by 0.25 %."""
    near, far = DISTANCES_MM
    distance = torch.linspace(near, far, 41 if full else 11, dtype=torch.float64)
    draws = 2000 if full else 300
    target = Target.load("quad8")
    size = Uncertainty(focal_length=FOCAL_ERROR)
    cases = simulate(paper_camera(), target, distance, SIGMAS_PX, size, draws=draws, seed=seed, progress=progress)
    result = tabulate(cases)
    a, b, c = cases.values()
    result.comparisons = _comparisons(a, b, c)
    result.statements = _statements(a, c, draws)
    result.settings = {"draws": draws, "distances": len(distance), "focal_error": FOCAL_ERROR, "target": target.name}
    return result


def simulate(
    camera: Camera,
    target: Target,
    distance: Tensor,
    sigmas_px: Sequence[float],
    uncertainty: Uncertainty,
    *,
    tilt: float = 0.0,
    draws: int,
    seed: int,
    progress: Progress = ignore_progress,
) -> dict[str, Sweep]:
    """One sweep for each image noise alone, and one with the first of them and all other uncertainties.

    All have the same random numbers, so that their differences are those of the cases.
    """
    plans = {f"{sigma:g} px": Uncertainty(image=sigma) for sigma in sigmas_px}
    others = {name: getattr(uncertainty, name) for name in vars(uncertainty) if name != "image"}
    if any(any(v) if isinstance(v, tuple) else v for v in others.values()):
        words = [
            f"focal length {100 * value:.3g} %" if name == "focal_length" else name.replace("_", " ")
            for name, value in others.items()
            if (any(value) if isinstance(value, tuple) else value)
        ]
        plans[f"{sigmas_px[0]:g} px, {', '.join(words)}"] = replace(uncertainty, image=sigmas_px[0])
    cases = {}
    for k, (title, plan) in enumerate(plans.items()):
        cases[title] = sweep(camera, target, distance, plan, tilt=tilt, draws=draws, seed=seed)
        progress((k + 1) / len(plans))
    return cases


def tabulate(cases: dict[str, Sweep]) -> StudyResult:
    """Tables and pictures of the sweeps by title."""
    title, last = list(cases.items())[-1]
    return StudyResult(
        tables=[
            Table("errors", "Errors against the distance", _errors(cases)),
            Table("budget", "Standard deviations by source", _budget(cases)),
        ],
        pictures=[
            Picture(
                "errors", "Largest and root mean square errors of the draws, and the prediction", plot_sweeps(cases)
            ),
            Picture("budget", "Error budget of the last case", plot_budget(last, title)),
        ],
    )


def _errors(cases: dict[str, Sweep]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for title, s in cases.items():
        lines = {i: fit(s.distance, s.largest[:, i], POWERS[AXES[i]]) for i in range(3)}
        paper = (s.lateral, s.lateral, s.depth + s.depth_focal)
        for k, d in enumerate(s.distance.tolist()):
            for i, axis in enumerate(AXES):
                values = {
                    "paper_equations": paper[i][k] if i < 3 else None,
                    "predicted_rms": s.budget.std()[k, i],
                    "rms": s.rms[k, i],
                    "largest": s.largest[k, i],
                    "line_through_largest": lines[i][k] if i < 3 else None,
                }
                numbers = {name: None if v is None else SCALE[i] * float(v) for name, v in values.items()}
                rows.append({"case": title, "distance_mm": d, "axis": axis, "unit": UNITS[i], **numbers})
    return rows


def _budget(cases: dict[str, Sweep]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for title, s in cases.items():
        for k, d in enumerate(s.distance.tolist()):
            for source in [*s.budget.sources, "total"]:
                std = s.budget.std(None if source == "total" else source)[k].tolist()
                numbers = {f"{a}_{u}": f * v for a, u, f, v in zip(AXES, UNITS, SCALE, std, strict=True)}
                rows.append({"case": title, "distance_mm": d, "source": source, **numbers})
    return rows


def exponent(s: Sweep, axis: int) -> float:
    """Slope of log(rms) over log(distance)."""
    x, y = s.distance.log(), s.rms[:, axis].log()
    return float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())


def _comparisons(a: Sweep, b: Sweep, c: Sweep) -> list[Comparison]:
    lateral = [1e3 * float(s.rms[-1, 0]) for s in (a, b)]
    depth = [1e3 * float(s.rms[-1, 2]) for s in (a, b, c)]
    bound = [1e3 * float(s.budget.std("image")[-1, i]) for s, i in ((a, 0), (b, 0), (a, 2), (b, 2))]
    at = f"at {float(a.distance[-1]):g} mm, rms"
    return [
        Comparison(f"x, 0.2 px, {at}; paper: eq. (3)", "um", 1e3 * float(a.lateral[-1]), lateral[0], bound[0]),
        Comparison(f"x, 1 px, {at}; paper: eq. (3)", "um", 1e3 * float(b.lateral[-1]), lateral[1], bound[1]),
        Comparison(f"z, 0.2 px, {at}; paper: eq. (2)", "um", 1e3 * float(a.depth[-1]), depth[0], bound[2]),
        Comparison(f"z, 1 px, {at}; paper: eq. (2)", "um", 1e3 * float(b.depth[-1]), depth[1], bound[3]),
        Comparison(
            f"z, 0.2 px and 8.02 mm, largest {at.split(',')[0]}; paper: eq. (2) + (5)",
            "um",
            1e3 * float(c.depth[-1] + c.depth_focal[-1]),
            1e3 * float(c.largest[-1, 2]),
        ),
        Comparison("growth of x, power of the distance", "", "linear", exponent(a, 0)),
        Comparison("growth of z, power of the distance", "", "quadratic", exponent(a, 2)),
    ]


def _statements(a: Sweep, c: Sweep, draws: int) -> list[str]:
    together = (c.depth + c.depth_focal)[-1]
    return [
        f"Without focal error x grows as the distance to the power {exponent(a, 0):.2f} and z as {exponent(a, 2):.2f}; "
        "the paper says linear and quadratic.",
        f"The standard deviation of z is {float((a.rms[:, 2] / a.depth).mean()):.2f} of eq. (2), that of x "
        f"{float((a.rms[:, 0] / a.lateral).mean()):.2f} of eq. (3). The equations take one length and an error of "
        "exactly that size; a pose averages four markers with two coordinates each: face on sqrt(1/2) of eq. (2). x is "
        "worse than the average of four, because a small turn of the plane moves its image sideways almost alike.",
        f"The largest of {draws} errors is {float((a.largest[:, 2] / a.rms[:, 2]).mean()):.1f} standard deviations in "
        "the mean: what is called the largest error depends on the number of draws.",
        f"With the focal error, the largest error of z at {float(c.distance[-1]):g} mm is "
        f"{1e3 * float(c.largest[-1, 2]):.0f} um; the sum of eq. (2) and (5) is {1e3 * float(together):.0f} um, "
        f"of which {1e3 * float(c.depth_focal[-1]):.0f} um are focal. The focal error changes the rms of x by "
        f"{100 * float((c.rms[-1, 0] / a.rms[-1, 0] - 1).abs()):.2f} %.",
    ]
