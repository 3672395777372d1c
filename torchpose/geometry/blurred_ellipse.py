"""Indicator of an ellipse under a blur, exact for any ratio of blur to size, with derivatives.

By the divergence theorem it is an integral along the boundary. With r from the point to the boundary, the blur's
covariance S, m = r' S^-1 r and the share M(m) of the blur within m,

    E = closed integral of M(m) / (2 pi m sqrt(det S)) (r . n) dl

(the divergence of the radial field in front is the blur, k(r) = M'(m) / (pi sqrt(det S))). A parameter that moves the
boundary by v changes E by the integral of k(r) times (v . n) dl; a change of S stretches the blur, which is as if the
boundary moved by v = -dS S^-1 r / 2. All integrands are periodic and as smooth as the blur, so the trapezoidal rule
converges faster than any power of its step (Trefethen, Weideman, SIAM Review 56, 2014).
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

# standard deviations of the blur from node to node: values err by 1e-5, derivatives by a thousandth of their largest
# (measured against 400 nodes, axes' ratios down to a third)
_STEP = 1.25
# m at the rim of a disc, and how far it is soft: 0.28 deviations, as by 0.7 px of lens and pixel at a disc of 5 px
_RIM, _SOFTNESS = 3.66, 0.6


Profile = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Of a blur, from m (...), which it may overwrite: -M(m), see above, and 2 M'(m), 1 at m = 0 for a Gaussian."""


def gaussian(square: Tensor) -> tuple[Tensor, Tensor]:
    """Of a Gaussian: M = 1 - exp(-m / 2)."""
    less = (-0.5 * square).expm1_()
    return less, less + 1


def disc(square: Tensor) -> tuple[Tensor, Tensor]:
    """Of a disc with a soft rim: M' falls as a logistic function of m, and m has the mean 2 that is a Gaussian's."""
    begin = math.log1p(math.exp(-_RIM / _SOFTNESS))
    whole = _RIM + _SOFTNESS * begin
    beyond = (square - _RIM) / _SOFTNESS
    within = square - _SOFTNESS * (torch.nn.functional.softplus(beyond) - begin)
    return within.div_(-whole), beyond.neg_().sigmoid_().mul_(2 / whole)


def nodes_of_each(semi_major: Float[Tensor, " K"], sigma: Float[Tensor, " K"]) -> Float[Tensor, " K"]:
    """Number of nodes for ellipses with these semi-major axes and (least) blurs."""
    # equal steps of the eccentric anomaly are longest at the ends of the minor axis
    return (2 * math.pi / _STEP * semi_major / sigma).ceil().clamp_min(8)


def nodes_needed(semi_major: Float[Tensor, " K"], sigma: Float[Tensor, " K"]) -> int:
    """The same for the most demanding of them."""
    return int(nodes_of_each(semi_major, sigma).max())


def blurred_ellipse(
    xy: Float[Tensor, "K P 2"],
    center: Float[Tensor, "K 2"],
    shape: Float[Tensor, "K 2 2"],
    scale: Float[Tensor, " K"],
    blur: Float[Tensor, "K 3"],
    nodes: int,
    profile: Profile = gaussian,
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P 9"]]:
    """Blurred indicators, in [0, 1], of K ellipses at P points each, and their derivatives.

    Args:
        shape: symmetric, see `conics.shape_matrix`.
        scale: factor on the shape.
        blur: covariance s11, s12, s22.
        nodes: of the trapezoidal rule, see `nodes_needed`; a disc with its rim is then right to 0.015.
        profile: of the blur.

    Returns:
        Values, and derivatives by centre (2), shape s11, s12, s22, scale and blur (3).
    """
    angle = torch.arange(nodes, dtype=xy.dtype, device=xy.device) * (2 * math.pi / nodes)
    unit = torch.stack([angle.cos(), angle.sin()])  # (2, M)
    turn = torch.stack([-unit[1], unit[0]]) * (2 * math.pi / nodes)
    rim = scale[:, None, None] * (shape @ unit)  # (K, 2, M), from the centre
    tangent = scale[:, None, None] * (shape @ turn)
    nx, ny = tangent[:, 1], -tangent[:, 0]  # outward, times the length of a step
    bx, by = rim.unbind(1)
    outward = bx * nx + by * ny
    s11, s12, s22 = blur.unbind(-1)
    area = (s11 * s22 - s12 * s12)[:, None]
    inverse = torch.stack([s22, -s12, -s12, s11], -1).unflatten(-1, (2, 2)) / area[..., None]
    from_center = xy - center[:, None]
    weighted = from_center @ inverse
    square = torch.baddbmm(((inverse @ rim) * rim).sum(1)[:, None], weighted, rim, alpha=-2)
    square = square.add_((weighted * from_center).sum(-1, keepdim=True)).clamp_min_(1e-9)
    (ex, ey), q = unit, scale[:, None]
    moves = [nx, ny, q * ex * nx, q * (ey * nx + ex * ny), q * ey * ny, outward / q]
    columns = torch.stack([*moves, bx * nx, by * nx, bx * ny, by * ny, outward], -1)
    norm = 2 * math.pi * area.sqrt()[..., None]
    within, density = profile(square)
    flux = within.div_(square) @ columns[..., (0, 1, 10)] / -norm  # (K, P, 3)
    by_motion = density @ columns[..., :10] / norm  # (K, P, 10)
    value = flux[..., 2] - (from_center * flux[..., :2]).sum(-1)
    # integrals of (boundary - point)_k n_i times the density; by the inverse of the blur what a stretch moves
    x, y = from_center.unbind(-1)
    along, across = by_motion[..., 0], by_motion[..., 1]
    xx, yx, xy_, yy = by_motion[..., 6:].unbind(-1)
    xx, yx, xy_, yy = xx - x * along, yx - y * along, xy_ - x * across, yy - y * across
    i11, i12, i22 = (inverse[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    by_blur = [-0.5 * (i11 * xx + i12 * yx), -(i12 * xx + i22 * yx), -0.5 * (i12 * xy_ + i22 * yy)]
    return value, torch.cat([by_motion[..., :6], torch.stack(by_blur, -1)], -1)
