"""Which copies of a target go on to the refinement, and how many there are."""

from dataclasses import replace

import torch

from torchpose.geometry.arguments import checked
from torchpose.geometry.segments import marked, rank_in_group
from torchpose.identify import MIN_MARKERS, Scene
from torchpose.pose.outcome import Found


@checked
def best_copies(scene: Scene, found: Found, instances: int) -> tuple[Scene, Found]:
    """The best rows of every frame and target: those with a pose first, then by support as they come.

    Their `copies` are then those that a pose explains or, where none does, that four rings or more show: three rings
    that lie as three markers do are an accident where rings are many.

    Args:
        scene: whose each row is.
        found: of these rows.
        instances: most rows of a frame and target.
    """
    rows = len(scene.frame)
    if rows == scene.groups:
        return scene, found
    solved = marked(found.solvable[found.solutions.solved], rows)
    counts = solved | ((found.identified.ring >= 0).sum(-1) > MIN_MARKERS)
    copies = torch.bincount(scene.group[counts], minlength=scene.groups)[scene.group]
    best = rank_in_group(scene.group, by=(~solved).long()) < instances
    kept, chosen = best.nonzero()[:, 0], best[found.solvable]
    return scene.of_rows(scene.group[kept]), found._replace(
        identified=replace(found.identified, copies=copies)[kept],
        evidence=found.evidence[kept],
        solvable=(best.cumsum(0) - 1)[found.solvable[chosen]],
        solutions=found.solutions[chosen],
    )
