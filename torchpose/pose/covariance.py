"""Covariance of poses from centres."""

import torch
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.geometry.projection import by_pose, image_by_point
from torchpose.geometry.rotations import turned
from torchpose.pose.evidence import Evidence, visible


@checked
def pose_covariance(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Pose covariance (J^T W J)^-1 (N, 6, 6), and whether the centres determine all six parameters (N,)."""
    jacobian, _, weight = center_jacobian(evidence, R, t)
    weighted = (weight @ jacobian).flatten(1, 2)
    return scaled_inverse(torch.bmm(jacobian.flatten(1, 2).mT, weighted))


def center_jacobian(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projected centres' derivatives by the pose (N, M, 2, 6), normalised points (N, M, 2), weights (N, M, 2, 2)."""
    arm = turned(R, evidence.points)
    by_point, xy = derivative(arm + t[:, None], evidence.matrix)
    weight = torch.linalg.inv_ex(visible(evidence.covariance, evidence.mask)).inverse * evidence.mask[..., None, None]
    return by_pose(by_point, arm), xy, weight


def derivative(x: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels' derivatives (..., 2, 3) by points (..., 3) of the camera frame, and their normalised images (..., 2)."""
    xy = x[..., :2] / x[..., 2:]
    return matrix.diagonal()[:2, None] * image_by_point(xy, x[..., 2]), xy
