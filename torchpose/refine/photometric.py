"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F

with the fraction of paper F of `ring_model`. Pose and blur (one for each frame) are found by Gauss-Newton; the two grey
levels of each marker, with linear gradients over the plane, are linear unknowns (`gauss_newton`).
Frames and markers are padded blocks of pixels: one sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum
from torchpose.refine.gauss_newton import LEVELS, QUANTISATION, gauss_newton_step, solve_ridged
from torchpose.refine.result import Refined
from torchpose.refine.ring_model import PixelBlocks, RingModel, gather_pixels, ring_model

_COARSE = 6  # the first steps take one pixel of so many; both are whole numbers of tiles
_MOST_COARSE = 512  # of a marker whose edges are sharp: the last step, on all pixels, mends what they leave
_STEPS = (3, 1)  # of Gauss-Newton, on some of the pixels and on all
_BAND = 4.0  # px on either side of an edge
_BAND_PER_BLUR = 4.6  # band of a wide blur, in its standard deviations
_WIDEST = 12.0  # px, of all bands
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)
_CUT = 4.0  # robust standard deviations beyond which a pixel is left out
_CLEAR_OF_LIMITS = 3.0  # standard deviations between what a pixel should show and where its noise is clipped
_MISFIT = 0.02  # of the contrast: what a point-spread function that is not Gaussian leaves at the edges of quiet frames
_TILE = 256  # pixels summed in float32 at a time; sums of tiles are float64, so padding changes no digit that counts
_SECTORS = 48  # of a circle
_SECTOR_KEPT = 0.9  # of a sector's pixels that must follow the model for it to count
_SECTOR_CUT = 4.0  # standard deviations of the mean square of a sector's residuals
_LEAST_CLEAR = 0.55  # of the sectors of a marker, below which none of them counts
_MOST_SPREAD = 1.5  # of a marker's residuals, in those of the best marker of its frame


def refine_photometric(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    rotation: Tensor,
    translation: Tensor,
    mask: Tensor,
    rings: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
    *,
    prior: Tensor | None = None,
) -> Refined:
    """Refines N poses on the grey values around the rings of their markers.

    Args:
        frames: (B, H, W) grey, any real dtype, in grey levels. frame: (N,) int64.
        rotation, translation: (N, 3, 3), (N, 3) to start from, within about a pixel.
        mask: (N, M) bool, markers seen. rings: (N, M, 2, 5) their fitted ellipses in raw pixels, outer and inner.
        centers, normals: (N, M, 3) in the target frame. radii: (N, M, 2), mm.
        prior: (N, 6, 6), information about the pose besides the frames, that is the inverse covariance of the start:
            from the robot, or to hold what is known.
    """
    rows = rotation.shape[0]
    start = torch.full((rows,), _START_BLUR, dtype=torch.float64, device=rotation.device)
    none = torch.zeros(rows, 6, 6, dtype=torch.float64, device=rotation.device)
    known = none if prior is None else prior
    narrow = torch.full_like(start, _BAND)
    model = (centers, normals, radii)
    where = (frames, camera, frame, mask, rings)
    first = _refine(*where, *model, rotation, translation, start, narrow, known, most_coarse=_MOST_COARSE)
    # a wide blur needs a wider band, or it takes the levels on both sides of the edge for its own
    w = (_BAND_PER_BLUR * first.blur > _BAND + 1).nonzero()[:, 0]
    if w.numel() == 0:
        return first
    band = (_BAND_PER_BLUR * first.blur[w]).clamp_max(_WIDEST)
    model = (centers[w], normals[w], radii[w])
    again = _refine(
        frames, camera, frame[w], mask[w], rings[w], *model, rotation[w], translation[w], first.blur[w], band, known[w]
    )
    good = again.good.nonzero()[:, 0]
    return first.replaced(w[good], again[good])


def _refine(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    mask: Tensor,
    rings: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
    r: Tensor,
    t: Tensor,
    blur: Tensor,
    band: Tensor,
    prior: Tensor,
    most_coarse: int | None = None,
) -> Refined:
    """`refine_photometric` by the pixels within ``band`` (N,) px of an edge, from a blur (N,) px."""
    rows = r.shape[0]
    blocks = gather_pixels(frames, camera, frame, mask, rings, centers, normals, radii, band, _TILE * _COARSE)
    coarse = blocks.every(_COARSE, most_coarse)
    levels = _first_levels(coarse, r, t, blur)
    usable = weight = blocks.valid
    information = torch.zeros(rows, 7, 7, dtype=torch.float64, device=r.device)
    variance = torch.ones(rows, dtype=torch.float64, device=r.device)
    known = torch.nn.functional.pad(prior, (0, 1, 0, 1))
    moved = torch.zeros(rows, 7, dtype=torch.float64, device=r.device)
    for part in (*[coarse] * _STEPS[0], *[blocks] * _STEPS[1]):
        model = ring_model(part, r, t, blur)
        columns = _columns(part, model, levels)
        residual = columns[:, :, -1].flatten(1)
        usable, weight = _inliers(residual, part, levels)
        if part is blocks:
            weight = weight * _clear_sectors(residual, usable, weight, part, model, levels)
        sums = _products(columns, weight)
        step, level_step, information, variance = gauss_newton_step(
            sums, weight.sum(-1), levels, blocks.row, rows, known, moved
        )
        moved = moved + step
        r = rotations.exp(step[:, 3:6]) @ r
        t = t + step[:, :3]
        blur = (blur + step[:, 6]).clamp(*_BLUR_RANGE)
        levels = levels + level_step
    inverse, info = torch.linalg.inv_ex(information)
    covariance = inverse[:, :6, :6] * variance[:, None, None]
    kept = segment_sum(weight.sum(-1), blocks.row, rows) / segment_sum(usable.sum(-1), blocks.row, rows)
    good = (info == 0) & covariance.isfinite().all(-1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    return Refined(r, t, covariance, blur, variance.sqrt(), kept, good)


def _basis(m: RingModel) -> tuple[Tensor, ...]:
    """Planes of the linear unknowns: ring (1, x, y), paper (1, x, y)."""
    ring = 1 - m.fraction
    return ring, ring * m.x, ring * m.y, m.fraction, m.fraction * m.x, m.fraction * m.y


def _columns(b: PixelBlocks, m: RingModel, levels: Tensor) -> Tensor:
    """Derivatives by pose (6), blur (1) and levels (6), and the residual, by tiles: (K, P / 256, 14, 256) float32."""
    a0, ax, ay, p0, px, py = (v[:, None].float() for v in levels.unbind(-1))
    ring, paper = a0 + ax * m.x + ay * m.y, p0 + px * m.x + py * m.y
    contrast = paper - ring
    by_d = contrast * m.by_d
    residual = b.grey - (ring + contrast * m.fraction)
    return _tiled((*(by_d * v for v in m.by_pose), contrast * m.by_q, *_basis(m), residual))


def _tiled(planes: tuple[Tensor, ...]) -> Tensor:
    """Planes (K, P) as (K, P / 256, planes, 256)."""
    return torch.stack([p.unflatten(1, (-1, _TILE)) for p in planes], 2)


def _products(columns: Tensor, weight: Tensor) -> Tensor:
    """Sums over all pixels of weight times the products of every two columns: (K, n, n) float64."""
    weighted = columns * weight.unflatten(1, (-1, 1, _TILE))
    return (weighted @ columns.mT).double().sum(1)


def _first_levels(b: PixelBlocks, r: Tensor, t: Tensor, blur: Tensor) -> Tensor:
    """Grey levels (K, 6) for the poses that come in: medians, then reweighted linear fits.

    A third of a ring may be covered: a least-squares fit of gradients would bend towards the cover and stay there.
    """
    model = ring_model(b, r, t, blur)
    columns = _tiled((*_basis(model), b.grey))
    none = torch.zeros_like(model.fraction[:, 0])
    ring, paper = _median(b.grey, b.valid * (model.fraction < 0.05)), _median(b.grey, b.valid * (model.fraction > 0.95))
    # a level beyond the range of grey values shows no pixel
    low, high = b.limits.unbind(-1)
    ring, paper = (
        torch.where(x.isnan(), torch.where(y < 0.5 * high, high, low), x) for x, y in ((ring, paper), (paper, ring))
    )
    levels = torch.stack([ring, none, none, paper, none, none], -1).nan_to_num(0.0, 0.0, 0.0).double()
    for _ in range(3):
        predicted = (levels.float()[:, None, None] @ columns[:, :, :LEVELS]).flatten(1)
        residual = b.grey - predicted
        weight = b.valid / (1 + (residual / (2 * _spread(residual, b)[:, None])).square()).square()
        sums = _products(columns, weight)
        levels = solve_ridged(sums[:, :LEVELS, :LEVELS], sums[:, :LEVELS, LEVELS:]).squeeze(-1)
    return levels


def _median(values: Tensor, where: Tensor) -> Tensor:
    """Medians (K,) of the values (K, P) where the mask is not 0; NaN where it is 0 everywhere."""
    return values.masked_fill(where == 0, torch.nan).nanmedian(-1).values


def _spread(residual: Tensor, b: PixelBlocks) -> Tensor:
    """Robust standard deviation (K,) from the median absolute residual.

    All markers of a frame share its noise, so none may claim much more than the best of them: cover would.
    """
    own = (1.4826 * _median(residual.abs(), b.valid)).nan_to_num(nan=1.0).clamp_min(math.sqrt(QUANTISATION))
    least = torch.full((int(b.row.max()) + 1 if len(own) else 0,), torch.inf, dtype=own.dtype, device=own.device)
    least = least.scatter_reduce(0, b.row, own, "amin")
    return torch.minimum(own, _MOST_SPREAD * least[b.row])


def _inliers(residual: Tensor, b: PixelBlocks, levels: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (K, P) whose noise is not clipped, by what they should show, and of these the ones that do show it."""
    spread = _spread(residual, b)[:, None]
    predicted = b.grey - residual
    margin = _CLEAR_OF_LIMITS * spread
    low, high = b.limits[:, :1], b.limits[:, 1:]
    usable = b.valid * ((predicted > low + margin) & (predicted < high - margin))
    contrast = (levels[:, 3] - levels[:, 0]).abs().to(residual.dtype)[:, None]
    return usable, usable * (residual.abs() < _CUT * spread + _MISFIT * contrast)


def _clear_sectors(
    residual: Tensor, usable: Tensor, weight: Tensor, b: PixelBlocks, m: RingModel, levels: Tensor
) -> Tensor:
    """0 for the pixels (K, P) of those sectors of either circle where many usable ones do not follow the model, else 1.

    What covers an edge agrees with it by chance wherever the edge passes through the cover's own grey, and where both
    are blurred no single pixel may betray it: a sector's mean square must be that of noise, too.
    """
    middle = 0.5 * (1 + b.radii[:, 1] / b.radii[:, 0])
    outer = torch.hypot(m.x, m.y) > middle[:, None].float()
    turn = (torch.atan2(m.y, m.x) / (2 * math.pi) + 0.5) * _SECTORS
    block = torch.arange(len(b.row), device=b.row.device)[:, None]
    cell = ((2 * block + outer) * _SECTORS + turn.long().clamp(0, _SECTORS - 1)).flatten()
    count = 2 * _SECTORS * len(b.row)
    total = torch.zeros(count, dtype=weight.dtype, device=weight.device).index_add_(0, cell, usable.flatten())
    used = torch.zeros_like(total).index_add_(0, cell, weight.flatten())
    square = torch.zeros_like(total).index_add_(0, cell, (weight * residual.square()).flatten())
    misfit = _MISFIT * (levels[:, 3] - levels[:, 0]).to(square.dtype)
    spread = _spread(residual, b)[:, None]
    total, used, square = (v.view(len(b.row), 2 * _SECTORS) for v in (total, used, square))
    limit = spread.square() * (1 + _SECTOR_CUT * (2 / used.clamp_min(1)).sqrt()) + misfit[:, None].square()
    clear = (used > _SECTOR_KEPT * total) & (square < used * limit)
    # where half of a ring is gone, the rest of the marker is not to be trusted either
    clear = clear & (clear.to(weight.dtype).mean(-1, keepdim=True) > _LEAST_CLEAR)
    return clear.flatten()[cell].view_as(weight).to(weight.dtype)
