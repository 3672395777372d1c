"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F

with the fraction of paper F of `ring_model`. Pose and blur (one for each frame) are found by Gauss-Newton; the two grey
levels of each marker, with linear gradients over the plane, are linear unknowns (`grey_levels`, `gauss_newton`).
Frames and markers are padded blocks of pixels: one sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum
from torchpose.refine.photometric.band import BAND, band_width
from torchpose.refine.photometric.gauss_newton import LEVELS, gauss_newton_step
from torchpose.refine.photometric.grey_levels import (
    TILE,
    columns_of,
    first_levels,
    inliers,
    model_misfit,
    noise_spread,
    sum_products,
)
from torchpose.refine.photometric.ring_model import Sight, gather_pixels, ring_model
from torchpose.refine.photometric.sectors import away_from_unclear, clear_sectors, doubtful, sum_sectors, trust
from torchpose.refine.result import Refined

_COARSE = 6  # the first steps take one pixel of so many; both are whole numbers of tiles
_MOST_COARSE = 512  # of a marker whose edges are sharp: the last step, on all pixels, mends what they leave
_STEPS = (3, 1)  # of Gauss-Newton, on some of the pixels and on all
_THOROUGH_STEPS = (3, 4)
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)


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
    narrow = torch.full_like(start, BAND)
    sight = Sight(frames, camera, frame, mask, rings, centers, normals, radii)
    first, doubt = _refine(sight, rotation, translation, start, narrow, known, most_coarse=_MOST_COARSE)
    # a wide blur needs a wider band, or it takes the levels on both sides of the edge for its own
    wide = band_width(first.blur) > BAND + 1
    for thorough in (False, True):
        w = (doubt if thorough else wide).nonzero()[:, 0]
        if w.numel() == 0:
            continue
        band = torch.where(wide, band_width(first.blur), BAND)[w]
        begin = (rotation[w], translation[w], first.blur[w], band, known[w])
        again, still = _refine(sight.rows(w), *begin, thorough=thorough)
        good = again.good.nonzero()[:, 0]
        first = first.replaced(w[good], again[good])
        doubt = doubt.index_copy(0, w[good], still[good])
    return first


def _refine(
    sight: Sight,
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
    blocks = gather_pixels(sight, band, TILE * _COARSE)
    coarse = blocks.every(_COARSE, most_coarse)
    levels = first_levels(coarse, r, t, blur)
    seen, of_them = (segment_sum(b.valid.sum(-1).double(), b.row, rows) for b in (blocks, coarse))
    more = (seen / of_them.clamp_min(1)).clamp_min(1)
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
        columns, slope = columns_of(part, model, levels)
        residual = columns[:, :, -1].flatten(1)
        usable, weight = inliers(residual, part, model, levels)
        if part is blocks:
            sectors = sum_sectors(residual, slope, usable, weight, part, model)
            clear = clear_sectors(sectors, noise_spread(residual, part), model_misfit(levels))
            if thorough:  # what levels without curvature could not explain stays out: curved ones bend into covers
                clear = away_from_unclear(sectors, clear) & (earlier if tempered else True)
                earlier = clear
            factor = trust(sectors, clear, variance[blocks.row]) if tempered else clear.to(weight.dtype)
            weight = weight * sectors.of_pixels(factor)
        sums = sum_products(columns, weight)
        step, level_step, information, variance = gauss_newton_step(
            sums, weight.sum(-1), levels, blocks.row, rows, known, moved
        )
        if part is blocks:
            step_chi2 = (step * (information @ step[..., None]).squeeze(-1)).sum(-1) / variance
            doubt = doubtful(sectors, clear, variance[blocks.row], blocks.row, step_chi2, more)
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
