"""What may become a ring that is wanted: cheap looks before anything is fitted, and before anything is followed.

A region turns with its gradient: along a circle the unit gradient is the place on it, less the centre, over the radius.
How far both go together tells circles from straight edges and from texture, by sums alone. And a ring has a second edge
inside its outer one, of the opposite step, in whatever direction one looks.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.regions import Gradient, Regions
from torchpose.detect.validation import Candidates
from torchpose.geometry import conics
from torchpose.geometry.segments import positions, run_sums, values_at

_CREST = 0.5  # of squared gradients: with 0.64 more rings are lost, with 0.36 less is saved (measured: docs/tried.md)
# Of true rings of `scripts/clutter_statistics.py`, seeds 41, 42 and 33: regions of outer circles have a mean direction
# of length 0.64 at most and a roundness of at least 0.27; an ellipse of an axes' ratio of 0.12 has 0.27 as well
# (measured).
_STRAIGHT = 0.8  # length of the mean direction of a region that turns too little: an arc of 130 degrees has 0.8
_ROUND = 0.2  # roundness; and length of the mean direction of what goes all the way round (measured, as above)
_LINE = 0.985  # an arc of 34 degrees: straighter regions are no arcs (measured: docs/tried.md, cost)
# of the inner edge, to the outer one: true rings have it in 0.83 of the directions at least (measured: decisions/0057)
_STEP = 0.2
_SHARE = 0.6  # of the directions in which the outer edge is seen (measured: decisions/0057)
_DIRECTIONS = 16
_RADII = (1.05, 1.0, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.45, 0.3, 0.15, 0.0)  # close where the other circle may be close
_OUTSIDE = (1.0, 2.0)  # px beyond the ellipse


def roundness(regions: Regions, xy: Float[Tensor, "P 2"]) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
    """Length of the mean direction of each region's gradient, and the correlation of directions with positions.

    The correlation is 1 on any arc of a circle that is dark inside, -1 on one that is light, and about 0 where
    directions have nothing to do with positions.
    """
    (x, y), (gx, gy) = xy.unbind(-1), regions.gradient.unbind(-1)
    scale = (gx * gx + gy * gy).rsqrt()
    gx, gy = (gx * scale).double(), (gy * scale).double()
    size = torch.bincount(regions.region, minlength=regions.frame.numel())
    sums = run_sums(torch.stack([x, y, gx, gy, x * gx + y * gy, x * x + y * y]), size) / size
    mx, my, mgx, mgy, mixed, square = sums.unbind(0)
    mean = mgx * mgx + mgy * mgy
    spread = ((square - mx * mx - my * my) * (1 - mean)).clamp_min(1e-12).sqrt()
    return mean.sqrt(), (mixed - mx * mgx - my * mgy) / spread


def crests(grad: Gradient, cell: Int[Tensor, " P"]) -> Int[Tensor, " Q"]:
    """Those of the cells, rising, that have about the strongest gradient of their neighbours across the edge."""
    if cell.numel() == 0:
        return cell
    gx, gy = grad.components(cell)
    width, power = grad.shape[2], gx * gx + gy * gy
    table = power.new_zeros(int(cell[-1]) + 2 * (width + 2))
    table[cell + (width + 1)] = power
    most = torch.maximum(gx.abs(), gy.abs())
    step = (gx / most).round_() + width * (gy / most).round_()
    step = step.long()
    before, after = (table.index_select(0, cell + (width + 1) + sign * step) for sign in (-1, 1))
    return cell[positions(power >= _CREST * torch.maximum(before, after))]


def sorted_out(
    regions: Regions, xy: Float[Tensor, "P 2"], polarity: float
) -> tuple[Bool[Tensor, " R"], Bool[Tensor, " R"]]:
    """Regions that may be most of an ellipse of the polarity (0 for either) or the whole of another one; and those
    that are not, but may have arcs of the polarity in them."""
    mean, turning = roundness(regions, xy)
    own = turning.abs() if polarity == 0 else polarity * turning
    fit = ((mean < _STRAIGHT) & (own > _ROUND)) | ((mean < _ROUND) & (turning.abs() > _ROUND))
    return fit, ~fit & (mean < _LINE) & (own > -_ROUND)


def rings(grad: Gradient, found: Candidates) -> Bool[Tensor, " M"]:
    """Whether a second edge, of the opposite step, lies inside each ellipse in most directions in which it is seen."""
    return second_edges(grad, found) > _SHARE


def second_edges(grad: Gradient, found: Candidates) -> Float[Tensor, " M"]:
    """Share of the directions in which each ellipse is seen that have a second edge, of the opposite step, inside."""
    if len(found) == 0:
        return found.frame.float()
    _, height, width = grad.shape
    turn = (torch.arange(_DIRECTIONS, device=found.frame.device) + 0.5) * (2 * torch.pi / _DIRECTIONS)
    circle = torch.stack([turn.cos(), turn.sin()]).double()
    way = (conics.shape_matrix(found.ellipse) @ circle).float()[..., None]  # (M, 2, A, 1)
    beyond = 1 + way.new_tensor(_OUTSIDE) / torch.linalg.vector_norm(way, dim=1)
    at = torch.cat([way.new_tensor(_RADII).expand(len(found), _DIRECTIONS, -1), beyond], -1)
    x, y = (torch.addcmul(found.ellipse[:, k, None, None].float(), way[:, k], at).round_() for k in (0, 1))
    on_x, on_y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    cell = (found.frame[:, None, None] * height + on_y.long()) * width + on_x.long()
    grey = values_at(grad.frames, cell) * found.polarity[:, None, None].float()
    grey, outside = grey.split([len(_RADII), len(_OUTSIDE)], -1)
    low, first = grey.min(-1)
    # the greatest from there to the centre
    inner = grey.flip(-1).cummax(-1).values.flip(-1).gather(-1, first[..., None]).squeeze(-1)
    outer = outside.amax(-1) - low
    inside = ((x == on_x) & (y == on_y))[..., len(_RADII) :].all(-1)
    seen = inside & (outer > 0.5 * grad.threshold[found.frame, None]) & inner.isfinite()
    second = seen & (inner - low > _STEP * outer)
    return second.sum(-1) / seen.sum(-1).clamp_min(1)
