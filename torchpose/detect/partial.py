"""Ellipses of which only a part is in view, freed from the edges that run into them.

Where something covers a circle, its own edge leaves the circle at a small angle: a fit to all that lies near the
ellipse bends towards that stump. The ellipse is therefore fitted to every run of sectors that is a little longer than
half of it, and the one that most of the perimeter agrees with is kept: a consensus (Fischler and Bolles 1981) whose
samples are the runs, few enough to try them all.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.arcs import edge_band, fit_scatter, perimeter_samples, scatter_sums
from torchpose.detect.regions import Gradient
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import positions, segment_sum

_SECTORS = 16
_RUN = 9  # sectors of a run: what leaves 65 % of a perimeter in view leaves a run in view, wherever it begins
_REACH = 3  # cells to either side in which the ridge of an edge is looked for
_MOST_SAMPLES = 96  # of an ellipse, a multiple of the sectors
_WELL = 0.9  # support from which on an ellipse is left as it is
_ROUNDS = 2
_SETTLE = 4  # fits to what agrees


@dataclass(frozen=True, eq=False)
class Ridge(Rows):
    """Edges beside samples of the perimeters of M ellipses."""

    of: Int[Tensor, " S"]  # the ellipse
    sector: Int[Tensor, " S"]  # which sixteenth of its perimeter
    xy: Float[Tensor, "S 2"]  # where the gradient across the ellipse peaks, cells
    gradient: Float[Tensor, "S 2"]  # there
    offset: Float[Tensor, " S"]  # cells from the ellipse, positive outside
    found: Bool[Tensor, " S"]  # an edge of its direction
    # share of the perimeter whose edge lies on it; an edge a cell away counts nothing, one on it fully
    support: Float[Tensor, " M"] = shared()


def free_of_stumps(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Float[Tensor, "M 5"]:
    """Ellipses, those that are well supported as they are, the others by the run of sectors that fits best.

    The polarity is +1 where the gradient points outwards.
    """
    for _ in range(_ROUNDS):
        ridge = find_ridge(grad, frame, ellipses, polarity)
        part = positions(ridge.support < _WELL)
        if part.numel() == 0:
            break
        fits = torch.cat([_runs(ridge, ellipses)[part], ellipses[part, None]], 1)
        of = torch.arange(part.numel(), device=part.device)
        each = part.repeat_interleave(fits.shape[1])
        again = find_ridge(grad, frame[each], fits.flatten(0, 1), polarity[each])
        fits = fits[of, again.support.view(fits.shape[:2]).argmax(1)]
        # and again with all of the perimeter that agrees, until it stays as it is: the runs' borders leave no trace
        for _ in range(_SETTLE):
            near = find_ridge(grad, frame[part], fits, polarity[part])
            on = (near.found & (near.offset.abs() < 1)).double()
            sums = scatter_sums(near.xy, near.gradient, near.of, fits[:, :2], on)
            refit = fit_scatter(sums, fits[:, :2], fits[:, 2])
            fits = torch.where(refit.isfinite().all(-1, keepdim=True), refit, fits)
        ellipses = ellipses.index_copy(0, part, fits)
    return ellipses


def find_ridge(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Ridge:
    """The strongest edge of the right direction beside each sample; arguments as in `free_of_stumps`."""
    at = perimeter_samples(ellipses, _MOST_SAMPLES, _SECTORS)
    band = edge_band(grad, frame, polarity, at, _REACH)
    peak = band.rise.argmax(-1, keepdim=True)
    beside = torch.cat([(peak - 1).clamp_min(0), peak, (peak + 1).clamp_max(2 * _REACH)], -1)
    weight = band.rise.gather(-1, beside).double()
    # a cell is sampled where its centre is, not where it was asked for
    px, py, nx, ny = (v[:, None] for pair in (at.xy, at.normal) for v in pair.unbind(-1))
    away = (band.x.gather(-1, beside) - px) * nx + (band.y.gather(-1, beside) - py) * ny
    total = weight.sum(-1)
    offset = (weight * away).sum(-1) / total.clamp_min(1e-12)
    found = total > 0
    support = segment_sum(torch.where(found, (1 - offset.square()).clamp_min(0), 0.0), at.of, len(ellipses))
    support = support / torch.bincount(at.of, minlength=len(ellipses)).clamp_min(1)
    gradient = torch.cat([band.gx.gather(-1, peak), band.gy.gather(-1, peak)], -1)
    sector = (at.turn * _SECTORS).long().clamp_max(_SECTORS - 1)
    return Ridge(at.of, sector, at.xy + offset[:, None] * at.normal, gradient, offset, found, support)


def _runs(ridge: Ridge, ellipses: Tensor) -> Float[Tensor, "M 16 5"]:
    """Ellipses fitted to the ridge of every run of sectors, NaN where it is none."""
    count = len(ellipses)
    sector = ridge.of * _SECTORS + ridge.sector
    center, scale = (v.repeat_interleave(_SECTORS, 0) for v in (ellipses[:, :2], ellipses[:, 2]))
    sums = scatter_sums(ridge.xy, ridge.gradient, sector, center, ridge.found, _MOST_SAMPLES // _SECTORS)
    sums = sums.view(count, _SECTORS, 6, 6)
    runs = torch.cat([sums, sums[:, : _RUN - 1]], 1).unfold(1, _RUN, 1).sum(-1)
    return fit_scatter(runs.flatten(0, 1), center, scale).view(count, _SECTORS, 5)
