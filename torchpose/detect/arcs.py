"""Arcs of ellipses: joint fits to positions and directions, and chaining across gaps.

Whole circles come out of region growing in one piece. Where something covers a ring, touches it or crosses it, the
region breaks into arcs or runs on along the other edge. Arcs that belong to one ellipse are chained as in ELSDc
(Patraucean, Gurdjos, Grompone von Gioi 2017), here all pairs of a batch at once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.detect.regions import AGREE_COS, MOST_A_FRAME, Gradient, Regions
from torchpose.geometry import conics, segments
from torchpose.geometry.constants import either
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import positions, ragged_arange, segment_sum

_TANGENT_PX = 2.0  # px of position error that weigh as much as a radian of direction error
_LEAST_TURN = 0.25  # rad from end to end of an arc; less may be straight (measured: docs/tried.md, cost)


@dataclass(frozen=True, eq=False)
class Arcs(Rows):
    """Smooth curve pieces."""

    frame: Int[Tensor, " N"]
    middle: Float[Tensor, "N 2"]  # px, mean of the cells
    normal: Float[Tensor, "N 2"]  # mean direction of the gradient
    curvature: Float[Tensor, " N"]  # 1/px, positive where the gradient points away from the centre of curvature
    turn: Float[Tensor, " N"]  # rad, from end to end
    size: Int[Tensor, " N"]  # cells


@dataclass(frozen=True, eq=False)
class Perimeter(Rows):
    """Samples of the perimeters of ellipses."""

    of: Int[Tensor, " S"]  # the ellipse
    xy: Float[Tensor, "S 2"]
    normal: Float[Tensor, "S 2"]  # of unit length, outwards
    turn: Float[Tensor, " S"]  # how far along the perimeter, in [0, 1)


@dataclass(frozen=True, eq=False)
class Band(Rows):
    """Cells beside samples of a perimeter, from inside to outside."""

    at: Perimeter
    x: Float[Tensor, "S K"]  # centres of the cells
    y: Float[Tensor, "S K"]
    gx: Float[Tensor, "S K"]
    gy: Float[Tensor, "S K"]
    rise: Float[Tensor, "S K"]  # of the grey value across the ellipse, 0 where the gradient is weak or has another way


def describe_arcs(regions: Regions, xy: Float[Tensor, "P 2"]) -> Arcs:
    """Circle-like description of regions from positions and gradient directions of their cells.

    Along an arc of radius R the direction of the gradient turns by ds / R; the curvature is the regression of one on
    the other.
    """
    count, index = regions.frame.numel(), regions.region
    (x, y), (gx, gy) = xy.unbind(-1), regions.gradient.unbind(-1)
    scale = (gx * gx + gy * gy).rsqrt()
    gx, gy = (gx * scale).double(), (gy * scale).double()
    size = torch.bincount(index, minlength=count)
    mean = segment_sum(torch.stack([x, y, gx, gy], -1), index, count) / size[:, None]
    middle, normal = mean.split_with_sizes([2, 2], -1)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    mx, my, nx, ny = torch.cat([middle, normal], 1).index_select(0, index).unbind(1)
    along = (y - my) * nx - (x - mx) * ny  # the tangent is (-ny, nx)
    angle = torch.atan2(gy * nx - gx * ny, gx * nx + gy * ny)
    curvature = segment_sum(along * angle, index, count) / segment_sum(along * along, index, count).clamp_min(1e-9)
    ends = torch.zeros(2, count, dtype=angle.dtype, device=angle.device)
    ends[0].scatter_reduce_(0, index, along, "amax")
    ends[1].scatter_reduce_(0, index, -along, "amax")
    turn = ends.sum(0) * curvature.abs()
    return Arcs(regions.frame, middle, normal, curvature, turn, size)


def chain_pairs(arcs: Arcs, polarity: float = 0.0) -> Int[Tensor, "Q 2"]:
    """Pairs of arcs that may be of one ellipse: same turning sense, each on the inner side of the other.

    The middles are no farther apart than the two circles of curvature allow. Arcs are sorted by frame. With a
    ``polarity`` only those count that belong to ellipses of this one.
    """
    curved = arcs.turn > _LEAST_TURN
    rank = segments.rank_in_group(arcs.frame, by=either(curved, -arcs.size, 0))
    index = positions(curved & (rank < MOST_A_FRAME) & (arcs.curvature * polarity >= 0))
    i, j = segments.pairs_in_group(arcs.frame[index], arcs.frame[index])
    ahead = positions(i < j)
    i, j = index[i[ahead]], index[j[ahead]]
    ki, kj = arcs.curvature[i], arcs.curvature[j]
    reach = 1 / torch.minimum(ki.abs(), kj.abs())
    step = arcs.middle[j] - arcs.middle[i]
    distance = torch.linalg.vector_norm(step, dim=-1)
    inward_i, inward_j = -ki.sign()[:, None] * arcs.normal[i], -kj.sign()[:, None] * arcs.normal[j]
    # a chord leaves a convex curve inwards at both ends
    fits = (
        (ki * kj > 0) & (distance < 3 * reach) & ((step * inward_i).sum(-1) > -1.0) & ((step * inward_j).sum(-1) < 1.0)
    )
    return torch.stack([i[fits], j[fits]], -1)


def fit_pairs(
    regions: Regions, about: Arcs, xy: Float[Tensor, "P 2"], pair: Int[Tensor, "Q 2"]
) -> Float[Tensor, "Q 5"]:
    """Ellipses of the cells of pairs of arcs, each arc summed once however many pairs it is in."""
    arc, member = pair.flatten().unique(return_inverse=True)
    order = torch.arange(len(arc), device=pair.device)
    number = torch.full((len(about),), -1, device=pair.device).index_copy(0, arc, order)
    own = number.index_select(0, regions.region)
    cell = positions(own >= 0)
    own, gradient, xy = own[cell], regions.gradient[cell], xy[cell]
    middle, first = about.middle[arc], member.view(-1, 2)
    sums = scatter_sums(xy, gradient, own, middle, torch.linalg.vector_norm(gradient, dim=-1))
    weight = sums[:, 5, 5]
    mean = middle + sums[:, 3:5, 5] / weight[:, None]
    share = weight[first] / weight[first].sum(-1, keepdim=True)
    center = (share[..., None] * mean[first]).sum(1)
    step = (middle[first] - center[:, None]).flatten(0, 1)
    return fit_scatter(moved_sums(sums[member], step).view(-1, 2, 6, 6).sum(1), center)


def scatter_sums(
    xy: Tensor, gradient: Tensor, index: Tensor, center: Tensor, weights: Tensor, size: int = 32
) -> Float[Tensor, "M 6 6"]:
    """What points (P, 2) add to the scatter that `fit_scatter` solves, summed by their index, about centres (M, 2).

    ``size`` is that of the tiles of points that are summed at once, about as many as a centre has.
    """
    (x, y), (gx, gy) = xy.unbind(-1), gradient.double().unbind(-1)
    x, y = (v - c.contiguous().index_select(0, index) for v, c in zip((x, y), center.unbind(-1), strict=True))
    root = weights.double().sqrt()
    turn = _TANGENT_PX * root / (gx * gx + gy * gy).sqrt().clamp_min(1e-12)
    tiles = segments.Tiles.of(index, len(center), size)
    x, y, gx, gy, root = tiles.planes(x, y, gx * turn, gy * turn, root).unbind(1)
    tx, ty = -gy, gx
    on = torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)], 1) * root[:, None]
    along = torch.stack([2 * x * tx, x * ty + y * tx, 2 * y * ty, tx, ty, torch.zeros_like(x)], 1)
    rows = torch.cat([on, along], -1)
    return tiles.sums(rows @ rows.mT)


def moved_sums(sums: Float[Tensor, "M 6 6"], step: Float[Tensor, "M 2"]) -> Float[Tensor, "M 6 6"]:
    """The same sums about other centres, from which the old ones lie a step away: monomials of x + step."""
    dx, dy = step.unbind(-1)
    change = torch.eye(6, dtype=sums.dtype, device=sums.device).repeat(len(sums), 1, 1)
    change[:, 0, 3], change[:, 0, 5] = 2 * dx, dx * dx
    change[:, 1, 3], change[:, 1, 4], change[:, 1, 5] = dy, dx, dx * dy
    change[:, 2, 4], change[:, 2, 5] = 2 * dy, dy * dy
    change[:, 3, 5], change[:, 4, 5] = dx, dy
    return change @ sums @ change.mT


def fit_scatter(sums: Float[Tensor, "M 6 6"], center: Tensor, scale: Tensor | None = None) -> Float[Tensor, "M 5"]:
    """Ellipses of `scatter_sums` about centres (M, 2), NaN where the conic is no ellipse.

    Conics are of unit length in units of their scale (M,), by default the extent of the points about the centre.
    """
    if scale is None:  # directions have no part in the last row
        scale = ((sums[:, 0, 5] + sums[:, 2, 5]) / sums[:, 5, 5]).sqrt()
    one = torch.ones_like(scale)
    unit = 1 / torch.stack([scale * scale, scale * scale, scale * scale, scale, scale, one], -1)
    scatter = sums * unit[:, :, None] * unit[:, None]
    sound = scatter.isfinite().all(-1).all(-1)
    conic = torch.linalg.eigh(either(sound[:, None, None], scatter, 0.0)).eigenvectors[..., 0]
    params = conics.ellipse_from_conic(conic)
    params = torch.cat([params[:, :2] * scale[:, None] + center, params[:, 2:4] * scale[:, None], params[:, 4:]], -1)
    return either(sound[:, None], params, torch.nan)


def perimeter_samples(ellipses: Float[Tensor, "M 5"], most: int | None = None, multiple: int = 2) -> Perimeter:
    """About one sample a pixel of perimeter, ``most`` at most, none of an ellipse that is NaN.

    Their number is a multiple of the even ``multiple``, so that none lies on the border of that many sectors.
    """
    # an even number, half a step off the axes: the samples of a mirrored ellipse are the mirrored samples
    n = multiple * (conics.perimeter(ellipses).nan_to_num(nan=0.0) / multiple).ceil().long()
    n = n if most is None else n.clamp_max(most)
    of, position = ragged_arange(n)
    turn = (position.double() + 0.5) / n.index_select(0, of)
    x, y, nx, ny = conics.boundary(ellipses, of, 2 * torch.pi * turn)
    return Perimeter(of, torch.stack([x, y]).mT, torch.stack([nx, ny]).mT, turn)


def cells_at(grad: Gradient, frame: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Flat cells (...) of the frame nearest to positions, their columns and rows, and which positions lie on it."""
    _, height, width = grad.shape
    x, y = (x - 0.5).round_(), (y - 0.5).round_()
    on_x, on_y = x.clamp(0, width - 2), y.clamp(0, height - 2)
    inside = (x == on_x).logical_and_(y == on_y)
    cell = torch.add(on_y, frame, alpha=height, out=y).mul_(width).add_(on_x).long()
    return cell, on_x, on_y, inside


def edge_band(grad: Gradient, frame: Tensor, polarity: Tensor, at: Perimeter, reach: int) -> Band:
    """Edges up to ``reach`` cells to either side of samples of ellipses; polarity +1 where grey rises outwards."""
    across = torch.arange(-reach, reach + 1, dtype=torch.float64, device=at.xy.device)
    planes = zip(at.xy.unbind(-1), at.normal.unbind(-1), strict=True)
    beside = (torch.addcmul(p[:, None], n[:, None], across) for p, n in planes)
    cell, column, row, inside = cells_at(grad, frame.index_select(0, at.of)[:, None], *beside)
    gx, gy = (g.view_as(column) for g in grad.components(cell.flatten()))
    nx, ny = (n[:, None].float() for n in at.normal.unbind(-1))
    outward = polarity.index_select(0, at.of)[:, None].float()
    rise = (gx * nx).addcmul_(gy, ny).mul_(outward)
    power, least = (gx * gx).addcmul_(gy, gy), (0.5 * grad.threshold[frame]).square()
    steep = rise.square() > AGREE_COS**2 * power
    good = inside.logical_and_(rise > 0).logical_and_(steep).logical_and_(power > least[at.of, None])
    return Band(at, column + 0.5, row + 0.5, gx, gy, rise.masked_fill_(~good, 0.0))
