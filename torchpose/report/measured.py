"""Plots and a table of a measured target: how far its markers are from their nominal places, and what is left."""

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.calibration.session import Measurement
from torchpose.geometry.segments import segment_mean
from torchpose.io.writers import write_rows
from torchpose.report.figures import COLOURS, GREY, legend_below, subplots

_BLUE, _RED = COLOURS[:2]
_LONGEST = 0.15  # of the plate: the longest arrow


def plot_target(found: Measurement) -> Figure:
    """Places against the nominal ones, the mean residual of every marker, and the correlation of the unknowns."""
    figure, ((places, residuals, correlation),) = subplots(1, 3, (19, 6))
    _plot_places(places, found)
    _plot_residuals(residuals, found)
    _plot_correlation(correlation, found)
    legend_below(figure, [residuals], 2)
    gain, sigma = found.target.edge_gain, _deviations(found)[-1]
    figure.suptitle(
        f"{found.target.name}: edge gain {1e3 * gain:.3g} +- {1e3 * float(sigma):.2g} um, "
        f"{len(found.calibration.views)} views",
        fontsize=11,
    )
    return figure


def _deviations(found: Measurement) -> Tensor:
    assert found.target.covariance is not None  # always there after a measurement
    return found.target.covariance.diagonal().clamp_min(0).sqrt()


def _enlargement(most: float, extent: float) -> float:
    """1, 2 or 5 times a power of ten: the longest arrow is `_LONGEST` of the plate at most."""
    wanted = _LONGEST * extent / max(most, 1e-9)
    decade = 10 ** math.floor(math.log10(wanted))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= wanted))


def _plot_places(panel: Any, found: Measurement) -> None:
    """In the plate's plane as arrows, out of it as numbers beside the markers."""
    nominal = found.nominal.centers
    off, sigma = found.target.centers - nominal, _deviations(found)[:-1].view(-1, 3)
    extent = float((nominal[:, :2].amax(0) - nominal[:, :2].amin(0)).max())
    enlarged = _enlargement(float(off[:, :2].norm(dim=-1).max()), extent)
    panel.plot(*nominal[:, :2].T, "+", color=GREY)
    panel.quiver(
        *nominal[:, :2].T, *(enlarged * off[:, :2].T), angles="xy", scale_units="xy", scale=1, width=0.004, color=_BLUE
    )
    for marker, at, move, known in zip(found.target.ids.tolist(), nominal, off, sigma[:, 2], strict=True):
        text = f"{marker}: z {1e3 * float(move[2]):+.1f} +- {1e3 * float(known):.1f} um"
        beside = 10 if move[1] > 0 else -16  # points; away from the arrow, y downwards
        panel.annotate(text, at[:2].tolist(), xytext=(0, beside), textcoords="offset points", fontsize=8, ha="center")
    room = 2 * _LONGEST * extent  # for the longest arrow and the numbers
    (left, top), (right, bottom) = ((nominal[:, :2].amin(0) - room).tolist(), (nominal[:, :2].amax(0) + room).tolist())
    panel.set(xlim=(left, right), ylim=(bottom, top), xlabel="x, mm", ylabel="y, mm")
    panel.set_aspect("equal", "box")
    panel.set_title(f"places less nominal places, enlarged {enlarged:g} times", fontsize=10)


def _plot_residuals(panel: Any, found: Measurement) -> None:
    """Mean residual of every marker over all views, in its three deviations of the mean: what is left on the plate."""
    views, bundle = found.calibration.views, found.calibration.bundle
    index = (views.point[:, None] == found.target.ids).long().argmax(1)
    count = len(found.target)
    mean = segment_mean(bundle.residual, index, count)
    variance = segment_mean(views.covariance.diagonal(dim1=-2, dim2=-1), index, count)
    deviation = 3 * (variance / torch.bincount(index, minlength=count)[:, None]).sqrt()
    places = range(count)
    for k, axis in enumerate("uv"):
        shift = [p + 0.2 * (k - 0.5) for p in places]
        panel.errorbar(
            *(shift, mean[:, k].tolist(), deviation[:, k].tolist()),
            **{"fmt": "o", "ms": 3, "lw": 0.8, "color": COLOURS[k], "label": f"mean residual along {axis}"},
        )
    panel.axhline(0, color=GREY, lw=0.6)
    panel.set_xticks(places, [str(i) for i in found.target.ids.tolist()])
    panel.set(xlabel="marker", ylabel="mean residual, px")
    panel.set_title("left over all views; bars: three deviations", fontsize=10)


def _plot_correlation(panel: Any, found: Measurement) -> None:
    names, whole = _whole(found)
    scale = whole.diagonal().clamp_min(1e-300).rsqrt()
    shown = panel.imshow((whole * scale[:, None] * scale).tolist(), cmap="RdBu_r", vmin=-1, vmax=1)
    panel.figure.colorbar(shown, ax=panel, shrink=0.8)
    size = max(3, min(8, 240 // len(names)))
    panel.set_xticks(range(len(names)), names, rotation=90, fontsize=size)
    panel.set_yticks(range(len(names)), names, fontsize=size)
    panel.grid(visible=False)
    panel.set_title("correlation", fontsize=10)


def _whole(found: Measurement) -> tuple[list[str], Tensor]:
    """Names and covariance of the intrinsics, the places and the edge gain together."""
    target, calibration = found.target, found.calibration
    assert target.covariance is not None  # always there after a measurement
    cross = target.cross_covariance
    if cross is None:
        cross = target.covariance.new_zeros(len(target.covariance), len(calibration.covariance))
    whole = torch.cat([torch.cat([calibration.covariance, cross.mT], 1), torch.cat([cross, target.covariance], 1)])
    return [*calibration.names, *(f"{axis}{i}" for i in target.ids.tolist() for axis in "xyz"), "gain"], whole


def save_places(found: Measurement, folder: Path) -> Path:
    """Writes the table of places: nominal, how far off, and how well that is known; mm."""
    off, sigma = found.target.centers - found.nominal.centers, _deviations(found)[:-1].view(-1, 3)
    columns = [f"{prefix}{axis}" for prefix in ("", "d", "s") for axis in "xyz"]
    columns += ["outer_radius", "inner_radius"]
    values = torch.cat([found.nominal.centers, off, sigma, found.target.printed_radii], 1).tolist()
    rows = (
        {"marker": marker} | dict(zip(columns, numbers, strict=True))
        for marker, numbers in zip(found.target.ids.tolist(), values, strict=True)
    )
    path = folder / "places.csv"
    write_rows(path, rows, {"marker": int} | dict.fromkeys(columns, float))
    return path
