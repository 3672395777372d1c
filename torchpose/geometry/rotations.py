"""Rotations and rigid transforms, batched and differentiable, exact to float64 rounding at every angle.

Kornia's conversions have the same digits (tests/geometry/test_rotations.py) but take up to three times as long for few
rotations, of which refinement turns many, and their import would delay the start of every run (docs/kornia.md).
"""

import torch
from torch import Tensor

from torchpose.geometry.constants import constant

# the entries of a cross-product matrix, by the vector's
_SKEW = (
    (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
)


def skew(v: Tensor) -> Tensor:
    """Cross-product matrix [v]x of vectors (..., 3), as (..., 3, 3): ``skew(a) @ b == cross(a, b)``."""
    return (v @ constant(_SKEW, v)).unflatten(-1, (3, 3))


def exp(rotation_vector: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad (Rodrigues).

    Sines and versines are divided through ``sinc``, so value and gradient hold at zero.
    """
    # a tiny constant keeps the gradient of the square root finite at zero without touching the value
    angle = (rotation_vector.square().sum(-1) + torch.finfo(rotation_vector.dtype).tiny).sqrt()[..., None, None]
    half = torch.sinc(angle * (0.5 / torch.pi))
    k = skew(rotation_vector)
    square = torch.bmm(k.reshape(-1, 3, 3), k.reshape(-1, 3, 3)).view_as(k)
    # sin(w) / w = cos(w / 2) sin(w / 2) / (w / 2), and the versine's quotient is half of the square of the latter
    a = torch.cos(0.5 * angle) * half
    eye = torch.eye(3, dtype=rotation_vector.dtype, device=rotation_vector.device)
    return eye + a * k + (0.5 * half * half) * square


def turned(rotation: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (N, M, 3) turned by rotations (N, 3, 3), in one call where matrices times columns are nine."""
    return torch.bmm(vectors, rotation.mT)


def quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternions (..., 4) as w, x, y, z with w >= 0 of rotation matrices (..., 3, 3) (Shepperd 1978)."""
    m = rotation
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    # the four rows of 4 q q^T; the one with the largest diagonal is divided by, so no digit is lost
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, a, b, c], -1),
            torch.stack([a, 1 + m00 - m11 - m22, d, e], -1),
            torch.stack([b, d, 1 - m00 + m11 - m22, f], -1),
            torch.stack([c, e, f, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).nan_to_num(nan=0.0).argmax(-1)
    q = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    q = q / q.square().sum(-1, keepdim=True).sqrt()
    return torch.where(q[..., :1] < 0, -q, q)


def log(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3) in rad, of length 0 to pi, of rotation matrices (..., 3, 3)."""
    q = quaternion(rotation)
    w, v = q[..., :1], q[..., 1:]
    s2 = v.square().sum(-1, keepdim=True)
    small = s2 < 1e-24
    s = torch.where(small, torch.ones_like(s2), s2).sqrt()
    return torch.where(small, 2 * v, 2 * torch.atan2(s, w) / s * v)


def inverse(rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of the rigid transform x -> R x + t, for R (..., 3, 3) and t (..., 3)."""
    rt = rotation.mT
    return rt, -(rt @ translation[..., None]).squeeze(-1)


def compose(ra: Tensor, ta: Tensor, rb: Tensor, tb: Tensor) -> tuple[Tensor, Tensor]:
    """Rigid transform a after b: x -> Ra (Rb x + tb) + ta."""
    return ra @ rb, (ra @ tb[..., None]).squeeze(-1) + ta


def angle_between(ra: Tensor, rb: Tensor) -> Tensor:
    """Angle in rad of the rotation from ``rb`` to ``ra``, both (..., 3, 3)."""
    return torch.linalg.vector_norm(log(ra @ rb.mT), dim=-1)


def plane_axes(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (M, 3), (M, 3) that complete unit normals (M, 3) to orthonormal frames (Duff et al. 2017)."""
    x, y, z = normals.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    return torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1), torch.stack([b, sign + y * y * a, -y], -1)
