"""Both minima of a few poses through a pinhole, each from a start of its own, in the fewest calls.

What `solve` does from two starts that are given, for those who want the minima and nothing else: the same steps
(`iterative`), with the pose first (`few`), and without codes, ratios and covariances.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.pnp.few import Few, stepped
from torchpose.pnp.iterative import RESERVE
from torchpose.pnp.verdict import COINCIDENCE, relevant

_RTOL = 1e-12  # as of `iterative.minimise`
# times, by which information with second derivatives may differ from that without (convention: only cost depends on it)
_BENT = 1e3


class Pairs(NamedTuple):
    """Minima of N rows: R (N, 2, 3, 3), t (N, 2, 3), rms (N, 2) px, chi2 (N, 2); NaN where there is none, or the same
    one, or where one of two has not been reached. behind: (N,) bool, both have points behind the camera."""

    R: Tensor
    t: Tensor
    rms: Tensor
    chi2: Tensor
    behind: Tensor


class _Body(NamedTuple):
    """The points' frame: their centroids (N, 3), and their extent (N, 1)."""

    center: Tensor
    unit: Tensor


def pair_minima(
    points: Tensor,
    pixels: Tensor,
    matrix: Tensor,
    covariances: Tensor,
    mask: Tensor,
    starts: tuple[Tensor, Tensor],
    max_iterations: int,
) -> Pairs:
    """Minima from two starts for each of N rows; arguments as of `solve`, points (N, M, 3), starts (N, 2, ...)."""
    seen = mask[..., None].to(points)
    count = seen.sum(1)
    center = (points * seen).sum(1) / count
    local = (points - center[:, None]) * seen
    unit = local.square().sum(-1).amax(-1, keepdim=True).sqrt().clamp_min(torch.finfo(local.dtype).tiny)
    focal, principal = matrix.diagonal()[:2], matrix[:2, 2]
    xy = torch.where(mask[..., None], (pixels - principal) / focal, 0.0)
    factor, root = torch.linalg.cholesky_ex(covariances)[0], torch.diag(focal).expand_as(covariances)
    root = torch.linalg.solve_triangular(factor, root, upper=False) * seen[..., None]
    aimed = (root * xy[:, :, None]).sum(-1)
    # residuals that are wrong by the rounding of their image points
    scale = root.square().amax((-1, -2)) * (1 + xy.square().sum(-1))
    floor = (4 * torch.finfo(xy.dtype).eps) ** 2 * scale.sum(-1)
    x = torch.nn.functional.pad(local / unit[..., None], (0, 1), value=1.0)
    x, root, aimed, floor = (value.repeat_interleave(2, 0) for value in (x, root, aimed, floor))
    few = Few(x, x[..., :3].repeat_interleave(2, 1), root, aimed)
    R, t = starts
    shift = (R @ center[:, None, :, None] + t[..., None]) / unit[:, :, None, None]
    pose, done, matrix = _minimised(few, torch.cat([R, shift], -1).flatten(0, 1), floor, max_iterations)
    depth, uv, white = few.seen(pose)
    pose = pose.unflatten(0, (-1, 2))
    chi2 = torch.where(depth.amin((1, 2)) > 0, (white - few.aimed).square().sum((1, 2)), torch.inf).view(-1, 2)
    off = (uv.unflatten(0, (-1, 2)) - xy[:, None]) * focal * seen[:, None]
    rms = (off.square().sum((2, 3)) / count).sqrt()
    worse = (chi2[:, 1:].nan_to_num(nan=torch.inf) >= chi2[:, :1].nan_to_num(nan=torch.inf)).long()
    distance = _distance(pose, matrix, worse)
    if bool(((distance > COINCIDENCE / _BENT) & (distance < COINCIDENCE * _BENT)).any()):
        distance = _distance(pose, few.whole(pose.flatten(0, 1), newton=False)[0][:, :6, :6], worse)
    chi2 = _apart(chi2, done.view(-1, 2), worse, distance < COINCIDENCE)
    gone = ~chi2.isfinite()
    R, t = pose.split_with_sizes([3, 1], -1)
    t = (t * unit[:, :, None, None] - R @ center[:, None, :, None])[..., 0]
    R, t = torch.where(gone[..., None, None], torch.nan, R), torch.where(gone[..., None], torch.nan, t)
    behind = (chi2 == torch.inf).all(1)
    return Pairs(R, t, torch.where(gone, torch.nan, rms), torch.where(gone, torch.nan, chi2), behind)


def _distance(pose: Tensor, matrix: Tensor, worse: Tensor) -> Tensor:
    """Squared Mahalanobis distances (N, 1) of poses (N, 2, 3, 4) by the information (2 N, 6, 6) about the better one.

    Args:
        worse: (N, 1) int64, which is the other.
    """
    R, t = pose.split_with_sizes([3, 1], -1)
    each = torch.arange(len(R), device=R.device)
    best, of_best = R[each, 1 - worse[:, 0]], matrix[2 * each + 1 - worse[:, 0]]
    # the one as seen from the other: translation, and twice the tangent of half the angle, as steps are made
    turn = R[:, 0].mT @ R[:, 1]
    axis = (turn - turn.mT)[:, (2, 0, 1), (1, 2, 0)]
    axis = 2 * axis / (1 + turn.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True)).clamp_min(1e-12)
    step = torch.cat([best.mT @ (t[:, 1] - t[:, 0]), axis[..., None]], 1)
    return (step.mT @ of_best @ step).flatten(1)


def _apart(chi2: Tensor, done: Tensor, worse: Tensor, same: Tensor) -> Tensor:
    """Chi-squared (N, 2) of minima that are two, NaN for what is none.

    Args:
        done: (N, 2) bool, were they reached?
        worse: (N, 1) int64, which has the larger one. same: (N, 1) bool, are both one?
    """
    second, some = torch.arange(2, device=chi2.device) == worse, chi2 < torch.inf
    alone = same | ~some.all(1, keepdim=True)
    lost = (~done & ~(second & alone)).any(1, keepdim=True) & some.any(1, keepdim=True)
    return torch.where(lost | (second & alone & some), torch.nan, chi2)


def _minimised(few: Few, start: Tensor, floor: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (K, 3, 4) of minima, those of one row following each other, whether they were reached (K,) bool, and the
    information about them (K, 6, 6), before the last step."""
    pose = trial = start
    over = done = torch.zeros_like(floor, dtype=torch.bool)
    damping, cost, whole = torch.full_like(floor, 1e-3), torch.full_like(floor, torch.inf), start
    decrease = enough = cost
    for number in range(steps):
        there, ahead = few.whole(trial, newton=True)
        new = torch.where(ahead, there[:, 6, 6], torch.inf)
        lower = (new <= cost + 2 * (cost * floor).sqrt() + floor) if number else ~over
        accept = lower & ~over
        if number == 0 or bool(accept.all()):
            pose, whole, cost = trial, there, new
        else:
            pose, whole = (torch.where(accept[:, None, None], *v) for v in ((trial, pose), (there, whole)))
            cost = torch.where(accept, new, cost)
        if number == 0:
            enough = relevant(cost.view(-1, 2).nan_to_num(nan=torch.inf).amin(1)).repeat_interleave(2)
        old = (trial, decrease, damping, done)
        damping = torch.where(lower, (0.1 * damping).clamp_min(1e-6), (10 * damping).clamp_min(1e-2))
        step, decrease, definite = _damped(whole, damping)
        if not bool((definite | over).all()):
            step, decrease = _off_saddle(few, pose, cost, damping, (step, decrease, definite))
        trial, sure = stepped(pose, -step), damping <= 1
        left = sure & (cost - RESERVE * decrease > enough)
        if bool(left.any()):
            trial, decrease = torch.where(left[:, None, None], pose, trial), torch.where(left, 0.0, decrease)
        done = sure & (decrease <= _RTOL * cost + floor) & (cost < torch.inf)
        if bool(over.any()):
            trial = torch.where(over[:, None, None], old[0], trial)
            decrease, damping, done = (
                torch.where(over, a, b) for a, b in zip(old[1:], (decrease, damping, done), strict=True)
            )
        # neither a pose without numbers nor one whose steps have shrunk to nothing will come to an end
        over = done | ~((damping < 1e8) & (cost < torch.inf))
        if bool(over.all()):
            break
    return torch.where(done[:, None, None], trial, pose), done, whole[:, :6, :6]


def _damped(whole: Tensor, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Steps (K, 6), the decrease of the cost that they promise, and whether they are to a minimum (K,)."""
    matrix, right = whole[:, :6, :6], whole[:, :6, 6:]
    matrix = matrix + torch.diag_embed(matrix.diagonal(dim1=1, dim2=2) * damping[:, None])
    factor, failed = torch.linalg.cholesky_ex(matrix)
    step = torch.cholesky_solve(right, factor)
    return step[..., 0], (step * right).sum((1, 2)), failed == 0


def _off_saddle(
    few: Few, pose: Tensor, cost: Tensor, damping: Tensor, newton: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Steps and decreases, those of Gauss-Newton, stretched, where the matrix is not definite; see `iterative`."""
    step, decrease, _ = _damped(few.whole(pose, newton=False)[0], damping)
    stretch = torch.where(damping < 1e-3, (0.1 * cost / decrease).sqrt().clamp(1, 1e3), 1.0)
    definite = newton[2]
    return torch.where(definite[:, None], newton[0], stretch[:, None] * step), torch.where(
        definite, newton[1], decrease
    )
