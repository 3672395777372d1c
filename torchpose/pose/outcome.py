"""What became of every target in every frame: who owns a ring that two rows claim, the status, the rows returned."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either, numbers
from torchpose.geometry.rows import replace
from torchpose.geometry.segments import marked, rank_in_group
from torchpose.identify import MIN_MARKERS, Identified, Scene
from torchpose.pose.centers import raw_centers
from torchpose.pose.evidence import Evidence
from torchpose.pose.excess import improbable
from torchpose.pose.solutions import Solutions
from torchpose.results import Detections, Misfit, Poses, Reason, Status
from torchpose.rings import Rings

# fields of `Solutions` that `Poses` has of every row
_OF_SOLUTIONS = (
    "R",
    "t",
    "covariance",
    "noise",
    "systematic",
    "place",
    "residual_chi2",
    "rms",
    "chi2",
    "R_alt",
    "t_alt",
    "rms_alt",
    "chi2_alt",
)


class Found(NamedTuple):
    """What the stages found in a scene of N rows: rings of all frames, which markers they are, and what these tell.

    solvable: (S,) int64, the rows with enough of it. solutions: of these.
    """

    rings: Rings
    identified: Identified
    evidence: Evidence
    solvable: Tensor
    solutions: Solutions


@checked
def outcome(scene: Scene, found: Found) -> Poses:
    """Rows of every frame and target: at least one, and one for each copy that has a pose."""
    rows, solvable = len(found.evidence), found.solvable
    solutions = _vouched(found.solutions, found.evidence.mask[solvable])
    device = solvable.device
    mask = found.evidence.mask.index_copy(0, solvable, solutions.mask)
    status = torch.full((rows,), int(Status.REJECTED), device=device).index_copy(0, solvable, solutions.status)
    reason = torch.full((rows,), int(Reason.RESIDUAL), device=device).index_copy(0, solvable, solutions.reason)
    support = either(status == Status.REJECTED, 0, mask.sum(-1))
    awarded, claimed = award((scene.target, len(scene.table)), support, mask, found.identified.ring, len(found.rings))

    # without a pose: the rings that nobody else explains tell why
    proposed = found.identified.proposed(~claimed)
    mask &= awarded[:, None] | ~torch.cat([claimed, claimed.new_ones(1)])[found.identified.ring]
    few = ~awarded & (proposed < MIN_MARKERS)
    few_status = either(proposed == 0, int(Status.NO_TARGET), int(Status.TOO_FEW_MARKERS))

    whole = bool(awarded.all())  # each has a solution then

    def spread(values: Tensor) -> Tensor:
        if whole:
            return values
        out = torch.full((rows, *values.shape[1:]), torch.nan, dtype=values.dtype, device=device)
        kept = awarded.view(-1, *[1] * (values.ndim - 1))
        return either(kept, out.index_copy(0, solvable, values), torch.nan)

    # no row is sure of its pose without a covariance that is one
    unknown = (status == Status.OK) & ~_positive(spread(solutions.covariance))
    status = either(unknown, int(Status.REJECTED), status)
    reason = either(unknown, int(Reason.DEGENERATE), reason)
    every = Poses(
        frame=scene.frame,
        target=scene.target,
        instance=torch.zeros_like(scene.frame),
        copies=torch.maximum(
            found.identified.copies, torch.bincount(scene.group[awarded], minlength=scene.groups)[scene.group]
        ),
        status=torch.where(few, few_status, status),
        reason=either(few, int(Reason.NONE), reason),
        markers=torch.where(few, proposed, mask.sum(-1)),
        **{
            name: torch.zeros_like(status).index_copy(0, solvable, getattr(solutions, name)) * awarded
            for name in ("misfit", "freedom")
        },
        detections=detections_of(scene, found, mask),
        of_camera=found.evidence.of_camera,
        **{name: spread(getattr(solutions, name)) for name in _OF_SOLUTIONS},
    )
    return every if rows == scene.groups else _numbered(scene, every, awarded)


def _vouched(solutions: Solutions, identified: Tensor) -> Solutions:
    """Solutions that left a marker out of those ``identified`` (S, M) only where the others may be of a print.

    Three centres agree with any pose: if their rings scatter, it is not known which marker is wrong.
    """
    few = solutions.mask.sum(-1) <= MIN_MARKERS
    left_out = (identified & ~solutions.mask).any(-1)
    # rims may scatter so evenly that they count as so much noise
    beyond_noise = (solutions.misfit == Misfit.NONE) & improbable(solutions.chi2, solutions.freedom)
    scatter = (solutions.misfit == Misfit.SCATTER) | beyond_noise
    return solutions.marked(solutions.ok & few & left_out & scatter, Status.REJECTED, Reason.RESIDUAL)


def _positive(covariance: Tensor) -> Tensor:
    """Covariances (N,) bool, each scaled by its own deviations, that are positive definite."""
    scale = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).rsqrt()
    scaled = either(numbers(scale)[..., None], covariance * scale[..., :, None] * scale[..., None, :], -1.0)
    return torch.linalg.cholesky_ex(scaled.nan_to_num(nan=-1.0))[1] == 0


def _numbered(scene: Scene, poses: Poses, awarded: Tensor) -> Poses:
    """The rows with a pose, from left to right, or the best-supported one of a frame and target without any.

    Args:
        scene: whose each row is.
        poses: rows of which those of one frame and target are sorted by support; detections have the row for number.
        awarded: (N,) bool, rows with a pose.
    """
    kept, place = _instances(scene, awarded, poses.t)
    number = torch.full_like(scene.frame, -1).index_copy_(0, kept, place)
    seen = replace(poses.detections, instance=number[poses.detections.instance])
    return replace(poses[kept], instance=place, detections=seen[seen.instance >= 0])


def _instances(scene: Scene, awarded: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Indices (P,) of the rows to return, see `_numbered`, and their numbers (P,) among those of a frame and target."""
    group = scene.group
    first = torch.cat([awarded.new_ones(1), group.diff() > 0])[: len(group)]
    kept = (awarded | (first & ~marked(group[awarded], scene.groups)[group])).nonzero()[:, 0]
    left = scene.camera.project(t[kept])[:, 0].nan_to_num(nan=torch.inf)
    place = rank_in_group(group[kept], by=left)
    order = torch.argsort(group[kept] * len(group) + place)
    return kept[order], place[order]


def detections_of(scene: Scene, found: Found, mask: Tensor) -> Detections:
    """The markers of the rows that the mask (N, M) has; their instance is the row, or 0 where each has one."""
    row, marker = mask.nonzero().unbind(-1)
    ring, target = found.identified.ring[row, marker], scene.target[row]
    evidence = found.evidence
    center, covariance = raw_centers(scene.camera, evidence.center[row, marker], evidence.covariance[row, marker])
    ids = scene.table.ids[target, marker]
    number = torch.zeros_like(row) if len(mask) == scene.groups else row
    disc = scene.table.radii[target, marker, 1] < 0
    inner = either(disc[:, None], torch.nan, found.rings.inner_raw.index_select(0, ring))
    outer = found.rings.outer_raw.index_select(0, ring)
    return Detections(scene.frame[row], target, number, ids, center, covariance, outer, inner)


def award(target: tuple[Tensor, int], support: Tensor, mask: Tensor, ring: Tensor, rings: int) -> tuple[Tensor, Tensor]:
    """Rows (N,) bool that keep their pose, and rings (K,) bool that these explain.

    A ring belongs to one copy of one target: where two claim it, to the one that explains more rings; of two copies of
    one target that explain as many, to the better-supported one.

    Args:
        target: of each row (N,), and their number.
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
    slot = of * target[1] + target[0][row]
    first = torch.full((rings * target[1],), len(mask), device=row.device)
    first.scatter_reduce_(0, slot[~less], row[~less], "amin")
    outdone = marked(row[less | (row > first[slot])], len(mask))
    claimed = marked(of[~outdone[row]], rings)
    return (support > 0) & ~outdone, claimed
