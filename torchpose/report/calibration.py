"""Plots and tables of a calibration: where the residuals are, and whether they are what their covariances say."""

import math
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from torchpose.calibration import Calibration, HandEyeFit
from torchpose.calibration.session import Measurement
from torchpose.geometry.segments import segment_mean
from torchpose.io.writers import write_rows
from torchpose.report.figures import COLOURS, GREY, legend_below, subplots
from torchpose.report.files import make_folder, save_figures
from torchpose.report.measured import plot_target, save_places

_BLUE, _RED = COLOURS[:2]


def plot_residuals(calibration: Calibration) -> Figure:
    """Residuals over the frame, their scatter, and their size by view and by point."""
    figure, ((frame, scatter), (by_view, by_point)) = subplots(2, 2, (13, 9), width_ratios=[1.4, 1])
    views, bundle = calibration.views, calibration.bundle
    _plot_arrows(frame, calibration)
    _plot_scatter(scatter, calibration)

    def bars(panel: Any, index: torch.Tensor, names: list[str], title: str) -> None:
        rms = segment_mean(bundle.residual.square().sum(-1), index, len(names)).sqrt()
        own = segment_mean(bundle.chi2 / 2, index, len(names)).sqrt()
        panel.bar(range(len(names)), rms.tolist(), color=[_RED if o > 2 else _BLUE for o in own.tolist()])
        panel.set_xticks(range(len(names)), names, rotation=90 if len(names) > 8 else 0, fontsize=7)
        panel.set_ylabel("RMS residual, px")
        panel.set_title(title, fontsize=10)

    bars(by_view, views.view, [Path(n).name for n in views.names], "by view; red: twice what the covariances say")
    ids, place = views.point.unique(return_inverse=True)
    bars(by_point, place, [str(i) for i in ids.tolist()], "by marker or corner")
    common = f", {calibration.common_sigma_px:.3g} px added to every point" if calibration.common_sigma_px else ""
    figure.suptitle(
        f"{len(views)} views, {len(views.view)} points, reduced chi-squared {calibration.reduced_chi2:.3g}{common}",
        fontsize=11,
    )
    return figure


def _plot_arrows(panel: Any, calibration: Calibration) -> None:
    """Residuals over the frame: the longest arrow a tenth of it at most, enlarged by 1, 2 or 5 times a power of ten."""
    residual, pixels, camera = calibration.bundle.residual, calibration.views.pixels, calibration.camera
    most = 0.1 * camera.width / max(float(residual.norm(dim=-1).max()), 1e-9)
    decade = 10 ** math.floor(math.log10(most))
    enlarged = max(step * decade for step in (1, 2, 5) if step * decade <= most)
    panel.quiver(*pixels.T, *(enlarged * residual.T), angles="xy", scale_units="xy", scale=1, width=0.0018, color=_BLUE)
    panel.plot(*pixels.T, ".", ms=2, color=GREY)
    panel.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), xlabel="u, px", ylabel="v, px")
    panel.set_aspect("equal")
    panel.set_title(f"seen - predicted, enlarged {enlarged:g} times", fontsize=10)


def _plot_scatter(panel: Any, calibration: Calibration) -> None:
    panel.plot(*calibration.bundle.residual.T, ".", ms=3, color=_BLUE)
    own = calibration.views.covariance.diagonal(dim1=-2, dim2=-1).mean()
    expected = (own + calibration.common_sigma_px**2).sqrt()
    angle = torch.linspace(0, 2 * torch.pi, 121)
    for n in (1, 2, 3):
        panel.plot(n * expected * angle.cos(), n * expected * angle.sin(), color=GREY, lw=0.7)
    panel.set_aspect("equal", "datalim")
    panel.set(xlabel="u, px", ylabel="v, px")
    panel.set_title(f"RMS {calibration.rms_px:.3g} px; circles: 1, 2, 3 sigma of the points", fontsize=10)


def plot_hand_eye(fit: HandEyeFit, of: str = "camera", what: str = "target seen - predicted from the robot") -> Figure:
    """Residuals, pose by pose: of the target's pose in the camera, or of what else the fit has them, by whose axes."""
    figure, ((position,), (rotation,)) = subplots(2, 1, (11, 6), sharex=True)
    for panel, values, label in (
        (position, 1e3 * fit.residual[:, :3], "position, um"),
        (rotation, fit.residual[:, 3:].rad2deg() * 1e3, "rotation, mdeg"),
    ):
        for k, axis in enumerate("xyz"):
            panel.plot(values[:, k], "o-", ms=3, lw=0.8, color=COLOURS[k], label=f"{axis} of the {of}")
        panel.axhline(0, color=GREY, lw=0.6)
        panel.set_ylabel(label)
    legend_below(figure, [position], 3)
    rotation.set_xlabel("pose")
    figure.suptitle(
        f"{what}; robot noise {fit.robot_sigma_mm * 1e3:.3g} um, "
        f"{math.degrees(fit.robot_sigma_rad) * 1e3:.3g} mdeg per axis",
        fontsize=11,
    )
    return figure


def save_calibration(
    calibration: Calibration | None, hand_eye: HandEyeFit | None, folder: Path, measured: Measurement | None = None
) -> list[Path]:
    """Writes the plots and tables that there are; the paths. ConfigError: the folder cannot be written."""
    make_folder(folder, "--plots")
    figures = {}
    if calibration is not None:
        figures["residuals.png"] = plot_residuals(calibration)
    if hand_eye is not None:
        figures["hand_eye.png"] = plot_hand_eye(hand_eye)
    tables = []
    if measured is not None:
        figures["target.png"] = plot_target(measured)
        tables = [save_places(measured, folder)]
    return [*tables, *(() if calibration is None else _tables(calibration, folder)), *save_figures(figures, folder)]


def _tables(calibration: Calibration, folder: Path) -> list[Path]:
    views, bundle, names = calibration.views, calibration.bundle, calibration.names
    columns = ("u", "v", "du_px", "dv_px", "chi2")
    values = torch.cat([views.pixels, bundle.residual, bundle.chi2[:, None]], 1).tolist()
    points = (
        {"frame": views.names[view], "point": point} | dict(zip(columns, numbers, strict=True))
        for view, point, numbers in zip(views.view.tolist(), views.point.tolist(), values, strict=True)
    )
    spread = (
        {"parameter": name} | dict(zip(names, row, strict=True))
        for name, row in zip(names, calibration.covariance.tolist(), strict=True)
    )
    residuals, covariance = folder / "residuals.csv", folder / "covariance.csv"
    write_rows(residuals, points, {"frame": str, "point": int} | dict.fromkeys(columns, float))
    write_rows(covariance, spread, {"parameter": str} | dict.fromkeys(names, float))
    return [residuals, covariance]
