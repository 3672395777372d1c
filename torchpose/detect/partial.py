"""Ellipses of which only a part is in view, freed from the edges that run into them.

Where something covers a circle, its own edge leaves the circle at a small angle: a fit to all that lies near the
ellipse bends towards that stump. The ellipse is therefore fitted to every run of sectors that is a little longer than
half of it, and the one that most of the perimeter agrees with is kept: a consensus (Fischler and Bolles 1981) whose
samples are the runs, few enough to try them all.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.arcs import edge_band, fit_scatter, perimeter_samples, scatter_sums
from torchpose.detect.regions import Gradient
from torchpose.detect.validation import WHOLE
from torchpose.geometry import conics
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.sectors import MOST, SECTORS
from torchpose.geometry.segments import positions, segment_sum

_RUNS = 16  # of an ellipse, each a little longer than half of it: few enough to try them all (convention)
_RUN = round(MOST * SECTORS)  # sectors of a run: 65 % in view leave a run in view, wherever it begins (derived)
_REACH = 3  # cells to either side in which the ridge of an edge is looked for
_MOST_SAMPLES = 96  # of an ellipse, a multiple of the sectors
_ROUNDS = 2
_TRIALS = 4  # fits of runs that are compared at the frame itself
SETTLE = 4  # fits to what agrees (measured: docs/tried.md, rounds of freeing rings of stumps)


@dataclass(frozen=True, eq=False)
class Ridge(Rows):
    """Edges beside samples of the perimeters of M ellipses."""

    of: Int[Tensor, " S"]  # the ellipse
    sector: Int[Tensor, " S"]  # of its perimeter, see `geometry.sectors`
    xy: Float[Tensor, "S 2"]  # where the gradient across the ellipse peaks, cells
    gradient: Float[Tensor, "S 2"]  # there
    offset: Float[Tensor, " S"]  # cells from the ellipse, positive outside
    found: Bool[Tensor, " S"]  # an edge of its direction
    # share of the perimeter whose edge lies on it; an edge a cell away counts nothing, one on it fully
    support: Float[Tensor, " M"] = shared()


def free_of_stumps(
    grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor, settle: int = SETTLE
) -> Float[Tensor, "M 5"]:
    """Ellipses, those that are well supported as they are, the others by the run of sectors that fits best.

    The polarity is +1 where the gradient points outwards. ``settle`` is the number of fits to what agrees.
    """
    part = torch.arange(len(ellipses), device=ellipses.device)
    for _ in range(_ROUNDS if len(part) else 0):
        ridge = find_ridge(grad, frame[part], ellipses[part], polarity[part])
        weak = positions(ridge.support < WHOLE)
        part, ridge = part[weak], _ridge_of(ridge, weak)
        if part.numel() == 0:
            break
        fits, changed = _best_fits(grad, frame[part], ellipses[part], polarity[part], ridge)
        ellipses = ellipses.index_copy(0, part, _settled(grad, frame[part], fits, polarity[part], settle))
        part = part[positions(changed)]  # what was best as it was would be so again
    return ellipses


def _ridge_of(ridge: Ridge, some: Tensor) -> Ridge:
    """The ridge of some (K,) of its ellipses only."""
    order = torch.arange(len(some), dtype=ridge.support.dtype, device=some.device)
    number = torch.full_like(ridge.support, -1).index_copy(0, some, order)
    of = number.long().index_select(0, ridge.of)
    sample = positions(of >= 0)
    return replace(ridge[sample], of=of[sample], support=ridge.support[some])


def _best_fits(
    grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor, ridge: Ridge
) -> tuple[Tensor, Tensor]:
    """The best of each ellipse and the fits to its runs (M, 5), and whether it is one of a run.

    Which runs are worth a look at the frame is judged by the edges beside the ellipse as it was.
    """
    runs = _runs(ridge, ellipses)
    likely = _agreement(ridge, runs).topk(_TRIALS, 1).indices
    fits = runs.gather(1, likely[..., None].expand(-1, -1, 5))
    each = torch.arange(len(ellipses), device=ellipses.device)
    of = each.repeat_interleave(_TRIALS)
    again = find_ridge(grad, frame[of], fits.flatten(0, 1), polarity[of])
    support, best = again.support.view(-1, _TRIALS).max(1)
    changed = support >= ridge.support
    return torch.where(changed[:, None], fits[each, best], ellipses), changed


def _agreement(ridge: Ridge, fits: Float[Tensor, "M F 5"]) -> Float[Tensor, "M F"]:
    """How much of the ridge of each ellipse lies on each of its fits."""
    conic = conics.conic_from_ellipse(fits)[ridge.of].unbind(-1)
    off, _, _ = conics.signed_distance(conic, *(v[:, None] for v in ridge.xy.unbind(-1)))
    on = (1 - off.square()).nan_to_num(nan=0.0).clamp_min(0) * ridge.found[:, None]
    return segment_sum(on, ridge.of, len(fits))


def _settled(grad: Gradient, frame: Tensor, fits: Tensor, polarity: Tensor, settle: int) -> Float[Tensor, "M 5"]:
    """Fitted again to all of the perimeter that agrees, so often that the borders of the runs leave no trace."""
    for _ in range(settle):
        near = find_ridge(grad, frame, fits, polarity)
        on = (near.found & (near.offset.abs() < 1)).double()
        refit = fit_scatter(scatter_sums(near.xy, near.gradient, near.of, fits[:, :2], on), fits[:, :2], fits[:, 2])
        fits = torch.where(refit.isfinite().all(-1, keepdim=True), refit, fits)
    return fits


def find_ridge(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Ridge:
    """The strongest edge of the right direction beside each sample; arguments as in `free_of_stumps`."""
    at = perimeter_samples(ellipses, _MOST_SAMPLES, SECTORS)
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
    sector = (at.turn * SECTORS).long().clamp_max(SECTORS - 1)
    return Ridge(at.of, sector, at.xy + offset[:, None] * at.normal, gradient, offset, found, support)


def _runs(ridge: Ridge, ellipses: Tensor) -> Float[Tensor, "M R 5"]:
    """Ellipses fitted to the ridge of every run of sectors, NaN where it is none."""
    count = len(ellipses)
    sector = ridge.of * SECTORS + ridge.sector
    center, scale = (v.repeat_interleave(SECTORS, 0) for v in (ellipses[:, :2], ellipses[:, 2]))
    sums = scatter_sums(ridge.xy, ridge.gradient, sector, center, ridge.found, _MOST_SAMPLES // SECTORS)
    sums = sums.view(count, SECTORS, 6, 6)
    step = SECTORS // _RUNS
    runs = torch.cat([sums, sums[:, : _RUN - step]], 1).unfold(1, _RUN, step).sum(-1)
    return fit_scatter(runs.flatten(0, 1), center[::step], scale[::step]).view(count, _RUNS, 5)
