"""Plots of the experiment, as Fig. 13 of the paper: errors over frames and steps, with what the poses claim."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from torchpose.report.figures import COLOURS, GREY, subplots
from torchpose.rig.experiment import AXES, Experiment, unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_experiment(e: Experiment, title: str) -> Figure:
    """Static deviations over the frames on top, errors over the moves and turns below; bands: 2 sigma claimed."""
    figure, panels = subplots(4, 3, (13, 12))
    for k, axis in enumerate(AXES):
        name, scale = unit(axis)
        panel = panels[k // 3, k % 3]
        if e.static is not None:
            number = torch.arange(len(e.static.deviation))
            sigma = 2 * scale * e.static.sigma[:, k]
            panel.fill_between(number, (-sigma).tolist(), sigma.tolist(), color="#e6e6e6", lw=0)
            panel.plot(number, scale * e.static.deviation[:, k], "o-", ms=3, lw=0.7, color=COLOURS[k % 3])
            spread, claimed = scale * float(e.static.spread[k]), scale * float(e.static.claimed[k])
            panel.set_title(f"static, {_camera_axis(k)}: {spread:.3g} {name}, claimed {claimed:.3g}", fontsize=10)
        panel.set(xlabel="frame", ylabel=name)
        panel.axhline(0, color=GREY, lw=0.6)
    for k, axis in enumerate(AXES):
        name, scale = unit(axis)
        panel = panels[2 + k // 3, k % 3]
        for moves in (m for m in e.moves if m.axis == axis):
            _plot_moves(panel, moves, COLOURS[k % 3], name, scale)
        panel.set(xlabel=f"robot, {'degrees' if k > 2 else 'mm'}", ylabel=name)
        panel.axhline(0, color=GREY, lw=0.6)
    robot = "emulated rig" if e.emulated else "robot and camera"
    figure.suptitle(f"{title} ({robot}): camera - robot; bands: 2 sigma claimed by the poses", fontsize=11)
    return figure


def _camera_axis(k: int) -> str:
    return f"{'rotation about' if k > 2 else ''} {'xyz'[k % 3]}".strip()


def _plot_moves(panel: Any, moves: Any, colour: str, name: str, scale: float) -> None:
    order = moves.value.argsort()
    at = moves.robot[order]
    at = (at.rad2deg() if moves.turn else at).tolist()
    error, sigma = scale * moves.error[order], 2 * scale * moves.sigma[order]
    panel.fill_between(at, (-sigma).tolist(), sigma.tolist(), color="#e6e6e6", lw=0)
    panel.plot(at, error.tolist(), "o-", ms=3, lw=0.7, color=colour)
    rms = float(error.square().mean().sqrt())
    claimed = 0.5 * float(sigma.square().mean().sqrt())
    panel.set_title(f"{moves.axis}: RMS {rms:.3g} {name}, claimed {claimed:.3g}", fontsize=10)
