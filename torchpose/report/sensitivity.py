"""Plots of errors over the working distance, and of the error budget."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from torchpose.analysis.sweep import Sweep, fit
from torchpose.report.figures import COLOURS, GREY, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POWERS = {"x": (0, 1), "y": (0, 1), "z": (1, 2)}  # of the line through the largest errors: with a linear term for focal
AXES = ("x", "y", "z", "pitch", "yaw", "roll")
SCALE = (1e3, 1e3, 1e3, *(1e3 * 180 / math.pi,) * 3)
UNITS = ("um", "um", "um", "mdeg", "mdeg", "mdeg")


def plot_sweeps(cases: Mapping[str, Sweep]) -> Figure:
    """Position and orientation error against the distance, one row for each of the cases by title."""
    figure, axes = subplots(len(cases), 3, (14, 4 * len(cases)))
    for row, (title, s) in zip(axes, cases.items(), strict=True):
        d = s.distance
        for panel, components in zip(row, ((0, 1), (2,), (3, 4, 5)), strict=True):
            for i in components:
                colour, scale = COLOURS[i % 3], SCALE[i]
                name = AXES[i]
                panel.plot(d, scale * s.largest[:, i], ".", ms=4, color=colour, label=f"{name}: largest error")
                if name in POWERS:
                    line = fit(d, s.largest[:, i], POWERS[name])
                    panel.plot(d, scale * line, "--", lw=0.9, color=colour, label=f"{name}: line through them")
                panel.plot(d, scale * s.rms[:, i], "+", ms=5, color=colour, label=f"{name}: rms of the draws")
                panel.plot(d, scale * s.budget.std()[:, i], "-", lw=1.2, color=colour, label=f"{name}: predicted rms")
            panel.set_xlabel("distance [mm]")
            panel.set_ylim(bottom=0)
        row[0].plot(d, SCALE[0] * s.lateral, ":", color=GREY, label="paper, eq. (3)")
        row[1].plot(d, SCALE[2] * (s.depth + s.depth_focal), ":", color=GREY, label="paper, eq. (2) + (5)")
        row[0].set_ylabel("x, y error [um]")
        row[1].set_ylabel("z error [um]")
        row[2].set_ylabel("orientation error [mdeg]")
        row[1].set_title(title, fontsize=10)
        for panel in row:
            panel.legend(fontsize=6)
    return figure


def plot_budget(s: Sweep, title: str) -> Figure:
    """What every source contributes to each component, against the distance."""
    figure, axes = subplots(2, 3, (14, 8))
    for i, panel in enumerate(axes.flat):
        total = SCALE[i] * s.budget.std()[:, i]
        panel.semilogy(s.distance, total, color="#bbbbbb", lw=6, solid_capstyle="butt", label="total")
        for k, source in enumerate(s.budget.sources):
            value = SCALE[i] * s.budget.std(source)[:, i]
            if float(value.max()) > 1e-6:  # below, the source does not act on this component
                panel.semilogy(s.distance, value, color=COLOURS[k % 6], ls="-" if k < 6 else "--", label=source)
        panel.set_ylabel(f"{AXES[i]}, standard deviation [{UNITS[i]}]")
        panel.set_xlabel("distance [mm]")
    lines = {line.get_label(): line for panel in axes.flat for line in panel.lines}
    figure.legend(lines.values(), [str(name).replace("_", " ") for name in lines], loc="outside right upper")
    axes[0, 1].set_title(title, fontsize=10)
    return figure
