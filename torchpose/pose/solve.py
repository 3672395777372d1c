"""Stage: from identified markers to one pose a row, its covariance, and an honest status.

Every row is solved from two starts (both planar solutions; with three markers the rough pose of the identification and
its mirror image), each refined by batched Levenberg-Marquardt. The solution that explains all evidence best wins: the
centres by their covariances, and the shapes of the rings' own ellipses, which decide alone where only three markers are
seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.pose.covariance import pose_covariance
from torchpose.pose.evidence import Evidence, shape_chi2, visible
from torchpose.pose.solutions import AMBIGUOUS_CHI2, Solutions
from torchpose.results import Reason, Status

_SHAPE_LIMIT = 16.0  # mean chi-squared a shape component above which the rings contradict the pose
_CENTER_LIMIT = (30.0, 10.0)  # chi-squared, and per degree of freedom, above which the centres contradict each other
_ITERATIONS = (16, 60)  # of the solver: for most rows, and for those that need more
_CENTER_RMS = 0.3  # px, below which they do not: small errors of calibration or print are no mix-up


def solve_poses(evidence: Evidence, rough: tuple[Tensor, Tensor]) -> Solutions:
    """Pose, alternative, covariance and status of N rows with three markers or more.

    A row whose centres contradict each other is solved again without each of its markers in turn; if one of these fits,
    that marker is left out.

    Args:
        evidence: N rows. rough: R (N, 3, 3), t (N, 3) to start from.
    """
    solved = _solve(evidence, rough, _ITERATIONS[0])
    slow = (solved.reason == Reason.NOT_CONVERGED).nonzero()[:, 0]
    if slow.numel():
        solved = solved.replaced(slow, _solve(evidence[slow], (rough[0][slow], rough[1][slow]), _ITERATIONS[1]))
    bad = (solved.status == Status.REJECTED) & (evidence.mask.sum(-1) >= 4)
    row, marker = (bad[:, None] & evidence.mask).nonzero().unbind(-1)
    if row.numel() == 0:
        return solved
    retry = _solve(evidence[row].without(marker), (rough[0][row], rough[1][row]), _ITERATIONS[1])
    # of the subsets that fit, the one with the least chi-squared
    cost = torch.where(retry.status == Status.REJECTED, torch.inf, retry.chi2.nan_to_num(nan=torch.inf))
    least = torch.full(bad.shape, torch.inf, dtype=cost.dtype, device=cost.device).scatter_reduce(0, row, cost, "amin")
    winner = (cost.isfinite() & (cost == least[row])).nonzero()[:, 0]
    return solved.replaced(row[winner], retry[winner])


def _solve(e: Evidence, rough: tuple[Tensor, Tensor], iterations: int) -> Solutions:
    seen = e.mask.sum(-1)
    center = torch.where(e.mask[..., None], e.center, 0.0)
    result = pnp.solve(
        e.points,
        center,
        e.matrix,
        covariances=visible(e.covariance, e.mask),
        mask=e.mask,
        initial=_starts(e, rough),
        max_iterations=iterations,
    )
    # both minima of the centres, weighed again with the rings' shapes
    both_r, both_t = torch.stack([result.R, result.R_alt], 1), torch.stack([result.t, result.t_alt], 1)
    center_chi2 = torch.stack([result.chi2, result.chi2_alt], 1)
    of_shapes = shape_chi2(e, both_r, both_t)
    total = (center_chi2 + of_shapes).nan_to_num(nan=torch.inf)  # NaN: no such minimum
    chi2, best = total.min(1)
    row = torch.arange(best.numel(), device=best.device)
    r, t, rms = both_r[row, best], both_t[row, best], torch.stack([result.rms, result.rms_alt], 1)
    covariance, determined = pose_covariance(e, r, t)
    chi2_alt = total[row, 1 - best]
    chi2_alt = torch.where(chi2_alt.isfinite(), chi2_alt, torch.nan)

    chi2_center, rms_best = center_chi2[row, best], rms[row, best]
    contradicts = (chi2_center > _CENTER_LIMIT[0] + _CENTER_LIMIT[1] * (2 * seen - 6)) & (rms_best > _CENTER_RMS)
    reason = torch.full_like(seen, Reason.NONE)
    for condition, why in (
        (chi2_alt - chi2 < AMBIGUOUS_CHI2, Reason.TWO_SOLUTIONS),
        (of_shapes[row, best] > 4 * _SHAPE_LIMIT * seen, Reason.RING_SHAPE),
        (contradicts, Reason.RESIDUAL),
        (~chi2.isfinite(), Reason.NOT_CONVERGED),
        (result.code == pnp.PnPCode.BEHIND_CAMERA, Reason.BEHIND_CAMERA),
        ((result.code == pnp.PnPCode.DEGENERATE) | (chi2.isfinite() & ~determined), Reason.DEGENERATE),
    ):
        reason = torch.where(condition, int(why), reason)  # the last that holds
    status = torch.where(reason == Reason.NONE, int(Status.OK), int(Status.REJECTED))
    status = torch.where(reason == Reason.TWO_SOLUTIONS, int(Status.AMBIGUOUS), status)
    return Solutions(
        r,
        t,
        covariance,
        rms_best,
        chi2,
        both_r[row, 1 - best],
        both_t[row, 1 - best],
        rms[row, 1 - best],
        chi2_alt,
        status,
        reason,
        e.mask,
    )


def _starts(e: Evidence, rough: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Two poses (N, 2, 3, 3), (N, 2, 3) to start from: both planar solutions, or the rough pose and its mirror."""
    r, t = rough
    # depth mirrored along the line of sight, the plane turned back on itself: the same weak-perspective image
    weight = e.mask.double() / e.mask.sum(-1, keepdim=True)
    middle = (e.points * weight[..., None]).sum(1)
    at = (r @ middle[..., None]).squeeze(-1) + t
    first = e.mask.int().argmax(-1)
    normal = e.normals[torch.arange(first.numel(), device=first.device), first]
    mirrored = _reflection(at) @ r @ _reflection(normal)
    mirrored_t = at - (mirrored @ middle[..., None]).squeeze(-1)
    focal, principal = e.matrix.diagonal()[:2], e.matrix[:2, 2]
    xy = torch.where(e.mask[..., None], (e.center - principal) / focal, 0.0)
    flat = pnp.planar(e.points, xy, mask=e.mask)
    both = flat.R.isfinite().all(-1).all(-1).all(-1)  # else a marker behind the camera, or no plane
    planar = (e.coplanar & (e.mask.sum(-1) >= 4) & both)[:, None]
    start_r = torch.where(planar[..., None, None], flat.R, torch.stack([r, mirrored], 1))
    start_t = torch.where(planar[..., None], flat.t, torch.stack([t, mirrored_t], 1))
    return start_r, start_t


def _reflection(direction: Tensor) -> Tensor:
    """Householder matrices (N, 3, 3) that turn ``direction`` (N, 3) round."""
    unit = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
    return eye - 2 * unit[..., :, None] * unit[..., None, :]
