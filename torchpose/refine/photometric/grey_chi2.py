"""Chi-squared of the grey values around the rings under two poses of the same frame."""

import torch
from torch import Tensor

from torchpose.geometry.blurred_edge import Spread
from torchpose.geometry.least_squares import solve_scaled
from torchpose.geometry.robust import CUT
from torchpose.geometry.segments import segment_sum
from torchpose.refine.photometric.band import band_width
from torchpose.refine.photometric.grey_levels import (
    columns_of,
    first_levels,
    inliers,
    model_misfit,
    noise_spread,
    sum_products,
)
from torchpose.refine.photometric.light import POSE
from torchpose.refine.photometric.ring_model import gather_pixels, ring_model
from torchpose.refine.photometric.sectors import clear_sectors, misfit, sum_sectors
from torchpose.refine.sight import Refined, Sight

_LEVEL_STEPS = 3  # of the grey levels alone


def grey_chi2(sight: Sight, one: Refined, two: Refined) -> tuple[Tensor, Tensor, Tensor]:
    """Chi-squared (N,) of the grey values under the refined poses ``two`` less that under ``one``.

    Also whether under each of the two (N, 2) every marker has a ring that differs from its paper, and whether that
    explains most of its sectors.

    Both are judged on the same pixels, those that either explains, each with grey levels of its own; no pixel counts
    for more than an outlier would. Where not even the better pose explains them within noise the difference counts
    for less, by as much as the displacements of its sectors exceed theirs.
    """
    rows = len(sight.frame)
    spreads = [Spread(pose.spread) for pose in (one, two)]
    band = torch.maximum(*(band_width(spread) for spread in spreads))
    blocks = gather_pixels(sight, band)
    squares, weights, variances, misfits, there, explained = [], [], [], [], [], []
    for pose, spread in zip((one, two), spreads, strict=True):
        model = ring_model(blocks, pose.R, pose.t, spread, check=True)
        levels = first_levels(blocks, model)
        for _ in range(_LEVEL_STEPS):
            columns, slope, residual = columns_of(blocks, model, levels)
            noise = noise_spread(residual, blocks), model_misfit(levels)
            usable, weight = inliers(residual, blocks, model, *noise)
            sectors = sum_sectors(residual, slope, usable, weight, blocks, model)
            clear = clear_sectors(sectors, *noise)
            every, weight = weight, weight * sectors.of_pixels(clear.to(weight.dtype))
            sums = sum_products(columns, weight)
            levels = levels + solve_scaled(sums[:, POSE:-2, POSE:-2], sums[:, POSE:-2, -2]).squeeze(-1)
        used = segment_sum(weight.sum(-1).double(), blocks.row, rows).clamp_min(1)
        variance = (segment_sum(sums[:, -2, -2], blocks.row, rows) / used).clamp_min(sight.quantisation)
        squares.append(residual.square())
        weights.append(weight)
        variances.append(variance)
        misfits.append(misfit(sectors, clear, variance[blocks.row], blocks.row, rows))
        information = sum_products(columns, every)[:, POSE:-2, POSE:-2]
        shows = _has_contrast(levels, information, variance[blocks.row])
        there.append(segment_sum((~shows).double(), blocks.row, rows) == 0)
        explained.append(segment_sum((~(shows & clear.any(-1))).double(), blocks.row, rows) == 0)
    variance = torch.minimum(*variances)
    most = (CUT**2 * variance[blocks.row, None]).to(squares[0].dtype)
    of_one, of_two = (torch.minimum(s, most) for s in squares)
    difference = (torch.maximum(*weights) * (of_two - of_one)).sum(-1).double()
    chi2 = segment_sum(difference, blocks.row, rows) / variance / torch.minimum(*misfits).clamp_min(1)
    return chi2, torch.stack(there, -1), torch.stack(explained, -1)


def _has_contrast(levels: Tensor, information: Tensor, variance: Tensor) -> Tensor:
    """Markers (K,) bool whose ring and paper differ beyond noise: levels that are equal explain a cover.

    Args:
        levels: (K, 6). information: (K, 6, 6) about them at unit noise. variance: (K,) of noise.
    """
    by_level = torch.zeros_like(levels)
    by_level[:, 0], by_level[:, 3] = -1.0, 1.0
    spread2 = variance * (by_level * solve_scaled(information, by_level[..., None]).squeeze(-1)).sum(-1)
    return (by_level * levels).sum(-1).square() > CUT**2 * spread2
