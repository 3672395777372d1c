"""How the plots look: one style, no window, no global state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# of Okabe and Ito, told apart without red and green
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY = "#666666"


def subplots(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """A figure of ``size`` inches with a grid of panels, and the array of its axes.

    Args:
        options: of `matplotlib.figure.Figure.subplots`.
    """
    from matplotlib.figure import Figure  # slow to import, and only plots need it

    figure = Figure(size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25, lw=0.5)
    return figure, axes
