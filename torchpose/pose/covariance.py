"""Covariance of poses from centres, or from edges all along the rings, and what uncertain intrinsics add to it."""

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.rotations import plane_axes
from torchpose.pose.evidence import Evidence, visible

_RIM_POINTS = 24  # of a circle: sums over it are exact up to the perspective's high orders


def pose_covariance(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pose covariance (J^T W J)^-1 (N, 6, 6), and whether the centres determine all six parameters (N,)."""
    jacobian, _, weight = _center_jacobian(evidence, R, t)
    return scaled_inverse((jacobian.mT @ weight @ jacobian).sum(1))


def intrinsics_covariance(evidence: Evidence, R: Tensor, t: Tensor, camera: Camera, *, refined: bool) -> Tensor:
    """What uncertain intrinsics add to the pose covariance (N, 6, 6): G Sigma_K G^T, G = d pose / d (fx, fy, cx, cy).

    At the least-squares optimum G = -(J^T W J)^-1 J^T W J_K with the Jacobians J and J_K of what the pose is fitted to.

    Args:
        evidence: N rows, their mask the markers that the pose is of.
        R: (N, 3, 3), of the pose.
        t: (N, 3), the same.
        camera: with a ``covariance``.
        refined: the pose is fitted to the edges of the rings, which tell their size and shape too, not to the centres.
    """
    if camera.covariance is None:
        raise ValueError("the camera has no covariance")
    jacobian, xy, weight = (_rim_jacobian if refined else _center_jacobian)(evidence, R, t)
    weighted = jacobian.mT @ weight
    covariance, _ = scaled_inverse((weighted @ jacobian).sum(1))
    gain = -covariance @ (weighted @ _by_intrinsics(camera, xy)).sum(1)
    return gain @ camera.covariance[:4, :4].to(gain) @ gain.mT


def _rim_jacobian(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`_center_jacobian` of points all along both rims of every marker, weighted by their length across the edge."""
    angle = torch.arange(_RIM_POINTS, dtype=t.dtype, device=t.device) * (2 * torch.pi / _RIM_POINTS)
    one, two = (x[..., None, None, :] for x in plane_axes(evidence.normals))
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    radii = evidence.radii[..., None, None]
    points = (evidence.points[:, :, None, None] + radii * (cos * one + sin * two)).flatten(1, 3)
    along = (radii * (cos * two - sin * one)).flatten(1, 3)
    arm = points @ R.mT
    by_point, xy = _derivative(arm + t[:, None], evidence.matrix)
    tangent = (by_point @ (along @ R.mT)[..., None]).squeeze(-1)  # px per rad
    length = torch.linalg.vector_norm(tangent, dim=-1)
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / length[..., None]
    seen = evidence.mask.repeat_interleave(2 * _RIM_POINTS, 1)
    weight = normal[..., :, None] * normal[..., None, :] * (length * seen)[..., None, None]
    return by_pose(by_point, arm), xy, weight


def _center_jacobian(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projected centres' derivatives by the pose (N, M, 2, 6), normalised points (N, M, 2), weights (N, M, 2, 2)."""
    arm = (R[:, None] @ evidence.points[..., None]).squeeze(-1)
    by_point, xy = _derivative(arm + t[:, None], evidence.matrix)
    weight = torch.linalg.inv(visible(evidence.covariance, evidence.mask)) * evidence.mask[..., None, None]
    return by_pose(by_point, arm), xy, weight


def _derivative(x: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels' derivatives (..., 2, 3) by points (..., 3) of the camera frame, and their normalised images (..., 2)."""
    xy = x[..., :2] / x[..., 2:]
    return matrix.diagonal()[:2, None] * image_by_point(xy, x[..., 2]), xy


def _by_intrinsics(camera: Camera, xy: Tensor) -> Tensor:
    """How residuals in ideal pixels change with fx, fy, cx, cy (..., 2, 4), at normalised points (..., 2).

    Measured are the pixels of the frame: a changed matrix moves the ideal pixels made of them too.
    """
    focal = camera.matrix.diagonal()[:2]
    bent = (camera.distort(xy) - camera.matrix[:2, 2]) / focal
    by_raw = focal[:, None] * torch.linalg.inv(camera.J_distort(xy))
    return torch.cat([by_raw * bent[..., None, :], by_raw], -1)
