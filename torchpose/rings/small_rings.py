"""Rings too small for separate edges: both circles, blur and grey levels fitted to the grey values at once.

Where the two circles are closer than an edge mask, or the inner one fits into the mask, each edge bends the other's
measurement. The whole ring as one model has no such limit:

    I = paper + slope . x + contrast (E(1) - E(q)),

E(s) the blurred indicator of the ellipse scaled by s, q the ratio of the radii. To first order in the distance it is
Phi(d_s / sigma - sigma k_s / 2), d_s the distance inside the ellipse, k_s its curvature, Phi the normal distribution.
Where the blur is more than a fifth of the inner circle, that is off by up to a quarter of the contrast, and the ring is
fitted once more with the exact integral (`geometry.blurred_ellipse`). The circles share their shape; perspective parts
their centres by about a^2 (1 - q^2) / f at most (a the semi-major axis, f the focal length, px), the standard deviation
of a prior at zero. What covers a part of the ring, or touches it, is left out by robust weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics
from torchpose.geometry.least_squares import (
    Eliminated,
    Normal,
    Unknowns,
    Vector,
    geman_mcclure,
    minimise,
    solve_scaled,
)
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import ragged_arange, segment_mean, segment_sum
from torchpose.rings.small_ring_model import MOST_NODES, depth, exact, first_order, outer_ellipses

_MARGIN = 3.0  # px around the outer ellipse
_SOFT, _CUT = 2.5, 4.0  # standard deviations: scale of the soft weights, and from where on a pixel is dropped
_SECTORS, _SECTOR_CUT = 16, 4.0  # and standard deviations of the mean square of a sector
_LEAST_KEPT = 0.5  # of the pixels
_MOST_MOVE = (*[0.7] * 5, 0.1, *[0.7] * 3)  # of an iteration: px, and the ratio
_START_SIGMA = 0.8  # px
_BLURRED = 0.2  # blur over inner semi-minor axis above which edges are no edges any more
_BLURRED_MARGIN = 2.5  # blurs around the outer ellipse
_LEAST_EXPLAINED = 0.75  # of the variance of grey around the ring
_PROMISING = 0.5  # of it, from the first fit, for a second one
_PART = 400_000  # pixels times nodes at a time
_RATIO_RANGE = (0.12, 0.93)  # beyond it, a plain disc or its rim
_RATIO_SIGMA = 0.1  # of the ratio: an inner circle that is not sure is none
_NONLINEAR = 9  # centre 2, shape 3, ratio, blur, inner from outer centre 2
_LEVELS = 4  # paper, its slope 2, contrast
_LEAST = (*[-math.inf] * 5, 0.05, 0.3, *[-math.inf] * 2)  # of the unknowns, and the most
_MOST = (*[math.inf] * 5, 0.97, 6.0, *[math.inf] * 2)
_LEAST_PARTED = 1e-3  # px, standard deviation of the prior of the smallest rings


@dataclass(frozen=True, eq=False)
class SmallRings(Rows):
    """K fitted rings.

    Attributes:
        outer: ellipses in raw pixels.
        inner: the same.
        good: whether the model explains what is seen.
    """

    outer: EllipseFit
    inner: EllipseFit
    good: Bool[Tensor, " K"]


class _Stage(NamedTuple):
    """Some steps, and how they weigh the pixels.

    held: the ring stays where it is. sectors: those that contradict the model do not count. hard: every pixel counts
    or not, instead of by a smooth weight.
    """

    steps: int
    held: bool = False
    sectors: bool = True
    hard: bool = False


class _Scheme(NamedTuple):
    """How the rings are modelled and solved."""

    coverage: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
    damping: float
    stages: tuple[_Stage, ...]


# grey levels and weights alone at first, so that a cover does not pull from the start
_ROUGH = _Scheme(first_order, 1e-3, (_Stage(3, held=True, sectors=False), _Stage(7), _Stage(4, hard=True)))
# blur, width and contrast of a ring much blurred are hard to tell apart: no step is to be shortened
_PRECISE = _Scheme(exact, 1e-5, (_Stage(6), _Stage(4, hard=True)))


def fit_small_rings(
    frames: Shaped[Tensor, "B H W"],
    frame: Int[Tensor, " K"],
    outer: Float[Tensor, "K 5"],
    ratio: Float[Tensor, " K"],
    seen: Bool[Tensor, "K A"],
    polarity: Float[Tensor, " K"],
    focal: Float[Tensor, ""],
) -> SmallRings:
    """Fits the model above by damped Gauss-Newton from rough rings.

    Args:
        frames: grey, any real dtype.
        frame: of each ring.
        outer: rough outer ellipses, px.
        ratio: rough, of the radii.
        seen: the directions in which the outer edge shows, see `inner_circles.find_inner`; the others do not count.
        polarity: +1 for a dark ring.
        focal: px.
    """
    shape = conics.shape_matrix(outer)
    start = [outer[:, :2], shape[:, 0, :1], shape[:, 0, 1:], shape[:, 1, 1:], ratio[:, None]]
    theta = torch.cat([*start, torch.full_like(ratio, _START_SIGMA)[:, None], torch.zeros_like(outer[:, :2])], -1)
    parted = (outer[:, 2].square() * (1 - ratio.square()) / focal).clamp_min(_LEAST_PARTED)
    known = torch.nn.functional.pad(parted.pow(-2)[:, None].expand(-1, 2), (_NONLINEAR - 2, 0))
    margin = torch.full_like(ratio, _MARGIN)
    fit = _fitted(_windows(frames, frame, outer, margin), theta, seen, known, _ROUGH)
    for part in _blurred(fit, outer, polarity):
        reach = (_BLURRED_MARGIN * fit.theta[part, 6]).clamp_min(_MARGIN)
        window = _windows(frames, frame[part], outer[part], reach)
        fit = fit.replaced(part, _fitted(window, fit.theta[part], seen[part], known[part], _PRECISE))
    return _judged(fit, outer, polarity)


def _blurred(fit: _Fit, outer: Tensor, polarity: Tensor) -> Sequence[Tensor]:
    """Which of K fits may be rings whose blur is wide for their size, in parts that fit the cache."""
    blur, inner = fit.theta[:, 6], fit.theta[:, 5] * outer[:, 3]
    promising = fit.sound & (fit.contrast * polarity < 0) & (fit.explained > _PROMISING)
    which = (promising & (blur > _BLURRED * inner)).nonzero()[:, 0]
    pixels = (2 * (outer[which, 2] + _BLURRED_MARGIN * blur[which]) + 1).square()
    order = torch.argsort(pixels)  # those of a part are padded to the largest of them
    part = (pixels[order].cumsum(0) * MOST_NODES / _PART).long()
    return which[order].split(part.unique_consecutive(return_counts=True)[1].tolist())


@dataclass(frozen=True, eq=False)
class _Fit(Rows):
    """K fits: parameters and their covariance, contrast, residual variance, number of pixels kept and their share, the
    share of the grey values' variance that is explained, and whether the window is on the frame and the data determine
    all parameters."""

    theta: Float[Tensor, "K 9"]
    covariance: Float[Tensor, "K 9 9"]
    contrast: Float[Tensor, " K"]
    variance: Float[Tensor, " K"]
    pixels: Float[Tensor, " K"]
    kept: Float[Tensor, " K"]
    explained: Float[Tensor, " K"]
    sound: Bool[Tensor, " K"]


def _fitted(window: _Window, theta: Tensor, seen: Tensor, known: Tensor, scheme: _Scheme) -> _Fit:
    """Fits from parameters (K, 9), with ``known`` (K, 9) the information about each that is there before."""
    pixels, limits = (
        _Pixels(window, theta, seen, known, scheme),
        [theta.new_tensor(x) for x in (_LEAST, _MOST, _MOST_MOVE)],
    )
    unknowns = Unknowns({"ring": Vector(theta, *limits)})
    for stage in scheme.stages:
        pixels.stage = stage
        if stage.held:
            for _ in range(stage.steps):
                pixels(unknowns)
            continue
        found = minimise(pixels, unknowns, stage.steps, damping=scheme.damping, settle=False)
        unknowns = found.unknowns
    index, weight, grey, count = window.ring, pixels.weight, window.grey, len(theta)
    number = segment_sum(weight, index, count)  # the last weights are 0 or 1
    residual = segment_sum(weight * pixels.residual.square(), index, count)
    variance = residual / (number - _NONLINEAR - _LEVELS).clamp_min(1)
    mean = segment_mean(grey, index, count, weight)
    total = segment_sum(weight * (grey - mean[index]).square(), index, count) / number
    covariance, determined = found.covariance()
    covariance = covariance * (variance / pixels.spread.square())[:, None, None]
    sound = window.whole & determined & covariance.isfinite().all(-1).all(-1)
    kept = number / torch.bincount(index, minlength=count)
    theta = unknowns.values("ring")
    return _Fit(theta, covariance, pixels.levels[:, 3], variance, number, kept, 1 - variance / total, sound)


class _Pixels:
    """The normal equations of K rings by the pixels of their windows, and what these last showed."""

    def __init__(self, window: _Window, theta: Tensor, seen: Tensor, known: Tensor, scheme: _Scheme) -> None:
        self.window, self.scheme, self.known, self.stage = window, scheme, known, scheme.stages[0]
        semi_major = outer_ellipses(theta)[0][:, 2]
        local = (window.xy - theta[window.ring, :2]) / semi_major[window.ring, None]
        self.plane = torch.cat([torch.ones_like(local[:, :1]), local], -1)
        at, directions = depth(theta, window.ring, window.xy), seen.shape[1]
        direction = (torch.atan2(at.v, at.u) * (directions / (2 * math.pi))).round().long() % directions
        self.clear = self.weight = seen[window.ring, direction].to(window.grey)
        self.sector = window.ring * _SECTORS + direction * _SECTORS // directions
        self.spread = torch.ones_like(theta[:, 0])
        self.residual, self.levels = window.grey, theta.new_zeros(len(theta), _LEVELS)

    def __call__(self, unknowns: Unknowns) -> Normal:
        theta, (index, xy, grey, _) = unknowns.values("ring"), self.window
        count, stage = len(theta), self.stage
        value, derivative = self.scheme.coverage(theta, index, xy)
        basis = torch.cat([self.plane, value[:, None]], -1)
        # grey levels first, so that the derivatives have their contrast
        self.levels = _levels(basis, grey, index, count, self.weight)
        self.residual = residual = grey - (basis * self.levels[index]).sum(-1)
        if not stage.hard:  # later it would grow with what it lets in
            self.spread = segment_mean(residual.square(), index, count, self.weight).sqrt()
        agrees = _agreeing(residual, self.clear, self.sector, count) if stage.sectors else 1.0
        self.weight = self.clear * agrees * _weights(residual / self.spread[index], keep=stage.hard)
        jacobian = torch.cat([derivative * self.levels[index, 3:], basis], -1)
        weighted = jacobian * (self.weight / self.spread.square()[index])[:, None]
        products = segment_sum((weighted[:, :, None] * jacobian[:, None]).flatten(1), index, count)
        products = products.unflatten(1, (_NONLINEAR + _LEVELS, -1))
        right = segment_sum(weighted * residual[:, None], index, count)
        n = _NONLINEAR
        owner = torch.arange(count, device=theta.device)
        part = Eliminated(products[:, :n, n:], products[:, n:, n:], right[:, n:], owner)
        # the prior of the shift between the centres is at zero
        information = products[:, :n, :n] + torch.diag_embed(self.known)
        return Normal(information, right[:, :n] - self.known * theta, torch.zeros_like(right[:, 0]), part)


def _judged(fit: _Fit, outer: Tensor, polarity: Tensor) -> SmallRings:
    """Both ellipses of each fit, and whether it is a ring of this polarity where the rough one (K, 5) was."""
    theta, covariance = fit.theta, fit.covariance
    params, shape_ok = outer_ellipses(theta)
    ratio = theta[:, 5]
    good = (
        shape_ok
        & fit.sound
        & (fit.kept > _LEAST_KEPT)
        & (fit.explained > _LEAST_EXPLAINED)
        & (fit.contrast * polarity < 0)
        & (ratio > _RATIO_RANGE[0])
        & (ratio < _RATIO_RANGE[1])
        & (covariance[:, 5, 5].sqrt() < _RATIO_SIGMA * ratio)
        & (torch.linalg.vector_norm(params[:, :2] - outer[:, :2], dim=-1) < 0.3 * outer[:, 3] + 1)
    )
    to_axes = _to_axes(params)
    outer_jacobian = theta.new_zeros(theta.shape[0], 5, _NONLINEAR)
    outer_jacobian[:, :2, :2] = torch.eye(2, dtype=theta.dtype, device=theta.device)
    outer_jacobian[:, 2:, 2:5] = to_axes
    inner_jacobian = outer_jacobian.clone()
    inner_jacobian[:, :2, 7:] = inner_jacobian[:, :2, :2]
    inner_jacobian[:, 2:, 2:5] *= ratio[:, None, None]
    inner_jacobian[:, 2, 5], inner_jacobian[:, 4, 5] = params[:, 2], params[:, 3]
    inner = torch.cat([params[:, :2] + theta[:, 7:], params[:, 2:4] * ratio[:, None], params[:, 4:]], -1)
    # both circles tell the same shape and nearly the same centre: as independent ones each has twice the variance
    fits = [
        EllipseFit(p, 2 * j @ covariance @ j.mT, fit.variance.sqrt(), fit.pixels)
        for p, j in ((params, outer_jacobian), (inner, inner_jacobian))
    ]
    return SmallRings(fits[0], fits[1], good)


class _Window(NamedTuple):
    """Pixels around K rings: ring (P,), sorted, position (P, 2), grey value (P,) float64.

    And whether all of them are on the frame (K,) bool: what the border cuts off leaves the shape open.
    """

    ring: Tensor
    xy: Tensor
    grey: Tensor
    whole: Tensor


def _windows(frames: Tensor, frame: Tensor, outer: Tensor, margin: Tensor) -> _Window:
    """Pixels of frames (B, H, W) within a margin (K,) px of rough outer ellipses (K, 5)."""
    height, width = frames.shape[-2:]
    half = (outer[:, 2] + margin).ceil().long()
    side = 2 * half + 1
    index, position = ragged_arange(side.square())
    corner = outer[:, :2].round().long() - half[:, None]
    u, v = corner[index, 0] + position % side[index], corner[index, 1] + position // side[index]
    xy = torch.stack([u, v], -1).double()
    theta = torch.cat([outer[:, :2], conics.shape_matrix(outer).flatten(1)[:, [0, 1, 3]]], -1)
    near = depth(theta, index, xy).depth > -margin[index]
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    cut = segment_sum((near & ~seen).double(), index, frame.numel()) > 0
    keep = near & seen
    index, xy, u, v = index[keep], xy[keep], u[keep], v[keep]
    grey = frames.reshape(-1)[(frame[index] * height + v) * width + u].double()
    return _Window(index, xy, grey, ~cut)


def _weights(deviation: Tensor, keep: bool) -> Tensor:
    """Weights (P,) of residuals in standard deviations: Geman-McClure's, or with ``keep`` 1 within the cut, else 0."""
    if keep:
        return (deviation.abs() < _CUT).to(deviation)
    return geman_mcclure(deviation / _SOFT).nan_to_num(nan=0.0)


def _agreeing(residual: Tensor, clear: Tensor, sector: Tensor, count: int) -> Tensor:
    """Pixels (P,) 0 or 1 whose sector of the ring leaves no more than the median sector does, and chance.

    A cover of nearly the grey of the ring leaves residuals that no single pixel betrays, but all of a sector do.

    Args:
        residual, clear: (P,). sector: (P,) int64, in [0, 16 ``count``).
    """
    sums = segment_sum(torch.stack([clear * residual.square(), clear], -1), sector, count * _SECTORS)
    square = (sums[:, 0] / sums[:, 1]).view(count, _SECTORS)  # NaN for a sector that is not seen
    limit = square.nanmedian(-1, keepdim=True).values * (1 + _SECTOR_CUT * (2 / sums[:, 1].view_as(square)).sqrt())
    return (square <= limit).flatten()[sector].to(residual)


def _levels(basis: Tensor, grey: Tensor, index: Tensor, count: int, weight: Tensor) -> Tensor:
    """Weighted least-squares coefficients (count, C) of grey values on a basis (P, C)."""
    c = basis.shape[1]
    weighted = basis * weight[:, None]
    gram = segment_sum((weighted[:, :, None] * basis[:, None]).flatten(1), index, count).unflatten(1, (c, c))
    right = segment_sum(weighted * grey[:, None], index, count)
    return solve_scaled(gram, right).nan_to_num(nan=0.0)


def _to_axes(ellipses: Tensor) -> Tensor:
    """Matrices (K, 3, 3) that turn a change (s11, s12, s22) of the shape into (e11, e12, e22) of its own axes."""
    c, s = ellipses[:, 4].cos(), ellipses[:, 4].sin()
    rows = [c * c, 2 * c * s, s * s, -c * s, c * c - s * s, c * s, s * s, -2 * c * s, c * c]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
