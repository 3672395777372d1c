"""Arcs of ellipses: joint fits to positions and directions, chaining across gaps, and following an ellipse on.

Whole circles come out of region growing in one piece. Where something covers a ring, touches it or crosses it, the
region breaks into arcs or runs on along the other edge. Arcs that belong to one ellipse are chained as in ELSDc
(Patraucean, Gurdjos, Grompone von Gioi 2017), here all pairs of a batch at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.detect.regions import Gradient, Regions
from torchpose.geometry import conics
from torchpose.geometry.segments import positions, ragged_arange, rank_in_group, segment_mean, segment_sum

_TANGENT_PX = 2.0  # px of position error that weigh as much as a radian of direction error
_LEAST_TURN = 0.25  # rad from end to end of an arc; less may be straight
_MOST_ARCS = 200  # of one frame that are chained, the longest
_RADII = 4.0  # most ratio of the radii of curvature of two arcs of one ellipse
_BAND = 2  # px to either side in which an ellipse is followed
_BAND_COS = 0.9  # of a gradient with the normal of the ellipse that is followed: 26 degrees


@dataclass(frozen=True, eq=False)
class Arcs:
    """N smooth curve pieces.

    Attributes:
        frame: (N,) int64. middle: (N, 2) px, mean of the cells. normal: (N, 2), mean direction of the gradient.
        curvature: (N,) 1/px, positive where the gradient points away from the centre of curvature.
        turn: (N,) rad, from end to end. size: (N,) cells.
    """

    frame: Tensor
    middle: Tensor
    normal: Tensor
    curvature: Tensor
    turn: Tensor
    size: Tensor


def describe_arcs(regions: Regions, xy: Tensor) -> Arcs:
    """Circle-like description of regions from positions and gradient directions.

    Along an arc of radius R the direction of the gradient turns by ds / R; the curvature is the regression of one on
    the other.

    Args:
        xy: (P, 2) float64, centres of the cells of the regions.
    """
    count, index = regions.frame.numel(), regions.region
    (x, y), (gx, gy) = xy.unbind(-1), regions.gradient.unbind(-1)
    scale = (gx * gx + gy * gy).rsqrt()
    gx, gy = (gx * scale).double(), (gy * scale).double()
    size = torch.bincount(index, minlength=count)
    mean = torch.stack([segment_sum(v, index, count) for v in (x, y, gx, gy)], -1) / size[:, None]
    middle, normal = mean.split(2, -1)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    each = (*middle.unbind(-1), *normal.unbind(-1))
    mx, my, nx, ny = (v.contiguous().index_select(0, index) for v in each)
    along = (y - my) * nx - (x - mx) * ny  # the tangent is (-ny, nx)
    angle = torch.atan2(gy * nx - gx * ny, gx * nx + gy * ny)
    curvature = segment_sum(along * angle, index, count) / segment_sum(along * along, index, count).clamp_min(1e-9)
    ends = torch.zeros(2, count, dtype=angle.dtype, device=angle.device)
    ends[0].scatter_reduce_(0, index, along, "amax")
    ends[1].scatter_reduce_(0, index, -along, "amax")
    turn = ends.sum(0) * curvature.abs()
    return Arcs(regions.frame, middle, normal, curvature, turn, size)


def chain_pairs(arcs: Arcs) -> tuple[Tensor, Tensor]:
    """Pairs (i, j) int64 of arcs that may be of one ellipse: same turning sense, each on the inner side of the other.

    The middles are no farther apart than the two circles of curvature allow.
    """
    curved = arcs.turn > _LEAST_TURN
    order = torch.argsort(torch.where(curved, arcs.size, 0), descending=True, stable=True)
    rank = torch.empty_like(order)
    frames = int(arcs.frame.max()) + 1 if arcs.frame.numel() else 0
    rank[order] = rank_in_group(arcs.frame[order], frames)
    index = (curved & (rank < _MOST_ARCS)).nonzero()[:, 0]
    index = index[torch.argsort(arcs.frame[index], stable=True)]
    per_frame = torch.bincount(arcs.frame[index], minlength=frames)
    start = per_frame.cumsum(0) - per_frame
    first, second = ragged_arange(per_frame[arcs.frame[index]])
    i, j = index[first], index[start[arcs.frame[index[first]]] + second]
    ahead = i < j
    i, j = i[ahead], j[ahead]
    ki, kj = arcs.curvature[i], arcs.curvature[j]
    ratio = (ki / kj).abs()
    reach = 1 / torch.minimum(ki.abs(), kj.abs())
    step = arcs.middle[j] - arcs.middle[i]
    distance = torch.linalg.vector_norm(step, dim=-1)
    inward_i, inward_j = -ki.sign()[:, None] * arcs.normal[i], -kj.sign()[:, None] * arcs.normal[j]
    # a chord leaves a convex curve inwards at both ends
    fits = (
        (ki * kj > 0)
        & (ratio < _RADII)
        & (ratio > 1 / _RADII)
        & (distance < 3 * reach)
        & ((step * inward_i).sum(-1) > -1.0)
        & ((step * inward_j).sum(-1) < 1.0)
    )
    return i[fits], j[fits]


def fit_joint(xy: Tensor, gradient: Tensor, index: Tensor, count: int, weights: Tensor) -> Tensor:
    """Ellipses (count, 5) from positions and gradient directions, NaN where the conic is no ellipse.

    The smallest eigenvector of the scatter of two rows a point: the conic passes through the point, and its tangent
    there is at right angles with the gradient (pole and polar). Directions hold arcs that positions alone leave open.

    Args:
        xy: (P, 2) float64. gradient: (P, 2). index: (P,) int64. weights: (P,) not negative.
    """
    w = weights.double()
    center = segment_mean(xy, index, count, w)
    scale = segment_mean((xy - center[index]).square().sum(-1), index, count, w).sqrt()
    rows = direction_rows(xy, gradient, index, center, scale)
    return fit_scatter(segment_sum(rows * w[:, None], index, count), center, scale)


def direction_rows(xy: Tensor, gradient: Tensor, index: Tensor, center: Tensor, scale: Tensor) -> Tensor:
    """What each point adds to the scatter that `fit_scatter` solves: (P, 21), the upper triangle.

    Args:
        xy: (P, 2) float64. gradient: (P, 2). index: (P,) int64, whose ellipse. center, scale: (M, 2), (M,), in whose
            units the conic is sought.
    """
    x, y = ((xy - center[index]) / scale[index, None]).unbind(-1)
    g = gradient.double()
    g = g / torch.linalg.vector_norm(g, dim=-1, keepdim=True).clamp_min(1e-12)
    tx, ty = -g[:, 1], g[:, 0]
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    on = torch.stack([x * x, x * y, y * y, x, y, one], -1)
    along = torch.stack([2 * x * tx, x * ty + y * tx, 2 * y * ty, tx, ty, zero], -1)
    along = along * (_TANGENT_PX / scale)[index, None]
    upper = torch.triu_indices(6, 6, device=xy.device)
    return on[:, upper[0]] * on[:, upper[1]] + along[:, upper[0]] * along[:, upper[1]]


def fit_scatter(sums: Tensor, center: Tensor, scale: Tensor) -> Tensor:
    """Ellipses (M, 5) of summed `direction_rows` (M, 21), NaN where the conic is no ellipse."""
    upper = torch.triu_indices(6, 6, device=sums.device)
    scatter = torch.zeros(sums.shape[0], 6, 6, dtype=sums.dtype, device=sums.device)
    scatter[:, upper[0], upper[1]] = sums
    scatter[:, upper[1], upper[0]] = sums
    sound = scatter.isfinite().all(-1).all(-1)
    conic = torch.linalg.eigh(torch.where(sound[:, None, None], scatter, 0.0)).eigenvectors[..., 0]
    params = conics.ellipse_from_conic(conic)
    params = torch.cat([params[:, :2] * scale[:, None] + center, params[:, 2:4] * scale[:, None], params[:, 4:]], -1)
    return torch.where(sound[:, None], params, torch.nan)


def follow(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor, rounds: int = 3) -> Tensor:
    """Refits ellipses (M, 5) to whatever edge lies along them, so that an arc grows round over gaps.

    Args:
        frame: (M,) int64. ellipses: (M, 5), cells. polarity: (M,) +1 where the gradient points outwards.

    Returns:
        (M, 5); NaN where nothing was left to fit.
    """
    largest = max(grad.shape[1:])
    for _ in range(rounds if ellipses.shape[0] else 0):
        # a hairline fits an ellipse of any size: without a limit, its samples would fill the memory
        ellipses = torch.where(ellipses[:, 2:3] <= largest, ellipses, torch.nan)
        which, xy, normal, _ = perimeter_samples(ellipses)
        band = torch.arange(-_BAND, _BAND + 1, dtype=torch.float64, device=xy.device)
        cell, inside, (x, y) = cells_along(grad, frame.index_select(0, which), xy, normal, band)
        gx, gy = (g.view_as(x) for g in grad.components(cell.flatten()))
        nx, ny = (n[:, None].float() for n in normal.unbind(-1))
        rise = (gx * nx + gy * ny) * polarity.index_select(0, which)[:, None].float()
        power, least = gx * gx + gy * gy, (0.5 * grad.threshold[frame]).square()
        good = inside & (rise > 0) & (rise * rise > _BAND_COS**2 * power) & (power > least[which, None])
        keep = positions(good.flatten())
        kept = [v.flatten().index_select(0, keep) for v in (x, y, gx, gy, rise)]
        middle, gradient = torch.stack(kept[:2], -1), torch.stack(kept[2:4], -1)
        of = which.index_select(0, keep // band.numel())
        ellipses = fit_joint(middle, gradient, of, ellipses.shape[0], kept[4])
    return ellipses


def perimeter_samples(
    ellipses: Tensor, most: int | None = None, multiple: int = 2
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """About one sample a pixel of perimeter, ``most`` at most: ellipse (S,), position (S, 2), outward normal (S, 2).

    And how far along the perimeter each lies, (S,) in [0, 1). Ellipses that are NaN have none.

    Args:
        multiple: even; the number of samples is a multiple of it, so that none lies on the border of that many sectors.
    """
    # an even number, half a step off the axes: the samples of a mirrored ellipse are the mirrored samples
    n = multiple * (conics.perimeter(ellipses).nan_to_num(nan=0.0) / multiple).ceil().long()
    n = n if most is None else n.clamp_max(most)
    which, position = ragged_arange(n)
    turn = (position.double() + 0.5) / n.index_select(0, which)
    x, y, nx, ny = conics.boundary(ellipses, which, 2 * torch.pi * turn)
    return which, torch.stack([x, y]).mT, torch.stack([nx, ny]).mT, turn


def cells_at(grad: Gradient, frame: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Flat cells (S,) nearest to positions (S, 2), and which positions lie on the frame (S,) bool; the others any."""
    _, height, width = grad.shape
    x, y = ((v - 0.5).round() for v in xy.unbind(-1))
    on_x, on_y = x.clamp(0, width - 2), y.clamp(0, height - 2)
    return ((frame * height + on_y) * width + on_x).long(), (x == on_x) & (y == on_y)


def cells_along(
    grad: Gradient, frame: Tensor, xy: Tensor, normal: Tensor, band: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Cells (S, K) nearest to the positions ``band`` (K,) along normals (S, 2) from positions (S, 2).

    Returns:
        cells (S, K) and which positions lie on the frame, as `cells_at`, and x, y (S, K), the centres of the cells.
    """
    _, height, width = grad.shape
    x, y = (
        (at[:, None] + n[:, None] * band - 0.5).round() for at, n in zip(xy.unbind(-1), normal.unbind(-1), strict=True)
    )
    on_x, on_y = x.clamp(0, width - 2), y.clamp(0, height - 2)
    cell = ((frame[:, None] * height + on_y) * width + on_x).long()
    return cell, (x == on_x) & (y == on_y), (x + 0.5, y + 0.5)
