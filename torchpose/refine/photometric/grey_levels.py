"""Grey levels of the rings and the paper around them: their first fit, their columns, and the pixels that follow them.

Each marker has linear unknowns of its own: ring and paper, constant and gradient over its plane, and if the light is
curved second derivatives too.
"""

import math

import torch
from torch import Tensor

from torchpose.geometry.least_squares import geman_mcclure, solve_scaled
from torchpose.geometry.robust import CUT
from torchpose.refine.photometric.light import LEVELS
from torchpose.refine.photometric.ring_model import TILE, PixelBlocks, RingModel

_CLEAR_OF_LIMITS = 3.0  # deviations from where noise is clipped: its mean is off by 0.0004 of one there (derived)
_MISFIT = 0.02  # of the contrast: what a point-spread function that is not Gaussian leaves at the edges of quiet frames
MOST_SPREAD = 1.5  # of a marker's residuals, in those of the best marker of its frame
_NEAR_PURE = 0.05  # of paper in a pixel, beside the most and the least of its marker (convention)
_FIRST_STEPS = 3  # reweighted fits of the levels before the pose is moved


def first_levels(blocks: PixelBlocks, model: RingModel) -> Tensor:
    """Grey levels (K, 6) under a model: medians, then reweighted linear fits.

    A third of a ring may be covered: a least-squares fit of gradients would bend towards the cover and stay there.
    """
    basis = torch.stack(_basis(model), 2)
    columns, used = torch.cat([basis, tiled(blocks.grey)[:, :, None]], 2), blocks.valid * blocks.seen
    ring, paper = _pure_levels(blocks, model.fraction.flatten(1))
    none = torch.zeros_like(ring)
    levels = torch.stack([ring, none, none, paper, none, none], -1).nan_to_num(0.0, 0.0, 0.0).double()
    for _ in range(_FIRST_STEPS):
        predicted = (levels.float().view(-1, 1, LEVELS, 1) * basis).sum(2).flatten(1)
        residual = blocks.grey - predicted
        weight = used * geman_mcclure(residual / (2 * noise_spread(residual, blocks)[:, None]))
        levels = solve_scaled(*sum_products(columns, weight)[:, :LEVELS].split_with_sizes([LEVELS, 1], -1))
    return levels.squeeze(-1)


def _pure_levels(blocks: PixelBlocks, fraction: Tensor) -> tuple[Tensor, Tensor]:
    """Grey of ring and of paper (K,) by the medians of the pixels that show most of either.

    A blurred ring has no pixel without paper, so the line through both medians is followed to the ends. A level beyond
    the range of grey values shows no pixel at all.
    """
    fraction = fraction.clamp(0, 1)  # beyond: deep in a flat hole, where the expansions fail
    known = fraction.masked_fill(blocks.valid == 0, torch.nan)
    least = known.nan_to_num(nan=2.0).amin(-1, keepdim=True)
    most = known.nan_to_num(nan=-1.0).amax(-1, keepdim=True)
    ends = [blocks.valid * where for where in (fraction < least + _NEAR_PURE, fraction > most - _NEAR_PURE)]
    (ring, paper), (at_ring, at_paper) = ([_median(v, w) for w in ends] for v in (blocks.grey, fraction))
    slope = (paper - ring) / (at_paper - at_ring)
    return ring - at_ring * slope, paper + (1 - at_paper) * slope


def columns_of(blocks: PixelBlocks, model: RingModel, levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives by pose (6), blur (3) and levels (L), the residual, and the derivative by the edge gain where
    the model has it, by tiles: (K, P / 256, 11 + L, 256) float32.

    Also the derivative by the distance from the edges, and the residual, (K, P).
    """
    a0, ax, ay, p0, px, py, *curved = levels.float()[..., None, None].unbind(1)
    x, y = model.x, model.y
    ring, paper = (torch.addcmul(torch.addcmul(c, cx, x), cy, y) for c, cx, cy in ((a0, ax, ay), (p0, px, py)))
    if curved:
        axx, axy, ayy, pxx, pxy, pyy = curved
        ring = ring + axx * x.square() + axy * x * y + ayy * y.square()
        paper = paper + pxx * x.square() + pxy * x * y + pyy * y.square()
    contrast = paper - ring
    by_d = contrast * model.by_d
    residual = tiled(blocks.grey) - torch.addcmul(ring, contrast, model.fraction)
    basis = _basis(model, bool(curved))
    by_blur = (contrast * v for v in model.by_blur)
    by_pose = (by_d[:, :, None] * model.by_pose).unbind(2)
    by_gain = () if model.by_gain is None else (contrast * model.by_gain,)
    columns = torch.stack([*by_pose, *by_blur, *basis, residual, *by_gain], 2)
    return columns, by_d.flatten(1), residual.flatten(1)


def _basis(model: RingModel, curved: bool = False) -> tuple[Tensor, ...]:
    """Planes of the linear unknowns: ring (1, x, y), paper (1, x, y); if ``curved`` also (xx, xy, yy) of both."""
    ring, paper = 1 - model.fraction, model.fraction
    flat = (ring, ring * model.x, ring * model.y, paper, paper * model.x, paper * model.y)
    if not curved:
        return flat
    squares = (model.x.square(), model.x * model.y, model.y.square())
    return (*flat, *(ring * p for p in squares), *(paper * p for p in squares))


def tiled(plane: Tensor) -> Tensor:
    """A plane (K, P) as (K, P / 256, 256)."""
    return plane.view(plane.shape[0], plane.shape[1] // TILE, TILE)


def sum_products(columns: Tensor, weight: Tensor) -> Tensor:
    """Sums over all pixels of weight times the products of every two columns: (K, n, n) float64."""
    tiles = columns.flatten(0, 1)
    products = torch.bmm(tiles * weight.view(-1, 1, TILE), tiles.mT)
    return products.unflatten(0, columns.shape[:2]).sum(1, dtype=torch.float64)


def inliers(
    residual: Tensor,
    blocks: PixelBlocks,
    model: RingModel,
    spread: Tensor,
    misfit: Tensor,
    rough: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Pixels (K, P) whose noise is not clipped, by what they should show, and of these the ones that do show it.

    Args:
        spread: (K,), as `noise_spread`. misfit: (K,), as `model_misfit`. rough: (K, P) grey levels, deviation of what
            edges that scatter do.
    """
    spread = spread[:, None]
    predicted = blocks.grey - residual
    margin = _CLEAR_OF_LIMITS * spread
    low, high = blocks.limits[:, :1], blocks.limits[:, 1:]
    usable = blocks.valid * ((predicted > low + margin) & (predicted < high - margin))
    if model.sound is not None:
        usable = usable * model.sound.flatten(1)
    spread = spread if rough is None else torch.hypot(spread, rough.to(spread))
    return usable, usable * (residual.abs() < CUT * spread + misfit[:, None])


def noise_spread(residual: Tensor, blocks: PixelBlocks) -> Tensor:
    """Robust standard deviation (K,) from the median absolute residual.

    All markers of a frame share its noise, so none may claim much more than the best of them: cover would.
    """
    own = (1.4826 * _median(residual.abs(), blocks.valid)).nan_to_num(nan=1.0).clamp_min(math.sqrt(blocks.quantisation))
    least = own.new_full((blocks.rows,), torch.inf).scatter_reduce_(0, blocks.row, own, "amin")
    return torch.minimum(own, MOST_SPREAD * least.index_select(0, blocks.row))


def _median(values: Tensor, where: Tensor) -> Tensor:
    """Medians (K,) of the values (K, P) where the mask is not 0; NaN where it is 0 everywhere."""
    return values.masked_fill(where == 0, torch.nan).nanmedian(-1).values


def model_misfit(levels: Tensor) -> Tensor:
    """What the model itself may be off by at an edge: (K,) float32, grey levels."""
    return _MISFIT * (levels[:, 3] - levels[:, 0]).abs().float()
