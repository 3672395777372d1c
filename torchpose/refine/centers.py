"""Centre refinement: the pose whose projected circles have their ellipses' centres where they were measured.

The centre of a circle's image is not the image of its centre. Compensating the measured centres spends most of what
they tell, for it extrapolates from both circles to radius 0; predicting the ellipse centres of the posed circles spends
nothing, and their eccentricity tells of the tilt besides.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import Normal, Pose, Unknowns, minimise
from torchpose.geometry.rows import Rows
from torchpose.pose import Evidence, MarkerNormals

_STEPS = 4  # from within a few standard deviations: the last one changes no digit that counts


@dataclass(frozen=True, eq=False)
class OnCenters(Rows):
    """Poses of N rows refined on centres.

    Attributes:
        R: target to camera.
        t: mm.
        covariance: as in `results.Poses`.
        chi2: of the centres.
        good: where False no better pose than the start was found, and R, t and chi2 are those of the start.
        normals: what each marker tells at that pose.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    chi2: Float[Tensor, " N"]
    good: Bool[Tensor, " N"]
    normals: MarkerNormals


@checked
def refine_centers(evidence: Evidence, rotation: Tensor, translation: Tensor) -> OnCenters:
    """Refines N poses on the centres of the ellipses of both circles of every marker seen.

    The ellipses are those of ideal pixels, so that distortion is off already. Markers that contradict each other are
    for `solve_poses` to find; here all that it kept count, by their covariances.

    Args:
        evidence: what was measured.
        rotation: (N, 3, 3) to start from.
        translation: (N, 3), the same.
    """
    seen = evidence.mask[:, :, None].expand(-1, -1, 2)
    eye = torch.eye(2, dtype=evidence.shape.dtype, device=evidence.shape.device)
    covariance = torch.where(seen[..., None, None], evidence.shape_covariance[..., :2, :2], eye)
    weight = torch.linalg.inv(covariance) * seen[..., None, None]
    measured = torch.where(seen[..., None], evidence.shape[..., :2], 0.0)
    focal, principal = evidence.matrix.diagonal()[:2], evidence.matrix[:2, 2]

    def of_markers(pose: Pose) -> tuple[MarkerNormals, Tensor]:
        center, by_pose = ellipse_centers(pose.R, pose.t, evidence.points, evidence.normals, evidence.radii)
        error = torch.where(seen[..., None], measured - (focal * center + principal), 0.0)[..., None]
        # dot gain hardly moves a centre; that of the eccentricity is left out
        jacobian = torch.nn.functional.pad(focal[:, None] * by_pose, (0, 1))
        weighted = jacobian.mT @ weight
        cost = (error.mT @ weight @ error).sum((1, 2, 3, 4))
        return MarkerNormals((weighted @ jacobian).sum(2), (weighted @ error).sum(2).squeeze(-1)), cost

    def problem(unknowns: Unknowns) -> Normal:
        each, cost = of_markers(unknowns.pose)
        return Normal(each.information[..., :6, :6].sum(1), each.right[..., :6].sum(1), cost)

    start = Pose(rotation, translation)
    found = minimise(problem, Unknowns({"pose": start}), _STEPS)
    covariance, determined = found.covariance()
    good = determined & (found.normal.cost <= found.first_cost)
    pose = found.unknowns.pose.where(good, start)
    chi2 = torch.where(good, found.normal.cost, found.first_cost)
    return OnCenters(pose.R, pose.t, covariance, chi2, good, of_markers(pose)[0])


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
