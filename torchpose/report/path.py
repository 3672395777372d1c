"""Picture of a capture plan: where the tool goes, and the box that it may not leave."""

from pathlib import Path

from matplotlib.patches import Rectangle

from torchpose.report.figures import COLOURS, GREY, subplots
from torchpose.report.files import save_figures
from torchpose.rig.plan import CapturePlan
from torchpose.rig.settings import Workspace


def draw_path(plan: CapturePlan, workspace: Workspace, out: Path) -> None:
    """Draws the path from above and from two sides with the workspace, and every turn from the origin.

    As SVG, which no command takes for a frame of the session that it lies beside. ConfigError: it cannot be written.
    """
    positions, turns = plan.positions().numpy(), plan.turns().rad2deg().numpy()
    kinds: dict[str, list[int]] = {}
    for number, waypoint in enumerate(plan.waypoints):
        kinds.setdefault(waypoint.kind, []).append(number)
    figure, axes = subplots(2, 2, (9, 8))
    *views, last = axes.flat
    low, high = workspace.min, workspace.max
    for panel, (a, b) in zip(views, ((0, 1), (0, 2), (1, 2)), strict=True):
        panel.add_patch(Rectangle((low[a], low[b]), high[a] - low[a], high[b] - low[b], fill=False, ec=GREY, ls="--"))
        panel.plot(positions[:, a], positions[:, b], color=GREY, lw=0.6, alpha=0.6)
        for (kind, rows), colour in zip(kinds.items(), COLOURS, strict=False):
            panel.plot(positions[rows, a], positions[rows, b], "o", ms=4, color=colour, alpha=0.7, label=kind)
        panel.set(xlabel=f"{'xyz'[a]} in the base (mm)", ylabel=f"{'xyz'[b]} in the base (mm)")
        panel.set_aspect("equal", adjustable="datalim")
        panel.autoscale_view()
    figure.legend(*views[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(kinds), frameon=False)
    views[0].set_title("tool and workspace (dashed)")
    last.plot(turns, color=GREY, lw=0.6, alpha=0.6)
    for rows, colour in zip(kinds.values(), COLOURS, strict=False):
        last.plot(rows, turns[rows], "o", ms=4, color=colour, alpha=0.7)
    last.set(xlabel="waypoint", ylabel="angle from the origin (deg)")
    figure.suptitle(f"{plan.name}: {len(plan.waypoints)} waypoints")
    save_figures({out.name: figure}, out.parent)
