"""POSIT (DeMenthon, Davis, IJCV 15, 1995) and coplanar POSIT (Oberkampf, DeMenthon, Davis, CVIU 63, 1996).

A scaled orthographic pose is linear in the image points; the perspective of the pose found corrects the image points,
and so on. For a plane, the linear system leaves the components along the normal open: the two poses that the unit
length and orthogonality of the axes allow are both followed, each branch keeping the better of its two descendants.
"""

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import cross, inverse3, matmul3
from torchpose.pnp.candidates import Candidates, batch_last, rank, weighted_mean
from torchpose.pnp.planar import plane_frame, ray_frame

_ITERATIONS = 60


def posit(object_points: Tensor, image_points: Tensor, mask: Tensor | None = None) -> Candidates:
    """Pose by iterated scaled orthography, of points in general position or in a plane.

    It minimises no reprojection error: with noise it is less accurate than the other methods, and it diverges where the
    object is deeper than about half its distance.

    Args:
        object_points: (N, 3) or (B, N, 3), N >= 4, not on a line.
        image_points: (B, N, 2), undistorted normalised coordinates.
        mask: (B, N) bool, True where a point was seen.

    Returns:
        `Candidates` with S = 2: both poses of a plane; the second is NaN for points in general position.

    Raises:
        ArgumentError: the shapes do not fit.
    """
    points, xy, weight = batch_last(object_points, image_points, mask)
    frame = plane_frame(points, weight)
    flat, unit = frame.flat, frame.extent[2]
    local = frame.local(points - frame.center[:, None]) / unit
    if weight is not None:
        local = local * weight
    scatter = (local[:, None] * local).sum(2)
    # a flat object has no extent along the normal: the row is dropped
    scatter[2, 2] = torch.where(flat, 1.0, scatter[2, 2])
    scatter[:2, 2] = scatter[2, :2] = torch.where(flat, 0.0, scatter[:2, 2])
    solver = inverse3(scatter)
    solver = torch.where(flat & (torch.arange(3, device=xy.device) == 2)[:, None, None], 0.0, solver)
    basis = (solver[:, :, None] * local).sum(1)  # (3, N, B): pseudo-inverse of the centred points

    # turn the camera towards the centroid: off its axis, scaled orthography errs however far the object is
    turn = ray_frame(weighted_mean(xy, weight))
    x, y, z = turn[0, :, None] * xy[0] + turn[1, :, None] * xy[1] + turn[2, :, None]
    turned = torch.stack([x, y]) / z

    # one more dimension for branches
    local, basis, image = (v.unsqueeze(-2) for v in (local, basis, turned))
    share = None if weight is None else weight.unsqueeze(-2)
    r, t = _linear_poses(basis, image, share, flat)
    r, t = r[..., 0, :], t[..., 0, :]  # (3, 3, 2, B), (3, 2, B): both poses of scaled orthography
    for _ in range(_ITERATIONS):
        depth = 1 + (r[2, :, None] * local).sum(0) / t[2]  # (N, S, B), over that of the centroid
        r, t = _linear_poses(basis, image * depth, share, flat)  # two descendants a branch
        error = torch.stack([_error(r[:, :, k], t[:, k], local, image, share) for k in (0, 1)])
        first = error[0] <= error[1]
        r, t = torch.where(first, r[:, :, 0], r[:, :, 1]), torch.where(first, t[:, 0], t[:, 1])
    second = flat | (torch.arange(2, device=xy.device) == 0)[:, None]
    r = torch.where(second & frame.wide, r, torch.nan)
    r, t = matmul3(matmul3(turn[:, :, None], r), frame.axes[:, :, None]), matmul3(turn[:, :, None], t[:, None])[:, 0]
    t = t * unit - (r * frame.center[:, None]).sum(1)
    return rank(r, t, points, xy, weight)


def _linear_poses(basis: Tensor, scaled: Tensor, weight: Tensor | None, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Poses R (3, 3, 2, S, B), t (3, 2, S, B) of image points times depth (2, N, S, B); equal where not flat."""
    i, j = (basis[:, None] * scaled).sum(2).unbind(1)  # (3, S, B): rows of R over the depth, but for the normal
    mixed, difference = (i * j).sum(0), j.square().sum(0) - i.square().sum(0)
    # lambda + i mu, components along the normal: (lambda + i mu)^2 = difference - 2 i mixed
    modulus = (difference.square() + 4 * mixed.square()).sqrt()
    lam = (0.5 * (modulus + difference)).clamp_min(0).sqrt()
    mu = (0.5 * (modulus - difference)).clamp_min(0).sqrt() * torch.where(mixed > 0, -1.0, 1.0)
    lam, mu = torch.where(flat, lam, 0.0), torch.where(flat, mu, 0.0)
    zero = torch.zeros_like(lam)
    normal_i, normal_j = torch.stack([zero, zero, lam]), torch.stack([zero, zero, mu])
    x = torch.stack([i + normal_i, i - normal_i], 1)  # (3, 2, S, B)
    y = torch.stack([j + normal_j, j - normal_j], 1)
    lengths = x.square().sum(0).sqrt(), y.square().sum(0).sqrt()
    depth = 1 / (lengths[0] * lengths[1]).sqrt()
    x = x / lengths[0]
    z = cross(x, y)
    z = z / z.square().sum(0).sqrt()
    mean = weighted_mean(scaled, weight)[:, None]  # (2, 1, S, B)
    return torch.stack([x, cross(z, x), z]), torch.cat([mean * depth, depth[None]])


def _error(r: Tensor, t: Tensor, points: Tensor, xy: Tensor, weight: Tensor | None) -> Tensor:
    """Sums (S, B) of squared distances from the image points."""
    x, y, z = r[:, 0, None] * points[0] + r[:, 1, None] * points[1] + r[:, 2, None] * points[2] + t[:, None]
    square = (x / z - xy[0]).square() + (y / z - xy[1]).square()
    return (square if weight is None else square * weight).sum(0)
