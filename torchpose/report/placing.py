"""Plots of what several cameras tell together: over the distance, and over the angle between two."""

from collections.abc import Mapping

from matplotlib.figure import Figure
from torch import Tensor

from torchpose.analysis.evaluation import AXES, SCALE
from torchpose.report.figures import COLOURS, GREY, legend_below, subplots

_PANELS = (("x, y [um]", (0, 1)), ("z, depth [um]", (2,)), ("orientation [mdeg]", (3, 4, 5)))


def plot_angles(degrees: Tensor, bound: Tensor, alone: Tensor, distance: float) -> Figure:
    """Standard deviations with a second camera against the angle between the two; dashed: the first alone."""
    figure, (panels,) = subplots(1, 3, (15, 4.6))
    sigma, single = SCALE * bound.diagonal(dim1=-2, dim2=-1).sqrt(), SCALE * alone.diagonal().sqrt()
    for panel, (title, components) in zip(panels, _PANELS, strict=True):
        for i in components:
            colour = COLOURS[i % 3]
            panel.plot(degrees, sigma[:, i], "o-", ms=3, color=colour, label=f"{AXES[i]}, two cameras")
            panel.axhline(float(single[i]), color=colour, ls="--", lw=0.9, label=f"{AXES[i]}, the first alone")
        panel.set(xlabel="angle between the cameras [degrees]", ylabel=f"standard deviation of {title}")
        panel.set_ylim(bottom=0)
    legend_below(figure, panels, 6)
    figure.suptitle(f"a second camera like the first, turned about the target at {distance:g} mm", fontsize=11)
    return figure


def plot_distances(distance: Tensor, bounds: Mapping[str, Tensor]) -> Figure:
    """Of each camera alone and of all, against the distance along the axis of the first; root mean squares of axes."""
    figure, (panels,) = subplots(1, 3, (15, 4.6))
    for panel, (title, components) in zip(panels, _PANELS, strict=True):
        for k, (name, bound) in enumerate(bounds.items()):
            sigma = SCALE[components[0]] * bound.diagonal(dim1=-2, dim2=-1)[:, list(components)].mean(-1).sqrt()
            style = {"color": GREY, "lw": 2.5} if name == "all" else {"color": COLOURS[(k - 1) % len(COLOURS)]}
            panel.semilogy(distance, sigma, label=name, **style)
        panel.set(xlabel="distance from the first camera [mm]", ylabel=f"standard deviation of {title}")
    legend_below(figure, panels[:1], 6)
    return figure
