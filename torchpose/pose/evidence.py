"""What was measured of the markers of each row, and how well a pose explains it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose.geometry import conics
from torchpose.rings import Rings

_SHAPE_FLOOR = (0.03, 0.5)  # px, and times the curvature a / b^2: what blur and mask do to an ellipse's shape


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was measured of the M markers of N rows; padded, see ``mask``.

    Attributes:
        points, normals: (N, M, 3) float64 in the target frame. radii: (N, M, 2).
        center, covariance: (N, M, 2) ideal px and (N, M, 2, 2): compensated centres.
        shape: (N, M, 2, 5) fitted ellipses, outer and inner, ideal px. shape_covariance: (N, M, 2, 5, 5), see
            `ellipse.EllipseFit`.
        mask: (N, M) bool, marker seen. coplanar: (N,) bool.
        matrix: (3, 3) camera matrix.
    """

    points: Tensor
    normals: Tensor
    radii: Tensor
    center: Tensor
    covariance: Tensor
    shape: Tensor
    shape_covariance: Tensor
    mask: Tensor
    coplanar: Tensor
    matrix: Tensor

    def __getitem__(self, index: Tensor) -> Evidence:
        rows = {n: getattr(self, n)[index] for n in self.__dataclass_fields__ if n != "matrix"}
        return Evidence(**rows, matrix=self.matrix)

    def without(self, marker: Tensor) -> Evidence:
        """The same rows with one marker each, (N,) int64, taken as not seen."""
        mask = self.mask.clone()
        mask[torch.arange(mask.shape[0], device=mask.device), marker] = False
        return replace(self, mask=mask)


def gather_evidence(
    rings: Rings,
    ring: Tensor,
    centers: Tensor,
    covariances: Tensor,
    points: Tensor,
    normals: Tensor,
    radii: Tensor,
    coplanar: Tensor,
    matrix: Tensor,
) -> Evidence:
    """Lays the measurements of flat rings out by row and marker.

    Args:
        rings: K rings. ring: (N, M) int64, -1 where not seen. centers, covariances: (N, M, 2), (N, M, 2, 2).
        points, normals, radii, coplanar: of the target of each row, (N, M, ...) and (N,). matrix: (3, 3).
    """
    mask = ring >= 0
    at = ring.clamp_min(0)
    shape = torch.stack([rings.outer.params, rings.inner.params], 1)
    covariance = torch.stack([rings.outer.covariance, rings.inner.covariance], 1)
    if len(rings) == 0:  # nothing to index: any row will do, the mask hides it
        shape, covariance = shape.new_ones(1, 2, 5), covariance.new_ones(1, 2, 5, 5)
    return Evidence(points, normals, radii, centers, covariances, shape[at], covariance[at], mask, coplanar, matrix)


def shape_chi2(e: Evidence, r: Tensor, t: Tensor) -> Tensor:
    """Chi-squared (N, S) of the rings' shapes: elongation and its direction, which blur and threshold hardly touch."""
    x = (r[:, :, None] @ e.points[:, None, ..., None]).squeeze(-1) + t[:, :, None]  # (N, S, M, 3)
    predicted = conics.circle_ellipse(
        e.matrix, r[:, :, None, None], x[..., None, :], e.normals[:, None, :, None], e.radii[:, None]
    )  # (N, S, M, 2, 5)
    difference = conics.shape_matrix(e.shape)[:, None] - conics.shape_matrix(predicted)
    theta = e.shape[..., 4]
    cos, sin = theta.cos(), theta.sin()
    axes = torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))[:, None]
    d = axes.mT @ difference @ axes
    v = torch.stack([d[..., 0, 0] - d[..., 1, 1], 2 * d[..., 0, 1]], -1)
    pick = torch.tensor([[0, 0, 1, 0, -1], [0, 0, 0, 2, 0]], dtype=v.dtype, device=v.device)
    floor = _SHAPE_FLOOR[0] + _SHAPE_FLOOR[1] * e.shape[..., 2] / e.shape[..., 3].square()
    eye = torch.eye(2, dtype=v.dtype, device=v.device)
    covariance = pick @ e.shape_covariance @ pick.T + floor.square()[..., None, None] * eye
    seen = e.mask[..., None, None, None]
    weight = torch.linalg.inv(torch.where(seen, covariance, eye))[:, None]
    chi2 = (v[..., None, :] @ weight @ v[..., None]).squeeze(-1).squeeze(-1)
    return torch.where(e.mask[:, None, :, None], chi2, 0.0).sum((-1, -2))


def center_rms(e: Evidence, r: Tensor, t: Tensor) -> Tensor:
    """RMS distance (N,) in px of the compensated centres from the projected ones."""
    x = (r[:, None] @ e.points[..., None]).squeeze(-1) + t[:, None]
    d = (x @ e.matrix.T)[..., :2] / x[..., 2:] - e.center
    square = torch.where(e.mask, d.square().sum(-1), 0.0)
    return (square.sum(-1) / e.mask.sum(-1)).sqrt()


def visible(covariance: Tensor, mask: Tensor) -> Tensor:
    """Covariances with the identity where nothing was seen."""
    eye = torch.eye(2, dtype=covariance.dtype, device=covariance.device)
    return torch.where(mask[..., None, None], covariance, eye)
