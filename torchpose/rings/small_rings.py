"""Rings too small for separate edges: both circles, blur and grey levels fitted to the grey values at once.

Where the two circles are closer than an edge mask, or the inner one fits into the mask, each edge bends the other's
measurement. The whole ring as one model has no such limit:

    I = paper + slope . x + contrast (E(1) - E(q)),

E(s) the blurred indicator of the ellipse scaled by s, q the ratio of the radii. To first order in the distance it is
that of a curved edge (`geometry.blurred_edge`). Where the blur is more than a third of the inner circle, that misreads
codes, and the ring is fitted once more with the exact integral (`geometry.blurred_ellipse`). Where even that leaves
residuals with a shape, the blur is none of a Gaussian's: out of focus it is a disc, under which ratio and contrast are
others. It has several minima, so it is begun from a small hole and from a large one, and the best fit is kept.
The circles share their shape; perspective parts their centres by about a^2 (1 - q^2) / f at most (a the semi-major
axis, f the focal length, px), the standard deviation of a prior at zero. What covers a part of the ring, or touches it,
is left out by robust weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchpose.detect import Candidates
from torchpose.ellipse import EllipseFit
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.blurred_edge import BLUR, LONG, MOST, Spread
from torchpose.geometry.blurred_ellipse import disc, nodes_of_each
from torchpose.geometry.least_squares import (
    Block,
    Normal,
    Unknowns,
    Vector,
    geman_mcclure,
    minimise,
    solve_scaled,
)
from torchpose.geometry.robust import CUT, LEAST_KEPT, RATIO_RANGE, of_chance
from torchpose.geometry.rows import Rows
from torchpose.geometry.sectors import SECTORS, sector_of
from torchpose.geometry.segments import segment_mean, values_at
from torchpose.rings.inner_circles import InnerCircles
from torchpose.rings.small_ring_model import MOST_NODES, RING, depth, exact, first_order, outer_ellipses

_MARGIN = 3.0  # px around the outer ellipse
_SOFT = 2.5  # standard deviations, scale of the soft weights
_MISFIT = 0.05  # of the contrast, RMS in a sector: the most that a box for a Gaussian leaves
_ACROSS = 4.0  # px across an edge, two blurs on either side, that share its misfit: all of them tell as much as one
_MOST_MOVE = (*[0.7] * 5, 0.1, *[0.7] * 2)  # of an iteration: px, and the ratio
_START_SIGMA = 0.8  # px, at least
_OVAL = 0.3  # of a blur's mean variance: what is expected of its lean, which a ring as small as its blur hardly tells
# blur over inner semi-minor axis above which edges are no edges any more (measured: decisions/0053 and docs/tried.md)
BLURRED = 0.33
_BLURRED_MARGIN = 2.5  # blurs around the outer ellipse
# of the variance of grey around the ring: noise of half of the contrast's deviation remains (convention)
_LEAST_EXPLAINED = 0.75
# variance of a ring's residuals over that of white noise with the same third differences: mean of a frame's rings under
# a Gaussian up to 1.1, under a disc 1.6 to 1.9 (measured: decisions/0053)
_WHITE = 1.25
_BEGINNINGS = (0.35, 0.65)  # ratios: from one of them any code is reached (measured: decisions/0053)
_PART = 400_000  # pixels times nodes at a time
_FEW = 10_000  # pixels: the calls of a part cost as much, so fewer are padded to one size (measured: docs/tried.md)
_UNEVEN = 2.0  # most pixels of a window over the least, of those that are padded to one size
_RATIO_SIGMA = 0.1  # of the ratio: an inner circle that is not sure is none (convention)
_LEVELS = 4  # paper, its slope 2, contrast
_LEAST = (*[-math.inf] * 5, 0.05, *[-math.inf] * 2)  # of the ring's parameters, and the most
_MOST = (*[math.inf] * 5, 0.97, *[math.inf] * 2)
_LEAST_PARTED = 1e-3  # px, standard deviation of the prior of the smallest rings


@dataclass(frozen=True, eq=False)
class SmallRings(Rows):
    """K fitted rings.

    Attributes:
        outer: ellipses in raw pixels.
        inner: the same.
        blur: px^2, see `geometry.blur`.
        good: whether the model explains what is seen.
        promising: whether it is that of a blur too wide for it, and the exact one may explain more.
        disc: whether a round disc explains its blur, and a Gaussian does not.
        seen: sectors in which it does.
    """

    outer: EllipseFit
    inner: EllipseFit
    blur: Float[Tensor, "K 3"]
    good: Bool[Tensor, " K"]
    promising: Bool[Tensor, " K"]
    disc: Bool[Tensor, " K"]
    seen: Bool[Tensor, "K 48"]


class _Stage(NamedTuple):
    """Some steps, and how they weigh the pixels.

    held: the ring stays where it is. sectors: those that contradict the model do not count. hard: every pixel counts
    or not, instead of by a smooth weight. even: every pixel counts.
    """

    steps: int
    held: bool = False
    sectors: bool = True
    hard: bool = False
    even: bool = False


class _Scheme(NamedTuple):
    """How the rings are modelled and solved."""

    coverage: Callable[[Tensor, Spread, Tensor, Tensor], tuple[Tensor, Tensor]]
    damping: float
    stages: tuple[_Stage, ...]


# grey levels and weights alone at first, so that a cover does not pull from the start
_ROUGH = _Scheme(first_order, 1e-3, (_Stage(2, held=True, sectors=False), _Stage(6), _Stage(3, hard=True)))
# blur, width and contrast of a ring much blurred are hard to tell apart: no step is to be shortened
_PRECISE = _Scheme(exact, 1e-5, (_Stage(6), _Stage(4, hard=True)))
_GLANCE = _PRECISE._replace(stages=(_Stage(3), _Stage(1, hard=True)))  # enough to see that a Gaussian will not do
# from afar a weight would leave out what contradicts the beginning
_OUT_OF_FOCUS = _Scheme(partial(exact, profile=disc), 1e-5, (_Stage(4, sectors=False, even=True), _Stage(2, hard=True)))


def fit_small_rings(
    frames: Shaped[Tensor, "B H W"],
    candidates: Candidates,
    inside: InnerCircles,
    focal: Float[Tensor, ""],
    *,
    begun: bool = False,
) -> SmallRings:
    """Fits the model above by damped Gauss-Newton from rough rings.

    Args:
        frames: grey, any real dtype.
        candidates: the outer circles, about.
        inside: what is inside of them, about; directions in which the outer edge does not show do not count.
        focal: px.
        begun: circles and blur are those of such a fit, which the exact integral continues; by the first one alone
            codes of rings of a wide blur may be off by a fifth of their tolerance.
    """
    outer, ratio = candidates.ellipse, inside.ratio
    shape = conics.shape_matrix(outer)
    start = [outer[:, :2], shape[:, 0, :1], shape[:, 0, 1:], shape[:, 1, 1:], ratio[:, None]]
    apart = inside.ellipse[:, :2] - outer[:, :2] if begun else torch.zeros_like(outer[:, :2])
    parted = (outer[:, 2].square() * (1 - ratio.square()) / focal).clamp_min(_LEAST_PARTED)
    spread = Spread(blurs.limited(inside.blur, _START_SIGMA**2, MOST**2))
    first = _Start(torch.cat([*start, apart], -1), spread, inside.seen, parted, inside.clipped)
    if not begun or len(outer) == 0:
        return _judged(_fitted_all(frames, candidates, first, _ROUGH), outer, candidates.polarity)
    fit = _fitted_all(frames, candidates, first, _GLANCE)
    frame, number = candidates.frame, int(candidates.frame.max()) + 1
    odd = (segment_mean(fit.variance / fit.noise, frame, number)[frame] > _WHITE).nonzero()[:, 0]
    if odd.numel():
        fit = fit.replaced(odd, _out_of_focus(frames, candidates[odd], first[odd], fit[odd]))
    left = (~fit.explained_by_disc).nonzero()[:, 0]
    if left.numel():
        # a glance is no fit
        fit = replace(fit, sound=fit.sound & fit.disc, variance=fit.variance.where(fit.disc, torch.inf))
        fit = fit.bettered(left, _fitted_all(frames, candidates[left], first[left], _PRECISE))
    return _judged(fit, outer, candidates.polarity)


def _fitted_all(frames: Tensor, candidates: Candidates, first: _Start, scheme: _Scheme) -> _Fit:
    """Fits of K rings by one scheme."""
    outer, exactly = candidates.ellipse, scheme is not _ROUGH
    least, most = (axis.sqrt() for axis in blurs.axes(first.spread.values))
    margin = (_BLURRED_MARGIN * most).clamp_min(_MARGIN) if exactly else torch.full_like(most, _MARGIN)
    nodes = nodes_of_each(outer[:, 2], least).clamp_max(MOST_NODES) if exactly else None
    fit = _no_fit(first)
    for part in _parts(_pixels(outer, margin), nodes):
        window = _windows(frames, candidates.frame[part], outer[part], margin[part])
        fit = fit.replaced(part, _fitted(window, first[part], scheme))
    return fit


def _out_of_focus(frames: Tensor, candidates: Candidates, first: _Start, fit: _Fit) -> _Fit:
    """The best of the K fits and those under a disc, of the blur that the rings of the frame have on average."""
    frame, number = candidates.frame, int(candidates.frame.max()) + 1
    size = 0.5 * (fit.blur[:, 0] + fit.blur[:, 2])
    usual = segment_mean(size, frame, number)[frame]
    spread = Spread(blurs.limited(blurs.isotropic(usual.sqrt()), _START_SIGMA**2, MOST**2))
    begun = replace(first, spread=spread)
    left = torch.arange(len(frame), device=frame.device)
    for ratio in _BEGINNINGS:
        theta = torch.cat([begun.theta[:, :5], torch.full_like(usual, ratio)[:, None], begun.theta[:, 6:]], -1)
        other = _fitted_all(frames, candidates[left], replace(begun, theta=theta)[left], _OUT_OF_FOCUS)
        fit = fit.bettered(left, other)
        told = fit.variance.minimum(fit.noise)  # a ring that fits tells the noise of all
        least = told.new_full((number,), math.inf).scatter_reduce(0, frame, told, "amin")[frame]
        left = left[fit.variance[left] > _WHITE**2 * least[left]]  # twice beyond chance, as both have some
        if left.numel() == 0:
            break
    return fit


@dataclass(frozen=True, eq=False)
class _Start(Rows):
    """Where K fits begin: parameters, blur; directions in which the ring is seen, how far its centres may be apart, px,
    and whether it is clipped."""

    theta: Float[Tensor, "K 8"]
    spread: Spread
    seen: Bool[Tensor, "K 48"]
    parted: Float[Tensor, " K"]
    clipped: Bool[Tensor, " K"]

    @property
    def known(self) -> Float[Tensor, "K 15 15"]:
        """Prior information: both centres are one, and the blur is round; none about the grey levels."""
        size = self.spread.values[:, 0] + self.spread.values[:, 2]
        lean, turn = (size.new_zeros(RING + BLUR) for _ in range(2))
        lean[RING], lean[RING + 2], turn[RING + 1] = 0.5, -0.5, 1.0
        oval = torch.outer(lean, lean) + torch.outer(turn, turn)
        centers = torch.nn.functional.pad(self.parted.pow(-2)[:, None].expand(-1, 2), (RING - 2, BLUR))
        known = torch.diag_embed(centers) + oval * (0.5 * _OVAL * size).pow(-2)[:, None, None]
        return torch.nn.functional.pad(known, (0, _LEVELS, 0, _LEVELS))


@dataclass(frozen=True, eq=False)
class _Fit(Rows):
    """K fits: parameters, blur and the covariance of both, contrast, residual variance, number of pixels kept and their
    share, the share of the grey values' variance that is explained, the variance of white noise that has their
    residuals' third differences, whether the blur is a disc's, whether the window is on the frame and the data
    determine all parameters, and the sectors that follow the model."""

    theta: Float[Tensor, "K 8"]
    blur: Float[Tensor, "K 3"]
    covariance: Float[Tensor, "K 11 11"]
    contrast: Float[Tensor, " K"]
    variance: Float[Tensor, " K"]
    pixels: Float[Tensor, " K"]
    kept: Float[Tensor, " K"]
    explained: Float[Tensor, " K"]
    noise: Float[Tensor, " K"]
    disc: Bool[Tensor, " K"]
    sound: Bool[Tensor, " K"]
    seen: Bool[Tensor, "K 48"]

    @property
    def loss(self) -> Tensor:
        """(K,): mean squares of the residuals, those left out with the least that they have."""
        return self.variance * (self.kept + CUT**2 * (1 - self.kept))

    @property
    def explained_by_disc(self) -> Tensor:
        """(K,) bool: a disc leaves no more than noise."""
        return self.disc & (self.variance < _WHITE**2 * self.noise)

    def bettered(self, index: Tensor, others: _Fit) -> _Fit:
        """With those of the others, of the rings ``index``, that leave less."""
        better = (others.sound & (others.loss < self.loss[index])).nonzero()[:, 0]
        return self.replaced(index[better], others[better])


def _no_fit(begun: _Start) -> _Fit:
    """Of rings of which nothing is known yet."""
    none = torch.zeros_like(begun.theta[:, 0])
    covariance = none.new_zeros(len(none), RING + BLUR, RING + BLUR)
    no = none > 0
    return _Fit(begun.theta, begun.spread.values, covariance, none, none, none, none, none, none, no, no, begun.seen)


def _pixels(outer: Tensor, margin: Tensor) -> Tensor:
    """Pixels (K,) of the windows of `_windows`."""
    return (2 * _half_sides(outer, margin) + 1).prod(-1)


def _half_sides(outer: Tensor, margin: Tensor) -> Tensor:
    """(K, 2) int64, of the windows that hold ellipses with their margins."""
    shape = conics.shape_matrix(outer)
    return (shape.square().sum(-1).sqrt() + margin[:, None]).ceil().long()


def _parts(pixels: Tensor, nodes: Tensor | None = None) -> Iterator[Tensor]:
    """Indices in parts that fit the cache, each padded to the largest of them; few pixels are one part."""
    order = torch.argsort(pixels)
    size = pixels[order].double()
    step = (size / size[:1].clamp_min(1)).log().div(math.log(_UNEVEN)).long()
    if len(order) and len(order) * float(size[-1]) < _FEW:
        step = torch.zeros_like(step)
    part = 1_000_000 * step + ((size if nodes is None else size * nodes[order]).cumsum(0) / _PART).long()
    yield from order.split(part.unique_consecutive(return_counts=True)[1].tolist() if len(order) else [])


def _fitted(window: _Window, begun: _Start, scheme: _Scheme) -> _Fit:
    """Fits of K rings to the pixels of their windows."""
    middle = torch.nn.functional.pad(window.middle, (0, RING - 2))
    limits = [begun.theta.new_tensor(x) for x in (_LEAST, _MOST, _MOST_MOVE)]
    own: dict[str, Block] = {"ring": Vector(begun.theta - middle, *limits), "blur": begun.spread}
    own["levels"] = Vector(middle.new_zeros(len(middle), _LEVELS))  # only how they move with the others counts
    unknowns = Unknowns(own)
    pixels = _Pixels(window, unknowns.values("ring"), begun, scheme)
    for stage in scheme.stages:
        pixels.stage = stage
        if stage.held:
            for _ in range(stage.steps):
                pixels(unknowns)
            continue
        found = minimise(pixels, unknowns, stage.steps, damping=scheme.damping, settle=False)
        unknowns = found.unknowns
    weight, grey = pixels.weight, window.grey
    number = weight.sum(-1)  # the last weights are 0 or 1
    variance = (weight * pixels.residual.square()).sum(-1) / (number - RING - BLUR - _LEVELS).clamp_min(1)
    # clipped pixels have no noise; at the edges is what a profile cut off, no Gaussian's, leaves of the model
    steep = weight * pixels.steepness
    at_edges = (steep * pixels.residual.square()).sum(-1) / steep.sum(-1)
    misfit = torch.where(begun.clipped, (at_edges - variance).clamp_min(0), 0.0)
    uncertain = variance + _ACROSS * misfit
    mean = (weight * grey).sum(-1, keepdim=True) / number[:, None]
    total = (weight * (grey - mean).square()).sum(-1) / number
    covariance, determined = found.covariance()
    covariance = covariance[:, : RING + BLUR, : RING + BLUR] * (uncertain / pixels.spread.square())[:, None, None]
    sound = window.whole & determined & covariance.isfinite().all(-1).all(-1)
    theta, spread = unknowns.values("ring") + middle, cast(Spread, unknowns.own["blur"])
    kept, explained = number / window.valid.sum(-1), 1 - variance / total
    return _Fit(
        theta,
        spread.values,
        covariance,
        pixels.levels[:, 3],
        variance,
        number,
        kept,
        explained,
        torch.zeros_like(variance) if scheme is _ROUGH else _noise(pixels.residual, weight),  # only asked of the others
        torch.full_like(sound, scheme is _OUT_OF_FOCUS),
        sound,
        pixels.followed(),
    )


class _Pixels:
    """The normal equations of K rings by the pixels of their windows, and what these last showed."""

    def __init__(self, window: _Window, theta: Tensor, begun: _Start, scheme: _Scheme) -> None:
        self.window, self.scheme, self.known, self.stage = window, scheme, begun.known, scheme.stages[0]
        semi_major = outer_ellipses(theta)[0][:, 2, None]
        one = torch.ones_like(window.x)
        self.plane = torch.stack([one, window.x / semi_major, window.y / semi_major], 1)
        at = depth(theta, window.x, window.y)
        sector = sector_of(at.u, at.v)
        self.clear = self.weight = begun.seen.to(window.grey).gather(1, sector) * window.valid
        self.sector = torch.arange(len(theta), device=theta.device)[:, None] * SECTORS + sector
        self.spread = torch.ones_like(theta[:, 0])
        self.steepness = torch.zeros_like(window.x)  # squared slope of the coverage
        self.residual, self.levels = window.grey, theta.new_zeros(len(theta), _LEVELS)

    def __call__(self, unknowns: Unknowns) -> Normal:
        theta, window, stage, n = unknowns.values("ring"), self.window, self.stage, RING + BLUR
        value, derivative = self.scheme.coverage(theta, cast(Spread, unknowns.own["blur"]), window.x, window.y)
        self.steepness = derivative[:, :2].square().sum(1)  # by the centre
        basis = torch.cat([self.plane, value.to(self.plane)[:, None]], 1)
        # grey levels first, so that the derivatives have their contrast
        self.levels = _levels(basis, window.grey, self.weight)
        self.residual = residual = window.grey - (self.levels[:, None] @ basis).squeeze(1)
        if not stage.hard:  # later it would grow with what it lets in
            mean = (self.weight * residual.square()).sum(-1) / self.weight.sum(-1)
            self.spread = mean.sqrt()
        agrees = self._agreeing(residual) if stage.sectors else 1.0
        fitting = 1.0 if stage.even else _weights(residual / self.spread[:, None], keep=stage.hard)
        self.weight = self.clear * agrees * fitting
        columns = torch.cat([derivative.to(basis) * self.levels[:, 3:, None], basis, residual[:, None]], 1)
        weighted = columns[:, :-1] * (self.weight / self.spread.square()[:, None])[:, None]
        sums = weighted @ columns.mT
        blur = cast(Spread, unknowns.own["blur"]).values
        pull = (self.known[..., :n] @ torch.cat([theta, blur], -1)[..., None]).squeeze(-1)
        return Normal(sums[..., :-1] + self.known, sums[..., -1] - pull, torch.zeros_like(sums[:, 0, 0]))

    def _agreeing(self, residual: Tensor) -> Tensor:
        """Pixels (K, P) 0 or 1 whose sector of the ring leaves no more than the median sector does, chance, and a blur
        of another shape.

        A cover of nearly the grey of the ring leaves residuals that no single pixel betrays, but all of a sector do.
        """
        # a sector has a pixel or two: its neighbours speak with it
        own = (self._by_sector(self.clear * residual.square()), self._by_sector(self.clear))
        total, number = (sums + sums.roll(1, 1) + sums.roll(-1, 1) for sums in own)
        square = total / number  # NaN where it is not seen
        allowed = (_MISFIT * self.levels[:, 3:]).square()
        limit = square.nanmedian(-1, keepdim=True).values * of_chance(number) + allowed
        return (square <= limit).flatten()[self.sector].to(residual)

    def _by_sector(self, values: Tensor) -> Tensor:
        """Sums (K, 48) of values (K, P)."""
        sums = values.new_zeros(len(values) * SECTORS)
        return sums.scatter_add_(0, self.sector.flatten(), values.flatten()).view(-1, SECTORS)

    def followed(self) -> Tensor:
        """Sectors (K, 48) bool most of whose pixels count in the end."""
        return self._by_sector(self.weight) > LEAST_KEPT * self._by_sector(self.window.valid)


def _judged(fit: _Fit, outer: Tensor, polarity: Tensor) -> SmallRings:
    """Both ellipses of each fit, and whether it is a ring of this polarity where the rough one (K, 5) was."""
    theta, covariance = fit.theta, fit.covariance[:, :RING, :RING]
    params, shape_ok = outer_ellipses(theta)
    ratio = theta[:, 5]
    good = (
        shape_ok
        & fit.sound
        & (fit.kept > LEAST_KEPT)
        & (fit.explained > _LEAST_EXPLAINED)
        & (fit.contrast * polarity < 0)
        & (ratio > RATIO_RANGE[0])
        & (ratio < RATIO_RANGE[1])
        & (covariance[:, 5, 5].sqrt() < _RATIO_SIGMA * ratio)
        & (torch.linalg.vector_norm(params[:, :2] - outer[:, :2], dim=-1) < 0.3 * outer[:, 3] + 1)
    )
    to_axes = _to_axes(params)
    outer_jacobian = theta.new_zeros(theta.shape[0], 5, RING)
    outer_jacobian[:, :2, :2] = torch.eye(2, dtype=theta.dtype, device=theta.device)
    outer_jacobian[:, 2:, 2:5] = to_axes
    inner_jacobian = outer_jacobian.clone()
    inner_jacobian[:, :2, 6:] = inner_jacobian[:, :2, :2]
    inner_jacobian[:, 2:, 2:5] *= ratio[:, None, None]
    inner_jacobian[:, 2, 5], inner_jacobian[:, 4, 5] = params[:, 2], params[:, 3]
    inner = torch.cat([params[:, :2] + theta[:, 6:], params[:, 2:4] * ratio[:, None], params[:, 4:]], -1)
    # a first fit may leave twice as much
    may = shape_ok & fit.sound & (fit.contrast * polarity < 0) & (1 - fit.explained < 2 * (1 - _LEAST_EXPLAINED))
    least, most = blurs.axes(fit.blur)
    promising = may & (most.sqrt() > BLURRED * ratio * params[:, 3])
    # both circles tell the same shape and nearly the same centre: as independent ones each has twice the variance
    fits = [
        EllipseFit(p, 2 * j @ covariance @ j.mT, fit.variance.sqrt(), fit.pixels)
        for p, j in ((params, outer_jacobian), (inner, inner_jacobian))
    ]
    round_disc = fit.explained_by_disc & (most < LONG * least)
    return SmallRings(fits[0], fits[1], fit.blur, good, promising, round_disc, fit.seen)


class _Window(NamedTuple):
    """Pixels around K rings, padded to P: middle (K, 2) of the window; x, y from there, grey and 1 or 0 (K, P) float64.

    And whether all of them are on the frame (K,) bool: what the border cuts off leaves the shape open.
    """

    middle: Tensor
    x: Tensor
    y: Tensor
    grey: Tensor
    valid: Tensor
    whole: Tensor


def _windows(frames: Tensor, frame: Tensor, outer: Tensor, margin: Tensor) -> _Window:
    """Pixels of frames (B, H, W) within a margin (K,) px of rough outer ellipses (K, 5)."""
    height, width = frames.shape[-2:]
    half = _half_sides(outer, margin)
    side = 2 * half + 1
    position = torch.arange(int(side.prod(-1).max()) if len(side) else 0, device=frames.device)
    row = torch.div(position, side[:, :1], rounding_mode="floor")
    column = position - row * side[:, :1]
    middle = outer[:, :2].round().long()
    u, v = column - half[:, :1] + middle[:, :1], row - half[:, 1:] + middle[:, 1:]
    x, y = (u - middle[:, :1]).double(), (v - middle[:, 1:]).double()
    shape = conics.shape_matrix(outer).flatten(1)[:, [0, 1, 3]]
    near = depth(torch.cat([outer[:, :2] - middle, shape], -1), x, y).distance < margin[:, None]
    near &= row < side[:, 1:]
    on = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    cell = (frame[:, None] * height + v.clamp(0, height - 1)) * width + u.clamp(0, width - 1)
    grey = values_at(frames, cell).double()
    sound = grey.isfinite()
    valid = (near & on & sound).double()
    return _Window(middle.double(), x, y, torch.where(sound, grey, 0.0), valid, ~(near & ~(on & sound)).any(-1))


def _weights(deviation: Tensor, keep: bool) -> Tensor:
    """Weights of residuals in standard deviations: Geman-McClure's, or with ``keep`` 1 within the cut, else 0."""
    if keep:
        return (deviation.abs() < CUT).to(deviation)
    return geman_mcclure(deviation / _SOFT).nan_to_num(nan=0.0)


def _levels(basis: Tensor, grey: Tensor, weight: Tensor) -> Tensor:
    """Weighted least-squares coefficients (K, C) of grey values (K, P) on a basis (K, C, P)."""
    weighted = basis * weight[:, None]
    right = (weighted @ grey[..., None]).squeeze(-1)
    return solve_scaled(weighted @ basis.mT, right).nan_to_num(nan=0.0)


def _noise(residual: Tensor, weight: Tensor) -> Tensor:
    """Variance (K,) of the white noise that has the third differences of residuals (K, P), in the order of rows."""
    last = residual.shape[1] - 3
    difference, whole = torch.zeros_like(residual[:, 3:]), torch.ones_like(residual[:, 3:])
    for at, factor in enumerate((-1.0, 3.0, -3.0, 1.0)):
        difference = difference + factor * residual[:, at : at + last]
        whole = whole * weight[:, at : at + last]
    return (whole * difference.square()).sum(-1) / (20 * whole.sum(-1))


def _to_axes(ellipses: Tensor) -> Tensor:
    """Matrices (K, 3, 3) that turn a change (s11, s12, s22) of the shape into (e11, e12, e22) of its own axes."""
    c, s = ellipses[:, 4].cos(), ellipses[:, 4].sin()
    rows = [c * c, 2 * c * s, s * s, -c * s, c * c - s * s, c * s, s * s, -2 * c * s, c * c]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
