"""Direct linear transform (Abdel-Aziz, Karara 1971; Hartley, Zisserman, 2nd ed., section 7.1) with known intrinsics."""

import torch
from torch import Tensor

from torchpose.pnp.candidates import Candidates, batch_last, rank
from torchpose.pnp.planar import plane_frame, translation


def dlt(object_points: Tensor, image_points: Tensor, mask: Tensor | None = None) -> Candidates:
    """Pose of points in general position from the 3 x 4 matrix with the least algebraic error.

    Args:
        object_points: (N, 3) or (B, N, 3), N >= 6, not in one plane.
        image_points: (B, N, 2), undistorted normalised coordinates.
        mask: (B, N) bool, True where a point was seen; at least six of them.

    Returns:
        `Candidates` with S = 1; NaN for coplanar points.

    Raises:
        ArgumentError: the shapes do not fit.
    """
    points, xy, weight = batch_last(object_points, image_points, mask)
    frame = plane_frame(points, weight)
    local = (points - frame.center[:, None]) / frame.extent[2]
    ones = torch.ones_like(xy[0])
    homogeneous = torch.cat([local.expand(3, *ones.shape), ones[None]])
    if weight is not None:
        homogeneous = torch.where(weight > 0, homogeneous, 0.0)
    x, y = xy

    def moment(factor: Tensor) -> Tensor:
        return (homogeneous[:, None] * homogeneous * factor).sum(2)

    m0, mx, my, mr = moment(ones), moment(-x), moment(-y), moment(x * x + y * y)
    zero = torch.zeros_like(m0)
    normal = torch.cat([torch.cat(row, 1) for row in ([m0, zero, mx], [zero, m0, my], [mx, my, mr])])
    p = least_eigenvectors(normal)[:, :, 0].unflatten(1, (3, 4))  # (B, 3, 4)
    # the centroid is in front of the camera
    p = p * torch.where(p[:, 2:, 3:] < 0, -1.0, 1.0)
    r = nearest_rotation(p[:, :, :3]).permute(1, 2, 0)[:, :, None]
    r = torch.where(frame.flat, torch.nan, r)
    return rank(r, translation(r, points, xy, weight, frame.center), points, xy, weight)


def least_eigenvectors(matrix: Tensor) -> Tensor:
    """Eigenvectors (B, n, n) as columns, by ascending eigenvalue, of symmetric matrices (n, n, B), NaN if infinite."""
    finite, matrix = _made_finite(matrix.permute(2, 0, 1))
    return torch.where(finite, torch.linalg.eigh(matrix).eigenvectors, torch.nan)


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation (B, 3, 3) nearest to a matrix (B, 3, 3) in the Frobenius norm (Kabsch 1976); NaN if not finite."""
    finite, matrix = _made_finite(matrix)
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[:, None, None]], -1)
    return torch.where(finite, u @ vh, torch.nan)


def _made_finite(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 1, 1) bool, are matrices (B, n, n) finite? And these, the identity where they are not."""
    finite = matrix.isfinite().flatten(1).all(1)[:, None, None]
    return finite, torch.where(finite, matrix, torch.eye(matrix.shape[1], dtype=matrix.dtype, device=matrix.device))
