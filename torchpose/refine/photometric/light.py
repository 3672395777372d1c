"""The normal equations of the photometric fit: pose and blur, with the grey levels of every marker to be eliminated.

A marker has six levels: ring and paper, each with a constant and a gradient over the plane. Gradients left free cost a
tenth of the precision of a frame whose light is even, and gradients left out would be a bias of many deviations where
it is not. So they have a normal prior about 0 whose width is found in the frame itself (empirical Bayes; Morris 1983):
the mean square of its gradients beyond what their noise explains.
"""

import torch
from torch import Tensor

from torchpose.geometry.blurred_edge import BLUR
from torchpose.geometry.constants import constant
from torchpose.geometry.least_squares import Eliminated, Normal, solve_scaled
from torchpose.geometry.rows import replace
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.pose import MarkerNormals

# unknowns of a frame (translation, rotation, blur) and of a marker, at least (derived: they are counted)
POSE, LEVELS = 6 + BLUR, 6
_PLANE = 3  # levels of ring, then of paper, each with its gradient; curvatures in the same order where there are any
# which levels are of which group, that of gradients and of curvatures where there are any
_GROUPS = (
    ((0.0, 1.0, 1.0, 0.0, 1.0, 1.0),),
    ((0.0, 1.0, 1.0, 0.0, 1.0, 1.0, *[0.0] * 6), (*[0.0] * 6, *[1.0] * 6)),
)
_BLUR_KNOWN = 1e-4  # information about each number of a blur, px^-4: a disc has two, so that the third is open
_LEAST_WIDTH = 0.01  # variance of the prior over that of a gradient's noise: as good as none
_RIDGE = 1e-9  # of a marker's information: sums in float32 make up as much


def normal_equations(
    sums: Tensor,
    used: Tensor,
    levels: Tensor,
    owner: Tensor,
    least: Tensor,
    prior: tuple[Tensor, Tensor] | None = None,
    *,
    gain: bool = False,
) -> tuple[Normal, Tensor]:
    """Normal equations of N frames in units of the noise, with the prior about the levels, and the noise's variance.

    Args:
        sums: (K, 11 + L, 11 + L), of every marker, weight times products of the derivatives by pose (9) and levels (L),
            the residual, and the derivative by the edge gain; the latter may be left out where it is no unknown.
        used: (K,) sum of weights.
        levels: (K, L) so far, L = 6, or 12 with the light's curvature.
        owner: (K,) int64, frame of every marker.
        least: (N,) variance below which the noise's does not fall.
        prior: information (N, 9, 9) about the pose, and how far the pose is from the prior's (N, 9).
        gain: the edge gain is an unknown of the frame, too, the tenth; the prior is about it as well.
    """
    rows, chosen = len(least), POSE + gain
    error = POSE + levels.shape[1]  # where the residual stands
    each = torch.stack([sums[:, error, error], used - levels.shape[1]], -1)
    chi2, freedom = segment_sum(each, owner, rows).unbind(-1)
    variance = (chi2 / (freedom - chosen).clamp_min(1)).maximum(least)
    sums = sums / variance.index_select(0, owner)[:, None, None]
    by_own = torch.cat([sums[:, :POSE], sums[:, -1:]], 1) if gain else sums[:, :POSE]
    of_levels = sums[:, POSE:error, POSE:error].clone()
    diagonal = of_levels.diagonal(dim1=-2, dim2=-1)
    diagonal.add_(diagonal.mean(-1, keepdim=True), alpha=_RIDGE)
    part = Eliminated(by_own[..., POSE:error], of_levels, sums[:, POSE:error, error], owner)
    # of pose and blur, and of the gain, which stands behind the residual
    every = segment_sum(by_own, owner, rows)
    right, own = every[..., error], torch.cat([every[..., :POSE], every[..., -1:]], -1) if gain else every[..., :POSE]
    own.diagonal(dim1=-2, dim2=-1)[:, POSE - BLUR : POSE].add_(_BLUR_KNOWN)
    normal = Normal(own, right, chi2 / variance, part)
    normal = normal if prior is None else normal.with_prior(*prior)
    precision = _precision(normal, part, levels)
    information = of_levels.clone()
    information.diagonal(dim1=-2, dim2=-1).add_(precision)
    held = replace(part, information=information, right=torch.addcmul(part.right, precision, levels, value=-1))
    return replace(normal, eliminated=held), variance


def of_markers(sums: Tensor, variance: Tensor, levels: Eliminated, mask: Tensor, step: Tensor) -> MarkerNormals:
    """What every marker tells of pose, blur and edge gain, its levels being unknown, after the last step.

    Args:
        sums: as for `normal_equations`.
        variance: (N,) of the noise.
        levels: part of the normal equations, with the prior.
        mask: (N, M), markers seen.
        step: (N, 9), of pose and blur, made since; (N, 10) where the edge gain is an unknown, too.
    """
    scaled = (sums / variance[levels.owner, None, None]).index_select(1, _chosen(sums))
    by_level, right = scaled[..., POSE:-2], scaled[..., -2:-1]
    part = torch.cat([by_level.mT, levels.right[..., None]], -1)
    told = torch.cat([scaled.index_select(2, _chosen(sums)), right], -1)
    told = told - torch.bmm(by_level, solve_scaled(levels.information, part))
    information, moved = told[..., :-1], step.shape[-1]
    right = (told[..., -1:] - torch.bmm(information[..., :moved], step[levels.owner, :, None]))[..., 0]
    held = constant((*[0.0] * (POSE - BLUR), *[_BLUR_KNOWN] * BLUR, 0.0), right)
    count = mask.sum(-1)[levels.owner].clamp_min(1)
    return MarkerNormals.laid_out(information + torch.diag(held) / count[:, None, None], right, mask)


def pulled_by_levels(sums: Tensor, variance: Tensor, levels: Eliminated, mask: Tensor, more: Tensor) -> Tensor:
    """Covariance (N, M, 10, 10) of the right sides in `of_markers` by noise of the levels that its information lacks.

    Args:
        sums, variance, levels, mask: as for `of_markers`.
        more: (K, 2) variance of what ring and paper tell of their levels, in units of that of the noise.
    """
    scaled = sums / variance[levels.owner, None, None]
    of_levels = scaled[:, POSE:-2, POSE:-2]
    deviation = more.sqrt().repeat_interleave(_PLANE, 1).repeat(1, 2)[:, : of_levels.shape[-1]]
    pull = scaled.index_select(1, _chosen(sums))[..., POSE:-2] @ solve_scaled(
        levels.information, torch.diag_embed(deviation)
    )
    every = pull.new_zeros(*mask.shape, pull.shape[1], pull.shape[1])
    return every.index_put(tuple(mask.nonzero().unbind(-1)), pull @ of_levels @ pull.mT)


def _chosen(sums: Tensor) -> Tensor:
    """Columns of pose, blur and edge gain: the latter stands last."""
    return constant((*range(POSE), sums.shape[-1] - 1), sums, torch.int64)


def _precision(normal: Normal, part: Eliminated, levels: Tensor) -> Tensor:
    """Information (K, L) of the prior about the levels, from those that the data alone give."""
    rows, owner = len(normal), part.owner
    free = normal.solve(variances=True)
    groups = constant(_GROUPS[levels.shape[1] > LEVELS], levels)
    both = torch.stack([(levels + free.eliminated).square(), free.variances], 1) @ (groups / groups.sum(1, True)).mT
    square, mean_noise = segment_mean(both, owner, rows).unbind(1)  # (N, G)
    width2 = (square - mean_noise).maximum(_LEAST_WIDTH * mean_noise).clamp_min(1e-12)
    return width2.reciprocal().index_select(0, owner) @ groups
