"""Ellipses of which only a part is in view, freed from the edges that run into them.

Where something covers a circle, its own edge leaves the circle at a small angle: a fit to all that lies near the
ellipse bends towards that stump. The ellipse is therefore fitted to every run of sectors that is a little longer than
half of it, and the one that most of the perimeter agrees with is kept: a consensus (Fischler and Bolles 1981) whose
samples are the runs, few enough to try them all.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.detect.arcs import cells_along, direction_rows, fit_scatter, perimeter_samples
from torchpose.detect.regions import Gradient
from torchpose.geometry.segments import segment_sum

_SECTORS = 16
_RUN = 9  # sectors of a run: what leaves 65 % of a perimeter in view leaves a run in view, wherever it begins
_REACH = 3  # cells to either side in which the ridge of an edge is looked for
_COS = 0.9  # of a gradient with the normal of the ellipse: 26 degrees
_MOST_SAMPLES = 96  # of an ellipse, a multiple of the sectors
_WELL = 0.9  # support from which on an ellipse is left as it is
_ROUNDS = 2
_SETTLE = 4  # fits to what agrees


@dataclass(frozen=True, eq=False)
class Ridge:
    """Edges beside S samples of the perimeters of M ellipses.

    Attributes:
        of: (S,) int64, the ellipse. sector: (S,) int64, which sixteenth of its perimeter.
        xy: (S, 2) float64, where the gradient across the ellipse peaks, cells. gradient: (S, 2), there.
        offset: (S,) float64, cells from the ellipse, positive outside. found: (S,) bool, an edge of its direction.
        support: (M,) float64 in [0, 1], share of the perimeter whose edge lies on it; an edge a cell away counts
            nothing, one on it fully.
    """

    of: Tensor
    sector: Tensor
    xy: Tensor
    gradient: Tensor
    offset: Tensor
    found: Tensor
    support: Tensor


def free_of_stumps(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Tensor:
    """Ellipses (M, 5), those that are well supported as they are, the others by the run of sectors that fits best.

    Args:
        frame: (M,) int64. ellipses: (M, 5), cells. polarity: (M,) +1 where the gradient points outwards.
    """
    for _ in range(_ROUNDS):
        ridge = find_ridge(grad, frame, ellipses, polarity)
        part = (ridge.support < _WELL).nonzero()[:, 0]
        if part.numel() == 0:
            break
        fits = torch.cat([_runs(ridge, ellipses)[part], ellipses[part, None]], 1)
        choices = fits.shape[1]
        again = find_ridge(
            grad, frame[part].repeat_interleave(choices), fits.flatten(0, 1), polarity[part].repeat_interleave(choices)
        )
        best = again.support.view(-1, choices).argmax(1)
        fits = fits[torch.arange(part.numel(), device=part.device), best]
        # and again with all of the perimeter that agrees, until it stays as it is: the runs' borders leave no trace
        for _ in range(_SETTLE):
            near = find_ridge(grad, frame[part], fits, polarity[part])
            refit = _fit(near, fits, near.found & (near.offset.abs() < 1))
            fits = torch.where(refit.isfinite().all(-1, keepdim=True), refit, fits)
        ellipses = ellipses.index_copy(0, part, fits)
    return ellipses


def find_ridge(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Ridge:
    """The strongest edge of the right direction beside each sample; arguments as in `free_of_stumps`."""
    count = ellipses.shape[0]
    of, xy, normal, turn = perimeter_samples(ellipses, _MOST_SAMPLES, _SECTORS)
    band = torch.arange(-_REACH, _REACH + 1, dtype=torch.float64, device=xy.device)
    cell, inside, (x, y) = cells_along(grad, frame.index_select(0, of), xy, normal, band)
    gx, gy = (g.view_as(x) for g in grad.components(cell.flatten()))
    nx, ny = normal.unbind(-1)
    rise = (gx * nx[:, None].float() + gy * ny[:, None].float()) * polarity.index_select(0, of)[:, None].float()
    power, least = gx * gx + gy * gy, (0.5 * grad.threshold[frame]).square()
    good = inside & (rise > 0) & (rise * rise > _COS**2 * power) & (power > least[of, None])
    rise = torch.where(good, rise, 0.0)
    peak = rise.argmax(-1, keepdim=True)
    beside = torch.cat([(peak - 1).clamp_min(0), peak, (peak + 1).clamp_max(2 * _REACH)], -1)
    weight = rise.gather(-1, beside).double()
    # a cell is sampled where its centre is, not where it was asked for
    px, py = xy.unbind(-1)
    away = (x.gather(-1, beside) - px[:, None]) * nx[:, None] + (y.gather(-1, beside) - py[:, None]) * ny[:, None]
    total = weight.sum(-1)
    offset = (weight * away).sum(-1) / total.clamp_min(1e-12)
    found = total > 0
    support = segment_sum(torch.where(found, (1 - offset.square()).clamp_min(0), 0.0), of, count)
    support = support / torch.bincount(of, minlength=count).clamp_min(1)
    gradient = torch.cat([gx.gather(-1, peak), gy.gather(-1, peak)], -1)
    sector = (turn * _SECTORS).long().clamp_max(_SECTORS - 1)
    return Ridge(of, sector, xy + offset[:, None] * normal, gradient, offset, found, support)


def _runs(ridge: Ridge, ellipses: Tensor) -> Tensor:
    """Ellipses (M, 16, 5) fitted to the ridge of every run of sectors, NaN where it is none."""
    count = ellipses.shape[0]
    rows = direction_rows(ridge.xy, ridge.gradient, ridge.of, ellipses[:, :2], ellipses[:, 2])
    rows = torch.where(ridge.found[:, None], rows, 0.0)
    sums = segment_sum(rows, ridge.of * _SECTORS + ridge.sector, count * _SECTORS).view(count, _SECTORS, -1)
    runs = torch.cat([sums, sums[:, : _RUN - 1]], 1).unfold(1, _RUN, 1).sum(-1)
    center, scale = (v.repeat_interleave(_SECTORS, 0) for v in (ellipses[:, :2], ellipses[:, 2]))
    return fit_scatter(runs.flatten(0, 1), center, scale).view(count, _SECTORS, 5)


def _fit(ridge: Ridge, ellipses: Tensor, use: Tensor) -> Tensor:
    """Ellipses (M, 5) fitted to the samples (S,) bool of their ridges."""
    rows = direction_rows(ridge.xy, ridge.gradient, ridge.of, ellipses[:, :2], ellipses[:, 2])
    sums = segment_sum(torch.where(use[:, None], rows, 0.0), ridge.of, ellipses.shape[0])
    return fit_scatter(sums, ellipses[:, :2], ellipses[:, 2])
