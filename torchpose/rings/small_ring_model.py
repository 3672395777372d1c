"""What a small ring looks like: E(1) - E(q) of `small_rings`, as an exact integral and to first order.

Parameters theta (K, 9) of a ring: centre of the outer ellipse, its shape matrix s11, s12, s22, ratio q of radii, blur,
and the inner centre from the outer one.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.blurred_ellipse import blurred_ellipse, nodes_needed

MOST_NODES = 120  # of the exact integral: enough for a semi-major axis of 19 blurs


def outer_ellipses(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Ellipses (K, 5) of centre and shape parameters, and whether the shape is one."""
    s11, s12, s22 = theta[:, 2], theta[:, 3], theta[:, 4]
    mean, diff = 0.5 * (s11 + s22), torch.hypot(0.5 * (s11 - s22), s12)
    angle = torch.remainder(0.5 * torch.atan2(2 * s12, s11 - s22), torch.pi)
    params = torch.stack([theta[:, 0], theta[:, 1], mean + diff, mean - diff, angle], -1)
    return params, params.isfinite().all(-1) & (mean > diff)


class Depth(NamedTuple):
    """Of pixels (P,) in an ellipse: first-order distance inside, unit normal, S^-1 (x - c), curvature."""

    depth: Tensor
    nx: Tensor
    ny: Tensor
    u: Tensor
    v: Tensor
    length: Tensor
    curvature: Tensor


def depth(theta: Tensor, index: Tensor, xy: Tensor, inner: bool = False) -> Depth:
    """Depths of pixels (P, 2) in the outer ellipses, or the inner ones, of their rings ``index`` (P,)."""
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
    return Depth((scale - rho) / length, gx / length, gy / length, u, v, length, curvature)


def exact(theta: Tensor, index: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """E(1) - E(q) at every pixel (P,), sorted by ring, and its derivatives (P, 9)."""
    count = theta.shape[0]
    size = torch.bincount(index, minlength=count)
    position = torch.arange(index.numel(), device=index.device) - (size.cumsum(0) - size)[index]
    near = xy - theta[index, :2]
    padded = near.new_zeros(count, int(size.max()), 2).index_put((index, position), near)
    ellipses, (ratio, sigma) = outer_ellipses(theta)[0], theta[:, 5:7].unbind(-1)
    shape, parted = theta[:, (2, 3, 3, 4)].unflatten(-1, (2, 2)), theta[:, 7:9]

    def blurred(center: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        nodes = min(nodes_needed(ellipses[:, 2] * scale, sigma), MOST_NODES)
        return blurred_ellipse(padded, center, shape, scale, sigma, nodes)

    outer, by_outer = blurred(torch.zeros_like(parted), torch.ones_like(ratio))
    inner, by_inner = blurred(parted, ratio)
    none = torch.zeros_like(by_outer[..., :1])
    derivative = torch.cat([by_outer[..., :5], none, by_outer[..., 6:], none, none], -1)
    derivative = derivative - torch.cat([by_inner, by_inner[..., :2]], -1)
    return (outer - inner)[index, position], derivative[index, position]


def first_order(theta: Tensor, index: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """The same to first order in the distance."""
    sigma = theta[index, 6]
    value, columns = [], []
    for inner in (False, True):
        d = depth(theta, index, xy, inner)
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
