"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F

with the fraction of paper F of `ring_model`. Pose and blur (three numbers a frame) are the unknowns; the two grey
levels of each marker, with linear gradients over the plane, are eliminated (`grey_levels`, `light`). Frames and markers
are padded blocks of pixels: one sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.reduce import reduction_for
from torchpose.geometry import blur as blurs
from torchpose.geometry.arguments import checked
from torchpose.geometry.blurred_edge import KINDS, LEAST, LONG, MOST, Spread
from torchpose.geometry.constants import finite
from torchpose.geometry.least_squares import (
    Block,
    Eliminated,
    Minimum,
    Normal,
    Pose,
    PosePrior,
    Unknowns,
    Vector,
    minimise,
)
from torchpose.geometry.robust import of_chance
from torchpose.geometry.rows import Rows, replace
from torchpose.geometry.segments import marked, segment_mean, segment_sum
from torchpose.pose import MarkerNormals
from torchpose.refine.photometric.band import band_width
from torchpose.refine.photometric.grey_levels import (
    columns_of,
    first_levels,
    inliers,
    model_misfit,
    noise_spread,
    sum_products,
)
from torchpose.refine.photometric.light import LEVELS, POSE, normal_equations, of_markers, pulled_by_levels
from torchpose.refine.photometric.ring_model import PixelBlocks, RingModel, gather_pixels, ring_model
from torchpose.refine.photometric.sectors import (
    Sectors,
    away_from_unclear,
    clear_sectors,
    doubtful,
    in_step,
    level_scatter,
    of_more,
    overdispersion,
    roughness,
    shift_scatter,
    sum_sectors,
    trust,
)
from torchpose.refine.sight import Look, Refined, Sight, refined_by_blur

_COARSE = 6  # the first steps take one pixel of so many
# px, of a blur's minor axis, in frames as they are: a pixel twice as wide adds 4 % of its variance (derived)
_WIDEST = 2.4
# chi-squared that a step on these takes off, pose and blur: one of less leaves 2 to a second one, where noise leaves 9
# (measured: decisions/0117)
_FAR = 500.0
_MOST_COARSE = 512  # of a marker whose edges are sharp: the last step, on all pixels, mends what they leave


class _Stage(NamedTuple):
    """Some Gauss-Newton steps, and how they see the pixels.

    coarse: some pixels only. wary: those where the model is sound, and in sectors clear of what stands beside them.
    tempered: light may be curved, and sectors that pull at the pose count for less.
    far: of rows alone that the step before moved far, or in which some pixels did not follow the model.
    """

    steps: int
    coarse: bool = False
    wary: bool = False
    tempered: bool = False
    far: bool = False


# of the contrast, RMS at the edges: that of a disc of 2 px, which costs a tenth in the covariance (measured:
# `scripts/corruption_statistics.py --only defocus`)
_MATTERS = 0.004
# of the pixels: so many a shape of the blur may keep less than a Gaussian, and still explain them better (convention)
_FEWER = 0.02
# of what would close the smallest hole, or the thinnest ring (convention)
_MOST_GAIN = 0.5
_COARSELY = (_Stage(1, coarse=True), _Stage(1, coarse=True, far=True))  # before all pixels
_BY_SOME = _Stage(2, coarse=True)  # on its own
_QUICK = (_Stage(1),)  # after the coarse steps
_AGAIN = (_Stage(2),)  # from where a fit of the same rows ended
_THOROUGH = (_Stage(1, wary=True), _Stage(2, wary=True, tempered=True))


@checked
def refine_photometric(
    sight: Sight,
    rotation: Tensor,
    translation: Tensor,
    *,
    prior: Tensor | None = None,
    thorough: bool = True,
    alike: bool = False,
) -> Refined:
    """Refines N poses on the grey values around the rings of their markers.

    Args:
        sight: the rows, frames in grey levels.
        rotation: (N, 3, 3) to start from, within about a pixel.
        translation: (N, 3), the same.
        prior: (N, 6, 6), information about the pose besides the frames, that is the inverse covariance of the start:
            from the robot, or to hold what is known. (N, 7, 7): the edge gain, mm, is an unknown too, and this is
            known of it, about zero.
        thorough: rows whose grey values contradict the model are refined once more, without what does not follow it.
        alike: rows are marks of one print by one lens, to be compared: where most of them contradict the model, what
            is wrong is of all, and all are refined once more. A row then depends on the others.
    """
    factor = reduction_for(blurs.axes(sight.common_blur)[0].clamp_min(0).sqrt(), _WIDEST)
    refine = partial(_refined_in, thorough=thorough, alike=alike)
    return refined_by_blur(refine, sight, Pose(rotation, translation), prior, factor)


@dataclass(frozen=True, eq=False)
class _Result(Rows):
    """N refined rows as far as their fit goes on from there, and where it is to be finished.

    Attributes:
        pose: after the last step.
        spread: blur, px^2, see `geometry.blur`.
        look: how the rows were seen.
        noise, kept, good, doubt: as in `Refined`.
        misshapen: whether the residuals stand out at the edges.
        end: which of the fits of `_Fits.ends` this is.
        at: row of that fit.
    """

    pose: Pose
    spread: Float[Tensor, "N 3"]
    look: Look
    noise: Float[Tensor, " N"]
    kept: Float[Tensor, " N"]
    good: Bool[Tensor, " N"]
    doubt: Bool[Tensor, " N"]
    misshapen: Bool[Tensor, " N"]
    end: Int[Tensor, " N"]
    at: Int[Tensor, " N"]


def _refined_in(sight: Sight, start: Pose, known: PosePrior | None, thorough: bool, alike: bool) -> Refined:
    """Rows of one kind of blur refined in the frames as they are."""
    fits, look = _Fits(sight, start, known), sight.look
    if look is not None and bool(look.doubt.any()):
        return fits.finished(fits.refined(fits.fit, start, fits.spread, _THOROUGH, look.levels))
    result = fits.first()
    if look is None:
        result = fits.shaped(result, torch.ones_like(result.misshapen))
        later = result.doubt & thorough  # a wider band is theirs then
        result = fits.widened(result, ~later)
    doubt = result.doubt
    if alike and len(doubt):
        doubt = doubt | doubt.int().median().bool()
    for kind in range(len(KINDS) if thorough else 0):
        some = doubt & (result.look.kind == kind)
        if bool(some.any()):
            result = result.replaced(*fits.again(result, some, kind, _THOROUGH))
    return fits.finished(result)


class _Fits:
    """The fits of N rows: the first one, and those with a band or a kind of blur that suits some rows better.

    ends: every fit and where it ended; what a row's last one tells is formed once.
    """

    def __init__(self, sight: Sight, start: Pose, known: PosePrior | None) -> None:
        self.sight, self.start, self.known = sight, start, known
        blur, look = blurs.limited(sight.common_blur, LEAST**2, MOST**2), sight.look
        kind = KINDS[int((sight.told if look is None else look.kind)[:1].sum())]
        self.spread = Spread.of(blur, kind) if look is None else Spread(look.blur, kind)
        self.band = band_width(self.spread) if look is None else look.band
        self.fit = _Fit(sight, self.band, known, _MOST_COARSE)
        self.ends: list[tuple[_Fit, Minimum, Tensor]] = []

    def first(self) -> _Result:
        look = self.sight.look
        if look is None:
            return self.refined(self.fit, self.start, self.spread, (*_COARSELY, *_QUICK))
        return self.refined(self.fit, self.start, self.spread, _AGAIN, look.levels)

    def again(self, result: _Result, rows: Tensor, kind: int, stages: tuple[_Stage, ...]) -> tuple[Tensor, _Result]:
        """Those of the rows (N,) bool that could be refined once more from where they are, and what came out."""
        look, fresh = result.look, self.sight.look is None
        band = self._band_for(Spread.of(result.spread, KINDS[kind])) if fresh else self.band
        begun = (look.kind == kind) & (look.band == band) & result.good
        cases, parts = 2 * (band == self.band) + begun, [(rows.nonzero()[:0, 0], result[:0])]
        for case in cases[rows].unique().tolist():
            some = (rows & (cases == case)).nonzero()[:, 0]
            fit = self.fit.of(some) if case > 1 else self._fit(some, band)
            if case % 2:
                spread, levels, steps = Spread(look.blur[some], KINDS[kind]), look.levels[some], stages
            else:
                spread, levels, steps = Spread.of(result.spread[some], KINDS[kind]), None, (*_COARSELY, *stages)
            begin = self.start[some].where(~result.good[some], result.pose[some])
            parts.append((some, self.refined(fit, begin, spread, steps, levels)))
        index, other = torch.cat([some for some, _ in parts]), _Result.cat([part for _, part in parts])
        return index[other.good], other[other.good]

    def _band_for(self, spread: Spread) -> Tensor:
        """Bands (N,) px for these blurs: those that are there where they are as wide, but for a pixel."""
        wanted = band_width(spread)
        return torch.where(wanted > self.band + 1, wanted, self.band)

    def _fit(self, rows: Tensor, band: Tensor) -> _Fit:
        return _Fit(self.sight[rows], band[rows], None if self.known is None else self.known[rows])

    def shaped(self, result: _Result, rows: Tensor) -> _Result:
        """With the kind of blur that explains misshapen ones of the rows (N,) bool better, where there is one."""
        least, most = blurs.axes(result.spread)
        # where a ring is all edge, none stand out: what contradicts the model there may be its blur
        long, rows = most > LONG * least, rows & (result.misshapen | result.doubt) & (result.look.kind == 0)
        for kind, some in ((1, rows & long), (2, rows & ~long)):
            if not bool(some.any()):
                continue
            begun, worse = self._tried(result, some & result.doubt, kind)
            index, other = self.again(begun, some & ~worse, kind, _QUICK)
            better = other.noise < result.noise[index]
            better &= other.kept > result.kept[index] - _FEWER
            result = result.replaced(index[better], other[better])
        return result

    def _tried(self, result: _Result, rows: Tensor, kind: int) -> tuple[_Result, Tensor]:
        """The result with the rows (N,) bool begun with another kind of blur, on some pixels; and those of them that it
        explains no better.

        For rows in doubt: what is amiss may be no blur at all.
        """
        index = rows.nonzero()[:, 0]
        if index.numel() == 0:
            return result, rows
        fit, spread = self.fit.of(index), Spread.of(result.spread[index], KINDS[kind])
        found = _minimised(fit, result.pose[index], spread, (_BY_SOME,), result.look.levels[index][fit.mask])
        unknowns = found.unknowns
        look = fit.look(cast(Spread, unknowns.own["blur"]), unknowns.values("levels"))
        begun = replace(result, pose=result.pose.replaced(index, unknowns.pose), look=result.look.replaced(index, look))
        return begun, rows.index_copy(0, index, fit.variance.sqrt() > result.noise[index])

    def widened(self, result: _Result, rows: Tensor) -> _Result:
        """With a wider band for the rows (N,) bool whose blur takes the levels beside the edge for its own."""
        wide = rows & (result.look.kind == 0) & (self._band_for(Spread(result.spread)) > self.band)
        if not bool(wide.any()):
            return result
        index, other = self.again(result, wide, 0, _QUICK)
        return self.shaped(result.replaced(index, other), marked(index, len(wide)))

    def refined(
        self, fit: _Fit, start: Pose, spread: Spread, stages: tuple[_Stage, ...], levels: Tensor | None = None
    ) -> _Result:
        """Rows refined in stages from poses and blurs, and from levels (N, M, 6) where there are any."""
        found = _minimised(fit, start, spread, stages, None if levels is None else levels[fit.mask])
        owner, rows = fit.blocks.row, len(spread)
        covariance, determined = found.covariance()
        good = determined & finite(covariance, (1, 2))
        of_rows = [(x > 0).sum(-1, dtype=torch.float64) for x in (fit.weight, fit.usable, fit.blocks.valid)]
        of_rows.append((fit.coarse.valid > 0).sum(-1, dtype=torch.float64))
        kept, usable, seen, of_them = segment_sum(torch.stack(of_rows, -1), owner, rows).unbind(-1)
        more = (seen / of_them.clamp_min(1)).clamp_min(1)
        doubt = doubtful(fit.sectors, fit.clear, fit.variance[owner], owner, found.step.own_chi2, more)
        spread = cast(Spread, found.unknowns.own["blur"])
        look = fit.look(spread, found.unknowns.values("levels"))
        at = torch.arange(rows, device=doubt.device)
        end = torch.full_like(at, len(self.ends))
        self.ends.append((fit, found, covariance))
        fresh = spread.kind == "gauss" and self.sight.look is None
        misshapen = fit.stands_out(look.levels[fit.mask]) if fresh else torch.zeros_like(good)
        known = (spread.covariance, look, fit.variance.sqrt(), kept / usable, good, doubt, misshapen)
        return _Result(found.unknowns.pose, *known, end, at)

    def finished(self, result: _Result) -> Refined:
        """What the rows tell at the end of their fits."""
        ends = result.end.unique().tolist() if len(self.ends) > 1 else [0]
        parts = [_told(*self.ends[end]) for end in ends]
        if len(self.ends) > 1:
            order = [(result.end == end).nonzero()[:, 0] for end in ends]
            parts = [part[result.at[index]] for part, index in zip(parts, order, strict=True)]
        told = parts[0] if len(parts) == 1 else _Told.cat(parts)[torch.argsort(torch.cat(order))]
        good = result.good & finite(told.covariance, (1, 2))
        of_fit = (result.spread, result.noise, result.kept, good, result.doubt)
        of_markers = (told.normals, told.rough, told.gain, told.even)
        return Refined(result.pose.R, result.pose.t, told.covariance, *of_fit, *of_markers, result.look)


@dataclass(frozen=True, eq=False)
class _Told(Rows):
    """What N rows of a fit tell in the end: fields of `Refined`."""

    covariance: Float[Tensor, "N 6 6"]
    normals: MarkerNormals
    rough: Bool[Tensor, " N"]
    even: Float[Tensor, " N"]
    gain: Float[Tensor, " N"] | None


def _told(fit: _Fit, found: Minimum, covariance: Tensor) -> _Told:
    """Of a fit, where it ended, and the covariance of pose and blur there."""
    owner, rows = fit.blocks.row, len(fit.band)
    wider, even = overdispersion(fit.sectors.scaled(fit.factor), fit.variance[owner], owner, rows)
    if fit.stage.tempered:  # its weights have what the rims scatter by
        even = overdispersion(fit.sectors.scaled(fit.clear.to(fit.factor)), fit.variance[owner], owner, rows)[1]
    covariance = wider[:, None, None] * covariance
    part = cast(Eliminated, found.normal.eliminated)
    normals = of_markers(fit.sums, fit.variance, part, fit.mask, found.step.own).over(wider)
    rough = even == 0
    if bool(rough.any()):
        more = _beyond_rims(fit, found, normals, wider) * rough[:, None, None, None]
        n = covariance.shape[-1]
        covariance = covariance + covariance @ more.sum(1)[:, :n, :n] @ covariance
        normals = normals.scattered(more)
    gain = found.unknowns.values("gain")[:, 0] if fit.gain else None
    scatters = torch.zeros_like(rough) if fit.rough is None else marked(owner[fit.rough > 0], rows)
    return _Told(covariance[:, :6, :6], normals, scatters, even, gain)


def _beyond_rims(fit: _Fit, found: Minimum, normals: MarkerNormals, wider: Tensor) -> Tensor:
    """Covariance (N, M, n, n) of the right sides of the normals by noise that the scatter along the rims, by which it
    is ``wider`` (N,), does not show: in step along lines, and in the levels of ring and paper.
    """
    row, pose, rows = fit.blocks.row, found.unknowns.pose, len(wider)
    factor, freedom, alone = in_step(fit.sectors.scaled(fit.factor), fit.variance[row], fit.blocks.rings, row, rows)
    shifted = shift_scatter(fit.sectors.scaled(fit.factor), fit.variance[row], fit.blocks.rings, row, rows)[:, None]
    beyond = (torch.where(of_more(factor, freedom), factor, 0.0).maximum(shifted) - wider[:, None]).clamp_min(0)
    away = (pose.R[row] @ fit.blocks.center[..., None])[:, 2] + pose.t[row, 2:]
    mm = (beyond[row] * alone).sqrt() * away / fit.focal
    shifts = torch.nn.functional.pad(torch.diag_embed(mm), (0, 0, 0, POSE - 1))
    every = shifts.new_zeros(*fit.mask.shape, POSE + 1, 2).index_put(tuple(fit.mask.nonzero().unbind(-1)), shifts)
    shares = (fit.of_ring, 1 - fit.of_ring)
    spread = [level_scatter(fit.sectors, fit.weight * s, fit.residual, fit.variance[row], row, rows) for s in shares]
    levels = (torch.stack(spread, -1) / wider[:, None] - 1).clamp_min(0)[row]
    part = cast(Eliminated, found.normal.eliminated)
    return normals.by_motions(every) + pulled_by_levels(fit.sums, wider * fit.variance, part, fit.mask, levels)


def _minimised(fit: _Fit, start: Pose, spread: Spread, stages: tuple[_Stage, ...], levels: Tensor | None) -> Minimum:
    own: dict[str, Block] = {"pose": start, "blur": spread}
    if fit.gain:
        outer, inner = fit.blocks.radii.unbind(-1)
        hole = torch.where(inner > 0, inner, outer)
        most = _MOST_GAIN * torch.minimum(hole, 0.5 * (outer - inner)).amin().reshape(1)
        own["gain"] = Vector(torch.zeros_like(start.t[:, :1]), low=-most, high=most)
    levels = fit.first_levels(start, spread) if levels is None else levels
    unknowns = Unknowns(own, {"levels": Vector(levels)}, fit.blocks.row)
    found: Minimum | None = None
    for stage in stages:
        if stage.tempered:
            levels = torch.nn.functional.pad(unknowns.values("levels"), (0, LEVELS))
            unknowns = replace(unknowns, eliminated={"levels": Vector(levels)})
        far = None
        if stage.far and found is not None:
            far = (found.step.own_chi2 > _FAR) | (fit.lost > _FEWER)
            if not bool(far.any()):
                continue
        fit.stage = stage
        found = minimise(fit, unknowns, stage.steps, settle=False)
        unknowns = found.unknowns if far is None else found.unknowns.where(far, unknowns)
    assert found is not None
    return found


class _Fit:
    """The normal equations of N rows by their pixels within ``band`` (N,) px of an edge, and what they last saw.

    ``most_coarse``: pixels of a marker in the coarse stages.
    """

    sums: Tensor
    sectors: Sectors
    clear: Tensor
    factor: Tensor
    residual: Tensor
    slope: Tensor
    inlying: Tensor
    rough: Tensor | None

    def __init__(self, sight: Sight, band: Tensor, prior: PosePrior | None, most_coarse: int | None = None) -> None:
        self.mask, self.band, self.by = sight.mask, band, sight.reduction
        self.blocks = gather_pixels(sight, band)
        self.coarse = self.blocks.every(_COARSE, most_coarse)
        self.focal = sight.camera.matrix.diagonal()[:2]
        self.prior = prior
        self.gain = prior is not None and prior.more
        self.stage = _QUICK[0]
        self.variance = torch.ones_like(band)
        self.least = torch.full_like(band, sight.quantisation)
        self.usable = self.weight = self.blocks.valid
        self.model: RingModel | None = None  # of the coarse pixels where a fit begins

    def first_levels(self, start: Pose, spread: Spread) -> Tensor:
        """Grey levels (K, 6) where a fit begins."""
        self.model = ring_model(self.coarse, start.R, start.t, spread, check=True, gain=self.gain)
        return first_levels(self.coarse, self.model)

    def of(self, rows: Tensor) -> _Fit:
        """Of these rows (K,) alone, on the same pixels."""
        fit = copy(self)
        number = torch.full_like(self.band, -1, dtype=torch.int64).index_copy(
            0, rows, torch.arange(len(rows), device=rows.device)
        )
        blocks = self.blocks[number[self.blocks.row] >= 0]
        fit.blocks = replace(blocks, row=number[blocks.row], rows=len(rows))
        fit.coarse = fit.blocks.every(_COARSE)
        fit.prior = None if self.prior is None else self.prior[rows]
        fit.mask, fit.band, fit.variance, fit.least = (
            x[rows] for x in (self.mask, self.band, self.variance, self.least)
        )
        return fit

    def __call__(self, unknowns: Unknowns) -> Normal:
        stage, part, pose = self.stage, self.coarse if self.stage.coarse else self.blocks, unknowns.pose
        levels = unknowns.values("levels")
        spread = cast(Spread, unknowns.own["blur"])
        if self.gain:
            part = part.wider(unknowns.values("gain")[:, 0])
        model, self.model = self.model or self._model(part, pose, spread), None
        columns, slope, residual = columns_of(part, model, levels)
        self.residual, self.of_ring = residual, 1 - model.fraction.flatten(1)
        noise = noise_spread(residual, part), model_misfit(levels)
        self.usable, self.weight = inliers(residual, part, model, *noise)
        self.rough = None
        if stage.wary:
            every = sum_sectors(residual, slope, self.usable, self.usable, part, model)
            self.rough = roughness(every, noise[0], part.row)
            self.usable, self.weight = inliers(residual, part, model, *noise, self.rough[:, None] * slope)
        if stage.coarse:  # the first steps begin with what was seen so far, the others see for themselves
            self.weight = self.weight * part.seen
        else:
            self.slope, self.inlying = slope, self.weight
            self.sectors = sum_sectors(residual, slope, self.usable, self.weight, part, model)
            factor = self._trusted(*noise)
            self.factor = factor.to(self.weight.dtype)
            self.weight = self.weight * self.sectors.of_pixels(self.factor)
        self.sums = sum_products(columns, self.weight)
        used, known = self.weight.sum(-1), self._known(unknowns)
        normal, self.variance = normal_equations(self.sums, used, levels, part.row, self.least, known, gain=self.gain)
        return normal

    @property
    def lost(self) -> Tensor:
        """Share (N,) of the coarse pixels that did not follow the model."""
        part = self.coarse
        kept = torch.stack([self.weight.sum(-1), (part.valid * part.seen).sum(-1)], -1)
        kept, every = segment_sum(kept, part.row, part.rows).unbind(-1)
        return 1 - kept / every

    def _model(self, part: PixelBlocks, pose: Pose, spread: Spread) -> RingModel:
        # what markers tell of the gain is asked of all pixels
        gain = self.gain or not self.stage.coarse
        return ring_model(part, pose.R, pose.t, spread, check=True, gain=gain)

    def look(self, spread: Spread, levels: Tensor) -> Look:
        """With the blurs of rows and the levels (K, L) of their markers."""
        kind, by = (torch.full_like(self.mask[:, 0], v, dtype=torch.int64) for v in (KINDS.index(spread.kind), self.by))
        laid = levels.new_zeros(*self.mask.shape, LEVELS).masked_scatter(self.mask[..., None], levels[:, :LEVELS])
        return Look(kind, spread.values, laid, self.band, by, torch.zeros_like(kind, dtype=torch.bool))

    def _known(self, unknowns: Unknowns) -> tuple[Tensor, Tensor] | None:
        """The prior's information (N, n, n) about the frames' unknowns, and how far these moved from it (N, n)."""
        if self.prior is None or not self.gain:
            return None if self.prior is None else self.prior.at(unknowns.pose, POSE)
        both = self.prior.information
        _, moved = replace(self.prior, information=both[:, :6, :6]).at(unknowns.pose, POSE)
        place = torch.tensor([*range(6), POSE], device=both.device)
        information = both.new_zeros(len(both), POSE + 1, POSE + 1)
        information[:, place[:, None], place] = both
        return information, torch.cat([moved, unknowns.values("gain")], -1)

    def stands_out(self, levels: Tensor) -> Tensor:
        """Rows (N,) bool whose mean square residual is larger at the edges than elsewhere, beyond chance and by so much
        of the contrast, of ``levels`` (K, L), that it matters.

        A wrong blur leaves residuals where grey values change, on both sides alike: they pull at no edge.
        """
        rows = len(self.least)
        contrast = segment_mean((levels[:, 3] - levels[:, 0]).abs(), self.blocks.row, rows)
        steep, square = self.slope.square(), self.residual.square()
        planes = (steep * square, steep, steep.square(), square, torch.ones_like(square))
        each = [(self.inlying * plane).sum(-1, dtype=torch.float64) for plane in planes]
        pulled, one, two, all_of, count = segment_sum(torch.stack(each, -1), self.blocks.row, rows).unbind(-1)
        at_edges, everywhere = pulled / one, all_of / count
        matters = at_edges - everywhere > (_MATTERS * contrast).square()
        return matters & (at_edges > everywhere * of_chance(one.square() / two))

    def _trusted(self, spread: Tensor, misfit: Tensor) -> Tensor:
        """Weights (K, 96) of the sectors."""
        clear = clear_sectors(self.sectors, spread, misfit, self.rough)
        if self.stage.wary:
            clear = away_from_unclear(self.sectors, clear)
        if not self.stage.tempered:
            self.clear = clear
            return clear
        # what levels without curvature could not explain stays out: curved ones bend into covers
        self.clear = clear & self.clear
        return trust(self.sectors, self.clear, self.variance[self.blocks.row], self.rough)
