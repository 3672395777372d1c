"""EPnP (Lepetit, Moreno-Noguer, Fua, IJCV 81, 2009): points as weighted sums of four control points, three for a plane.

The control points in the camera frame are a combination of the least eigenvectors of a 12 x 12 (plane: 9 x 9) matrix.
The factors come from the distances between control points, which a rigid motion keeps: linearly from each of the
paper's approximations, then by Gauss-Newton. The pose with the least reprojection error is kept.
"""

from itertools import combinations

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import solve_spd
from torchpose.pnp.candidates import Candidates, batch_last, rank
from torchpose.pnp.dlt import least_eigenvectors, nearest_rotation
from torchpose.pnp.planar import Frame, plane_frame, translation

_STEPS = 10
# products of factors that each linear start solves for; the first of them is a square
_APPROXIMATIONS = {
    4: (((0, 0), (0, 1), (0, 2), (0, 3)), ((0, 0), (0, 1), (1, 1)), ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2))),
    3: (((0, 0),), ((0, 0), (0, 1), (1, 1))),
}


def epnp(object_points: Tensor, image_points: Tensor, mask: Tensor | None = None) -> Candidates:
    """Pose of points in general position or in a plane.

    Args:
        object_points: (N, 3) or (B, N, 3), N >= 4 in a plane, N >= 6 otherwise (4 and 5 work, with less certainty).
        image_points: (B, N, 2), undistorted normalised coordinates.
        mask: (B, N) bool, True where a point was seen.

    Returns:
        `Candidates` with S = 1; NaN for collinear points. For a plane this is one of its two poses, not always the
        better one: `planar` finds both.

    Raises:
        ArgumentError: the shapes do not fit.
    """
    points, xy, weight = batch_last(object_points, image_points, mask)
    batch = xy.shape[2]
    shared = plane_frame(points, weight)
    flat = shared.flat.expand(batch)
    frame = Frame(*(v.expand(*v.shape[:-1], batch) for v in shared))
    points = points.expand(-1, -1, batch)
    r = points.new_full((3, 3, 3, batch), torch.nan)
    for controls, rows in ((3, flat.nonzero().squeeze(1)), (4, (~flat).nonzero().squeeze(1))):
        if len(rows):
            part = Frame(*(v[..., rows] for v in frame))
            found = _rotations(
                controls, None if weight is None else weight[:, rows], points[..., rows], xy[..., rows], part
            )
            r[:, :, : found.shape[2], rows] = found
    r = torch.where(frame.wide, r, torch.nan)
    solutions = rank(r, translation(r, points, xy, weight, frame.center), points, xy, weight)
    return Candidates(*(v[:, :1] for v in solutions))


def _rotations(controls: int, weight: Tensor | None, points: Tensor, xy: Tensor, frame: Frame) -> Tensor:
    """R (3, 3, S, B), one of each approximation."""
    # control points: the centroid and one standard deviation along each principal axis
    axes = controls - 1
    sizes = frame.extent.flip(0)[:axes]  # the normal comes first in extent, last in the axes
    offset = points - frame.center[:, None]
    local = frame.local(offset)[:axes] / sizes[:, None]
    alpha = torch.cat([1 - local.sum(0, keepdim=True), local])  # (C, N, B)
    if weight is not None:
        alpha = torch.where(weight > 0, alpha, 0.0)
    x, y = xy
    zero = torch.zeros_like(alpha)
    # unknowns: control points one after the other, x y z each
    u = torch.stack([alpha, zero, -x * alpha], 1).flatten(0, 1)  # (3C, N, B)
    v = torch.stack([zero, alpha, -y * alpha], 1).flatten(0, 1)
    normal = (u[:, None] * u).sum(2) + (v[:, None] * v).sum(2)
    kernel = least_eigenvectors(normal)[:, :, : axes + 1].permute(2, 1, 0).unflatten(1, (controls, 3))  # (K, C, 3, B)

    pairs = list(combinations(range(controls), 2))
    d = torch.stack([kernel[:, i] - kernel[:, j] for i, j in pairs], 1)  # (K, P, 3, B)
    # squared distances of the control points in the object frame
    rho = torch.stack([sizes[j - 1] ** 2 + (sizes[i - 1] ** 2 if i else 0) for i, j in pairs])  # (P, B)
    rotations = []
    for terms in _APPROXIMATIONS[controls]:
        columns = torch.stack([(1 if i == j else 2) * (d[i] * d[j]).sum(1) for i, j in terms])  # (T, P, B)
        products = _least_squares(columns, rho)
        beta = torch.zeros_like(d[:, 0, 0])
        square = products[0]
        beta[0] = square.abs().sqrt()
        for value, (i, j) in zip(products[1:], terms[1:], strict=True):
            if i == 0:
                beta[j] = value * torch.sign(square) / beta[0]
            elif i == j and (0, j) in terms:
                # the square gives the size, the mixed product the sign
                beta[j] = torch.where(beta[j] < 0, -1.0, 1.0) * (value * torch.sign(square)).clamp_min(0).sqrt()
        beta = _gauss_newton(beta, d, rho)
        control = (beta[:, None, None] * kernel).sum(0)  # (C, 3, B)
        camera = (alpha[:, None] * control[:, :, None]).sum(0)  # (3, N, B)
        camera = camera * torch.where(camera[2].sum(0) < 0, -1.0, 1.0)
        mean = camera.mean(1) if weight is None else camera.sum(1) / weight.sum(0)
        centred = camera - mean[:, None]
        if weight is not None:
            centred, offset = centred * weight, offset * weight
        rotations.append(nearest_rotation((centred[:, None] * offset).sum(2).permute(2, 0, 1)).permute(1, 2, 0))
    return torch.stack(rotations, 2)


def _least_squares(columns: Tensor, rhs: Tensor) -> Tensor:
    """Solution (T, B) of sum_k columns[k] x[k] = rhs, for columns (T, P, B) and rhs (P, B)."""
    normal = (columns[:, None] * columns).sum(2)
    # a little damping: the approximations leave products undetermined where the kernel has fewer dimensions
    damped = normal * (1 + 1e-12 * torch.eye(len(columns), dtype=rhs.dtype, device=rhs.device)[..., None])
    return solve_spd(damped, (columns * rhs).sum(1)[:, None])[0].squeeze(1)


def _gauss_newton(beta: Tensor, apart: Tensor, rho: Tensor) -> Tensor:
    """Factors (K, B) that make the distances |sum_k beta_k apart_k|^2 equal to rho (P, B), for apart (K, P, 3, B)."""
    for _ in range(_STEPS):
        difference = (beta[:, None, None] * apart).sum(0)  # (P, 3, B)
        residual = rho - difference.square().sum(1)
        step = _least_squares(2 * (apart * difference).sum(2), residual)
        better = (rho - ((beta + step)[:, None, None] * apart).sum(0).square().sum(1)).square().sum(0)
        beta = torch.where(better < residual.square().sum(0), beta + step, beta)
    return beta
