"""Plots of an evaluation: errors per frame, their distribution, and whether the claimed uncertainty holds."""

import math
from pathlib import Path

import torch
from matplotlib.figure import Figure

from torchpose.analysis.evaluation import AXES, UNITS, Evaluation
from torchpose.io.truth import Truth
from torchpose.report.figures import COLOURS, GREY, band, legend_below, subplots
from torchpose.report.files import make_folder, save_figures

_MOST_NEES = 25.0  # shown; larger ones in the last bin
_MOST_BAND = 20.0  # median deviations that a panel makes room for; what one row claims beyond is cut


def plot_errors(evaluation: Evaluation, title: str) -> Figure:
    """Errors of the six axes over the frames, with the bands that the estimates claim (as Fig. 11 of the paper)."""
    figure, axes = subplots(2, 3, (13, 6), sharex=True)
    number = torch.arange(len(evaluation.error))
    for i, panel in enumerate(axes.flat):
        error, claimed = evaluation.error[:, i], evaluation.predicted[:, i]
        band(panel, number, 2 * claimed)
        if bool(evaluation.bound[:, i].isfinite().any()):
            for sign in (-2, 2):
                panel.plot(number, sign * evaluation.bound[:, i], color=GREY, lw=0.6, ls="--")
        panel.plot(number, error, ".", ms=3, color=COLOURS[i % 3])
        axis = evaluation.axes[i]
        band_shown = min(2 * _largest(claimed), _MOST_BAND * _largest(claimed.nanmedian()[None]))
        limit = 1.1 * max(_largest(error), band_shown)
        panel.set(ylabel=f"error of {AXES[i]} [{UNITS[i]}]", ylim=(-limit, limit))
        panel.set_title(f"{AXES[i]}: bias {axis.bias:.3g}, spread {axis.spread:.3g} {UNITS[i]}", fontsize=10)
        panel.axhline(0, color=GREY, lw=0.6)
    for panel in axes[1]:
        panel.set_xlabel("frame")
    figure.suptitle(
        f"{title}: estimate - truth; band: 2 sigma claimed, dashed: 2 sigma of the Cramer-Rao bound", fontsize=11
    )
    return figure


def plot_consistency(evaluation: Evaluation, title: str) -> Figure:
    """Distributions of the errors in their own sigmas and of the NEES, beside what they should be."""
    figure, (axes,) = subplots(1, 3, (13, 4.2))
    z = evaluation.error / evaluation.predicted
    x = torch.linspace(-5, 5, 200, dtype=torch.float64)
    bins = max(12, min(40, int(2 * math.sqrt(len(z)))))
    for panel, first, name in ((axes[0], 0, "translation"), (axes[1], 3, "rotation")):
        for i in range(first, first + 3):
            values = z[:, i][z[:, i].isfinite()].clamp(-5, 5)
            panel.stairs(*_density(values, bins, -5, 5), lw=1.5, color=COLOURS[i % 3], label=AXES[i])
        panel.plot(x, (-0.5 * x.square()).exp() / math.sqrt(2 * math.pi), color=GREY, lw=1, label="ideal")
        panel.set_xlabel(f"{name} error / claimed sigma")
    axes[0].set_ylabel("density")
    legend_below(figure, axes[:2], 7)
    nees = evaluation.errors.nees[evaluation.error[:, 0].isfinite()].nan_to_num(_MOST_NEES).clamp(max=_MOST_NEES)
    axes[2].stairs(*_density(nees, bins, 0, _MOST_NEES), fill=True, color="#b3cde3")
    x = torch.linspace(0.01, _MOST_NEES, 300, dtype=torch.float64)
    axes[2].plot(x, x.square() * (-x / 2).exp() / 16, color=GREY, lw=1)  # chi-squared, 6 degrees of freedom
    low, high = evaluation.nees_interval
    axes[2].set_title(f"mean {evaluation.nees:.2f}; {low:.2f} to {high:.2f} if the covariance is right", fontsize=9)
    axes[2].set_xlabel("NEES (larger ones in the last bin)")
    figure.suptitle(f"{title}: is the claimed uncertainty right?", fontsize=11)
    return figure


def plot_conditions(evaluation: Evaluation, truth: Truth, title: str) -> Figure:
    """Lateral, depth and angular error over distance and tilt."""
    figure, axes = subplots(2, 3, (13, 6.5), sharey="col")
    ok = evaluation.error[:, 0].isfinite()
    values = (
        ("error across the axis [um]", evaluation.errors.lateral * 1e3),
        ("error along the axis [um]", evaluation.errors.depth.abs() * 1e3),
        ("error of rotation [mdeg]", evaluation.errors.angle.rad2deg() * 1e3),
    )
    tilt = truth.R[:, 2, 2].abs().clamp(max=1).acos().rad2deg()
    for row, (name, condition) in zip(axes, (("distance [mm]", truth.t[:, 2]), ("tilt [degrees]", tilt)), strict=True):
        for panel, (label, value), colour in zip(row, values, COLOURS[:3], strict=True):
            panel.semilogy(condition[ok], value[ok], ".", ms=4, color=colour)
            panel.set(xlabel=name, ylabel=label)
    figure.suptitle(f"{title}: where the errors are", fontsize=11)
    return figure


def save_plots(evaluation: Evaluation, truth: Truth, folder: Path, title: str) -> list[Path]:
    """Writes errors.png, consistency.png and conditions.png; the paths. ConfigError: the folder cannot be written."""
    make_folder(folder, "--plots")
    figures = {
        "errors.png": plot_errors(evaluation, title),
        "consistency.png": plot_consistency(evaluation, title),
        "conditions.png": plot_conditions(evaluation, truth, title),
    }
    return save_figures(figures, folder)


def _density(values: torch.Tensor, bins: int, low: float, high: float) -> tuple[list[float], list[float]]:
    """Histogram of unit area: heights, and edges of the bins."""
    density = torch.histc(values, bins, low, high) * (bins / (high - low) / max(len(values), 1))
    return density.tolist(), torch.linspace(low, high, bins + 1).tolist()


def _largest(values: torch.Tensor) -> float:
    finite = values[values.isfinite()].abs()
    return float(finite.max()) if len(finite) else 1.0
