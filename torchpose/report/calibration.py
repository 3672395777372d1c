"""Plots and tables of a calibration: where the residuals are, and whether they are what their covariances say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from torchpose.errors import ConfigError
from torchpose.geometry.segments import segment_mean
from torchpose.io.writers import atomic_path, write_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchpose.calibration import Calibration, HandEyeFit

_BLUE, _RED, _GREY = "#0072b2", "#d55e00", "#666666"


def plot_residuals(c: Calibration) -> Figure:
    """Residuals over the frame, their scatter, and their size by view and by point."""
    from matplotlib.figure import Figure  # slow to import, and only plots need it

    figure = Figure((13, 9), layout="constrained")
    (frame, scatter), (by_view, by_point) = figure.subplots(2, 2, width_ratios=[1.4, 1])
    residual, pixels = c.bundle.residual, c.views.pixels
    camera = c.camera

    # the longest arrow is at most a tenth of the frame; the factor is 1, 2 or 5 times a power of ten
    most = 0.1 * camera.width / max(float(residual.norm(dim=-1).max()), 1e-9)
    decade = 10 ** math.floor(math.log10(most))
    enlarged = max(step * decade for step in (1, 2, 5) if step * decade <= most)
    frame.quiver(*pixels.T, *(enlarged * residual.T), angles="xy", scale_units="xy", scale=1, width=0.0018, color=_BLUE)
    frame.plot(*pixels.T, ".", ms=2, color=_GREY)
    frame.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), xlabel="u, px", ylabel="v, px")
    frame.set_aspect("equal")
    frame.set_title(f"seen - predicted, enlarged {enlarged:g} times", fontsize=10)

    scatter.plot(*residual.T, ".", ms=3, color=_BLUE)
    expected = (c.views.covariance.diagonal(dim1=-2, dim2=-1).mean() + c.common_sigma_px**2).sqrt()
    angle = torch.linspace(0, 2 * torch.pi, 121)
    for n in (1, 2, 3):
        scatter.plot(n * expected * angle.cos(), n * expected * angle.sin(), color=_GREY, lw=0.7)
    scatter.set_aspect("equal", "datalim")
    scatter.set(xlabel="u, px", ylabel="v, px")
    scatter.set_title(f"RMS {c.rms_px:.3g} px; circles: 1, 2, 3 sigma of the points", fontsize=10)

    def bars(panel, index: torch.Tensor, names: list[str], title: str) -> None:  # type: ignore[no-untyped-def]
        rms = segment_mean(residual.square().sum(-1), index, len(names)).sqrt()
        own = segment_mean(c.bundle.chi2 / 2, index, len(names)).sqrt()
        panel.bar(range(len(names)), rms.tolist(), color=[_RED if o > 2 else _BLUE for o in own.tolist()])
        panel.set_xticks(range(len(names)), names, rotation=90 if len(names) > 8 else 0, fontsize=7)
        panel.set_ylabel("RMS residual, px")
        panel.set_title(title, fontsize=10)

    bars(by_view, c.views.view, [Path(n).name for n in c.views.names], "by view; red: twice what the covariances say")
    ids, place = c.views.point.unique(return_inverse=True)
    bars(by_point, place, [str(i) for i in ids.tolist()], "by marker or corner")
    for panel in (frame, scatter, by_view, by_point):
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25, lw=0.5)
    common = f", {c.common_sigma_px:.3g} px added to every point" if c.common_sigma_px else ""
    figure.suptitle(
        f"{len(c.views)} views, {len(c.views.view)} points, reduced chi-squared {c.reduced_chi2:.3g}{common}",
        fontsize=11,
    )
    return figure


def plot_hand_eye(fit: HandEyeFit) -> Figure:
    """Residuals of the target's pose in the camera, pose by pose."""
    from matplotlib.figure import Figure

    figure = Figure((11, 6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, unit in (
        (panels[0], 1e3 * fit.residual[:, :3], "um"),
        (panels[1], fit.residual[:, 3:].rad2deg() * 1e3, "mdeg"),
    ):
        for k, (axis, colour) in enumerate(zip("xyz", (_BLUE, _RED, "#009e73"), strict=True)):
            panel.plot(values[:, k], "o-", ms=3, lw=0.8, color=colour, label=axis)
        panel.axhline(0, color=_GREY, lw=0.6)
        panel.set_ylabel(f"{'position' if unit == 'um' else 'rotation'}, {unit}")
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25, lw=0.5)
    panels[0].legend(title="camera axis", ncols=3, fontsize=8)
    panels[1].set_xlabel("pose")
    figure.suptitle(
        f"target seen - predicted from the robot; robot noise {fit.robot_sigma_mm * 1e3:.3g} um, "
        f"{math.degrees(fit.robot_sigma_rad) * 1e3:.3g} mdeg per axis",
        fontsize=11,
    )
    return figure


def save_calibration(calibration: Calibration | None, hand_eye: HandEyeFit | None, folder: Path) -> list[Path]:
    """Writes residuals.png, residuals.csv and covariance.csv, and hand_eye.png; the paths.

    Raises:
        ConfigError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: --plots: {error.strerror}; choose a folder that can be written") from None
    paths = []
    figures = {}
    if calibration is not None:
        figures["residuals.png"] = plot_residuals(calibration)
        paths += _tables(calibration, folder)
    if hand_eye is not None:
        figures["hand_eye.png"] = plot_hand_eye(hand_eye)
    for name, figure in figures.items():
        with atomic_path(folder / name) as temporary:
            figure.savefig(temporary, format="png", dpi=120)
        paths.append(folder / name)
    return paths


def _tables(c: Calibration, folder: Path) -> list[Path]:
    columns = ("u", "v", "du_px", "dv_px", "chi2")
    values = torch.cat([c.views.pixels, c.bundle.residual, c.bundle.chi2[:, None]], 1).tolist()
    rows = (
        {"frame": c.views.names[view], "point": point} | dict(zip(columns, numbers, strict=True))
        for view, point, numbers in zip(c.views.view.tolist(), c.views.point.tolist(), values, strict=True)
    )
    residuals, covariance = folder / "residuals.csv", folder / "covariance.csv"
    write_rows(residuals, rows, {"frame": str, "point": int} | dict.fromkeys(columns, float))
    spread = (
        {"parameter": name} | dict(zip(c.names, row, strict=True))
        for name, row in zip(c.names, c.covariance.tolist(), strict=True)
    )
    write_rows(covariance, spread, {"parameter": str} | dict.fromkeys(c.names, float))
    return [residuals, covariance]
