"""Rings too small for separate edges: both circles, blur and grey levels fitted to the grey values at once.

Where the two circles are closer than an edge mask, or the inner one fits into the mask, each edge bends the other's
measurement. The whole ring as one model has no such limit:

    I = paper + slope . x + contrast (E(1) - E(q)),   E(s) = Phi(d_s / sigma - sigma k_s / 2),

d_s the first-order distance inside the ellipse scaled by s, k_s its curvature, Phi the normal distribution, q the ratio
of the radii. The circles share their shape; perspective parts their centres by about a^2 (1 - q^2) / f at most (a the
semi-major axis, f the focal length, px), the standard deviation of a prior at zero. What covers a part of the ring, or
touches it, is left out by robust weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, segment_mean, segment_sum

_MARGIN = 3  # px around the outer ellipse
_ITERATIONS = 14
_HOLD = 3  # of the iterations find grey levels and weights only, so that a cover does not pull from the start
_ROBUST = 10  # of the iterations are reweighted softly, the rest keeps or drops a pixel
_SOFT, _CUT = 2.5, 4.0  # standard deviations: scale of the soft weights, and from where on a pixel is dropped
_SECTORS, _SECTOR_CUT = 16, 4.0  # and standard deviations of the mean square of a sector
_LEAST_KEPT = 0.5  # of the pixels
_DAMPING = 1e-3
_MOST_MOVE = 0.7  # px of an iteration
_START_SIGMA = 0.8  # px
_LEAST_EXPLAINED = 0.75  # of the variance of grey around the ring
_RATIO_RANGE = (0.12, 0.93)  # beyond it, a plain disc or its rim
_RATIO_SIGMA = 0.1  # of the ratio: an inner circle that is not sure is none
_NONLINEAR = 9  # centre 2, shape 3, ratio, blur, inner from outer centre 2; then the four grey ones
_LEAST_PARTED = 1e-3  # px, standard deviation of the prior of the smallest rings


@dataclass(frozen=True, eq=False)
class SmallRings:
    """K fitted rings: both circles in raw pixels, and whether the model explains what is seen (K,) bool."""

    outer: EllipseFit
    inner: EllipseFit
    good: Tensor


def fit_small_rings(
    frames: Tensor, frame: Tensor, outer: Tensor, ratio: Tensor, seen: Tensor, polarity: Tensor, focal: Tensor
) -> SmallRings:
    """Fits the model above by damped Gauss-Newton from rough rings.

    Args:
        frames: (B, H, W) grey, any real dtype. frame: (K,) int64. outer: (K, 5) rough outer ellipses, px.
        ratio: (K,) rough ratio of the radii. seen: (K, A) bool, the directions in which the outer edge shows, see
            `inner_circles.find_inner`; the others do not count. polarity: (K,) +1 for a dark ring. focal: () px.
    """
    count = frame.numel()
    index, xy, grey, whole = _windows(frames, frame, outer)
    shape = conics.shape_matrix(outer)
    start = [outer[:, :2], shape[:, 0, :1], shape[:, 0, 1:], shape[:, 1, 1:], ratio[:, None]]
    theta = torch.cat([*start, torch.full_like(ratio, _START_SIGMA)[:, None], torch.zeros_like(outer[:, :2])], -1)
    parted = (outer[:, 2].square() * (1 - ratio.square()) / focal).clamp_min(_LEAST_PARTED)
    known = torch.nn.functional.pad(parted.pow(-2)[:, None].expand(-1, 2), (_NONLINEAR - 2, 4))
    origin = outer[:, :2]
    local = (xy - origin[index]) / outer[index, 2:3]
    eye = torch.eye(_NONLINEAR + 4, dtype=torch.float64, device=frames.device)
    linear = theta.new_zeros(count, 4)
    normal = eye.expand(count, -1, -1)
    residual = grey
    at = _depth(theta, index, xy)
    direction = (torch.atan2(at.v, at.u) * (seen.shape[1] / (2 * math.pi))).round().long() % seen.shape[1]
    clear = seen[index, direction].to(grey)
    sector = direction * _SECTORS // seen.shape[1]
    weight = clear
    spread = torch.ones_like(ratio)
    for step_number in range(_ITERATIONS):
        value, derivative = _coverage(theta, index, xy)
        basis = torch.cat([torch.ones_like(local[:, :1]), local, value[:, None]], -1)
        # grey levels first, so that the derivatives have their contrast
        linear = _solve(basis, grey, index, count, weight)
        residual = grey - (basis * linear[index]).sum(-1)
        last = step_number >= _ROBUST
        if not last:  # later it would grow with what it lets in
            spread = segment_mean(residual.square(), index, count, weight).sqrt()
        agrees = _agreeing(residual, clear, index * _SECTORS + sector, count) if step_number >= _HOLD else clear
        weight = clear * agrees * _weights(residual / spread[index], keep=last)
        jacobian = torch.cat([derivative * linear[index, 3:], basis], -1)
        weighted = jacobian * weight[:, None]
        normal = segment_sum((weighted[:, :, None] * jacobian[:, None]).flatten(1), index, count)
        normal = normal.view(count, _NONLINEAR + 4, -1) + torch.diag_embed(known * spread.square()[:, None])
        gradient = segment_sum(weighted * residual[:, None], index, count)
        gradient[:, 7:9] -= (known[:, 7:9] * spread.square()[:, None]) * theta[:, 7:9]
        damped = normal + torch.diag_embed(_DAMPING * normal.diagonal(dim1=-2, dim2=-1) + 1e-12)
        step = torch.linalg.solve_ex(damped, gradient[..., None]).result.squeeze(-1)[:, :_NONLINEAR]
        step = step.nan_to_num(nan=0.0).clamp(-_MOST_MOVE, _MOST_MOVE) * (step_number >= _HOLD)
        step[:, 5] = step[:, 5].clamp(-0.1, 0.1)
        theta = theta + step
        ratio, sigma = theta[:, 5:6].clamp(0.05, 0.97), theta[:, 6:7].clamp(0.3, 6.0)
        theta = torch.cat([theta[:, :5], ratio, sigma, theta[:, 7:]], -1)

    pixels = segment_sum(weight, index, count)  # the last weights are 0 or 1
    variance = segment_sum(weight * residual.square(), index, count) / (pixels - _NONLINEAR - 4).clamp_min(1)
    mean = segment_mean(grey, index, count, weight)
    total = segment_sum(weight * (grey - mean[index]).square(), index, count) / pixels
    inverse, info = torch.linalg.inv_ex(normal)
    covariance = inverse[:, :_NONLINEAR, :_NONLINEAR] * variance[:, None, None]
    params, shape_ok = _ellipses(theta)
    good = (
        shape_ok
        & whole
        & (pixels > _LEAST_KEPT * torch.bincount(index, minlength=count))
        & (info == 0)
        & covariance.isfinite().all(-1).all(-1)
        & (variance < (1 - _LEAST_EXPLAINED) * total)
        & (linear[:, 3] * polarity < 0)
        & (theta[:, 5] > _RATIO_RANGE[0])
        & (theta[:, 5] < _RATIO_RANGE[1])
        & (covariance[:, 5, 5].sqrt() < _RATIO_SIGMA * theta[:, 5])
        & (torch.linalg.vector_norm(params[:, :2] - outer[:, :2], dim=-1) < 0.3 * outer[:, 3] + 1)
    )
    to_axes = _to_axes(params)
    outer_jacobian = torch.zeros(count, 5, _NONLINEAR, dtype=torch.float64, device=frames.device)
    outer_jacobian[:, :2, :2] = torch.eye(2, dtype=torch.float64, device=frames.device)
    outer_jacobian[:, 2:, 2:5] = to_axes
    inner_jacobian = outer_jacobian.clone()
    inner_jacobian[:, :2, 7:] = inner_jacobian[:, :2, :2]
    inner_jacobian[:, 2:, 2:5] *= theta[:, 5, None, None]
    inner_jacobian[:, 2, 5], inner_jacobian[:, 4, 5] = params[:, 2], params[:, 3]
    inner = torch.cat([params[:, :2] + theta[:, 7:], params[:, 2:4] * theta[:, 5:6], params[:, 4:]], -1)
    # both circles tell the same shape and nearly the same centre: as independent ones each has twice the variance
    fits = [
        EllipseFit(p, 2 * j @ covariance @ j.mT, variance.sqrt(), pixels)
        for p, j in ((params, outer_jacobian), (inner, inner_jacobian))
    ]
    return SmallRings(fits[0], fits[1], good)


def _windows(frames: Tensor, frame: Tensor, outer: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels within the margin of each ring: ring (P,), position (P, 2), grey value (P,) float64.

    Also whether all of them are on the frame (K,) bool: what the border cuts off leaves the shape open.
    """
    height, width = frames.shape[-2:]
    half = outer[:, 2].ceil().long() + _MARGIN
    side = 2 * half + 1
    index, position = ragged_arange(side.square())
    corner = outer[:, :2].round().long() - half[:, None]
    u, v = corner[index, 0] + position % side[index], corner[index, 1] + position // side[index]
    xy = torch.stack([u, v], -1).double()
    theta = torch.cat([outer[:, :2], conics.shape_matrix(outer).flatten(1)[:, [0, 1, 3]]], -1)
    near = _depth(theta, index, xy).depth > -_MARGIN
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    cut = segment_sum((near & ~seen).double(), index, frame.numel()) > 0
    keep = near & seen
    index, xy, u, v = index[keep], xy[keep], u[keep], v[keep]
    return index, xy, frames.reshape(-1)[(frame[index] * height + v) * width + u].double(), ~cut


class _Depth(NamedTuple):
    """Of pixels (P,) in an ellipse: first-order distance inside, unit normal, S^-1 (x - c), curvature."""

    depth: Tensor
    nx: Tensor
    ny: Tensor
    u: Tensor
    v: Tensor
    length: Tensor
    curvature: Tensor


def _depth(theta: Tensor, index: Tensor, xy: Tensor, inner: bool = False) -> _Depth:
    cx, cy, s11, s12, s22 = theta[:, :5].unbind(-1)
    if inner:
        cx, cy = cx + theta[:, 7], cy + theta[:, 8]
    det = s11 * s22 - s12 * s12
    i11, i12, i22 = (s22 / det)[index], (-s12 / det)[index], (s11 / det)[index]
    dx, dy = xy[:, 0] - cx[index], xy[:, 1] - cy[index]
    u, v = i11 * dx + i12 * dy, i12 * dx + i22 * dy
    rho = torch.hypot(u, v).clamp_min(1e-6)
    gx, gy = (i11 * u + i12 * v) / rho, (i12 * u + i22 * v) / rho
    length = torch.hypot(gx, gy).clamp_min(1e-9)
    scale = theta[index, 5] if inner else 1.0
    curvature = 1 / (length**3 * det[index].square() * scale).clamp_min(1e-9)
    return _Depth((scale - rho) / length, gx / length, gy / length, u, v, length, curvature)


def _coverage(theta: Tensor, index: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """E(1) - E(q) at every pixel (P,), and its derivatives (P, 9) to first order in the distance."""
    sigma = theta[index, 6]
    value, columns = [], []
    for inner in (False, True):
        d = _depth(theta, index, xy, inner)
        # blur draws the edge of a disc of curvature k inwards by sigma^2 k / 2
        at = d.depth / sigma - 0.5 * sigma * d.curvature
        value.append(torch.special.ndtr(at))
        slope = torch.exp(-0.5 * at.square()) / math.sqrt(2 * math.pi)
        by_d = slope / sigma
        none = torch.zeros_like(by_d)
        by_center = (by_d * d.nx, by_d * d.ny)
        by_shape = (by_d * d.nx * d.u, by_d * (d.nx * d.v + d.ny * d.u), by_d * d.ny * d.v)
        by_ratio = by_d / d.length if inner else none
        by_sigma = -slope * (d.depth / sigma.square() + 0.5 * d.curvature)
        own = by_center if inner else (none, none)
        columns.append(torch.stack([*by_center, *by_shape, by_ratio, by_sigma, *own], -1))
    return value[0] - value[1], columns[0] - columns[1]


def _weights(deviation: Tensor, keep: bool) -> Tensor:
    """Weights (P,) of residuals in standard deviations: Geman-McClure's, or with ``keep`` 1 within the cut, else 0."""
    if keep:
        return (deviation.abs() < _CUT).to(deviation)
    return (1 + (deviation / _SOFT).square()).reciprocal().square().nan_to_num(nan=0.0)


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


def _solve(basis: Tensor, grey: Tensor, index: Tensor, count: int, weight: Tensor) -> Tensor:
    """Weighted least-squares coefficients (count, C) of grey values on a basis (P, C)."""
    c = basis.shape[1]
    weighted = basis * weight[:, None]
    gram = segment_sum((weighted[:, :, None] * basis[:, None]).flatten(1), index, count).unflatten(1, (c, c))
    right = segment_sum(weighted * grey[:, None], index, count)
    return torch.linalg.solve_ex(gram, right[..., None]).result.squeeze(-1).nan_to_num(nan=0.0)


def _ellipses(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Ellipses (K, 5) of centre and shape parameters, and whether the shape is one."""
    s11, s12, s22 = theta[:, 2], theta[:, 3], theta[:, 4]
    mean, diff = 0.5 * (s11 + s22), torch.hypot(0.5 * (s11 - s22), s12)
    angle = torch.remainder(0.5 * torch.atan2(2 * s12, s11 - s22), torch.pi)
    params = torch.stack([theta[:, 0], theta[:, 1], mean + diff, mean - diff, angle], -1)
    return params, params.isfinite().all(-1) & (mean > diff)


def _to_axes(ellipses: Tensor) -> Tensor:
    """Matrices (K, 3, 3) that turn a change (s11, s12, s22) of the shape into (e11, e12, e22) of its own axes."""
    c, s = ellipses[:, 4].cos(), ellipses[:, 4].sin()
    rows = [c * c, 2 * c * s, s * s, -c * s, c * c - s * s, c * s, s * s, -2 * c * s, c * c]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
