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
from torchpose.refine.gauss_newton import LEVELS, POSE, QUANTISATION, gauss_newton_step, solve_ridged
from torchpose.refine.result import Refined
from torchpose.refine.ring_model import PixelBlocks, RingModel, gather_pixels, ring_model
from torchpose.refine.sectors import away_from_unclear, clear_sectors, doubtful, misfit, sum_sectors, trust

_COARSE = 6  # the first steps take one pixel of so many; both are whole numbers of tiles
_MOST_COARSE = 512  # of a marker whose edges are sharp: the last step, on all pixels, mends what they leave
_STEPS = (3, 1)  # of Gauss-Newton, on some of the pixels and on all
_THOROUGH_STEPS = (3, 4)
_LEVEL_STEPS = 3  # of the grey levels alone
_BAND = 4.0  # px on either side of an edge
_BAND_PER_BLUR = 4.6  # band of a wide blur, in its standard deviations
_WIDEST = 12.0  # px, of all bands
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)
_NEAR_PURE = 0.05  # of paper in a pixel, beside the most and the least of its marker
_CUT = 4.0  # robust standard deviations beyond which a pixel is left out
_CLEAR_OF_LIMITS = 3.0  # standard deviations between what a pixel should show and where its noise is clipped
_MISFIT = 0.02  # of the contrast: what a point-spread function that is not Gaussian leaves at the edges of quiet frames
_TILE = 256  # pixels summed in float32 at a time; sums of tiles are float64, so padding changes no digit that counts
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
    first, doubt = _refine(*where, *model, rotation, translation, start, narrow, known, most_coarse=_MOST_COARSE)
    # a wide blur needs a wider band, or it takes the levels on both sides of the edge for its own
    wide = _BAND_PER_BLUR * first.blur > _BAND + 1
    for thorough in (False, True):
        w = (doubt if thorough else wide).nonzero()[:, 0]
        if w.numel() == 0:
            continue
        band = torch.where(wide, _BAND_PER_BLUR * first.blur, _BAND).clamp_max(_WIDEST)[w]
        rest = (centers[w], normals[w], radii[w], rotation[w], translation[w], first.blur[w], band, known[w])
        again, still = _refine(frames, camera, frame[w], mask[w], rings[w], *rest, thorough=thorough)
        good = again.good.nonzero()[:, 0]
        first = first.replaced(w[good], again[good])
        doubt = doubt.index_copy(0, w[good], still[good])
    return first


def grey_chi2(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    mask: Tensor,
    rings: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
    one: Refined,
    two: Refined,
) -> tuple[Tensor, Tensor]:
    """Chi-squared (N,) of the grey values under the refined poses ``two`` less that under ``one``.

    Also whether each of the two (N, 2) explains most of the sectors of every marker.

    Both are judged on the same pixels, those that either explains, each with grey levels of its own; no pixel counts
    for more than an outlier would. Where not even the better pose explains them within noise the difference counts
    for less, by as much as the displacements of its sectors exceed theirs.

    Args: as in `refine_photometric`.
    """
    rows = mask.shape[0]
    band = (_BAND_PER_BLUR * torch.maximum(one.blur, two.blur)).clamp(_BAND, _WIDEST)
    b = gather_pixels(frames, camera, frame, mask, rings, centers, normals, radii, band, _TILE * _COARSE)
    squares, weights, variances, misfits, explained = [], [], [], [], []
    for pose in (one, two):
        model = ring_model(b, pose.R, pose.t, pose.blur, check=True)
        levels = _first_levels(b, pose.R, pose.t, pose.blur)
        for _ in range(_LEVEL_STEPS):
            columns, slope = _columns(b, model, levels)
            residual = columns[:, :, -1].flatten(1)
            usable, weight = _inliers(residual, b, model, levels)
            sectors = sum_sectors(residual, slope, usable, weight, b, model)
            clear = clear_sectors(sectors, _spread(residual, b), _MISFIT * (levels[:, 3] - levels[:, 0]).float())
            weight = weight * sectors.of_pixels(clear.to(weight.dtype))
            sums = _products(columns, weight)
            levels = levels + solve_ridged(sums[:, POSE:-1, POSE:-1], sums[:, POSE:-1, -1:]).squeeze(-1)
        used = segment_sum(weight.sum(-1).double(), b.row, rows).clamp_min(1)
        variance = (segment_sum(sums[:, -1, -1], b.row, rows) / used).clamp_min(QUANTISATION)
        squares.append(residual.square())
        weights.append(weight)
        variances.append(variance)
        misfits.append(misfit(sectors, clear, variance[b.row], b.row, rows))
        explained.append(segment_sum((~clear.any(-1)).double(), b.row, rows) == 0)
    variance = torch.minimum(*variances)
    most = (_CUT**2 * variance[b.row, None]).to(squares[0].dtype)
    of_one, of_two = (torch.minimum(s, most) for s in squares)
    difference = (torch.maximum(*weights) * (of_two - of_one)).sum(-1).double()
    chi2 = segment_sum(difference, b.row, rows) / variance / torch.minimum(*misfits).clamp_min(1)
    return chi2, torch.stack(explained, -1)


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
    thorough: bool = False,
    most_coarse: int | None = None,
) -> tuple[Refined, Tensor]:
    """`refine_photometric` by the pixels within ``band`` (N,) px of an edge, from a blur (N,) px.

    Also says which rows (N,) are `doubtful`. ``thorough`` is for these: light may be curved, sectors that pull at the
    pose count for less, and there are more steps. ``most_coarse``: pixels of a marker in the coarse steps.
    """
    rows = r.shape[0]
    blocks = gather_pixels(frames, camera, frame, mask, rings, centers, normals, radii, band, _TILE * _COARSE)
    coarse = blocks.every(_COARSE, most_coarse)
    levels = _first_levels(coarse, r, t, blur)
    usable = weight = blocks.valid
    information = torch.zeros(rows, 7, 7, dtype=torch.float64, device=r.device)
    variance = torch.ones(rows, dtype=torch.float64, device=r.device)
    known = torch.nn.functional.pad(prior, (0, 1, 0, 1))
    moved = torch.zeros(rows, 7, dtype=torch.float64, device=r.device)
    doubt = torch.zeros(rows, dtype=torch.bool, device=r.device)
    earlier = doubt[:, None]
    steps = _THOROUGH_STEPS if thorough else _STEPS
    for number, part in enumerate((*[coarse] * steps[0], *[blocks] * steps[1])):
        tempered = thorough and number > steps[0] + 1
        if tempered and levels.shape[1] == LEVELS:
            levels = torch.nn.functional.pad(levels, (0, LEVELS))
        model = ring_model(part, r, t, blur, check=thorough)
        columns, slope = _columns(part, model, levels)
        residual = columns[:, :, -1].flatten(1)
        usable, weight = _inliers(residual, part, model, levels)
        if part is blocks:
            sectors = sum_sectors(residual, slope, usable, weight, part, model)
            clear = clear_sectors(sectors, _spread(residual, part), _MISFIT * (levels[:, 3] - levels[:, 0]).float())
            if thorough:  # what levels without curvature could not explain stays out: curved ones bend into covers
                clear = away_from_unclear(sectors, clear) & (earlier if tempered else True)
                earlier = clear
            factor = trust(sectors, clear, variance[blocks.row]) if tempered else clear.to(weight.dtype)
            weight = weight * sectors.of_pixels(factor)
        sums = _products(columns, weight)
        step, level_step, information, variance = gauss_newton_step(
            sums, weight.sum(-1), levels, blocks.row, rows, known, moved
        )
        if part is blocks:
            step_chi2 = (step * (information @ step[..., None]).squeeze(-1)).sum(-1) / variance
            doubt = doubtful(sectors, clear, variance[blocks.row], blocks.row, step_chi2)
        moved = moved + step
        r = rotations.exp(step[:, 3:6]) @ r
        t = t + step[:, :3]
        blur = (blur + step[:, 6]).clamp(*_BLUR_RANGE)
        levels = levels + level_step
    inverse, info = torch.linalg.inv_ex(information)
    covariance = inverse[:, :6, :6] * variance[:, None, None]
    kept = segment_sum((weight > 0).sum(-1), blocks.row, rows) / segment_sum(usable.sum(-1), blocks.row, rows)
    good = (info == 0) & covariance.isfinite().all(-1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    return Refined(r, t, covariance, blur, variance.sqrt(), kept, good), doubt


def _basis(m: RingModel, curved: bool = False) -> tuple[Tensor, ...]:
    """Planes of the linear unknowns: ring (1, x, y), paper (1, x, y); if ``curved`` also (xx, xy, yy) of both."""
    ring, paper = 1 - m.fraction, m.fraction
    flat = (ring, ring * m.x, ring * m.y, paper, paper * m.x, paper * m.y)
    if not curved:
        return flat
    squares = (m.x.square(), m.x * m.y, m.y.square())
    return (*flat, *(ring * p for p in squares), *(paper * p for p in squares))


def _columns(b: PixelBlocks, m: RingModel, levels: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives by pose (6), blur (1) and levels (L), and the residual, by tiles: (K, P / 256, 8 + L, 256) float32.

    Also the derivative by the distance from the edges (K, P).
    """
    a0, ax, ay, p0, px, py, *curved = (v[:, None].float() for v in levels.unbind(-1))
    ring, paper = a0 + ax * m.x + ay * m.y, p0 + px * m.x + py * m.y
    if curved:
        axx, axy, ayy, pxx, pxy, pyy = curved
        ring = ring + axx * m.x.square() + axy * m.x * m.y + ayy * m.y.square()
        paper = paper + pxx * m.x.square() + pxy * m.x * m.y + pyy * m.y.square()
    contrast = paper - ring
    by_d = contrast * m.by_d
    residual = b.grey - (ring + contrast * m.fraction)
    basis = _basis(m, bool(curved))
    return _tiled((*(by_d * v for v in m.by_pose), contrast * m.by_q, *basis, residual)), by_d


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
    ring, paper = _pure_levels(b, model.fraction)
    levels = torch.stack([ring, none, none, paper, none, none], -1).nan_to_num(0.0, 0.0, 0.0).double()
    for _ in range(3):
        predicted = (levels.float()[:, None, None] @ columns[:, :, :LEVELS]).flatten(1)
        residual = b.grey - predicted
        weight = b.valid / (1 + (residual / (2 * _spread(residual, b)[:, None])).square()).square()
        sums = _products(columns, weight)
        levels = solve_ridged(sums[:, :LEVELS, :LEVELS], sums[:, :LEVELS, LEVELS:]).squeeze(-1)
    return levels


def _pure_levels(b: PixelBlocks, fraction: Tensor) -> tuple[Tensor, Tensor]:
    """Grey of ring and of paper (K,) by the medians of the pixels that show most of either.

    A blurred ring has no pixel without paper, so the line through both medians is followed to the ends. A level beyond
    the range of grey values shows no pixel at all.
    """
    fraction = fraction.clamp(0, 1)  # beyond: deep in a flat hole, where the expansions fail
    known = fraction.masked_fill(b.valid == 0, torch.nan)
    least = known.nan_to_num(nan=2.0).amin(-1, keepdim=True)
    most = known.nan_to_num(nan=-1.0).amax(-1, keepdim=True)
    ends = [b.valid * where for where in (fraction < least + _NEAR_PURE, fraction > most - _NEAR_PURE)]
    (ring, paper), (at_ring, at_paper) = ([_median(v, w) for w in ends] for v in (b.grey, fraction))
    slope = (paper - ring) / (at_paper - at_ring)
    return ring - at_ring * slope, paper + (1 - at_paper) * slope


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


def _inliers(residual: Tensor, b: PixelBlocks, m: RingModel, levels: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (K, P) whose noise is not clipped, by what they should show, and of these the ones that do show it."""
    spread = _spread(residual, b)[:, None]
    predicted = b.grey - residual
    margin = _CLEAR_OF_LIMITS * spread
    low, high = b.limits[:, :1], b.limits[:, 1:]
    usable = b.valid * ((predicted > low + margin) & (predicted < high - margin))
    if m.sound is not None:
        usable = usable * m.sound
    contrast = (levels[:, 3] - levels[:, 0]).abs().to(residual.dtype)[:, None]
    return usable, usable * (residual.abs() < _CUT * spread + _MISFIT * contrast)
