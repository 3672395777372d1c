"""The paper's Fig. 4: position errors of an 8 mm target against the distance, by pixel noise and a wrong focal length.

The centres of the four markers are projected, noise is added, and `torchpose.pnp.solve` finds the pose; every draw
has Gaussian noise of 0.2 or 1 px on each coordinate. With focal error the lens has 8.02 mm and the solver 8 mm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from torchpose.analysis.evaluation import AXES, SCALE, UNITS
from torchpose.analysis.sensitivity import Uncertainty
from torchpose.analysis.sweep import Sweep, Swept, fit, sweep
from torchpose.camera import Camera
from torchpose.io.rows import Row
from torchpose.report.sensitivity import POWERS, plot_budget, plot_sweeps
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
    distance = torch.linspace(*DISTANCES_MM, 41 if full else 11, dtype=torch.float64)
    draws = 2000 if full else 300
    target = Target.load("quad8")
    cases: dict[str, Sweep] = {}
    plans = cases_of(SIGMAS_PX, Uncertainty(focal_length=FOCAL_ERROR))
    for title, plan in plans.items():
        cases[title] = sweep(paper_camera(), target, distance, plan, draws=draws, seed=seed)
        progress(len(cases) / len(plans))
    result = tabulate(cases)
    weak, strong, wrong = cases.values()
    result.comparisons = _comparisons(weak, strong, wrong)
    result.statements = _statements(weak, wrong, draws)
    result.settings = {"draws": draws, "distances": len(distance), "focal_error": FOCAL_ERROR, "target": target.name}
    return result


def cases_of(sigmas_px: Sequence[float], uncertainty: Uncertainty) -> dict[str, Uncertainty]:
    """By title: each image noise alone, and the first of them with all other uncertainties.

    Swept with one seed they have the same random numbers, so that their differences are those of the cases.
    """
    cases = {f"{sigma:g} px": Uncertainty(image=sigma) for sigma in sigmas_px}
    words = [
        f"focal length {100 * value:.3g} %" if name == "focal_length" else name.replace("_", " ")
        for name, value in vars(uncertainty).items()
        if name != "image" and (any(value) if isinstance(value, tuple) else value)
    ]
    if words:
        cases[f"{sigmas_px[0]:g} px, {', '.join(words)}"] = replace(uncertainty, image=sigmas_px[0])
    return cases


def tabulate(cases: Mapping[str, Sweep], rings: Mapping[str, Swept] | None = None) -> StudyResult:
    """Tables and pictures of the sweeps by title, and of predictions for poses from edges of rings."""
    rings = rings or {}
    title, last = list(cases.items())[-1]
    return StudyResult(
        tables=[
            Table("errors", "Errors against the distance", _errors(cases)),
            Table("budget", "Standard deviations by source", _budget({**cases, **rings})),
        ],
        pictures=[
            Picture(
                "errors", "Largest and root mean square errors of the draws, and the prediction", plot_sweeps(cases)
            ),
            Picture("budget", "Error budget of the last case", plot_budget(last, title)),
            *(Picture("budget_rings", "Error budget of edges", plot_budget(one, name)) for name, one in rings.items()),
        ],
    )


def _errors(cases: Mapping[str, Sweep]) -> list[Row]:
    rows: list[Row] = []
    for title, case in cases.items():
        lines = {i: fit(case.distance, case.largest[:, i], POWERS[AXES[i]]) for i in range(3)}
        paper = (case.lateral, case.lateral, case.depth + case.depth_focal)
        for k, distance in enumerate(case.distance.tolist()):
            for i, (axis, unit, scale) in enumerate(zip(AXES, UNITS, SCALE.tolist(), strict=True)):
                values = {
                    "paper_equations": paper[i][k] if i < 3 else None,
                    "predicted_rms": case.budget.std()[k, i],
                    "rms": case.rms[k, i],
                    "largest": case.largest[k, i],
                    "line_through_largest": lines[i][k] if i < 3 else None,
                }
                numbers = {name: None if v is None else scale * float(v) for name, v in values.items()}
                rows.append({"case": title, "distance_mm": distance, "axis": axis, "unit": unit, **numbers})
    return rows


def _budget(cases: Mapping[str, Swept]) -> list[Row]:
    columns = [f"{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True)]
    return [
        {"case": title, "distance_mm": distance, "source": source}
        | dict(zip(columns, (SCALE * case.budget.std(None if source == "total" else source)[k]).tolist(), strict=True))
        for title, case in cases.items()
        for k, distance in enumerate(case.distance.tolist())
        for source in (*case.budget.sources, "total")
    ]


def exponent(case: Sweep, axis: int) -> float:
    """Slope of log(rms) over log(distance)."""
    x, y = case.distance.log(), case.rms[:, axis].log()
    return float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())


def _comparisons(weak: Sweep, strong: Sweep, wrong: Sweep) -> list[Comparison]:
    at = f"at {float(weak.distance[-1]):g} mm"
    rows = [
        Comparison(
            f"{'xyz'[axis]}, {sigma:g} px, {at}, rms; paper: eq. ({equation})",
            "um",
            1e3 * float(getattr(case, paper)[-1]),
            1e3 * float(case.rms[-1, axis]),
            1e3 * float(case.budget.std("image")[-1, axis]),
        )
        for axis, equation, paper in ((0, 3, "lateral"), (2, 2, "depth"))
        for sigma, case in zip(SIGMAS_PX, (weak, strong), strict=True)
    ]
    focal = 1e3 * float(wrong.depth[-1] + wrong.depth_focal[-1])
    name = f"z, 0.2 px and 8.02 mm, largest {at}; paper: eq. (2) + (5)"
    return [
        *rows,
        Comparison(name, "um", focal, 1e3 * float(wrong.largest[-1, 2])),
        Comparison("growth of x, power of the distance", "", "linear", exponent(weak, 0)),
        Comparison("growth of z, power of the distance", "", "quadratic", exponent(weak, 2)),
    ]


def _statements(weak: Sweep, wrong: Sweep, draws: int) -> list[str]:
    together = (wrong.depth + wrong.depth_focal)[-1]
    return [
        f"Without focal error x grows as the distance to the power {exponent(weak, 0):.2f} and z as "
        f"{exponent(weak, 2):.2f}; the paper says linear and quadratic.",
        f"The standard deviation of z is {float((weak.rms[:, 2] / weak.depth).mean()):.2f} of eq. (2), that of x "
        f"{float((weak.rms[:, 0] / weak.lateral).mean()):.2f} of eq. (3). The equations take one length and an error "
        "of exactly that size; a pose averages four markers with two coordinates each: face on sqrt(1/2) of eq. (2). x "
        "is worse than the average of four, because a small turn of the plane moves its image sideways almost alike.",
        f"The largest of {draws} errors is {float((weak.largest[:, 2] / weak.rms[:, 2]).mean()):.1f} standard "
        "deviations in the mean: what is called the largest error depends on the number of draws.",
        f"With the focal error, the largest error of z at {float(wrong.distance[-1]):g} mm is "
        f"{1e3 * float(wrong.largest[-1, 2]):.0f} um; the sum of eq. (2) and (5) is {1e3 * float(together):.0f} um, "
        f"of which {1e3 * float(wrong.depth_focal[-1]):.0f} um are focal. The focal error changes the rms of x by "
        f"{100 * float((wrong.rms[-1, 0] / weak.rms[-1, 0] - 1).abs()):.2f} %.",
    ]
