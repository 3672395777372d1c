"""Map plots of the precision that a target promises over its working volume."""

import math
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from torchpose.design import PrecisionMap, WorkingVolume, surroundings
from torchpose.report.figures import COLOURS, subplots
from torchpose.report.files import save_figures

_PANELS = ("across the optical axis [um]", "along the optical axis [um]", "rotation [mdeg]")
_MARK = {"color": "white", "mec": "black", "ms": 11}  # of what was asked for
_LEAST_RANGE = 0.05  # of the largest value (convention), that the colours of a map cover
_Axis = tuple[str, Tensor]  # label and values


def plot_precision(found: PrecisionMap, title: str, volume: WorkingVolume | None = None) -> Figure:
    """Predicted standard deviations over distance and tilt, and over the offset: the largest axis of each panel.

    A dimension of the volume without extent is left out: what remains is a curve. Stars are the ends of ``volume``,
    where the map shows more than that.
    """
    by_tilt = ("distance [mm]", found.distance), ("tilt [degrees]", found.tilt.rad2deg())
    by_place = ("x [mm]", found.x), ("y [mm]", found.y)
    with_places = len(found.x) * len(found.y) > 1
    figure, axes = subplots(1 + with_places, 3, (13, 3.9 * (1 + with_places)))
    for k, panel in enumerate(axes[0]):
        _plot(panel, *by_tilt, found.by_tilt[..., k].T, _PANELS[k])
        if volume is not None and surroundings(volume) != volume:
            ends = [(z, tilt) for z in volume.distance for tilt in (0.0, math.degrees(volume.tilt))]
            panel.plot(*zip(*ends, strict=True), "*", **_MARK, clip_on=False)
    for k, panel in enumerate(axes[1] if with_places else ()):
        _plot(panel, *by_place, found.by_place[..., k], _PANELS[k])
        far = float(found.distance[-1]) if volume is None else volume.distance[1]
        panel.set_title(f"at {far:g} mm, all tilts", fontsize=10)
        if len(found.x) > 1 and len(found.y) > 1:
            panel.invert_yaxis()  # as in the frame
    asked = "" if volume is None or surroundings(volume) == volume else "; stars: what was asked for"
    figure.suptitle(f"{title}: predicted standard deviation (one sigma, largest axis){asked}", fontsize=11)
    return figure


def _plot(panel: Any, across: _Axis, up: _Axis, values: Tensor, name: str) -> None:
    """A map of values (up, across), or a curve where one of the axes has a single point."""
    (label_x, x), (label_y, y) = across, up
    if len(x) == 1 or len(y) == 1:
        (label, along), (other, at) = (up, across) if len(x) == 1 else (across, up)
        panel.plot(along.tolist(), values.flatten().tolist(), "o-", color=COLOURS[0], ms=4)
        panel.set(xlabel=f"{label} ({other} {float(at[0]):g})", ylabel=name, ylim=(0, 1.15 * float(values.max())))
        return
    filled = panel.contourf(x.tolist(), y.tolist(), values.tolist(), _levels(values), cmap="viridis")
    panel.figure.colorbar(filled, ax=panel, label=name)
    panel.grid(False)
    panel.spines[["top", "right"]].set_visible(True)
    panel.set(xlabel=label_x, ylabel=label_y)


def _levels(values: Tensor) -> list[float]:
    """Steps of a map, round numbers: what hardly varies is of one colour."""
    low, high = float(values.min()), float(values.max())
    more = max(0.0, 0.5 * (_LEAST_RANGE * high - (high - low)))
    return [float(level) for level in MaxNLocator(12).tick_values(low - more, high + more)]


def save_plot(found: PrecisionMap, title: str, path: Path, volume: WorkingVolume | None = None) -> None:
    """Writes `plot_precision` as PNG. ConfigError: the file cannot be written."""
    save_figures({path.name: plot_precision(found, title, volume)}, path.parent)
