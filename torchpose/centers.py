"""Stage: the image of a ring's centre, freed from the eccentricity of perspective (paper, section III-B-4, eq. (7))."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.ellipse import EllipseFit


def compensate(outer: EllipseFit, inner: EllipseFit, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Image of the common centre of two concentric circles from both ellipse centres, eq. (7).

    The centre of a circle's image moves from the image of the circle's centre in proportion to r^2 (to first order in
    r^2), so extrapolating the two measured centres to r = 0 gives u_c = K1 u_inner - K2 u_outer with
    K1 = r1^2 / (r1^2 - r2^2), K2 = r2^2 / (r1^2 - r2^2).

    Args:
        outer, inner: fits of K rings. radii: (K, 2) true outer and inner radius r1, r2, any unit.

    Returns:
        center (K, 2) px and its covariance (K, 2, 2) px^2, both circles measured independently.
    """
    r1, r2 = radii.square().unbind(-1)
    k1, k2 = r1 / (r1 - r2), r2 / (r1 - r2)
    center = k1[:, None] * inner.params[:, :2] - k2[:, None] * outer.params[:, :2]
    covariance = (
        k1.square()[:, None, None] * inner.center_covariance + k2.square()[:, None, None] * outer.center_covariance
    )
    return center, covariance


def eccentricity(rotation: Tensor, center: Tensor, normal: Tensor, radius: Tensor) -> Tensor:
    """Distance vector (..., 2) from the image of a circle's centre to the centre of its image, on the normalised plane.

    Exact: the ellipse's centre is the pole of the line at infinity, e ~ h33 h3 - r^2 a with a = n n^T-projected z axis
    (derivation in docs/methods.md).

    Args:
        rotation: (..., 3, 3) target to camera. center: (..., 3) in the camera frame. normal: (..., 3) in the target
            frame. radius: (...).
    """
    n = (rotation @ normal[..., None]).squeeze(-1)
    z = torch.zeros_like(n)
    z[..., 2] = 1
    a = z - n * n[..., 2:]  # (I - n n^T) z
    e = center[..., 2:] * center - radius.square()[..., None] * a
    return e[..., :2] / e[..., 2:] - center[..., :2] / center[..., 2:]
