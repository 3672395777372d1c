"""What became of every target in every frame: who owns a ring that two targets claim, the status, the rows returned."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.identify import Identified, MarkerTable
from torchpose.pose.centers import raw_centers
from torchpose.pose.evidence import Evidence
from torchpose.pose.solutions import MIN_MARKERS, Solutions
from torchpose.results import Detections, Poses, Reason, Status
from torchpose.rings import Rings


def outcome(
    target: Tensor,
    solvable: Tensor,
    s: Solutions,
    e: Evidence,
    identified: Identified,
    rings: Rings,
    table: MarkerTable,
    camera: Camera,
) -> Poses:
    """Rows of every frame and target, N = B * T.

    Args:
        target: (N,) int64. solvable: (S,) int64, the rows with solutions. s: these S. e, identified: of the N rows.
        rings: of all frames.
    """
    rows, device = target.numel(), target.device
    frame = torch.arange(rows, device=device) // len(table.ids)
    mask = e.mask.clone()
    mask[solvable] = s.mask
    status = torch.full((rows,), int(Status.REJECTED), device=device)
    reason = torch.full((rows,), int(Reason.RESIDUAL), device=device)
    status[solvable], reason[solvable] = s.status, s.reason

    support = torch.where(status == Status.REJECTED, 0, mask.sum(-1))
    found, claimed = _awarded(support, mask, identified.ring, len(rings))

    # without a pose: the rings that nobody else explains tell why
    proposed = identified.proposed(~claimed)
    mask &= found[:, None] | ~torch.cat([claimed, claimed.new_ones(1)])[identified.ring]
    few = ~found & (proposed < MIN_MARKERS)
    few_status = torch.where(proposed == 0, int(Status.NO_TARGET), int(Status.TOO_FEW_MARKERS))
    status = torch.where(few, few_status, status)
    reason = torch.where(few, int(Reason.NONE), reason)

    def spread(values: Tensor) -> Tensor:
        out = torch.full((rows, *values.shape[1:]), torch.nan, dtype=values.dtype, device=device)
        out[solvable] = values
        return torch.where(found.view(-1, *[1] * (values.ndim - 1)), out, torch.nan)

    row, marker = mask.nonzero().unbind(-1)
    ring = identified.ring[row, marker]
    center, center_cov = raw_centers(camera, e.center[row, marker], e.covariance[row, marker])
    detections = Detections(
        frame[row],
        target[row],
        table.ids[target[row], marker],
        center,
        center_cov,
        rings.outer_raw[ring],
        rings.inner_raw[ring],
    )
    names = ("R", "t", "covariance", "rms", "chi2", "R_alt", "t_alt", "rms_alt", "chi2_alt")
    return Poses(
        frame=frame,
        target=target,
        status=status,
        reason=reason,
        markers=torch.where(few, proposed, mask.sum(-1)),
        detections=detections,
        **{n: spread(getattr(s, n)) for n in names},
    )


def _awarded(support: Tensor, mask: Tensor, ring: Tensor, rings: int) -> tuple[Tensor, Tensor]:
    """Rows (N,) bool that keep their pose, and rings (K,) bool that these explain.

    A ring belongs to one target: where two claim it, to the one that explains more rings.

    Args:
        support: (N,) int64, number of rings the pose explains, 0 without one. mask: (N, M) bool, which markers' rings.
        ring: (N, M) int64, index into the ``rings`` K.
    """
    row, marker = (mask & (support > 0)[:, None]).nonzero().unbind(-1)
    of = ring[row, marker]
    best = torch.zeros(rings, dtype=support.dtype, device=support.device)
    best.scatter_reduce_(0, of, support[row], "amax")
    outdone = torch.zeros_like(support).index_add_(0, row, (support[row] < best[of]).to(support.dtype)) > 0
    claimed = torch.zeros(rings, dtype=torch.bool, device=support.device)
    claimed[of[~outdone[row]]] = True
    return (support > 0) & ~outdone, claimed
