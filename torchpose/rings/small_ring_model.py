"""What a small ring looks like: E(1) - E(q) of `small_rings`, to first order and as an exact integral.

Parameters (K, 8) of a ring: centre of the outer ellipse, its shape matrix s11, s12, s22, ratio q of radii, and the
inner centre from the outer one. Pixels are padded planes (K, P) x, y, px about any origin of the ring.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import HOLDS, Spread
from torchpose.geometry.blurred_ellipse import Profile, blurred_ellipse, gaussian, nodes_needed

RING = 8  # parameters
MOST_NODES = 120  # of the exact integral: enough for a semi-major axis of 19 blurs


def outer_ellipses(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Ellipses (K, 5) of centre and shape parameters, and whether the shape is one."""
    s11, s12, s22 = theta[:, 2], theta[:, 3], theta[:, 4]
    mean, diff = 0.5 * (s11 + s22), torch.hypot(0.5 * (s11 - s22), s12)
    angle = torch.remainder(0.5 * torch.atan2(2 * s12, s11 - s22), torch.pi)
    params = torch.stack([theta[:, 0], theta[:, 1], mean + diff, mean - diff, angle], -1)
    return params, params.isfinite().all(-1) & (mean > diff)


class Depth(NamedTuple):
    """Of pixels (..., K, P) and an ellipse: first-order distance outside, unit normal, S^-1 (x - c), |grad|, and the
    curvature of the level curve through the pixel."""

    distance: Tensor
    nx: Tensor
    ny: Tensor
    u: Tensor
    v: Tensor
    length: Tensor
    curvature: Tensor


def depth(theta: Tensor, x: Tensor, y: Tensor, scale: Tensor | float = 1.0) -> Depth:
    """Where pixels (K, P) are about ellipses (..., K, 5 at least), grown by a scale (..., K, 1)."""
    cx, cy, s11, s12, s22 = theta[..., :5, None].unbind(-2)
    det = s11 * s22 - s12 * s12
    i11, i12, i22 = s22 / det, -s12 / det, s11 / det
    dx, dy = x - cx, y - cy
    u, v = i11 * dx + i12 * dy, i12 * dx + i22 * dy
    rho = (u * u + v * v).sqrt().clamp_min(1e-6)
    gx, gy = (i11 * u + i12 * v) / rho, (i12 * u + i22 * v) / rho
    length = (gx * gx + gy * gy).sqrt().clamp_min(1e-9)
    distance = (rho - scale) / length
    curvature = 1 / (length.pow(3) * (det.square() * scale)).clamp_min(1e-9)
    curvature = curvature / (1 + curvature * distance).clamp_min(HOLDS)
    return Depth(distance, gx / length, gy / length, u, v, length, curvature)


def first_order(theta: Tensor, spread: Spread, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """E(1) - E(q) (K, P) to first order in the distance, and derivatives (K, 11, P) by theta and the blur; float32."""
    theta, x, y = theta.float(), x.float(), y.float()
    # both circles at once, outer and inner
    ratio = theta[:, 5:6]
    inner = torch.cat([theta[:, :2] + theta[:, 6:8], theta[:, 2:5]], -1)
    d = depth(torch.stack([theta[:, :5], inner]), x, y, torch.stack([torch.ones_like(ratio), ratio]))
    # perspective parts the centres by little: both circles have nearly the same normal at a pixel
    edge = spread.at(torch.arange(len(theta), device=theta.device), d.nx[0], d.ny[0])
    step, by_distance, by_blur = edge(d.distance, d.curvature)
    by_x, by_y = by_distance * d.nx, by_distance * d.ny
    each = torch.stack([by_x, by_y, by_x * d.u, by_x * d.v + by_y * d.u, by_y * d.v, *by_blur], 2)
    # the distance falls where the ellipse grows: E is the inside
    ring, blur = (each[0] - each[1]).split([5, len(by_blur)], 1)
    own = torch.stack([by_distance[1] / d.length[1], by_x[1], by_y[1]], 1)
    return step[1] - step[0], torch.cat([ring, -own, -blur], 1)


def exact(theta: Tensor, spread: Spread, x: Tensor, y: Tensor, profile: Profile = gaussian) -> tuple[Tensor, Tensor]:
    """The same as exact integrals, in float64, of a blur of any profile."""
    xy, blur = torch.stack([x, y], -1), spread.covariance
    ellipses, ratio = outer_ellipses(theta)[0], theta[:, 5]
    shape, least = theta[:, (2, 3, 3, 4)].unflatten(-1, (2, 2)), blurs.axes(blur)[0].sqrt()

    def blurred(center: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        nodes = min(nodes_needed(ellipses[:, 2] * scale, least), MOST_NODES)
        return blurred_ellipse(xy, center, shape, scale, blur, nodes, profile)

    outer, by_outer = blurred(theta[:, :2], torch.ones_like(ratio))
    inner, by_inner = blurred(theta[:, :2] + theta[:, 6:8], ratio)
    by_ring = by_outer[..., :5] - by_inner[..., :5]
    rest = [-by_inner[..., 5:6], -by_inner[..., :2], by_outer[..., 6:] - by_inner[..., 6:]]
    return outer - inner, torch.cat([by_ring, *rest], -1).mT
