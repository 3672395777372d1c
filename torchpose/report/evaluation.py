"""Plots of an evaluation: errors per frame, their distribution, and whether the claimed uncertainty holds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from torchpose.analysis.evaluation import AXES, UNITS, Evaluation
from torchpose.errors import ConfigError
from torchpose.report.figures import COLOURS, GREY, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpose.io.truth import Truth


def plot_errors(evaluation: Evaluation, title: str) -> Figure:
    """Errors of the six axes over the frames, with the bands that the estimates claim (as Fig. 11 of the paper)."""
    figure, axes = subplots(2, 3, (13, 6), sharex=True)
    number = torch.arange(len(evaluation.error))
    for i, panel in enumerate(axes.flat):
        error, claimed = evaluation.error[:, i], evaluation.predicted[:, i]
        panel.fill_between(number, -2 * claimed, 2 * claimed, color="#e6e6e6", lw=0)
        if bool(evaluation.bound[:, i].isfinite().any()):
            for sign in (-2, 2):
                panel.plot(number, sign * evaluation.bound[:, i], color=GREY, lw=0.6, ls="--")
        panel.plot(number, error, ".", ms=3, color=COLOURS[i % 3])
        axis = evaluation.axes[i]
        panel.set_title(f"{AXES[i]}: bias {axis.bias:.3g}, spread {axis.spread:.3g} {UNITS[i]}", fontsize=10)
        panel.set_ylabel(UNITS[i])
        panel.axhline(0, color=GREY, lw=0.6)
        limit = 1.15 * max(_largest(error), 2.2 * _largest(claimed.nanmedian()[None]))
        panel.set_ylim(-limit, limit)
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
    count = max(12, min(40, int(2 * math.sqrt(len(z)))))
    bins = torch.linspace(-5, 5, count + 1).tolist()
    for panel, first, name in ((axes[0], 0, "translation"), (axes[1], 3, "rotation")):
        for i in range(first, first + 3):
            values = z[:, i][z[:, i].isfinite()].clamp(-5, 5)
            density = torch.histc(values, count, -5, 5) * (count / 10 / max(len(values), 1))
            panel.stairs(density.tolist(), bins, lw=1.5, color=COLOURS[i % 3], label=AXES[i])
        panel.plot(x, (-0.5 * x.square()).exp() / math.sqrt(2 * math.pi), color=GREY, lw=1, label="ideal")
        panel.set_xlabel(f"{name} error / claimed sigma")
        panel.legend(frameon=False, fontsize=9)
    axes[0].set_ylabel("density")
    nees = evaluation.errors.nees[evaluation.error[:, 0].isfinite()]
    top = 25.0
    density = torch.histc(nees.nan_to_num(top).clamp(max=top), count, 0, top) * (count / top / max(len(nees), 1))
    axes[2].stairs(density.tolist(), torch.linspace(0, top, count + 1).tolist(), fill=True, color="#b3cde3")
    s = torch.linspace(0.01, top, 300, dtype=torch.float64)
    axes[2].plot(s, s.square() * (-s / 2).exp() / 16, color=GREY, lw=1)  # chi-squared, 6 degrees of freedom
    low, high = evaluation.nees_interval
    axes[2].set_title(f"mean {evaluation.nees:.2f}; {low:.2f} to {high:.2f} if the covariance is right", fontsize=10)
    axes[2].set_xlabel("NEES (larger ones in the last bin)")
    figure.suptitle(f"{title}: is the claimed uncertainty right?", fontsize=11)
    return figure


def plot_conditions(evaluation: Evaluation, truth: Truth, title: str) -> Figure:
    """Lateral, depth and angular error over distance and tilt."""
    figure, axes = subplots(2, 3, (13, 6.5), sharey="col")
    ok = evaluation.error[:, 0].isfinite()
    values = (
        ("lateral, um", evaluation.errors.lateral * 1e3),
        ("|depth|, um", evaluation.errors.depth.abs() * 1e3),
        ("rotation, mdeg", evaluation.errors.angle.rad2deg() * 1e3),
    )
    tilt = truth.R[:, 2, 2].abs().clamp(max=1).acos().rad2deg()
    for row, (name, condition) in zip(axes, (("distance, mm", truth.t[:, 2]), ("tilt, degrees", tilt)), strict=True):
        for panel, (label, value), colour in zip(row, values, COLOURS[:3], strict=True):
            panel.semilogy(condition[ok], value[ok], ".", ms=4, color=colour)
            panel.set_xlabel(name)
            panel.set_ylabel(label)
    figure.suptitle(f"{title}: where the errors are", fontsize=11)
    return figure


def save_plots(evaluation: Evaluation, truth: Truth, folder: Path, title: str) -> list[Path]:
    """Writes errors.png, consistency.png and conditions.png; the paths.

    Raises:
        ConfigError: the folder cannot be written.
    """
    made = {
        "errors.png": plot_errors(evaluation, title),
        "consistency.png": plot_consistency(evaluation, title),
        "conditions.png": plot_conditions(evaluation, truth, title),
    }
    paths = []
    for name, figure in made.items():
        path = folder / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=120)
        except OSError as error:
            raise ConfigError(f"{path}: --plots: cannot be written ({error.strerror}); choose another folder") from None
        paths.append(path)
    return paths


def _largest(values: torch.Tensor) -> float:
    finite = values[values.isfinite()].abs()
    return float(finite.max()) if len(finite) else 1.0
