"""How the plots look: one style, no window, no global state. Slow to import: commands do where they plot."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterMathtext
from torch import Tensor

from torchpose.io.rows import Row

# of Okabe and Ito, told apart without red and green
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY, BAND = "#666666", "#e6e6e6"  # of lines to compare with, and of what is claimed


class PlainLog(LogFormatterMathtext):
    """Numbers of a logarithmic axis as people write them: 0.06 and 200, where matplotlib has products with powers."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:.6g}" if super().__call__(x, pos) else ""


def finish(figure: Figure) -> Figure:
    """The figure as it is saved: plain numbers on logarithmic axes."""
    for panel in figure.axes:
        for axis, scale in ((panel.xaxis, panel.get_xscale()), (panel.yaxis, panel.get_yscale())):
            if scale == "log":
                axis.set_major_formatter(PlainLog())
                axis.set_minor_formatter(PlainLog(minor_thresholds=(1.5, 0.4)))
    return figure


def legend_below(
    figure: Figure, panels: Iterable[Any], columns: int, styles: Mapping[str, str] = {}, fontsize: float = 9
) -> None:
    """One legend of all panels below them, where it covers no data; each label once.

    Args:
        figure: of the panels.
        panels: whose labelled lines are listed.
        columns: of the legend.
        styles: further entries in grey: a style of line, or a marker, by what it stands for.
        fontsize: of its text.
    """
    found = [zip(*panel.get_legend_handles_labels(), strict=True) for panel in panels]
    handles = {label: handle for pairs in found for handle, label in pairs}
    for label, style in styles.items():
        line = style in ("-", "--", ":")
        handles[label] = Line2D([], [], color=GREY, ls=style if line else "none", marker="" if line else style)
    look: dict[str, Any] = {"ncols": columns, "fontsize": fontsize, "frameon": False}
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", **look)


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
        panel.set_axisbelow(True)
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
