"""Pose of a plane from its homography: both solutions of IPPE (Collins, Bartoli, IJCV 109, 2014).

The homography is fitted by the elimination of Harker and O'Leary (BMVC 2005), with its scale fixed at the centroid of
the points, which lies in front of the camera. IPPE then needs only the first-order part of the homography at the
centroid: it fixes the depth, and the rotation up to the two-fold ambiguity of a small plane.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import cross, matmul3
from torchpose.pnp.candidates import Candidates, batch_last, rank, weighted_mean

# thickness over extent (standard deviations) above which points are no plane
FLATNESS = 1e-2
# below which they are an exact plane but for rounding in float32 (derived)
_EVENNESS = 1e-6
# and above which they have no second pose that resembles the first (convention)
_THINNESS = 0.15
# width over length (standard deviations) below which points are a line
COLLINEARITY = 1e-4
# least curvature of the products of places and images, over their scatters, that fixes a homography: it is 0 where all
# points but one lie on a line or only three are distinct, about 4 for a square seen from afar: in exact images
# (rounding), and for a start that noise must not spoil (convention; what fails it is looked at by `third_pass`)
FIXED = 1e-12
FIXED_FIRMLY = 1e-3


class Frame(NamedTuple):
    """Frame of points' best plane; B is 1 where the points are shared by all poses and none is missing.

    Attributes:
        axes: (3, 3, B), as rows, the last one normal to the plane.
        center: (3, B), centroid.
        extent: (3, B), standard deviations of the points along the normal, the second and the first axis.
    """

    axes: Tensor
    center: Tensor
    extent: Tensor

    @property
    def flat(self) -> Tensor:
        """(B,) bool, do the points lie in a plane?"""
        return self.extent[0] <= FLATNESS * self.extent[2]

    @property
    def even(self) -> Tensor:
        """(B,) bool, are they a plane to rounding in float32?"""
        return self.extent[0] <= _EVENNESS * self.extent[2]

    @property
    def thin(self) -> Tensor:
        """(B,) bool, may a second pose explain them nearly as well, as it does for a plane?"""
        return self.extent[0] <= _THINNESS * self.extent[2]

    @property
    def wide(self) -> Tensor:
        """(B,) bool, do they fill more than a line?"""
        return self.extent[1] > COLLINEARITY * self.extent[2]

    def local(self, offset: Tensor) -> Tensor:
        """Offsets (3, N, B) from the centre along the axes."""
        return torch.stack([(axis[:, None] * offset).sum(0) for axis in self.axes])


def planar(object_points: Tensor, image_points: Tensor, mask: Tensor | None = None) -> Candidates:
    """Both poses of coplanar points, the better one first.

    Args:
        object_points: (N, 3) shared by all poses or (B, N, 3), N >= 4; their plane may lie anywhere in space and be
            seen from either side.
        image_points: (B, N, 2), undistorted normalised coordinates X/Z, Y/Z.
        mask: (B, N) bool, True where a point was seen; at least four of them, no three of four on a line.

    Returns:
        `Candidates` with S = 2. NaN where the points are collinear, no plane (thicker than a hundredth of their extent)
        or not in front of the camera in that solution.

    Raises:
        ArgumentError: the shapes do not fit.
    """
    points, xy, weight = batch_last(object_points, image_points, mask)
    frame = plane_frame(points, weight)
    r, t = ippe(points, xy, weight, frame.axes, frame.center)
    return rank(torch.where(frame.flat & frame.wide, r, torch.nan), t, points, xy, weight)


def plane_frame(points: Tensor, weight: Tensor | None) -> Frame:
    """`Frame` of points (3, N, B) with weights (N, B)."""
    center = weighted_mean(points, weight)
    offset = points - center[:, None]
    if weight is not None:
        offset = offset * weight
    # lower: rounding of the products would drown a thin plane in float32
    wide = offset.double()
    scatter = (wide[:, None] * wide[None]).sum(2) / points.shape[1]
    finite = scatter.isfinite().all(0).all(0)
    scatter = torch.where(finite, scatter, torch.eye(3, dtype=wide.dtype, device=wide.device)[..., None])
    values, vectors = torch.linalg.eigh(scatter.permute(2, 0, 1))
    x, y = vectors[..., 2].T, vectors[..., 1].T
    frame = torch.stack([x, y, torch.linalg.cross(x, y, dim=0)]).to(points)
    extent = torch.where(finite, values.T.clamp_min(0).sqrt(), torch.nan).to(points)
    return Frame(frame, center, extent)


def ippe(
    points: Tensor, xy: Tensor, weight: Tensor | None, frame: Tensor, center: Tensor, fixed: float = FIXED
) -> tuple[Tensor, Tensor]:
    """R (3, 3, 2, B) and t (3, 2, B) of the points (3, N, B) of the plane ``frame`` (3, 3, B) about ``center`` (3, B).

    The two solutions come unsorted; both reproduce the homography to first order about the centre. NaN where it is not
    ``fixed``, which takes four points of which no three lie on a line.
    """
    offset = points - center[:, None]
    if weight is not None:
        offset = offset * weight
    # orthonormal basis of 1, x, y: x and y are uncorrelated by the choice of axes as long as no point is missing
    ones = torch.ones_like(offset[0]) if weight is None else weight
    x, y = (frame[0, :, None] * offset).sum(0), (frame[1, :, None] * offset).sum(0)
    plane = torch.stack([x, y, ones])  # (3, N, B)
    lengths = plane.square().sum(1).sqrt()  # (3, B)
    basis = plane / lengths[:, None]
    skewness = (basis[0] * basis[1]).sum(0)
    y_norm = (1 - skewness.square()).sqrt()
    basis = torch.stack([basis[0], (basis[1] - skewness * basis[0]) / y_norm, basis[2]])

    # Harker, O'Leary: with h3 given, the first two rows of H follow by linear least squares from u (h3 . m)
    products = (xy[:, None] * plane).flatten(0, 1)  # u x, u y, u, v x, v y, v: (6, N, B)
    coefficients = moments(basis, products).transpose(0, 1)  # (3, 6, B)
    residual = products - basis[0] * coefficients[0, :, None]
    residual = residual - basis[1] * coefficients[1, :, None] - basis[2] * coefficients[2, :, None]
    a, b, c = residual.unflatten(0, (2, 3)).transpose(0, 1).flatten(1, 2)  # (2N, B) each
    aa, ab, bb, ac, bc = (a * a).sum(0), (a * b).sum(0), (b * b).sum(0), (a * c).sum(0), (b * c).sum(0)
    determinant = aa * bb - ab * ab
    scatter = coefficients[:2, 2::3].square().sum((0, 1)) * lengths[0].square() / lengths[2] ** 4
    determinant = torch.where(determinant > fixed * scatter * (aa + bb), determinant, torch.nan)
    p = torch.stack([ab * bc - bb * ac, ab * ac - aa * bc]) / determinant  # (2, B): h3 = (p, 1)

    # rows 1 and 2 of H in the basis, then in x, y, 1
    h = coefficients.unflatten(1, (2, 3))  # (basis, row, column, B)
    h = h[:, :, 0] * p[0] + h[:, :, 1] * p[1] + h[:, :, 2]  # (3, 2, B)
    hx, hy = (h[0] - skewness * h[1] / y_norm) / lengths[0], h[1] / (y_norm * lengths[1])
    q = h[2] / lengths[2]  # (2, B): image of the centroid
    jx, jy = hx - q * p[0], hy - q * p[1]  # columns of the Jacobian of the projection at the centroid

    # the first two columns of the rotation towards the centroid, projected, are the matrix g
    ray = ray_frame(q)
    (xx, xy_, nx), (_, yy, ny), _ = ray
    g00, g01, g10, g11 = xx + q[0] * nx, xy_ + q[0] * ny, xy_ + q[1] * nx, yy + q[1] * ny
    scale = 1 / (g00 * g11 - g01 * g10)
    a0, a1 = torch.stack([g11 * jx[0] - g01 * jx[1], g00 * jx[1] - g10 * jx[0]]) * scale
    b0, b1 = torch.stack([g11 * jy[0] - g01 * jy[1], g00 * jy[1] - g10 * jy[0]]) * scale

    # the largest singular value of [a b] is the inverse depth
    rows0, rows1, mixed = a0 * a0 + b0 * b0, a1 * a1 + b1 * b1, a0 * a1 + b0 * b1
    gamma = (0.5 * (rows0 + rows1 + ((rows0 - rows1).square() + 4 * mixed.square()).sqrt())).sqrt()
    a0, a1, b0, b1 = torch.stack([a0, a1, b0, b1]) / gamma
    a2 = (1 - a0 * a0 - a1 * a1).clamp_min(0).sqrt()
    b2 = (1 - b0 * b0 - b1 * b1).clamp_min(0).sqrt()
    b2 = torch.where(a0 * b0 + a1 * b1 > 0, -b2, b2)
    first = torch.stack([torch.stack([a0, a0]), torch.stack([a1, a1]), torch.stack([a2, -a2])])  # (3, 2, B)
    second = torch.stack([torch.stack([b0, b0]), torch.stack([b1, b1]), torch.stack([b2, -b2])])
    local = torch.stack([first, second, cross(first, second)], 1)  # (3, 3, 2, B)
    r = matmul3(matmul3(ray[:, :, None], local), frame[:, :, None])
    return r, translation(r, points, xy, weight, center)


def ray_frame(xy: Tensor) -> Tensor:
    """Least rotations (3, 3, B) that take the optical axis to the rays of normalised points (2, B)."""
    nz = (1 + xy.square().sum(0)).rsqrt()
    nx, ny = xy * nz
    k = 1 / (1 + nz)
    xx, mixed, yy = 1 - nx * nx * k, -nx * ny * k, 1 - ny * ny * k
    return torch.stack([xx, mixed, nx, mixed, yy, ny, -nx, -ny, nz]).unflatten(0, (3, 3))


def translation(r: Tensor, points: Tensor, xy: Tensor, weight: Tensor | None, center: Tensor) -> Tensor:
    """Translations t (3, S, B) of R (3, 3, S, B) of least |(x, y) Z - (X, Y)|^2, summed; ``center`` is the centroid."""
    offset = points - center[:, None]
    mean = weighted_mean(xy, weight)  # (2, B)
    xy_offset = xy - mean[:, None]
    if weight is not None:
        offset, xy_offset = offset * weight, xy_offset * weight
    count = xy.shape[1] if weight is None else weight.sum(0)
    # the points are about their centroid: their moments with (x, y), and with its square, are all that is needed
    mixed = moments(offset, xy_offset)[:, :, None]  # (2, 3, 1, B)
    square = moments(offset, (xy_offset * xy).sum(0)[None])[0, :, None]  # (3, 1, B)
    tz = ((r[:2] * mixed).sum(1).sum(0) - (r[2] * square).sum(0)) / xy_offset.square().sum(1).sum(0)
    txy = (r[2] * mixed).sum(1) / count + mean[:, None] * tz
    t = torch.cat([txy, tz[None]])
    cx, cy, cz = center[:, None]
    return t - (r[:, 0] * cx + r[:, 1] * cy + r[:, 2] * cz)


def moments(points: Tensor, values: Tensor) -> Tensor:
    """Sums (k, m, B) over the points (m, N, B|1) times values (k, N, B)."""
    if points.shape[2] == 1:
        return points[:, :, 0] @ values
    return (points * values[:, None]).sum(2)
