"""Picture of a capture plan: where the tool goes, and the box that it may not leave."""

from __future__ import annotations

from pathlib import Path

from torchpose.io.writers import atomic_path
from torchpose.report.figures import COLOURS, GREY, subplots
from torchpose.rig.plan import CapturePlan
from torchpose.rig.settings import Workspace


def draw_path(plan: CapturePlan, workspace: Workspace, out: Path) -> None:
    """Draws the path from above and from two sides with the workspace, and every turn from the origin.

    As SVG, which no command takes for a frame of the session that it lies beside.

    Raises:
        ConfigError: the file cannot be written.
    """
    from matplotlib.patches import Rectangle

    positions, turns = plan.positions().numpy(), plan.turns().rad2deg().numpy()
    kinds = list(dict.fromkeys(waypoint.kind for waypoint in plan.waypoints))
    figure, axes = subplots(2, 2, (9, 8))
    for panel, (a, b) in zip(axes.flat, ((0, 1), (0, 2), (1, 2)), strict=False):
        low, high = workspace.min, workspace.max
        box = Rectangle((low[a], low[b]), high[a] - low[a], high[b] - low[b], fill=False, ec=GREY, ls="--")
        panel.add_patch(box)
        panel.plot(positions[:, a], positions[:, b], color=GREY, lw=0.6, alpha=0.6)
        for kind, colour in zip(kinds, COLOURS, strict=False):
            rows = [i for i, waypoint in enumerate(plan.waypoints) if waypoint.kind == kind]
            panel.plot(positions[rows, a], positions[rows, b], "o", ms=4, color=colour, alpha=0.7, label=kind)
        panel.set(xlabel=f"{'xyz'[a]} in the base (mm)", ylabel=f"{'xyz'[b]} in the base (mm)")
        panel.set_aspect("equal", adjustable="datalim")
        panel.autoscale_view()
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(kinds), frameon=False)
    axes[0, 0].set_title("tool and workspace (dashed)")
    last = axes[1, 1]
    last.plot(turns, color=GREY, lw=0.6, alpha=0.6)
    for kind, colour in zip(kinds, COLOURS, strict=False):
        rows = [i for i, waypoint in enumerate(plan.waypoints) if waypoint.kind == kind]
        last.plot(rows, turns[rows], "o", ms=4, color=colour, alpha=0.7)
    last.set(xlabel="waypoint", ylabel="angle from the origin (deg)")
    figure.suptitle(f"{plan.name}: {len(plan.waypoints)} waypoints")
    with atomic_path(out) as temporary:
        figure.savefig(temporary, format="svg")
