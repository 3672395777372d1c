"""Stage: from identified markers to one pose a row, its covariance, and an honest status.

Every row is solved from two starts (both planar solutions; with three markers the rough pose of the identification and
its mirror image), each refined by batched Levenberg-Marquardt. The solution that explains all evidence best wins: the
centres by their covariances, and the shapes of the rings' own ellipses, which decide alone where only three markers are
seen.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose import pnp
from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either, finite, numbers
from torchpose.geometry.robust import CUT
from torchpose.pose.covariance import pose_covariance
from torchpose.pose.evidence import CENTER_RMS, Evidence, misfit_of_shapes, predicted_circles, visible
from torchpose.pose.sizes import sizes_beyond
from torchpose.pose.solutions import AMBIGUOUS_CHI2, PLACE, Solutions
from torchpose.results import Reason, Status

_ITERATIONS = 60  # of the solver, at most: rows that have converged rest


@checked
def solve_poses(
    evidence: Evidence, rough: tuple[Tensor, Tensor], *, near: bool = False, compile: bool = False
) -> Solutions:
    """Pose, alternative, covariance and status of N rows with three markers or more.

    A row whose centres contradict each other is solved again without each of its markers in turn; if one of these fits,
    that marker is left out.

    Args:
        evidence: N rows.
        rough: R (N, 3, 3), t (N, 3) to start from.
        near: the rough poses are within pixels of the true ones: none is sought without them.
        compile: as for `pnp.solve`.
    """
    if len(evidence) == 0:
        return _no_solutions(evidence, *rough)
    solved = _solve(evidence, _starts(evidence, rough, near), compile)
    bad = (solved.status == Status.REJECTED) & (evidence.mask.sum(-1) >= 4)
    row, marker = (bad[:, None] & evidence.mask).nonzero().unbind(-1)
    if row.numel() == 0:
        return solved
    rest = evidence[row].without(marker)
    retry = _solve(rest, _starts(rest, (rough[0][row], rough[1][row]), near), compile)
    # of the subsets that fit, the one with the least chi-squared
    cost = either(retry.status == Status.REJECTED, torch.inf, retry.chi2.nan_to_num(nan=torch.inf))
    least = torch.full(bad.shape, torch.inf, dtype=cost.dtype, device=cost.device).scatter_reduce(0, row, cost, "amin")
    winner = (cost.isfinite() & (cost == least[row])).nonzero()[:, 0]
    return solved.replaced(row[winner], retry[winner])


def _solve(evidence: Evidence, starts: tuple[Tensor, Tensor], compile: bool) -> Solutions:
    R, t, rms, of_centers, behind, degenerate = _minima(evidence, starts, compile)
    # both minima of the centres, weighed again with the rings' shapes
    circles = predicted_circles(evidence, R, t)
    of_shapes = misfit_of_shapes(evidence, circles)
    chi2, best = (of_centers + of_shapes).nan_to_num(nan=torch.inf).sort(1)  # NaN: no such minimum
    row = torch.arange(len(best), device=best.device)[:, None]
    R, t, rms, of_centers, of_shapes = (x[row, best] for x in (R, t, rms, of_centers, of_shapes))
    # shapes that contradict the better pose as well tell less by as much
    over = (of_shapes[:, 0] / (4 * evidence.mask.sum(-1))).clamp_min(1.0)
    ahead = of_centers[:, 1] - of_centers[:, 0] + (of_shapes[:, 1] - of_shapes[:, 0]) / over
    shift, larger = sizes_beyond(evidence, circles[row[:, 0], best[:, 0]])
    covariance, determined = pose_covariance(evidence, R[:, 0], t[:, 0])
    chi2_alt = either(numbers(chi2[:, 1]), chi2[:, 1], torch.nan)
    seen = evidence.mask.sum(-1)
    freedom = (2 * seen - 6).clamp_min(1)
    # half of the way to the next code, markers may as well be their neighbours
    contradicts = (of_centers[:, 0] > CUT**2 * freedom) & (rms[:, 0] > CENTER_RMS) | (shift > 0.5)
    solvable = numbers(chi2[:, 0])
    reason = torch.full_like(seen, Reason.NONE)
    for condition, why in (
        (ahead < AMBIGUOUS_CHI2, Reason.TWO_SOLUTIONS),
        (of_shapes[:, 0] > CUT**2 * 4 * seen, Reason.RING_SHAPE),
        (contradicts, Reason.RESIDUAL),
        (_from_behind(evidence, R[:, 0], t[:, 0]), Reason.MIRRORED),
        (~solvable, Reason.NOT_CONVERGED),
        (behind, Reason.BEHIND_CAMERA),
        (degenerate | (solvable & ~determined), Reason.DEGENERATE),
    ):
        reason = either(condition, int(why), reason)  # the last that holds
    status = either(reason == Reason.NONE, int(Status.OK), int(Status.REJECTED))
    status = either(reason == Reason.TWO_SOLUTIONS, int(Status.AMBIGUOUS), status)
    one, two = ((R[:, k], t[:, k], rms[:, k]) for k in range(2))
    alone = covariance.new_zeros(len(covariance), 6, evidence.numbers)
    parts = (covariance, covariance, alone)
    none = torch.zeros_like(status)
    unasked = torch.full_like(chi2[:, 0], torch.nan)
    rest = (evidence.mask, one[1].new_zeros(*evidence.mask.shape, PLACE), none, unasked, none, larger)
    return Solutions(one[0], one[1], *parts, one[2], chi2[:, 0], *two, chi2_alt, status, reason, *rest)


class _Minima(NamedTuple):
    """Of the centres alone: as `pnp.pairs.Pairs`, and which rows (N,) have no problem that makes sense."""

    R: Tensor
    t: Tensor
    rms: Tensor
    chi2: Tensor
    behind: Tensor
    degenerate: Tensor


def _minima(evidence: Evidence, starts: tuple[Tensor, Tensor], compile: bool) -> _Minima:
    given = (evidence.points, either(evidence.mask[..., None], evidence.center, 0.0), evidence.matrix)
    covariances = visible(evidence.covariance + evidence.placed, evidence.mask)
    if not compile and 2 * len(evidence) <= pnp.FEW:
        found = pnp.pair_minima(*given, covariances, evidence.mask, starts, _ITERATIONS)
        return _Minima(*found, ~finite(starts[0], (1, 2, 3)))
    result = pnp.solve(
        *given,
        covariances=covariances,
        mask=evidence.mask,
        initial=starts,
        max_iterations=_ITERATIONS,
        compile=compile,
    )
    R, t = torch.stack([result.R, result.R_alt], 1), torch.stack([result.t, result.t_alt], 1)
    rms, chi2 = torch.stack([result.rms, result.rms_alt], 1), torch.stack([result.chi2, result.chi2_alt], 1)
    behind, degenerate = (result.code == code for code in (pnp.PnPCode.BEHIND_CAMERA, pnp.PnPCode.DEGENERATE))
    return _Minima(R, t, rms, chi2, behind, degenerate)


def _from_behind(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """Poses (N,) bool that show all rings seen from behind their printed side."""
    x, normal = rotations.turned(R, torch.cat([evidence.points, evidence.normals], 1)).chunk(2, 1)
    return (((normal * (x + t[:, None])).sum(-1) < 0) | ~evidence.mask).all(-1)


def _no_solutions(evidence: Evidence, R: Tensor, t: Tensor) -> Solutions:
    """Of no rows: frames without a target cost nothing here."""
    one, code = t.new_empty(0), evidence.mask.new_empty(0, dtype=torch.int64)
    parts = (t.new_empty(0, 6, 6), t.new_empty(0, 6, 6), t.new_empty(0, 6, evidence.numbers))
    rest = (evidence.mask, t.new_empty(*evidence.mask.shape, PLACE), code, one, code, one)
    return Solutions(R, t, *parts, one, one, R, t, one, one, code, code, *rest)


def _starts(evidence: Evidence, rough: tuple[Tensor, Tensor], near: bool = False) -> tuple[Tensor, Tensor]:
    """Two poses (N, 2, 3, 3), (N, 2, 3) to start from: both planar solutions, or the rough pose and its mirror.

    ``near``: the latter for all rows.
    """
    if near:
        return _mirrored(evidence, *rough)
    focal, principal = evidence.matrix.diagonal()[:2], evidence.matrix[:2, 2]
    xy = either(evidence.mask[..., None], (evidence.center - principal) / focal, 0.0)
    if 2 * len(evidence) <= pnp.FEW:
        flat_R, flat_t, both = pnp.planar_starts(evidence.points, xy, evidence.mask)
    else:
        flat_R, flat_t, _ = pnp.planar(evidence.points, xy, mask=evidence.mask)
        both = flat_R.isfinite().all(-1).all(-1).all(-1)  # else a marker behind the camera, or no plane
    planar = evidence.coplanar & (evidence.mask.sum(-1) >= 4) & both
    if bool(planar.all()):
        return flat_R, flat_t
    R, t = _mirrored(evidence, *rough)
    return torch.where(planar[:, None, None, None], flat_R, R), torch.where(planar[:, None, None], flat_t, t)


def _mirrored(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and their mirror images (N, 2, 3, 3), (N, 2, 3): depth mirrored along the line of sight, the plane turned
    back on itself, which is the same weak-perspective image."""
    weight = evidence.mask.double() / evidence.mask.sum(-1, keepdim=True)
    middle = (evidence.points * weight[..., None]).sum(1)
    at = (R @ middle[..., None]).squeeze(-1) + t
    first = evidence.mask.int().argmax(-1)
    normal = evidence.normals[torch.arange(first.numel(), device=first.device), first]
    mirrored = _reflection(at) @ R @ _reflection(normal)
    mirrored_t = at - (mirrored @ middle[..., None]).squeeze(-1)
    return torch.stack([R, mirrored], 1), torch.stack([t, mirrored_t], 1)


def _reflection(direction: Tensor) -> Tensor:
    """Householder matrices (N, 3, 3) that turn ``direction`` (N, 3) round."""
    unit = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
    return eye - 2 * unit[..., :, None] * unit[..., None, :]
