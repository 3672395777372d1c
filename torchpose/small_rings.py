"""Rings too small for separate edges: both circles, blur and grey levels fitted to the grey values at once.

Where the two circles are closer than an edge mask, or the inner one fits into the mask, each edge bends the other's
measurement. The whole ring as one model has no such limit:

    I = paper + slope . x + contrast (E(1) - E(q)),   E(s) = Phi(d_s / sigma - sigma k_s / 2),

d_s the first-order distance inside the ellipse scaled by s, k_s its curvature, Phi the normal distribution, q the ratio
of the radii. The circles share centre and shape; perspective parts their centres by a few hundredths of a pixel at most
at these sizes, which the refinement of the pose on the grey values makes good.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, segment_mean, segment_sum

_MARGIN = 3  # px around the outer ellipse
_ITERATIONS = 10
_DAMPING = 1e-3
_STEP = 1e-4  # of the numerical derivatives, px
_MOST_MOVE = 0.7  # px of an iteration
_START_SIGMA = 0.8  # px
_LEAST_EXPLAINED = 0.75  # of the variance of grey around the ring
_RATIO_RANGE = (0.12, 0.93)  # beyond it, a plain disc or its rim
_RATIO_SIGMA = 0.1  # of the ratio: an inner circle that is not sure is none
_SHAPE = 5  # parameters of centre and shape; then ratio and blur, then the four grey ones


@dataclass(frozen=True, eq=False)
class SmallRings:
    """K fitted rings: both circles in raw pixels, and whether the model explains what is seen (K,) bool."""

    outer: EllipseFit
    inner: EllipseFit
    good: Tensor


def fit_small_rings(frames: Tensor, frame: Tensor, outer: Tensor, ratio: Tensor, polarity: Tensor) -> SmallRings:
    """Fits the model above by damped Gauss-Newton from rough rings.

    Args:
        frames: (B, H, W) grey, any real dtype. frame: (K,) int64. outer: (K, 5) rough outer ellipses, px.
        ratio: (K,) rough ratio of the radii. polarity: (K,) +1 for a dark ring.
    """
    count = frame.numel()
    index, xy, grey, whole = _windows(frames, frame, outer)
    shape = conics.shape_matrix(outer)
    start = [outer[:, :2], shape[:, 0, :1], shape[:, 0, 1:], shape[:, 1, 1:], ratio[:, None]]
    theta = torch.cat([*start, torch.full_like(ratio, _START_SIGMA)[:, None]], -1)
    origin = outer[:, :2]
    local = (xy - origin[index]) / outer[index, 2:3]
    eye = torch.eye(11, dtype=torch.float64, device=frames.device)
    linear = theta.new_zeros(count, 4)
    normal = eye.expand(count, -1, -1)
    residual = grey
    for _ in range(_ITERATIONS):
        value = _coverage(theta, index, xy)
        derivative = torch.stack([_slope(theta, index, xy, k) for k in range(7)], -1)
        basis = torch.cat([torch.ones_like(local[:, :1]), local, value[:, None]], -1)
        # grey levels first, so that the derivatives have their contrast
        linear = _solve(basis, grey, index, count)
        residual = grey - (basis * linear[index]).sum(-1)
        jacobian = torch.cat([derivative * linear[index, 3:], basis], -1)
        normal = segment_sum((jacobian[:, :, None] * jacobian[:, None]).flatten(1), index, count).unflatten(1, (11, 11))
        gradient = segment_sum(jacobian * residual[:, None], index, count)
        damped = normal + torch.diag_embed(_DAMPING * normal.diagonal(dim1=-2, dim2=-1) + 1e-12)
        step = torch.linalg.solve_ex(damped, gradient[..., None]).result.squeeze(-1)[:, :7]
        step = step.nan_to_num(nan=0.0).clamp(-_MOST_MOVE, _MOST_MOVE)
        step[:, 5] = step[:, 5].clamp(-0.1, 0.1)
        theta = theta + step
        theta = torch.cat([theta[:, :5], theta[:, 5:6].clamp(0.05, 0.97), theta[:, 6:].clamp(0.3, 6.0)], -1)

    pixels = torch.bincount(index, minlength=count).double()
    variance = segment_sum(residual.square(), index, count) / (pixels - 11).clamp_min(1)
    mean = segment_mean(grey, index, count)
    total = segment_sum((grey - mean[index]).square(), index, count) / pixels
    inverse, info = torch.linalg.inv_ex(normal)
    covariance = inverse[:, :7, :7] * variance[:, None, None]
    params, shape_ok = _ellipses(theta)
    good = (
        shape_ok
        & whole
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
    outer_jacobian = torch.zeros(count, 5, 7, dtype=torch.float64, device=frames.device)
    outer_jacobian[:, :2, :2] = torch.eye(2, dtype=torch.float64, device=frames.device)
    outer_jacobian[:, 2:, 2:5] = to_axes
    inner_jacobian = outer_jacobian.clone()
    inner_jacobian[:, 2:, 2:5] *= theta[:, 5, None, None]
    inner_jacobian[:, 2, 5], inner_jacobian[:, 4, 5] = params[:, 2], params[:, 3]
    inner = torch.cat([params[:, :2], params[:, 2:4] * theta[:, 5:6], params[:, 4:]], -1)
    # both circles tell the same centre and shape: as independent measurements each has twice the variance
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
    near = _depth(theta, index, xy, None)[0] > -_MARGIN
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    cut = segment_sum((near & ~seen).double(), index, frame.numel()) > 0
    keep = near & seen
    index, xy, u, v = index[keep], xy[keep], u[keep], v[keep]
    return index, xy, frames.reshape(-1)[(frame[index] * height + v) * width + u].double(), ~cut


def _depth(theta: Tensor, index: Tensor, xy: Tensor, scale: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """First-order distance (P,) inside the ellipse scaled by ``scale`` (K,), slope (P,) of the elliptic radius, a b."""
    cx, cy, s11, s12, s22 = theta[:, :_SHAPE].unbind(-1)
    det = s11 * s22 - s12 * s12
    i11, i12, i22 = (s22 / det)[index], (-s12 / det)[index], (s11 / det)[index]
    dx, dy = xy[:, 0] - cx[index], xy[:, 1] - cy[index]
    u, v = i11 * dx + i12 * dy, i12 * dx + i22 * dy
    rho = torch.hypot(u, v).clamp_min(1e-6)
    length = torch.hypot(i11 * u + i12 * v, i12 * u + i22 * v) / rho
    return ((1.0 if scale is None else scale[index]) - rho) / length.clamp_min(1e-9), length, det[index]


def _coverage(theta: Tensor, index: Tensor, xy: Tensor) -> Tensor:
    """E(1) - E(q) at every pixel (P,)."""
    sigma = theta[index, 6]
    depth, length, area = _depth(theta, index, xy, None)
    inner_depth, _, _ = _depth(theta, index, xy, theta[:, 5])
    # blur draws the edge of a disc of curvature k inwards by sigma^2 k / 2
    drawn = 0.5 * sigma / (length**3 * area.square()).clamp_min(1e-9)
    outer = torch.special.ndtr(depth / sigma - drawn)
    return outer - torch.special.ndtr(inner_depth / sigma - drawn / theta[index, 5])


def _slope(theta: Tensor, index: Tensor, xy: Tensor, k: int) -> Tensor:
    """Central difference of the coverage by parameter ``k``."""
    step = torch.zeros_like(theta)
    step[:, k] = _STEP
    return (_coverage(theta + step, index, xy) - _coverage(theta - step, index, xy)) / (2 * _STEP)


def _solve(basis: Tensor, grey: Tensor, index: Tensor, count: int) -> Tensor:
    """Least-squares coefficients (count, C) of grey values on a basis (P, C)."""
    c = basis.shape[1]
    gram = segment_sum((basis[:, :, None] * basis[:, None]).flatten(1), index, count).unflatten(1, (c, c))
    right = segment_sum(basis * grey[:, None], index, count)
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
