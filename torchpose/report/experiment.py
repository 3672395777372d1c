"""Plots of the experiment, as Fig. 13 of the paper: errors over frames and steps, with what the poses claim."""

from typing import Any

import torch
from matplotlib.figure import Figure

from torchpose.analysis import rms
from torchpose.report.figures import COLOURS, GREY, band, subplots
from torchpose.rig.experiment import AXES, Experiment, Moves, Static, unit


def plot_experiment(experiment: Experiment, title: str) -> Figure:
    """Static deviations over the frames on top, errors over the moves and turns below; bands: 2 sigma claimed."""
    figure, panels = subplots(4, 3, (13, 12))
    for k, axis in enumerate(AXES):
        turn, (name, _) = k > 2, unit(axis)
        resting, moving = panels[k // 3, k % 3], panels[2 + k // 3, k % 3]
        if experiment.static is not None:
            _plot_static(resting, experiment.static, k)
        for moves in (m for m in experiment.moves if m.axis == axis):
            _plot_moves(moving, moves, COLOURS[k % 3])
        resting.set(xlabel="frame", ylabel=f"deviation [{name}]")
        moving.set(xlabel=f"move of the robot [{'degrees' if turn else 'mm'}]", ylabel=f"camera - robot [{name}]")
        for panel in (resting, moving):
            panel.axhline(0, color=GREY, lw=0.6)
    robot = "emulated rig" if experiment.emulated else "robot and camera"
    figure.suptitle(f"{title} ({robot}): camera - robot; bands: 2 sigma claimed by the poses", fontsize=11)
    return figure


def _plot_static(panel: Any, static: Static, axis: int) -> None:
    name, scale = unit(AXES[axis])
    number = torch.arange(len(static.deviation))
    band(panel, number, 2 * scale * static.sigma[:, axis])
    panel.plot(number, scale * static.deviation[:, axis], "o-", ms=3, lw=0.7, color=COLOURS[axis % 3])
    words = f"{'about ' if axis > 2 else ''}{'xyz'[axis % 3]}"
    spread, claimed = scale * float(static.spread[axis]), scale * float(static.claimed[axis])
    panel.set_title(f"at rest, {words}: {spread:.3g} {name}, claimed {claimed:.3g}", fontsize=9)


def _plot_moves(panel: Any, moves: Moves, colour: str) -> None:
    name, scale = unit(moves.axis)
    order = moves.value.argsort()
    at = (moves.robot.rad2deg() if moves.turn else moves.robot)[order].tolist()
    error, sigma = scale * moves.error[order], scale * moves.sigma[order]
    band(panel, at, 2 * sigma)
    panel.plot(at, error.tolist(), "o-", ms=3, lw=0.7, color=colour)
    panel.set_title(f"{moves.axis}: RMS {rms(error):.3g} {name}, claimed {rms(sigma):.3g}", fontsize=9)
