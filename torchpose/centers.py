"""Stage: the image of a ring's centre, freed from the eccentricity of perspective (paper, section III-B-4, eq. (7))."""

from __future__ import annotations

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
