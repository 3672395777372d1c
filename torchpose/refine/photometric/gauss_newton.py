"""One Gauss-Newton step of the photometric fit from the sums of its pixels: pose and blur, grey levels eliminated.

A marker has six levels: ring and paper, each with a constant and a gradient over the plane. Gradients left free cost a
tenth of the precision of a frame whose light is even, and gradients left out would be a bias of many deviations where
it is not. So they have a normal prior about 0 whose width is found in the frame itself (empirical Bayes; Morris 1983):
the mean square of its gradients beyond what their noise explains.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.segments import segment_mean, segment_sum

POSE, LEVELS = 7, 6  # unknowns of a frame (translation, rotation, blur) and of a marker, at least
QUANTISATION = 1 / 12  # variance of rounding, in grey levels^2, below which no noise estimate falls
_GRADIENTS = (1, 2, 4, 5)  # among the levels
_CURVATURES = (6, 7, 8, 9, 10, 11)  # where there are any
_LEAST_WIDTH = 0.01  # variance of the prior over that of a gradient's noise: as good as none


class Step(NamedTuple):
    """pose: (N, 7). levels: (K, L). information: (N, 7, 7) at unit noise, levels eliminated. variance: (N,)."""

    pose: Tensor
    levels: Tensor
    information: Tensor
    variance: Tensor


def gauss_newton_step(
    sums: Tensor, used: Tensor, levels: Tensor, row: Tensor, rows: int, known: Tensor, moved: Tensor
) -> Step:
    """Step towards the least squares of the residuals and of the priors.

    Args:
        sums: (K, 8 + L, 8 + L), of every marker, weight times products of the derivatives by pose (7) and levels (L)
            and the residual. used: (K,) sum of weights. levels: (K, L) so far, L = 6, or 12 with the light's curvature.
        row: (K,) int64, frame of every marker, of ``rows`` N. known: (N, 7, 7) prior information about the pose;
            moved: (N, 7), how far the pose is from the prior's.
    """
    count = torch.bincount(row, minlength=rows)
    chi2 = segment_sum(sums[:, -1, -1], row, rows)
    freedom = segment_sum(used, row, rows) - POSE - levels.shape[1] * count
    variance = (chi2 / freedom.clamp_min(1)).clamp_min(QUANTISATION)
    known = known * variance[:, None, None]
    pull = (known @ moved[..., None]).squeeze(-1)
    free, scatter = _solve_step(sums, torch.zeros_like(levels), levels, row, rows, known, pull)
    precision = torch.zeros_like(levels)
    for group in (_GRADIENTS, _CURVATURES) if levels.shape[1] > LEVELS else (_GRADIENTS,):
        gradients = (levels + free.levels)[:, group]
        noise = variance[row, None] * scatter[:, group]
        mean_noise = segment_mean(noise.mean(-1), row, rows)
        excess = segment_mean(gradients.square().mean(-1), row, rows) - mean_noise
        width2 = excess.clamp_min(_LEAST_WIDTH * mean_noise)
        precision[:, group] = (variance / width2.clamp_min(1e-12))[row, None]
    held, _ = _solve_step(sums, precision, levels, row, rows, known, pull)
    return held._replace(variance=variance)


def _solve_step(
    sums: Tensor, precision: Tensor, levels: Tensor, row: Tensor, rows: int, known: Tensor, pull: Tensor
) -> tuple[Step, Tensor]:
    """Step under a prior of ``precision`` (K, L) about levels of 0, and variances (K, L) of the levels at unit noise.

    The variance of the residuals is left at 1.
    """
    nn, nb, gn = sums[:, :POSE, :POSE], sums[:, :POSE, POSE:-1], sums[:, :POSE, -1]
    bb, gb = sums[:, POSE:-1, POSE:-1], sums[:, POSE:-1, -1]
    ridge = 1e-9 * bb.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True) + 1e-12
    bb = bb + torch.diag_embed(ridge + precision)
    gb = gb - precision * levels
    eye = torch.eye(bb.shape[-1], dtype=bb.dtype, device=bb.device).expand_as(bb)
    by_pose, alone, inverse = torch.linalg.solve(bb, torch.cat([nb.mT, gb[..., None], eye], -1)).split(
        [POSE, 1, bb.shape[-1]], -1
    )
    information = segment_sum(nn - nb @ by_pose, row, rows) + known
    right = segment_sum(gn - (nb @ alone).squeeze(-1), row, rows) - pull
    eye = torch.eye(POSE, dtype=bb.dtype, device=bb.device).expand_as(information)
    step, covariance = solve_scaled(information, torch.cat([right[..., None], eye], -1)).split([1, POSE], -1)
    level_step = (alone - by_pose @ step[row]).squeeze(-1)
    scatter = inverse.diagonal(dim1=-2, dim2=-1) + ((by_pose @ covariance[row]) * by_pose).sum(-1)
    return Step(step.squeeze(-1), level_step, information, torch.ones_like(pull[:, 0])), scatter


def solve_scaled(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves (N, n, n) x = (N, n, m), every unknown scaled by its own information: mm and rad differ by orders."""
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).rsqrt()[..., None]
    return scale * solve_ridged(matrix * scale * scale.mT, right * scale)


def solve_ridged(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions (K, n, m) of small symmetric systems; a trace of the diagonal keeps empty ones solvable."""
    ridge = 1e-12 * matrix.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True) + 1e-12
    return torch.linalg.solve(matrix + torch.diag_embed(ridge.expand_as(matrix[..., 0])), right)
