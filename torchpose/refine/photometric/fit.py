"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F

with the fraction of paper F of `ring_model`. Pose and blur (one for each frame) are the unknowns; the two grey levels
of each marker, with linear gradients over the plane, are eliminated (`grey_levels`, `light`). Frames and markers are
padded blocks of pixels: one sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.least_squares import Block, Minimum, Normal, Pose, PosePrior, Unknowns, Vector, minimise
from torchpose.geometry.segments import segment_sum
from torchpose.refine.photometric.band import BAND, band_width
from torchpose.refine.photometric.grey_levels import (
    TILE,
    columns_of,
    first_levels,
    inliers,
    model_misfit,
    noise_spread,
    sum_products,
)
from torchpose.refine.photometric.light import LEVELS, POSE, normal_equations
from torchpose.refine.photometric.ring_model import gather_pixels, ring_model
from torchpose.refine.photometric.sectors import Sectors, away_from_unclear, clear_sectors, doubtful, sum_sectors, trust
from torchpose.refine.sight import Refined, Sight

_COARSE = 6  # the first steps take one pixel of so many; both are whole numbers of tiles
_MOST_COARSE = 512  # of a marker whose edges are sharp: the last step, on all pixels, mends what they leave
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)


class _Stage(NamedTuple):
    """Some Gauss-Newton steps, and how they see the pixels.

    coarse: some pixels only. wary: those where the model is sound, and in sectors clear of what stands beside them.
    tempered: light may be curved, and sectors that pull at the pose count for less.
    """

    steps: int
    coarse: bool = False
    wary: bool = False
    tempered: bool = False


_QUICK = (_Stage(3, coarse=True), _Stage(1))
_THOROUGH = (_Stage(3, coarse=True, wary=True), _Stage(2, wary=True), _Stage(2, wary=True, tempered=True))


def refine_photometric(sight: Sight, rotation: Tensor, translation: Tensor, *, prior: Tensor | None = None) -> Refined:
    """Refines N poses on the grey values around the rings of their markers.

    Args:
        sight: the rows, frames in grey levels.
        rotation: (N, 3, 3) to start from, within about a pixel.
        translation: (N, 3), the same.
        prior: (N, 6, 6), information about the pose besides the frames, that is the inverse covariance of the start:
            from the robot, or to hold what is known.
    """
    narrow = torch.full_like(translation[:, 0], BAND)
    start, blur = Pose(rotation, translation), torch.full_like(narrow, _START_BLUR)
    known = None if prior is None else PosePrior(prior, start)
    first, doubt = _refined(_Fit(sight, narrow, known, _MOST_COARSE), start, blur, _QUICK)
    # a wide blur needs a wider band, or it takes the levels on both sides of the edge for its own
    wide = band_width(first.blur) > BAND + 1
    for thorough in (False, True):
        w = (doubt if thorough else wide).nonzero()[:, 0]
        if w.numel() == 0:
            continue
        band = torch.where(wide, band_width(first.blur), BAND)[w]
        fit = _Fit(sight[w], band, None if known is None else known[w])
        again, still = _refined(fit, start[w], first.blur[w], _THOROUGH if thorough else _QUICK)
        good = again.good.nonzero()[:, 0]
        first, doubt = first.replaced(w[good], again[good]), doubt.index_copy(0, w[good], still[good])
    return first


def _refined(fit: _Fit, start: Pose, blur: Tensor, stages: tuple[_Stage, ...]) -> tuple[Refined, Tensor]:
    """Rows refined in stages from a pose and a blur (N,) px, and which of them are `doubtful`."""
    found = _minimised(fit, start, blur, stages)
    pose, owner, rows = found.unknowns.pose, fit.blocks.row, len(blur)
    covariance, determined = found.covariance()
    covariance = covariance[:, :6, :6]
    kept, usable = (segment_sum((x > 0).sum(-1), owner, rows) for x in (fit.weight, fit.usable))
    good = determined & covariance.isfinite().all(-1).all(-1)
    refined = Refined(
        pose.R, pose.t, covariance, found.unknowns.values("blur")[:, 0], fit.variance.sqrt(), kept / usable, good
    )
    seen, of_them = (segment_sum(b.valid.sum(-1).double(), owner, rows) for b in (fit.blocks, fit.coarse))
    more = (seen / of_them.clamp_min(1)).clamp_min(1)
    doubt = doubtful(fit.sectors, fit.clear, fit.variance[owner], owner, found.step.own_chi2, more)
    return refined, doubt


def _minimised(fit: _Fit, start: Pose, blur: Tensor, stages: tuple[_Stage, ...]) -> Minimum:
    low, high = blur.new_tensor(_BLUR_RANGE).unbind()
    own: dict[str, Block] = {"pose": start, "blur": Vector(blur[:, None], low, high)}
    levels = first_levels(fit.coarse, start.R, start.t, blur)
    unknowns = Unknowns(own, {"levels": Vector(levels)}, fit.blocks.row)
    for stage in stages:
        if stage.tempered:
            levels = torch.nn.functional.pad(unknowns.values("levels"), (0, LEVELS))
            unknowns = replace(unknowns, eliminated={"levels": Vector(levels)})
        fit.stage = stage
        found = minimise(fit, unknowns, stage.steps, settle=False)
        unknowns = found.unknowns
    return found


class _Fit:
    """The normal equations of N rows by their pixels within ``band`` (N,) px of an edge, and what they last saw.

    ``most_coarse``: pixels of a marker in the coarse stages.
    """

    sectors: Sectors
    clear: Tensor

    def __init__(self, sight: Sight, band: Tensor, prior: PosePrior | None, most_coarse: int | None = None) -> None:
        self.blocks = gather_pixels(sight, band, TILE * _COARSE)
        self.coarse = self.blocks.every(_COARSE, most_coarse)
        self.prior = prior
        self.stage = _QUICK[0]
        self.variance = torch.ones_like(band)
        self.usable = self.weight = self.blocks.valid

    def __call__(self, unknowns: Unknowns) -> Normal:
        stage, part, pose = self.stage, self.coarse if self.stage.coarse else self.blocks, unknowns.pose
        levels = unknowns.values("levels")
        model = ring_model(part, pose.R, pose.t, unknowns.values("blur")[:, 0], check=stage.wary)
        columns, slope = columns_of(part, model, levels)
        residual = columns[:, :, -1].flatten(1)
        self.usable, self.weight = inliers(residual, part, model, levels)
        if not stage.coarse:
            self.sectors = sum_sectors(residual, slope, self.usable, self.weight, part, model)
            factor = self._trusted(noise_spread(residual, part), model_misfit(levels))
            self.weight = self.weight * self.sectors.of_pixels(factor.to(self.weight.dtype))
        sums = sum_products(columns, self.weight)
        prior = None if self.prior is None else self.prior.at(pose, POSE)
        normal, self.variance = normal_equations(sums, self.weight.sum(-1), levels, part.row, len(pose), prior)
        return normal

    def _trusted(self, spread: Tensor, misfit: Tensor) -> Tensor:
        """Weights (K, 96) of the sectors."""
        clear = clear_sectors(self.sectors, spread, misfit)
        if self.stage.wary:
            clear = away_from_unclear(self.sectors, clear)
        if not self.stage.tempered:
            self.clear = clear
            return clear
        # what levels without curvature could not explain stays out: curved ones bend into covers
        self.clear = clear & self.clear
        return trust(self.sectors, self.clear, self.variance[self.blocks.row])
