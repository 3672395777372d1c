"""Centre refinement: the pose whose projected circles have their ellipses' centres where they were measured.

The centre of a circle's image is not the image of its centre. Compensating the measured centres spends most of what
they tell, for it extrapolates from both circles to radius 0; predicting the ellipse centres of the posed circles spends
nothing, and their eccentricity tells of the tilt besides.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.pose import Evidence
from torchpose.refine.photometric.gauss_newton import solve_scaled

_STEPS = 4  # from within a few standard deviations: the last one changes no digit that counts


class OnCenters(NamedTuple):
    """Poses of N rows refined on centres.

    R: (N, 3, 3). t: (N, 3). covariance: (N, 6, 6). chi2: (N,), of the centres. good: (N,) bool; where False no better
    pose than the start was found, and R, t and chi2 are those of the start.
    """

    R: Tensor
    t: Tensor
    covariance: Tensor
    chi2: Tensor
    good: Tensor


def refine_centers(e: Evidence, rotation: Tensor, translation: Tensor) -> OnCenters:
    """Refines N poses on the centres of the ellipses of both circles of every marker seen.

    The ellipses are those of ideal pixels, so that distortion is off already. Markers that contradict each other are
    for `solve_poses` to find; here all that it kept count, by their covariances.

    Args:
        e: what was measured. rotation, translation: (N, 3, 3), (N, 3) to start from.
    """
    seen = e.mask[:, :, None].expand(-1, -1, 2)
    eye = torch.eye(2, dtype=e.shape.dtype, device=e.shape.device)
    covariance = torch.where(seen[..., None, None], e.shape_covariance[..., :2, :2], eye)
    weight = torch.linalg.inv(covariance) * seen[..., None, None]
    measured = torch.where(seen[..., None], e.shape[..., :2], 0.0)
    focal, principal = e.matrix.diagonal()[:2], e.matrix[:2, 2]

    r, t = rotation, translation
    first = last = information = torch.empty(0)
    for step in range(_STEPS + 1):
        center, by_pose = ellipse_centers(r, t, e.points, e.normals, e.radii)
        error = torch.where(seen[..., None], measured - (focal * center + principal), 0.0)[..., None]
        jacobian = focal[:, None] * by_pose
        weighted = jacobian.mT @ weight
        information = (weighted @ jacobian).sum((1, 2))
        last = (error.mT @ weight @ error).sum((1, 2, 3, 4))
        first = last if step == 0 else first
        if step < _STEPS:
            change = solve_scaled(information, (weighted @ error).sum((1, 2))).squeeze(-1)
            r, t = rotations.exp(change[:, 3:]) @ r, t + change[:, :3]
    inverse, info = torch.linalg.inv_ex(information)
    good = (info == 0) & (last <= first) & (inverse.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    r, t = torch.where(good[:, None, None], r, rotation), torch.where(good[:, None], t, translation)
    return OnCenters(r, t, inverse, torch.where(good, last, first), good)


def ellipse_centers(
    rotation: Tensor, translation: Tensor, centers: Tensor, normals: Tensor, radii: Tensor
) -> tuple[Tensor, Tensor]:
    """Centres of the images of circles on the plane z = 1, and their derivatives by the pose.

    The dual conic of the image of the circle of radius r about c with the normal n is r^2 (I - n n^T) - c c^T
    (derived); its centre is the third column over its last entry.

    Args:
        rotation, translation: (N, 3, 3), (N, 3). centers, normals: (N, M, 3), target frame. radii: (N, M, L).

    Returns:
        (N, M, L, 2), and (N, M, L, 2, 6): by the translation, then by the rotation from the left.
    """
    arm = (rotation[:, None] @ centers[..., None]).squeeze(-1)[:, :, None]  # (N, M, 1, 3)
    c = arm + translation[:, None, None]
    n = (rotation[:, None] @ normals[..., None]).squeeze(-1)[:, :, None]
    square = radii.square()[..., None]
    axis = torch.zeros_like(translation[:1, :]).index_fill_(1, torch.tensor(2, device=c.device), 1.0)
    column = c * c[..., 2:] + square * (n * n[..., 2:] - axis)  # (N, M, L, 3)

    def of(vector: Tensor, change: Tensor) -> Tensor:
        """Derivative of v v_z where v changes by the columns of ``change``."""
        return vector[..., 2:, None] * change + vector[..., :, None] * change[..., 2:, :]

    eye = torch.eye(3, dtype=c.dtype, device=c.device)
    by_c, by_n = of(c, eye), of(n, eye)
    by_turn = -by_c @ rotations.skew(arm) - square[..., None] * (by_n @ rotations.skew(n))
    by_pose = torch.cat([by_c.expand_as(by_turn), by_turn], -1)  # (N, M, L, 3, 6)
    center = column[..., :2] / column[..., 2:]
    change = by_pose[..., :2, :] - center[..., None] * by_pose[..., 2:, :]
    return center, change / column[..., 2:, None]
