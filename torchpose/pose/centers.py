"""Stage: the image of a ring's centre, freed from the eccentricity of perspective (paper, section III-B-4, eq. (7))."""

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either, finite


@checked
def compensate(outer: EllipseFit, inner: EllipseFit, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Image of the common centre of two concentric circles from both ellipse centres, eq. (7).

    The centre of a circle's image moves from the image of the circle's centre in proportion to r^2 (to first order in
    r^2), so extrapolating the two measured centres to r = 0 gives u_c = K1 u_inner - K2 u_outer with
    K1 = r1^2 / (r1^2 - r2^2), K2 = r2^2 / (r1^2 - r2^2).

    Args:
        outer: fits of K outer circles.
        inner: of the inner ones.
        radii: (K, 2) true outer and inner radius r1, r2, any unit.

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


@checked
def common_center(outer: EllipseFit, inner: EllipseFit, radii: Tensor) -> tuple[Tensor, Tensor]:
    """`exact` for rings of two circles; arguments and result as `compensate`."""
    ellipses = torch.stack([outer.params, inner.params], -2)
    covariances = torch.stack([outer.center_covariance, inner.center_covariance], -3)
    return exact(ellipses, covariances, radii)


def exact(ellipses: Tensor, covariances: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Image of the common centre of concentric circles, exact at any tilt, from any number of them.

    With H the homography from the circles' plane, the dual conic of the image of the circle of radius r, scaled to the
    determinant -1 / r^2, is H diag(1, 1, 0) H^T - h h^T / r^2 up to a factor common to all, h the image of the centre
    (derived; the dual form of the pole-polar relation of Kim, Gurdjos and Kweon 2005). So the dual conics lie on a line
    over 1 / r^2, and h is the one eigenvector of its slope. Where perspective is weak, two circles give eq. (7).

    Args:
        ellipses: (..., L, 5) px, L >= 2 circles. covariances: (..., L, 2, 2) of their centres, px^2.
        radii: (..., L), all different, any unit.

    Returns:
        center (..., 2) px and its covariance (..., 2, 2), to first order, the circles measured independently.
    """
    # about the middle of the centres, in units of the largest circle: all entries of order one
    middle = ellipses[..., :2].mean(-2, keepdim=True)
    unit = ellipses[..., 2].amax(-1)[..., None, None]
    e = (ellipses[..., :2] - middle) / unit
    shape = conics.shape_matrix(ellipses) / unit[..., None]
    last = torch.nn.functional.pad(e, (0, 1), value=1.0)
    square = torch.nn.functional.pad(shape, (0, 1, 0, 1)).flatten(0, -3)
    dual = last[..., :, None] * last[..., None, :] - torch.bmm(square, square).view(*last.shape, 3)  # times -1
    inverse = (radii.amax(-1, keepdim=True) / radii).square()  # 1 / r^2
    scale = (inverse / (shape.det().square())).pow(1 / 3)
    lever = inverse - inverse.mean(-1, keepdim=True)
    slope = ((lever * scale)[..., None, None] * dual).sum(-3)
    known = finite(slope, (-2, -1))
    _, vectors = torch.linalg.eigh(either(known[..., None, None], slope, 0.0))
    h = vectors[..., :, -1]  # the other two eigenvalues vanish
    center = unit[..., 0] * h[..., :2] / h[..., 2:] + middle[..., 0, :]
    share = lever * scale / (lever * scale).sum(-1, keepdim=True)
    covariance = (share.square()[..., None, None] * covariances).sum(-3)
    return either(known[..., None], center, torch.nan), covariance


@checked
def raw_centers(camera: Camera, ideal: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (K, 2) and covariances (K, 2, 2) of ideal pixels as pixels of the distorted frame."""
    k = camera.matrix
    focal = k.diagonal()[:2]
    xy = (ideal - k[:2, 2]) / focal
    if not camera.distorts:
        return ideal, covariance
    at, jacobian = camera.linearised(xy)
    jacobian = jacobian / focal
    return at, torch.bmm(torch.bmm(jacobian, covariance), jacobian.mT)
