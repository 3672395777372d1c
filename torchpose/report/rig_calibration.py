"""Plots and tables of a calibrated rig: where its cameras are, and what is left in each."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchpose.calibration.several import RigCalibration
from torchpose.geometry import rotations
from torchpose.io.writers import write_rows
from torchpose.report.calibration import plot_hand_eye
from torchpose.report.figures import COLOURS, GREY, legend_below, subplots
from torchpose.report.files import make_folder, save_figures

_DRAWN = 0.25  # of the distance to the target: depth of the pyramid that stands for a camera
_ACROSS = 3  # panels in a row


def plot_rig(found: RigCalibration) -> Figure:
    """Cameras as pyramids of their field of view, and the target at every moment, in the axes of the first camera."""
    rig, bundle = found.rig, found.bundle
    figure = Figure((11, 9), layout="constrained")
    panel: Any = figure.add_subplot(projection="3d")
    points = found.views.points
    low, high = points.amin(0), points.amax(0)
    x, y = (torch.stack([low[k], high[k]]) for k in (0, 1))
    corners = torch.stack([x[[0, 1, 1, 0, 0]], y[[0, 0, 1, 1, 0]], torch.full((5,), float(low[2])).to(x)], -1)
    outlines = corners @ bundle.R.mT + bundle.t[:, None]
    for outline in outlines:
        _line(panel, outline, color=GREY, lw=0.6, alpha=0.6)
    depth = _DRAWN * float(bundle.t.norm(dim=-1).median())
    for number, (camera, name) in enumerate(zip(rig.cameras, rig.names, strict=True)):
        ends = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], dtype=torch.float64)
        sides = ends * (torch.tensor([camera.width, camera.height]) - 1)
        rays = (sides - camera.matrix[:2, 2]) / camera.matrix.diagonal()[:2]
        frame = depth * torch.nn.functional.pad(rays, (0, 1), value=1.0)
        back = rotations.inverse(rig.R[number], rig.t[number])
        at, origin = frame @ back[0].mT + back[1], back[1]
        colour = COLOURS[number % len(COLOURS)]
        _line(panel, at, color=colour, lw=1.5)
        for corner in at[:4]:
            _line(panel, torch.stack([origin, corner]), color=colour, lw=1.0)
        sigma = 0.0 if number == 0 or rig.covariance is None else _known_to(rig.covariance, number)
        label = name if not number else f"{name} +- {1e3 * sigma:.2g} um"
        above = origin - 0.3 * depth * back[0][:, 1]
        panel.text(*_turned(above), label, color=colour, fontsize=10, ha="center")
    panel.set(xlabel="x, mm", ylabel="z, mm", zlabel="-y, mm")
    panel.set_aspect("equal")
    figure.suptitle(f"{len(rig)} cameras, {len(found.views)} moments, axes of {rig.names[0]}", fontsize=11)
    return figure


def _known_to(covariance: Tensor, number: int) -> float:
    """Root of the mean variance of the place of a camera, mm."""
    return float(covariance.diagonal()[6 * (number - 1) :][:3].mean().sqrt())


def _turned(at: Tensor) -> list[float]:
    """Camera axes as one looks at them: depth away from the eye, v downwards."""
    return [float(at[0]), float(at[2]), -float(at[1])]


def _line(panel: Any, points: Tensor, **style: Any) -> None:
    x, y, z = points.T
    panel.plot(x, z, -y, **style)


def plot_cameras(found: RigCalibration) -> Figure:
    """Residuals over the frame of every camera, and their size by camera and moment."""
    count = len(found.rig)
    rows = math.ceil(count / _ACROSS) + 1
    figure = Figure((15, 4.2 * rows), layout="constrained")
    for number in range(count):
        _arrows(figure.add_subplot(rows, _ACROSS, number + 1), found, number)
    panel: Any = figure.add_subplot(rows, 1, rows)
    square, lens, view = found.bundle.residual.square().sum(-1), found.views.lens, found.views.view
    sums = torch.zeros(count, len(found.views), dtype=square.dtype).index_put((lens, view), square, accumulate=True)
    points = torch.zeros_like(sums).index_put((lens, view), torch.ones_like(square), accumulate=True)
    for number, row in enumerate((sums / points).sqrt()):
        panel.plot(row.tolist(), "o", ms=4, color=COLOURS[number % len(COLOURS)], label=found.rig.names[number])
    panel.set(xlabel="moment", ylabel="RMS residual, px", ylim=(0, None))
    legend_below(figure, [panel], min(count, 8))
    panel.grid(alpha=0.25, lw=0.5)
    return figure


def _arrows(panel: Any, found: RigCalibration, number: int) -> None:
    camera, own = found.rig.cameras[number], found.views.lens == number
    residual, pixels = found.bundle.residual[own], found.views.pixels[own]
    most = 0.1 * camera.width / max(float(residual.norm(dim=-1).max()), 1e-9)
    decade = 10 ** math.floor(math.log10(most))
    enlarged = max(step * decade for step in (1, 2, 5) if step * decade <= most)
    colour = COLOURS[number % len(COLOURS)]
    panel.quiver(*pixels.T, *(enlarged * residual.T), angles="xy", scale_units="xy", scale=1, width=0.002, color=colour)
    panel.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), xlabel="u, px", ylabel="v, px")
    panel.set_aspect("equal")
    panel.set_title(
        f"{found.rig.names[number]}: RMS {float(found.rms_px[number]):.3g} px, enlarged {enlarged:g} times", fontsize=10
    )


def plot_ties(found: RigCalibration) -> Figure:
    """In how many moments each two cameras see the target."""
    figure, ((panel,),) = subplots(1, 1, (6, 5))
    panel.imshow(found.common.numpy(), cmap="Blues", vmin=0)
    panel.grid(False)
    for (row, column), value in _entries(found.common):
        dark = value > 0.6 * float(found.common.max())
        panel.text(column, row, str(value), ha="center", va="center", color="white" if dark else "black")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_ticks(range(len(found.rig)), found.rig.names)
    panel.set_title("moments in which both see the target", fontsize=10)
    return figure


def _entries(table: Tensor) -> list[tuple[tuple[int, int], int]]:
    return [((k, j), value) for k, row in enumerate(table.tolist()) for j, value in enumerate(row)]


def save_rig_calibration(found: RigCalibration, folder: Path) -> list[Path]:
    """Writes plots and tables; the paths. ConfigError: the folder cannot be written."""
    make_folder(folder, "--plots")
    figures = {"rig.png": plot_rig(found), "residuals.png": plot_cameras(found), "ties.png": plot_ties(found)}
    if found.hand_eye is not None:
        figures["robot.png"] = plot_hand_eye(found.hand_eye, "robot's base", "robot's pose, as said - as seen")
    return [*_tables(found, folder), *save_figures(figures, folder)]


def _tables(found: RigCalibration, folder: Path) -> list[Path]:
    views, bundle = found.views, found.bundle
    columns = ("u", "v", "du_px", "dv_px", "chi2")
    values = torch.cat([views.pixels, bundle.residual, bundle.chi2[:, None]], 1).tolist()
    keys = zip(views.lens.tolist(), views.view.tolist(), views.point.tolist(), values, strict=True)
    points = (
        {"camera": found.rig.names[lens], "frame": views.names[view], "point": point}
        | dict(zip(columns, numbers, strict=True))
        for lens, view, point, numbers in keys
    )
    residuals = folder / "residuals.csv"
    write_rows(residuals, points, {"camera": str, "frame": str, "point": int} | dict.fromkeys(columns, float))
    return [residuals]
