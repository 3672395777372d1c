"""Plots of errors over the working distance, and of the error budget."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from torchpose.analysis.evaluation import AXES, SCALE, UNITS
from torchpose.analysis.sweep import Sweep, Swept, fit
from torchpose.report.figures import COLOURS, GREY, legend_below, subplots

POWERS = {"x": (0, 1), "y": (0, 1), "z": (1, 2)}  # of the line through the largest errors: with a linear term for focal


def plot_sweeps(cases: Mapping[str, Sweep]) -> Figure:
    """Position and orientation error against the distance, one row for each of the cases by title."""
    figure, axes = subplots(len(cases), 3, (14, 4 * len(cases)))
    for colour, names in zip(COLOURS, ("x, pitch", "y, yaw", "z, roll"), strict=False):
        axes[0, 0].plot([], [], "s", color=colour, label=names)
    for row, (title, case) in zip(axes, cases.items(), strict=True):
        distance = case.distance
        for panel, components in zip(row, ((0, 1), (2,), (3, 4, 5)), strict=True):
            for i in components:
                colour, scale, name = COLOURS[i % 3], SCALE[i], AXES[i]
                panel.plot(distance, scale * case.largest[:, i], ".", ms=4, color=colour)
                if name in POWERS:
                    line = scale * fit(distance, case.largest[:, i], POWERS[name])
                    panel.plot(distance, line, "--", lw=0.9, color=colour)
                predicted = scale * case.budget.std()[:, i]
                panel.plot(distance, scale * case.rms[:, i], "+", ms=5, color=colour)
                panel.plot(distance, predicted, "-", lw=1.2, color=colour)
        row[0].plot(distance, SCALE[0] * case.lateral, ":", color=GREY)
        row[1].plot(distance, SCALE[2] * (case.depth + case.depth_focal), ":", color=GREY)
        row[1].set_title(title, fontsize=10)
        for panel, label in zip(row, ("x, y error [um]", "z error [um]", "orientation error [mdeg]"), strict=True):
            panel.set(xlabel="distance [mm]", ylabel=label)
            panel.set_ylim(bottom=0)
    styles = {"largest error of the draws": ".", "line through them": "--", "RMS of the draws": "+"}
    styles |= {"predicted RMS": "-", "paper: eq. (3) for x and y, (2) + (5) for z": ":"}
    legend_below(figure, axes[0], 4, styles)
    return figure


def plot_budget(case: Swept, title: str) -> Figure:
    """What every source contributes to each component, against the distance."""
    figure, axes = subplots(2, 3, (14, 8))
    for i, panel in enumerate(axes.flat):
        total = SCALE[i] * case.budget.std()[:, i]
        panel.semilogy(case.distance, total, color="#bbbbbb", lw=6, solid_capstyle="butt", label="total")
        for k, source in enumerate(case.budget.sources):
            value = SCALE[i] * case.budget.std(source)[:, i]
            if float(value.max()) > 1e-6:  # below, the source does not act on this component
                panel.semilogy(case.distance, value, color=COLOURS[k % 6], ls="-" if k < 6 else "--", label=source)
        panel.set(xlabel="distance [mm]", ylabel=f"{AXES[i]}, standard deviation [{UNITS[i]}]")
    lines = {line.get_label(): line for panel in axes.flat for line in panel.lines}
    figure.legend(lines.values(), [str(name).replace("_", " ") for name in lines], loc="outside right upper")
    axes[0, 1].set_title(title, fontsize=10)
    return figure
