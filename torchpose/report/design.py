"""Map plots of the precision that a target promises over its working volume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.design import PrecisionMap
from torchpose.io.writers import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

_PANELS = ("across the optical axis, um", "along the optical axis, um", "rotation, mdeg")


def plot_precision(found: PrecisionMap, title: str) -> Figure:
    """Predicted standard deviations over distance and tilt, and over the offset: the largest axis of each panel.

    A dimension of the volume without extent is left out: what remains is a curve.
    """
    from matplotlib.figure import Figure

    by_tilt = found.by_tilt.transpose(0, 1)
    rows = [(found.distance, found.tilt.rad2deg(), by_tilt, "distance, mm", "tilt, degrees")]
    if len(found.x) * len(found.y) > 1:
        rows.append((found.x, found.y, found.by_place, "x, mm", "y, mm"))
    figure = Figure((13, 3.9 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), 3, squeeze=False)
    for line, (across, up, values, name_across, name_up) in zip(axes, rows, strict=True):
        for k, panel in enumerate(line):
            _panel(figure, panel, across, up, values[..., k], name_across, name_up, _PANELS[k])
            if name_up == "y, mm":
                panel.set_title(f"at {float(found.distance[-1]):g} mm, all tilts", fontsize=10)
                if len(found.y) > 1 and len(found.x) > 1:
                    panel.invert_yaxis()  # as in the frame
    figure.suptitle(f"{title}: predicted standard deviation (one sigma, largest axis)", fontsize=11)
    return figure


def _panel(figure: Figure, panel: Any, x: Tensor, y: Tensor, values: Tensor, of_x: str, of_y: str, name: str) -> None:
    """A map of values (Y, X), or a curve where one of the axes has a single point."""
    if len(x) == 1 or len(y) == 1:
        along, label, other = (
            (y, of_y, f"{of_x} {float(x[0]):g}") if len(x) == 1 else (x, of_x, f"{of_y} {float(y[0]):g}")
        )
        panel.plot(along.tolist(), values.flatten().tolist(), "o-", color="#0072b2", ms=4)
        panel.set_xlabel(f"{label} ({other})")
        panel.set_ylabel(name)
        panel.set_ylim(0, 1.15 * float(values.max()))
        panel.grid(alpha=0.25, lw=0.5)
        panel.spines[["top", "right"]].set_visible(False)
        return
    filled = panel.contourf(x.tolist(), y.tolist(), values.tolist(), 12, cmap="viridis")
    lines = panel.contour(x.tolist(), y.tolist(), values.tolist(), 5, colors="white", linewidths=0.6)
    panel.clabel(lines, fontsize=8)
    figure.colorbar(filled, ax=panel, label=name)
    panel.set_xlabel(of_x)
    panel.set_ylabel(of_y)


def save_plot(found: PrecisionMap, title: str, path: Path) -> None:
    """Writes `plot_precision` as PNG.

    Raises:
        ConfigError: the file cannot be written.
    """
    figure = plot_precision(found, title)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
