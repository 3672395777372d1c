"""How the plots look: one style, no window, no global state. Slow to import: commands do where they plot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.io.rows import Row

# of Okabe and Ito, told apart without red and green
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY, BAND = "#666666", "#e6e6e6"  # of lines to compare with, and of what is claimed


def subplots(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """A figure of ``size`` inches with a grid of panels, and the array of its axes.

    Args:
        rows: of panels.
        columns: of panels.
        size: width and height.
        options: of `matplotlib.figure.Figure.subplots`.
    """
    figure = Figure(size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25, lw=0.5)
    return figure, axes


def curve(panel: Any, rows: Sequence[Row], x: str, y: str, style: str = "o-", **options: Any) -> None:
    """A column of a table against another; options of `matplotlib.axes.Axes.plot`."""
    panel.plot([row[x] for row in rows], [row[y] for row in rows], style, **options)


def frames(
    pictures: Sequence[tuple[str, np.ndarray]], rows: int, size: tuple[float, float], fontsize: int = 12
) -> Figure:
    """A sheet of titled arrays: grey (H, W) of 0 to 255 or colour (H, W, 3), in rows of one length."""
    figure, axes = subplots(rows, len(pictures) // rows, size)
    for panel, (title, picture) in zip(axes.flat, pictures, strict=True):
        panel.imshow(picture, cmap="gray", vmin=0, vmax=255)
        panel.set_title(title, fontsize=fontsize)
        panel.set_axis_off()
    return figure


def band(panel: Any, at: Any, half_width: Tensor) -> None:
    """The range that is claimed, around zero."""
    panel.fill_between(at, (-half_width).tolist(), half_width.tolist(), color=BAND, lw=0)
