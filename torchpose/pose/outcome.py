"""What became of every target in every frame: who owns a ring that two rows claim, the status, the rows returned."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.segments import marked, rank_in_group
from torchpose.identify import MIN_MARKERS, Identified, Scene
from torchpose.pose.centers import raw_centers
from torchpose.pose.evidence import Evidence
from torchpose.pose.solutions import Solutions
from torchpose.results import Detections, Poses, Reason, Status
from torchpose.rings import Rings


class Found(NamedTuple):
    """What the stages found in a scene of N rows: rings of all frames, which markers they are, and what these tell.

    solvable: (S,) int64, the rows with enough of it. solutions: of these.
    """

    rings: Rings
    identified: Identified
    evidence: Evidence
    solvable: Tensor
    solutions: Solutions


def outcome(scene: Scene, found: Found) -> Poses:
    """Rows of every frame and target: at least one, and one for each copy that has a pose."""
    rows, solvable, solutions = len(found.evidence), found.solvable, found.solutions
    device = solvable.device
    mask = found.evidence.mask.index_copy(0, solvable, solutions.mask)
    status = torch.full((rows,), int(Status.REJECTED), device=device).index_copy(0, solvable, solutions.status)
    reason = torch.full((rows,), int(Reason.RESIDUAL), device=device).index_copy(0, solvable, solutions.reason)
    support = torch.where(status == Status.REJECTED, 0, mask.sum(-1))
    awarded, claimed = _awarded(scene, support, mask, found.identified.ring, len(found.rings))

    # without a pose: the rings that nobody else explains tell why
    proposed = found.identified.proposed(~claimed)
    mask &= awarded[:, None] | ~torch.cat([claimed, claimed.new_ones(1)])[found.identified.ring]
    few = ~awarded & (proposed < MIN_MARKERS)
    few_status = torch.where(proposed == 0, int(Status.NO_TARGET), int(Status.TOO_FEW_MARKERS))

    def spread(values: Tensor) -> Tensor:
        out = torch.full((rows, *values.shape[1:]), torch.nan, dtype=values.dtype, device=device)
        kept = awarded.view(-1, *[1] * (values.ndim - 1))
        return torch.where(kept, out.index_copy(0, solvable, values), torch.nan)

    names = ("R", "t", "covariance", "rms", "chi2", "R_alt", "t_alt", "rms_alt", "chi2_alt")
    values = {name: spread(getattr(solutions, name)) for name in names}
    kept, instance = _instances(scene, awarded, values["t"])
    found = found._replace(evidence=found.evidence[kept], identified=found.identified[kept])
    scene, mask = scene.of_rows(scene.group[kept]), mask[kept]
    return Poses(
        frame=scene.frame,
        target=scene.target,
        instance=instance,
        copies=torch.maximum(found.identified.copies, torch.bincount(scene.group[awarded[kept]], minlength=scene.groups)[scene.group]),
        status=torch.where(few, few_status, status)[kept],
        reason=torch.where(few, int(Reason.NONE), reason)[kept],
        markers=torch.where(few[kept], proposed[kept], mask.sum(-1)),
        detections=_detections(scene, found, mask, instance),
        **{name: value[kept] for name, value in values.items()},
    )


def _instances(scene: Scene, awarded: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """The rows (P,) to return, and their numbers (P,) among the copies of their frame and target, from left to right.

    These are the rows with a pose, or the best-supported one where no copy has one.
    """
    group = scene.group
    first = torch.cat([awarded.new_ones(1), group.diff() > 0])[: len(group)]
    kept = (awarded | (first & ~marked(group[awarded], scene.groups)[group])).nonzero()[:, 0]
    left = scene.camera.project(t[kept])[:, 0].nan_to_num(nan=torch.inf)
    place = rank_in_group(group[kept], by=left)
    order = torch.argsort(group[kept] * len(group) + place)
    return kept[order], place[order]


def _detections(scene: Scene, found: Found, mask: Tensor, instance: Tensor) -> Detections:
    """The markers of the rows that the mask (N, M) has."""
    row, marker = mask.nonzero().unbind(-1)
    ring, target = found.rings[found.identified.ring[row, marker]], scene.target[row]
    evidence = found.evidence
    center, covariance = raw_centers(scene.camera, evidence.center[row, marker], evidence.covariance[row, marker])
    ids = scene.table.ids[target, marker]
    return Detections(scene.frame[row], target, instance[row], ids, center, covariance, ring.outer_raw, ring.inner_raw)


def _awarded(scene: Scene, support: Tensor, mask: Tensor, ring: Tensor, rings: int) -> tuple[Tensor, Tensor]:
    """Rows (N,) bool that keep their pose, and rings (K,) bool that these explain.

    A ring belongs to one copy of one target: where two claim it, to the one that explains more rings; of two copies of
    one target that explain as many, to the better-supported one.

    Args:
        scene: whose each row is.
        support: (N,) int64, number of rings the pose explains, 0 without one.
        mask: (N, M) bool, which markers' rings.
        ring: (N, M) int64, index into the ``rings`` K.
        rings: their number.
    """
    row, marker = (mask & (support > 0)[:, None]).nonzero().unbind(-1)
    of = ring[row, marker]
    best = torch.zeros(rings, dtype=support.dtype, device=support.device)
    best.scatter_reduce_(0, of, support[row], "amax")
    less = support[row] < best[of]
    slot = of * len(scene.table) + scene.target[row]
    first = torch.full((rings * len(scene.table),), len(mask), device=row.device)
    first.scatter_reduce_(0, slot[~less], row[~less], "amin")
    outdone = marked(row[less | (row > first[slot])], len(mask))
    claimed = marked(of[~outdone[row]], rings)
    return (support > 0) & ~outdone, claimed
