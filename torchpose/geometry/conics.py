"""Ellipses and conics: conversions, circles under perspective. Batched over leading dimensions.

An ellipse is (cx, cy, a, b, theta): centre, semi-axes a >= b, angle of the major axis in [0, pi) from +u towards +v.
A conic is the coefficient vector (A, B, C, D, E, F) of A x^2 + B xy + C y^2 + D x + E y + F = 0, or its symmetric
(3, 3) matrix.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry.constants import either

Ellipse = Float[Tensor, "*#N 5"]
Conic = Float[Tensor, "*#N 6"]
Matrix = Float[Tensor, "*#N 3 3"]
Vector = Float[Tensor, "*#N 3"]
Scalar = Float[Tensor, "*#N"]


def to_matrix(conic: Conic) -> Matrix:
    """Symmetric matrices of conic coefficients."""
    a, b, c, d, e, f = conic.unbind(-1)
    b, d, e = b / 2, d / 2, e / 2
    return torch.stack([a, b, d, b, c, e, d, e, f], -1).unflatten(-1, (3, 3))


def from_matrix(matrix: Matrix) -> Conic:
    """Conic coefficients of symmetric matrices."""
    a, b, d, _, c, e, *_, f = matrix.flatten(-2).unbind(-1)
    return torch.stack([a, 2 * b, c, 2 * d, 2 * e, f], -1)


def ellipse_from_conic(conic: Conic) -> Ellipse:
    """Ellipses of conic coefficients; NaN where the conic is no real ellipse."""
    # the sign of the inside; the conic is taken so that this is negative
    a, b, c, d, e, f = (conic * (conic[..., :1] + conic[..., 2:3]).sign()).unbind(-1)
    half, square = 2 * a, 2 * c
    disc = torch.addcmul(half * square, b, b, value=-1)
    center_x = torch.addcmul(b * e, square, d, value=-1) / disc
    center_y = torch.addcmul(b * d, half, e, value=-1) / disc
    level = -torch.add(f, torch.addcmul(d * center_x, e, center_y), alpha=0.5)  # less its value at the centre
    # the smaller eigenvalue as a quotient: mean - diff cancels for slender ellipses; rounding must not exchange a and b
    large = 0.5 * (a + c + torch.hypot(a - c, b))
    small = torch.minimum(0.25 * disc / large, large)
    theta = torch.remainder(0.5 * torch.atan2(-b, c - a), torch.pi)
    # remainder may round a tiny negative angle up to pi itself
    theta = theta.masked_fill(theta >= torch.pi, 0.0)
    axes = (level / torch.stack([small, large])).sqrt()
    ellipse = torch.stack([center_x, center_y, *axes, theta], -1)
    valid = (disc > 0) & (level > 0) & ((0 * ellipse).sum(-1) == 0)
    return ellipse.masked_fill(~valid[..., None], torch.nan)


def axes_of(square: Float[Tensor, "*N 2 2"]) -> Float[Tensor, "*N 3"]:
    """Semi-axes and angle a, b, theta of ellipses by the square S S^T of their `shape_matrix`, positive definite."""
    s11, s12, _, s22 = square.flatten(-2).unbind(-1)
    twice, apart = 2 * s12, s11 - s22
    large = 0.5 * (s11 + s22 + torch.hypot(apart, twice))
    small = torch.addcmul(s11 * s22, s12, s12, value=-1) / large  # a difference would cancel for slender ones
    theta = torch.remainder(0.5 * torch.atan2(twice, apart), torch.pi)
    theta = theta.masked_fill(theta >= torch.pi, 0.0)  # a tiny negative angle is rounded up to pi
    return torch.stack([large.sqrt(), small.minimum(large).sqrt(), theta], -1)


def conic_from_ellipse(ellipse: Ellipse) -> Conic:
    """Conic coefficients, negative inside, of ellipses; scaled to -1 at the centre."""
    center, square = ellipse[..., :2], inverse_shape(ellipse, 2)
    p, r, _, q = square.flatten(-2).unbind(-1)
    linear = (square * center[..., None, :]).sum(-1)
    d, e = (-2 * linear).unbind(-1)
    return torch.stack([p, 2 * r, q, d, e, (linear * center).sum(-1) - 1], -1)


def rescaled(ellipses: Float[Tensor, "*batch 5"], factor: float) -> Float[Tensor, "*batch 5"]:
    """Ellipses of frames reduced by ``factor`` in the pixels of the frames themselves; the inverse by 1 / factor."""
    center = factor * ellipses[..., :2] + 0.5 * (factor - 1)
    return torch.cat([center, factor * ellipses[..., 2:4], ellipses[..., 4:]], -1)


def shape_matrix(ellipse: Ellipse) -> Float[Tensor, "*N 2 2"]:
    """Symmetric S = R diag(a, b) R^T: the ellipse is centre + S (cos s, sin s). Smooth also at a circle."""
    return _symmetric(*ellipse[..., 2:].unbind(-1))


def inverse_shape(ellipse: Ellipse, power: int = 1) -> Float[Tensor, "*N 2 2"]:
    """Inverse of `shape_matrix`, or a power of it."""
    a, b, theta = ellipse[..., 2:].unbind(-1)
    return _symmetric(a.pow(-power), b.pow(-power), theta)


def _symmetric(one: Tensor, other: Tensor, angle: Tensor) -> Tensor:
    """Symmetric matrices (..., 2, 2) of these eigenvalues, the first one's vector at an angle."""
    middle, twice = torch.lerp(one, other, 0.5), 2 * angle
    lean = one - middle
    c, s = lean * twice.cos(), lean * twice.sin()
    return torch.stack([middle + c, s, s, middle - c], -1).view(*angle.shape, 2, 2)


def points_on(ellipse: Ellipse, angle: Scalar) -> Float[Tensor, "*N 2"]:
    """Points of ellipses at eccentric anomaly ``angle``, counted from the major axis."""
    cx, cy, a, b, theta = ellipse.unbind(-1)
    x, y = a * angle.cos(), b * angle.sin()
    cos, sin = theta.cos(), theta.sin()
    return torch.stack([cx + cos * x - sin * y, cy + sin * x + cos * y], -1)


def boundary(
    ellipses: Float[Tensor, "M 5"], index: Int[Tensor, " S"], angle: Float[Tensor, " S"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points x, y of ellipses and the outward unit normals nx, ny there, (S,) each.

    Args:
        ellipses: of which samples are wanted.
        index: whose sample each is.
        angle: eccentric anomaly, counted from the major axis.
    """
    theta = ellipses[:, 4:]
    each = torch.cat([ellipses[:, :4], theta.cos(), theta.sin()], 1)
    cx, cy, a, b, cos, sin = each.index_select(0, index).unbind(1)
    c, s = angle.cos(), angle.sin()
    x, y, p, q = a * c, b * s, b * c, a * s
    scale = (p * p + q * q).rsqrt()
    p, q = p * scale, q * scale
    return cx + cos * x - sin * y, cy + sin * x + cos * y, cos * p - sin * q, sin * p + cos * q


def signed_distance(conic: Sequence[Tensor], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First-order (Sampson's) distances (...) of points outside conics, and unit normals nx, ny outwards.

    The conic is given by its six coefficients (...), negative inside. The normals are those of the conic of the same
    centre and proportions through each point.
    """
    a, b, c, d, e, f = conic
    px, py = 2 * a * x + b * y + d, b * x + 2 * c * y + e
    steep = torch.sqrt(px * px + py * py)
    value = 0.5 * ((px + d) * x + (py + e) * y) + f
    return value / steep, px / steep, py / steep


def perimeter(ellipse: Ellipse) -> Scalar:
    """Perimeters of ellipses (Ramanujan's second formula; relative error below 4e-4 at b/a = 0.1)."""
    a, b = ellipse[..., 2], ellipse[..., 3]
    h = ((a - b) / (a + b)).square()
    return torch.pi * (a + b) * (1 + 3 * h / (10 + (4 - 3 * h).sqrt()))


def circle_image(rotation: Matrix, center: Vector, normal: Vector, radius: Scalar) -> Matrix:
    """Image conic matrix on the normalised plane of a circle in space.

    Q = H^-T diag(1, 1, -r^2) H^-1 with H = [e1 e2 c], written without the inverse through the adjugate of H.

    Args:
        rotation: target to camera.
        center: in the camera frame.
        normal: of unit length, in the target frame.
        radius: in the unit of the centre.
    """
    n = (rotation @ normal[..., None]).squeeze(-1)
    # any unit vector not near n starts the in-plane basis
    axis = torch.nn.functional.one_hot(n.abs().argmin(-1), 3).to(n.dtype)
    e1 = torch.linalg.cross(n, axis)
    e1 = e1 / torch.linalg.vector_norm(e1, dim=-1, keepdim=True)
    e2 = torch.linalg.cross(n, e1)
    adj = torch.stack([torch.linalg.cross(e2, center), torch.linalg.cross(center, e1), torch.linalg.cross(e1, e2)], -2)
    weight = torch.stack([torch.ones_like(radius), torch.ones_like(radius), -radius.square()], -1)
    return adj.mT @ (weight[..., None] * adj)


def circle_ellipse(
    matrix: Float[Tensor, "3 3"], rotation: Matrix, center: Vector, normal: Vector, radius: Scalar
) -> Ellipse:
    """Ellipses in px of circles seen by a pinhole of this matrix; the rest as for `circle_image`.

    By their dual conics, r^2 (1 - n n') - c c' in space, about the image of the centre (derived). NaN where the circle
    reaches behind the camera.
    """
    return seen_circle(matrix, center, (rotation @ normal[..., None])[..., 0], radius)


def seen_circle(matrix: Float[Tensor, "3 3"], center: Vector, normal: Vector, radius: Scalar) -> Ellipse:
    """`circle_ellipse` of circles whose unit normals are in the camera frame."""
    seen = center @ matrix.mT
    flat, depth = seen.split_with_sizes([2, 1], -1)
    at = flat / depth
    # from space to homogeneous pixels about the image of the centre: the centre itself comes to (0, 0, depth)
    change = matrix - torch.nn.functional.pad(at, (0, 1))[..., None] * matrix[2]
    turned = (change * normal[..., None, :]).sum(-1)
    flat_change = change.reshape(-1, 3, 3)
    dual = torch.bmm(flat_change, flat_change.mT).view_as(change) - turned[..., :, None] * turned[..., None, :]
    dual = radius.square()[..., None, None] * dual
    whole = dual[..., 2, 2, None] - depth.square()  # below 0 in front of the camera
    side = dual[..., :2, 2] / whole
    spread = side[..., :, None] * side[..., None, :] - dual[..., :2, :2] / whole[..., None]
    ellipse = torch.cat([at + side, axes_of(spread)], -1)
    return either(whole < 0, ellipse, torch.nan)


def circle_poses(conic: Matrix, radius: Scalar) -> tuple[Float[Tensor, "*N 2 3"], Float[Tensor, "*N 2 3"]]:
    """Both poses of a circle of known radius from its image (Forsyth et al. 1991, by the cone's eigenvectors).

    From a symmetric matrix on the normalised plane the centres in front of the camera, and unit normals that point away
    from it.
    """
    # orient so that two eigenvalues are positive; eigh sorts ascending: l3 < 0 < l2 <= l1
    det_sign = torch.linalg.det(conic).sign()
    q = -conic * det_sign[..., None, None]
    values, vectors = torch.linalg.eigh(q)
    l3, l2, l1 = values.unbind(-1)
    v3, v1 = vectors[..., :, 0], vectors[..., :, 2]
    v3 = torch.where(v3[..., 2:] < 0, -v3, v3)  # the cone's axis, forwards
    span = l1 - l3
    g, h = ((l1 - l2) / span).clamp_min(0).sqrt(), ((l2 - l3) / span).clamp_min(0).sqrt()
    sign = torch.tensor([1.0, -1.0], dtype=conic.dtype, device=conic.device)[:, None]
    g, h, v1, v3 = g[..., None, None], h[..., None, None], v1[..., None, :], v3[..., None, :]
    normals = sign * g * v1 + h * v3
    # the plane sg x + hz = p cuts the cone l1 x^2 + l2 y^2 + l3 z^2 = 0 in a circle of radius p sqrt(-l1 l3) / l2
    ratio = (-l3 / l1).sqrt()[..., None, None]
    centers = radius[..., None, None] * (h / ratio * v3 - sign * g * ratio * v1)
    return centers, normals
