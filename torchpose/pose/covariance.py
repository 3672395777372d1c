"""Covariance of poses from centres, or from edges all along the rings, and what uncertain intrinsics add to it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.pose.evidence import Evidence, visible
from torchpose.pose.solutions import Solutions

_MOST_INFLATION = 1e10  # of a parameter's variance by the others' freedom, beyond which it counts as open
_RIM_POINTS = 24  # of a circle: sums over it are exact up to the perspective's high orders


def pose_covariance(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pose covariance (J^T W J)^-1 (N, 6, 6), and whether the centres determine all six parameters (N,)."""
    jac, _, weight = _center_jacobian(e, r, t)
    return _inverse((jac.mT @ weight @ jac).sum(1))


def intrinsics_covariance(e: Evidence, s: Solutions, camera: Camera, *, refined: bool) -> Tensor:
    """What uncertain intrinsics add to the pose covariance (N, 6, 6): G Sigma_K G^T, G = d pose / d (fx, fy, cx, cy).

    At the least-squares optimum G = -(J^T W J)^-1 J^T W J_K with the Jacobians J and J_K of what the pose is fitted to.

    Args:
        camera: with a ``covariance``.
        refined: the pose is fitted to the edges of the rings, which tell their size and shape too, not to the centres.
    """
    if camera.covariance is None:
        raise ValueError("the camera has no covariance")
    jac, n, weight = (_rim_jacobian if refined else _center_jacobian)(replace(e, mask=s.mask), s.R, s.t)
    weighted = jac.mT @ weight
    gain = -_inverse((weighted @ jac).sum(1))[0] @ (weighted @ _by_intrinsics(camera, n)).sum(1)
    return gain @ camera.covariance.to(gain) @ gain.mT


def _rim_jacobian(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same of points all along both rims of every marker, weighted by their length across the edge alone."""
    angle = torch.arange(_RIM_POINTS, dtype=t.dtype, device=t.device) * (2 * torch.pi / _RIM_POINTS)
    one, two = (x[..., None, None, :] for x in plane_axes(e.normals))
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    radii = e.radii[..., None, None]
    points = (e.points[:, :, None, None] + radii * (cos * one + sin * two)).flatten(1, 3)
    along = (radii * (cos * two - sin * one)).flatten(1, 3)
    turned = points @ r.mT
    by_point, n = _derivative(turned + t[:, None], e.matrix)
    tangent = (by_point @ (along @ r.mT)[..., None]).squeeze(-1)  # px per rad
    length = torch.linalg.vector_norm(tangent, dim=-1)
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / length[..., None]
    seen = e.mask.repeat_interleave(2 * _RIM_POINTS, 1)
    weight = normal[..., :, None] * normal[..., None, :] * (length * seen)[..., None, None]
    return torch.cat([by_point, -by_point @ rotations.skew(turned)], -1), n, weight


def _center_jacobian(e: Evidence, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projected centres' derivatives by the pose (N, M, 2, 6), normalised points (N, M, 2), weights (N, M, 2, 2).

    Translation first, then the rotation from the left, R = exp(w) R_est.
    """
    turned = (r[:, None] @ e.points[..., None]).squeeze(-1)
    by_point, n = _derivative(turned + t[:, None], e.matrix)
    weight = torch.linalg.inv(visible(e.covariance, e.mask)) * e.mask[..., None, None]
    return torch.cat([by_point, -by_point @ rotations.skew(turned)], -1), n, weight


def _derivative(x: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels' derivatives (..., 2, 3) by points (..., 3) of the camera frame, and their normalised images (..., 2)."""
    n = x[..., :2] / x[..., 2:]
    zero, one = torch.zeros_like(n[..., 0]), torch.ones_like(n[..., 0])
    by_point = torch.stack([one, zero, -n[..., 0], zero, one, -n[..., 1]], -1).unflatten(-1, (2, 3))
    return by_point * (matrix.diagonal()[:2, None] / x[..., 2, None, None]), n


def _by_intrinsics(camera: Camera, n: Tensor) -> Tensor:
    """How residuals in ideal pixels change with fx, fy, cx, cy (..., 2, 4), at normalised points n (..., 2).

    Measured are the pixels of the frame: a changed matrix moves the ideal pixels made of them too.
    """
    focal = camera.matrix.diagonal()[:2]
    d = (camera.distort(n) - camera.matrix[:2, 2]) / focal
    by_raw = focal[:, None] * torch.linalg.inv(camera.J_distort(n))
    return torch.cat([by_raw * d[..., None, :], by_raw], -1)


def _inverse(information: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of (N, 6, 6), and whether it determines all six parameters (N,)."""
    # in units of each parameter's own information, so that mm and rad can be compared
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    inverse, info = torch.linalg.inv_ex(information * scale[:, :, None] * scale[:, None, :])
    covariance = inverse * scale[:, :, None] * scale[:, None, :]
    determined = (info == 0) & (inverse.diagonal(dim1=-2, dim2=-1) < _MOST_INFLATION).all(-1)
    return covariance, determined
