"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F,   F = Phi(z_outer) + 1 - Phi(z_inner),   z = (d + q^2 k / 2) / q

with d the distance in px of the pixel from the projected circle, k the curvature of the projected circle, q the blur
(point-spread function and pixel together, one for each frame). The second term of z is the pull of blur on a curved
edge. Pose and blur are found by Gauss-Newton; the two grey levels of each marker, with linear gradients over the plane,
are linear unknowns, eliminated by the Schur complement. The distortion of the lens enters once, as the ray of each
pixel. Frames and markers are padded blocks of pixels: one sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.segments import ragged_arange, rank_in_group, segment_sum

_BAND = 3.5  # px on either side of an edge
_STEPS = 6
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)
_CUT = 4.0  # robust standard deviations beyond which a pixel is left out
_LEVELS = 6  # ring and paper, each with a constant and a gradient over the plane
_QUANTISATION = 1 / 12  # variance of rounding, in grey levels^2, below which no noise estimate falls


@dataclass(frozen=True, eq=False)
class Refined:
    """Refined poses of N rows.

    Attributes:
        R: (N, 3, 3), t: (N, 3) mm, covariance: (N, 6, 6) as in `results.Poses`.
        blur: (N,) px, standard deviation of the point-spread function with the pixel.
        noise: (N,) grey levels, standard deviation of the residuals kept.
        kept: (N,) fraction of the pixels kept.
        good: (N,) bool; where False the refinement failed and the pose is the one that came in.
    """

    R: Tensor
    t: Tensor
    covariance: Tensor
    blur: Tensor
    noise: Tensor
    kept: Tensor
    good: Tensor


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Pixels of K markers, padded to P.

    row: (K,) int64. ray: (K, P, 3), on the plane z = 1. warp: (K, P, 2, 2), d(ray)/d(pixel). grey, valid: (K, P).
    center, normal: (K, 3), target frame. radii: (K, 2).
    """

    row: Tensor
    ray: Tensor
    warp: Tensor
    grey: Tensor
    valid: Tensor
    center: Tensor
    normal: Tensor
    radii: Tensor


def refine_photometric(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    rotation: Tensor,
    translation: Tensor,
    mask: Tensor,
    rings: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
) -> Refined:
    """Refines N poses on the grey values around the rings of their markers.

    Args:
        frames: (B, H, W) grey, any real dtype, in grey levels. frame: (N,) int64.
        rotation, translation: (N, 3, 3), (N, 3) to start from, within about a pixel.
        mask: (N, M) bool, markers seen. rings: (N, M, 2, 5) their fitted ellipses in raw pixels, outer and inner.
        centers, normals: (N, M, 3) in the target frame. radii: (N, M, 2), mm.
    """
    rows = rotation.shape[0]
    blocks = _gather(frames, camera, frame, mask, rings, centers, normals, radii)
    r, t = rotation, translation
    blur = torch.full((rows,), _START_BLUR, dtype=torch.float64, device=r.device)
    weight = blocks.valid
    levels, weight = _first_levels(blocks, r, t, blur)
    information = torch.zeros(rows, 7, 7, dtype=torch.float64, device=r.device)
    variance = torch.ones(rows, dtype=torch.float64, device=r.device)
    for _ in range(_STEPS):
        jac, basis, residual = _linearise(blocks, r, t, blur, levels)
        weight = _inliers(residual, blocks)
        step, level_step, information, variance = _gauss_newton(jac, basis, residual, weight, blocks.row, rows)
        r = rotations.exp(step[:, 3:6]) @ r
        t = t + step[:, :3]
        blur = (blur + step[:, 6]).clamp(*_BLUR_RANGE)
        levels = levels + level_step
    inverse, info = torch.linalg.inv_ex(information)
    covariance = inverse[:, :6, :6] * variance[:, None, None]
    kept = segment_sum(weight.sum(-1), blocks.row, rows) / segment_sum(blocks.valid.sum(-1), blocks.row, rows)
    good = (info == 0) & covariance.isfinite().all(-1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    return Refined(r, t, covariance, blur, variance.sqrt(), kept, good)


def _gather(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    mask: Tensor,
    rings: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
) -> _Blocks:
    """The pixels within the band around either circle of every marker seen."""
    height, width = frames.shape[-2:]
    row, marker = mask.nonzero().unbind(-1)
    both = rings[row, marker]  # (K, 2, 5)
    outer = both[:, 0]
    cos, sin = outer[:, 4].cos(), outer[:, 4].sin()
    reach_u = torch.hypot(outer[:, 2] * cos, outer[:, 3] * sin) + _BAND
    reach_v = torch.hypot(outer[:, 2] * sin, outer[:, 3] * cos) + _BAND
    low_u, high_u = (
        (outer[:, 0] - reach_u).ceil().clamp_min(0).long(),
        (outer[:, 0] + reach_u).floor().clamp_max(width - 1).long(),
    )
    low_v, high_v = (
        (outer[:, 1] - reach_v).ceil().clamp_min(0).long(),
        (outer[:, 1] + reach_v).floor().clamp_max(height - 1).long(),
    )
    across = high_u - low_u + 1
    block, position = ragged_arange(across * (high_v - low_v + 1))
    u, v = low_u[block] + position % across[block], low_v[block] + position // across[block]
    uv = torch.stack([u, v], -1).double()
    near = (
        torch.minimum(ellipse.distance(uv, block, both[:, 0]).abs(), ellipse.distance(uv, block, both[:, 1]).abs())
        < _BAND
    )
    block, u, v, uv = block[near], u[near], v[near], uv[near]

    count = row.numel()
    slot = rank_in_group(block, count)
    most = int(slot.max()) + 1 if slot.numel() else 1

    def padded(values: Tensor, fill: float) -> Tensor:
        out = torch.full((count, most, *values.shape[1:]), fill, dtype=torch.float64, device=frames.device)
        out[block, slot] = values.double()
        return out

    xy = camera.undistort_points(uv)
    warp = torch.linalg.inv(camera.J_distort(xy))
    grey = frames.reshape(-1)[(frame[row[block]] * height + v) * width + u]
    sound = xy.isfinite().all(-1)
    xy, warp = torch.where(sound[:, None], xy, 0.0), torch.where(sound[:, None, None], warp, 0.0)
    ray = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
    return _Blocks(
        row,
        padded(ray, 1.0),
        padded(warp, 0.0),
        padded(grey, 0.0),
        padded(sound, 0.0),
        centers[row, marker],
        normals[row, marker],
        radii[row, marker],
    )


def _fraction(b: _Blocks, r: Tensor, t: Tensor, blur: Tensor) -> tuple[Tensor, ...]:
    """Paper fraction F (K, P) and what its derivatives need.

    Returns:
        F, dF/dd (K, P) (through both circles), dF/dq (K, P), the derivative of d by the pose (K, P, 6), and the plane
        coordinates over the outer radius (K, P, 2).
    """
    rk, tk, q = r[b.row], t[b.row], blur[b.row][:, None]
    normal = (rk @ b.normal[..., None]).squeeze(-1)
    center = (rk @ b.center[..., None]).squeeze(-1) + tk
    along = (b.ray @ normal[..., None]).squeeze(-1)  # n . ray
    depth = (normal * center).sum(-1)[:, None] / along
    point = depth[..., None] * b.ray - center[:, None]  # in the plane, camera axes
    radius = torch.linalg.vector_norm(point, dim=-1).clamp_min(1e-9)
    e = point / radius[..., None]
    m = e - normal[:, None] * ((e * b.ray).sum(-1) / along)[..., None]
    # a pixel's ray moves the point by depth m . d(ray): gradient of the radius in the image
    gradient = ((depth[..., None] * m[..., :2])[..., None, :] @ b.warp).squeeze(-2)
    slope = torch.linalg.vector_norm(gradient, dim=-1).clamp_min(1e-12)
    # |det| of pixel -> plane: depth^3 / (n . c) |det warp|, as the plane's area under a solid angle
    area = depth.square() * b.warp.det().abs() / along.abs()
    bend = area.square() / (slope**3 * radius)  # curvature of the circle's image, 1/px
    z_outer, z_inner = (((radius - size[:, None]) / slope + 0.5 * q.square() * bend) / q for size in b.radii.unbind(-1))
    f = _phi(z_outer) + 1 - _phi(z_inner)
    p_outer, p_inner = _density(z_outer), _density(z_inner)
    by_d = (p_outer - p_inner) / q
    by_q = p_outer * (bend - z_outer / q) - p_inner * (bend - z_inner / q)
    arm = point + center[:, None] - tk[:, None]  # R p: the point about the target's origin
    by_pose = -torch.cat([m, torch.linalg.cross(arm, m)], -1) / slope[..., None]
    plane = _plane_axes(normal)
    xy = point @ plane.mT / b.radii[:, :1, None]
    return f, by_d, by_q, by_pose, xy


def _plane_axes(normal: Tensor) -> Tensor:
    """Two unit vectors (K, 2, 3) across ``normal`` (K, 3)."""
    axis = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal)
    first = torch.linalg.cross(normal, axis)
    first = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(normal, first)], 1)


def _phi(z: Tensor) -> Tensor:
    return 0.5 * torch.erfc(-z / math.sqrt(2))


def _density(z: Tensor) -> Tensor:
    return torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)


def _level_basis(f: Tensor, xy: Tensor) -> Tensor:
    """Columns (K, P, 6) of the linear unknowns: ring (1, x, y), paper (1, x, y)."""
    plane = torch.cat([torch.ones_like(xy[..., :1]), xy], -1)
    return torch.cat([(1 - f)[..., None] * plane, f[..., None] * plane], -1)


def _first_levels(b: _Blocks, r: Tensor, t: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """Grey levels (K, 6) for the poses that come in, by a few reweighted linear fits, and the weights (K, P)."""
    f, _, _, _, xy = _fraction(b, r, t, blur)
    basis = _level_basis(f, xy)
    weight = b.valid
    levels = torch.zeros(basis.shape[0], _LEVELS, dtype=torch.float64, device=f.device)
    for _ in range(4):
        weighted = basis * weight[..., None]
        levels = _solve(weighted.mT @ basis, (weighted.mT @ b.grey[..., None]).squeeze(-1))
        residual = b.grey - (basis @ levels[..., None]).squeeze(-1)
        scale = _spread(residual, b.valid)
        weight = b.valid / (1 + (residual / (2 * scale[:, None])).square()).square()
    return levels, weight


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions of small symmetric systems (K, n, n), (K, n); a trace of the diagonal keeps empty blocks solvable."""
    n = matrix.shape[-1]
    ridge = 1e-12 * matrix.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
    return torch.linalg.solve(
        matrix + ridge[:, None, None] * torch.eye(n, dtype=matrix.dtype, device=matrix.device), right
    )


def _spread(residual: Tensor, valid: Tensor) -> Tensor:
    """Robust standard deviation (K,) from the median absolute residual."""
    masked = residual.abs().masked_fill(valid == 0, torch.nan)
    return (1.4826 * masked.nanmedian(-1).values).nan_to_num(nan=1.0).clamp_min(math.sqrt(_QUANTISATION))


def _linearise(b: _Blocks, r: Tensor, t: Tensor, blur: Tensor, levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the prediction by pose and blur (K, P, 7) and by the levels (K, P, 6), and residuals (K, P)."""
    f, by_d, by_q, by_pose, xy = _fraction(b, r, t, blur)
    basis = _level_basis(f, xy)
    plane = torch.cat([torch.ones_like(xy[..., :1]), xy], -1)
    contrast = (plane @ (levels[:, 3:] - levels[:, :3])[..., None]).squeeze(-1)
    jac = torch.cat([(contrast * by_d)[..., None] * by_pose, (contrast * by_q)[..., None]], -1)
    return jac, basis, b.grey - (basis @ levels[..., None]).squeeze(-1)


def _inliers(residual: Tensor, b: _Blocks) -> Tensor:
    scale = _spread(residual, b.valid)
    return b.valid * (residual.abs() < _CUT * scale[:, None])


def _gauss_newton(
    jac: Tensor, basis: Tensor, residual: Tensor, weight: Tensor, row: Tensor, rows: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Step (N, 7), level step (K, 6), reduced information (N, 7, 7) and residual variance (N,)."""
    columns = torch.cat([jac, basis, residual[..., None]], -1)
    sums = (columns * weight[..., None]).mT @ columns  # (K, 14, 14)
    nn, nb, bb = sums[:, :7, :7], sums[:, :7, 7:13], sums[:, 7:13, 7:13]
    gn, gb = sums[:, :7, 13], sums[:, 7:13, 13]
    ridge = 1e-9 * bb.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
    bb = bb + ridge[:, None, None] * torch.eye(_LEVELS, dtype=bb.dtype, device=bb.device)
    eliminated = torch.linalg.solve(bb, torch.cat([nb.mT, gb[..., None]], -1))  # (K, 6, 8)
    information = segment_sum(nn - nb @ eliminated[..., :7], row, rows)
    right = segment_sum(gn - (nb @ eliminated[..., 7:]).squeeze(-1), row, rows)
    step = _solve_scaled(information, right)
    level_step = eliminated[..., 7] - (eliminated[..., :7] @ step[row][..., None]).squeeze(-1)
    used = segment_sum(weight.sum(-1), row, rows)
    unknowns = 7 + _LEVELS * torch.bincount(row, minlength=rows)
    chi2 = segment_sum(sums[:, 13, 13], row, rows)
    variance = (chi2 / (used - unknowns).clamp_min(1)).clamp_min(_QUANTISATION)
    return step, level_step, information, variance


def _solve_scaled(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves after scaling every unknown by its own information: millimetres and radians differ by orders."""
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).rsqrt()
    return scale * _solve(matrix * scale[:, :, None] * scale[:, None, :], right * scale)
