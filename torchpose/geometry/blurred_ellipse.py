"""Indicator of an ellipse under a Gaussian blur, exact for any ratio of blur to size, with derivatives.

By the divergence theorem it is an integral along the boundary, with r from the point to the boundary:

    E = closed integral of (1 - exp(-r^2 / 2 sigma^2)) / (2 pi r^2) (r . n) dl

(the divergence of the radial field in front is the Gaussian). A parameter that moves the boundary by v changes E by
the integral of the Gaussian of r times (v . n) dl. Both integrands are periodic and as smooth as the blur, so the
trapezoidal rule converges faster than any power of its step (Trefethen, Weideman, SIAM Review 56, 2014).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_STEP = 1.0  # standard deviations of the blur from node to node: an error below 1e-8


def nodes_needed(semi_major: Float[Tensor, " K"], sigma: Float[Tensor, " K"]) -> int:
    """Number of nodes for the most demanding of K ellipses with these semi-major axes and blurs."""
    # equal steps of the eccentric anomaly are longest at the ends of the minor axis
    return max(8, int((2 * math.pi / _STEP * semi_major / sigma).max().ceil()))


def blurred_ellipse(
    xy: Float[Tensor, "K P 2"],
    center: Float[Tensor, "K 2"],
    shape: Float[Tensor, "K 2 2"],
    scale: Float[Tensor, " K"],
    sigma: Float[Tensor, " K"],
    nodes: int,
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P 7"]]:
    """Blurred indicators, in [0, 1], of K ellipses at P points each, and their derivatives.

    Args:
        shape: symmetric, see `conics.shape_matrix`.
        scale: factor on the shape.
        sigma: standard deviation of the blur.
        nodes: of the trapezoidal rule, see `nodes_needed`.

    Returns:
        Values, and derivatives by centre (2), shape s11, s12, s22, scale and sigma.
    """
    angle = torch.arange(nodes, dtype=xy.dtype, device=xy.device) * (2 * math.pi / nodes)
    unit = torch.stack([angle.cos(), angle.sin()])  # (2, M)
    turn = torch.stack([-unit[1], unit[0]]) * (2 * math.pi / nodes)
    rim = scale[:, None, None] * (shape @ unit)  # (K, 2, M), from the centre
    tangent = scale[:, None, None] * (shape @ turn)
    nx, ny = tangent[:, 1], -tangent[:, 0]  # outward, times the length of a step
    outward = rim[:, 0] * nx + rim[:, 1] * ny
    from_center = xy - center[:, None]
    square = torch.baddbmm(rim.square().sum(1)[:, None], from_center, rim, alpha=-2)
    square = square.add_(from_center.square().sum(-1, keepdim=True)).clamp_min_(1e-6)
    (ex, ey), q = unit, scale[:, None]
    columns = torch.stack([nx, ny, q * ex * nx, q * (ey * nx + ex * ny), q * ey * ny, outward / q, outward], -1)
    variance = sigma.square()[:, None, None]
    fall = (square * (-0.5 / variance)).expm1_()  # the Gaussian, less one
    flux = (fall / square) @ columns[..., (0, 1, 6)] / (-2 * math.pi)  # (K, P, 3)
    by_motion = fall.add_(1) @ columns / (2 * math.pi * variance)  # (K, P, 7)
    value = flux[..., 2] - (from_center * flux[..., :2]).sum(-1)
    by_sigma = ((from_center * by_motion[..., :2]).sum(-1) - by_motion[..., 6]) / sigma[:, None]
    return value, torch.cat([by_motion[..., :6], by_sigma[..., None]], -1)
