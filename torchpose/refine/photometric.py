"""Photometric refinement: the pose whose rendered rings come closest to the grey values themselves.

Every pixel in a band around the edges of a frame's rings is predicted as

    grey = ring + (paper - ring) F,   F = Phi(z_outer) + 1 - Phi(z_inner),   z = (d + q^2 k / 2) / q

with d the distance in px of the pixel from the projected circle, k the curvature of the projected circle, q the blur
(point-spread function and pixel together, one for each frame). The second term of z is the pull of blur on a curved
edge; Phi carries the fourth cumulant of the square pixel. Pose and blur are found by Gauss-Newton; the two grey levels
of each marker, with linear gradients over the plane, are linear unknowns, eliminated by the Schur complement. The
distortion of the lens enters once, as the ray of each pixel. Frames and markers are padded blocks of pixels: one
sequence of tensor operations for the whole batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_sum
from torchpose.refine.band import band_pixels

_BAND = 3.5  # px on either side of an edge
_COARSE = 4  # the first steps take one pixel of so many
_STEPS = (3, 1)  # of Gauss-Newton, on some of the pixels and on all
_START_BLUR = 0.8  # px
_BLUR_RANGE = (0.3, 4.0)
_CUT = 4.0  # robust standard deviations beyond which a pixel is left out
_TILE = 256  # pixels summed in float32 at a time; sums of tiles are float64, so padding changes no digit that counts
_MOST_SPREAD = 1.5  # of a marker's residuals, in those of the best marker of its frame
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
        good: (N,) bool; where False the refinement failed and the other fields mean nothing.
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
    """Pixels of K markers, padded to P; one plane of numbers (K, P) for every component.

    row: (K,) int64. ray_x, ray_y: on the plane z = 1. warp: 4 planes, d(ray)/d(pixel) row by row. grey, valid.
    center, normal: (K, 3), target frame. radii: (K, 2).
    """

    row: Tensor
    ray_x: Tensor
    ray_y: Tensor
    warp: tuple[Tensor, ...]
    grey: Tensor
    valid: Tensor
    center: Tensor
    normal: Tensor
    radii: Tensor

    def every(self, nth: int) -> _Blocks:
        """The same with one pixel of ``nth``."""
        planes = {n: getattr(self, n)[:, ::nth].contiguous() for n in ("ray_x", "ray_y", "grey", "valid")}
        return replace(self, **planes, warp=tuple(w[:, ::nth].contiguous() for w in self.warp))


class _Model(NamedTuple):
    """Prediction and derivatives at one pose; planes (K, P) in float32.

    fraction: of paper, F. by_d, by_q: dF/dd through both circles, dF/dq. by_pose: 6 planes, derivative of d.
    x, y: plane coordinates over the outer radius.
    """

    fraction: Tensor
    by_d: Tensor
    by_q: Tensor
    by_pose: tuple[Tensor, ...]
    x: Tensor
    y: Tensor


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
    *,
    prior: Tensor | None = None,
) -> Refined:
    """Refines N poses on the grey values around the rings of their markers.

    Args:
        frames: (B, H, W) grey, any real dtype, in grey levels. frame: (N,) int64.
        rotation, translation: (N, 3, 3), (N, 3) to start from, within about a pixel.
        mask: (N, M) bool, markers seen. rings: (N, M, 2, 5) their fitted ellipses in raw pixels, outer and inner.
        centers, normals: (N, M, 3) in the target frame. radii: (N, M, 2), mm.
        prior: (N, 6, 6), information about the pose besides the frames, that is the inverse covariance of the start:
            from the robot, or to hold what is known.
    """
    rows = rotation.shape[0]
    blocks = _gather(frames, camera, frame, mask, rings, centers, normals, radii)
    r, t = rotation, translation
    blur = torch.full((rows,), _START_BLUR, dtype=torch.float64, device=r.device)
    coarse = blocks.every(_COARSE)
    levels = _first_levels(coarse, r, t, blur)
    weight = blocks.valid
    information = torch.zeros(rows, 7, 7, dtype=torch.float64, device=r.device)
    variance = torch.ones(rows, dtype=torch.float64, device=r.device)
    known = torch.zeros_like(information) if prior is None else torch.nn.functional.pad(prior, (0, 1, 0, 1))
    moved = torch.zeros(rows, 7, dtype=torch.float64, device=r.device)
    for part in (*[coarse] * _STEPS[0], *[blocks] * _STEPS[1]):
        columns = _columns(part, _model(part, r, t, blur), levels)
        weight = _inliers(columns[:, :, -1].flatten(1), part)
        step, level_step, information, variance = _gauss_newton(columns, weight, blocks.row, rows, known, moved)
        moved = moved + step
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
    block, u, v = band_pixels(both[:, 0], both[:, 1], _BAND, height, width)
    uv = torch.stack([u, v], -1).double()
    count = row.numel()
    size = torch.bincount(block, minlength=count)
    # the pixels of the first steps, one of so many, are a whole number of tiles too
    grain = _TILE * _COARSE
    most = (int(size.max()) // grain + 1) * grain if count else grain
    start = torch.arange(count, device=block.device) * most - (size.cumsum(0) - size)
    place = torch.arange(block.numel(), device=block.device) + start[block]

    def padded(values: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
        out = torch.zeros(count * most, dtype=dtype, device=frames.device)
        return out.index_copy_(0, place, values.to(dtype)).view(count, most)

    xy = camera.undistort_points(uv)
    grey = frames.reshape(-1)[(frame[row[block]] * height + v) * width + u].float()
    sound = xy.isfinite().all(-1) & grey.isfinite()
    xy = torch.where(sound[:, None], xy, 0.0)
    j00, j01, j10, j11 = camera.J_distort(xy).flatten(-2).unbind(-1)
    det = j00 * j11 - j01 * j10
    warp = tuple(padded(w / det, torch.float32) for w in (j11, -j01, -j10, j00))
    return _Blocks(
        row,
        *(padded(c) for c in xy.unbind(-1)),
        warp,
        padded(torch.where(sound, grey, 0.0), torch.float32),
        padded(sound, torch.float32),
        centers[row, marker],
        normals[row, marker],
        radii[row, marker],
    )


def _model(b: _Blocks, r: Tensor, t: Tensor, blur: Tensor) -> _Model:
    """Predicts every pixel. The radius in the plane is formed in float64, what is small beside it in float32."""
    rk = r[b.row]
    normal = (rk @ b.normal[..., None]).squeeze(-1)
    arm = (rk @ b.center[..., None]).squeeze(-1)  # marker's centre about the target's origin, camera axes
    center = arm + t[b.row]
    one, two = _plane_axes(normal).unbind(1)

    def scalar(value: Tensor) -> Tensor:
        return value[:, None]

    def along(axis: Tensor) -> Tensor:
        return scalar(axis[:, 0]) * b.ray_x + scalar(axis[:, 1]) * b.ray_y + scalar(axis[:, 2])

    # the ray of the pixel meets the plane at depth * ray; coordinates about the circle's centre
    toward = 1 / along(normal)
    depth = scalar((normal * center).sum(-1)) * toward
    one_c, two_c = scalar((one * center).sum(-1)), scalar((two * center).sum(-1))
    x, y = depth * along(one) - one_c, depth * along(two) - two_c
    radius = torch.hypot(x, y).clamp_min(1e-9)
    outer, inner = ((radius - scalar(size)).float() for size in b.radii.unbind(-1))

    x, y, radius, depth, toward = (v.float() for v in (x, y, radius, depth, toward))
    one_c, two_c, q = one_c.float(), two_c.float(), scalar(blur[b.row]).float()
    axes = [[scalar(c).float() for c in v.unbind(-1)] for v in (one, two, normal, arm)]
    (ax, ay, az), (bx, by, bz), (nx, ny, nz), (cx, cy, cz) = axes
    ex, ey = x / radius, y / radius
    # a displacement w of the ray's foot, or of the plane against it, changes the radius by m . w
    s = (radius + ex * one_c + ey * two_c) / depth * toward
    mx, my, mz = ex * ax + ey * bx - s * nx, ex * ay + ey * by - s * ny, ex * az + ey * bz - s * nz
    w00, w01, w10, w11 = b.warp
    gu, gv = mx * w00 + my * w10, mx * w01 + my * w11  # gradient of the radius in the image, over the depth
    flat = (gu.square() + gv.square()).clamp_min(1e-30).rsqrt()
    per_mm = flat / depth  # px for a mm of radius
    # area of a pixel in the plane, mm^2; curvature of the circle's image, 1/px
    area = depth.square() * (w00 * w11 - w01 * w10).abs() * toward.abs()
    bend = area.square() * per_mm.pow(3) / radius
    # to second order in the distance: along the image's normal the radius bends where that normal is oblique in the
    # plane, and by perspective; both as second over first derivative, 1/px, halved
    nu, nv = gu * flat, gv * flat
    side = (ex * two_c - ey * one_c) / depth * toward
    hx, hy = ex * bx - ey * ax - side * nx, ex * by - ey * ay - side * ny  # as m, but across the radius
    oblique = (hx * w00 + hy * w10) * nu + (hx * w01 + hy * w11) * nv
    recede = ((nx * w00 + ny * w10) * nu + (nx * w01 + ny * w11) * nv) * toward
    second = 0.5 * oblique.square() * depth * flat / radius - recede
    d_outer, d_inner = outer * per_mm, inner * per_mm
    d_outer, d_inner = d_outer + second * d_outer.square(), d_inner + second * d_inner.square()
    pull = 0.5 * q * bend
    z_outer, z_inner = d_outer / q + pull, d_inner / q + pull
    # the pixel's square is not Gaussian: its fourth cumulant along the edge's normal, -(c^4 + s^4) / 120 px^4
    square = (1 - 2 * (nu * nv).square()) / (24 * 120) / q.square().square()
    f_outer, p_outer = _edge(z_outer, square)
    f_inner, p_inner = _edge(z_inner, square)
    px, py, pz = x * ax + y * bx + cx, x * ay + y * by + cy, x * az + y * bz + cz
    by_pose = tuple(-per_mm * v for v in (mx, my, mz, py * mz - pz * my, pz * mx - px * mz, px * my - py * mx))
    size = scalar(b.radii[:, 0]).float()
    return _Model(
        f_outer + 1 - f_inner,
        (p_outer - p_inner) / q,
        p_outer * (bend - z_outer / q) - p_inner * (bend - z_inner / q),
        by_pose,
        x / size,
        y / size,
    )


def _plane_axes(normal: Tensor) -> Tensor:
    """Two unit vectors (K, 2, 3) across ``normal`` (K, 3)."""
    axis = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal)
    first = torch.linalg.cross(normal, axis)
    first = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(normal, first)], 1)


def _edge(z: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    """Blurred step and its slope at ``z`` standard deviations: the normal law and its fourth-order Edgeworth term."""
    z2 = z.square()
    density = torch.exp(-0.5 * z2) * (1 / math.sqrt(2 * math.pi))
    step = 0.5 * torch.erfc(-z * math.sqrt(0.5)) + square * density * z * (z2 - 3)
    return step, density * (1 - square * (z2 * (z2 - 6) + 3))


def _basis(m: _Model) -> tuple[Tensor, ...]:
    """Planes of the linear unknowns: ring (1, x, y), paper (1, x, y)."""
    ring = 1 - m.fraction
    return ring, ring * m.x, ring * m.y, m.fraction, m.fraction * m.x, m.fraction * m.y


def _columns(b: _Blocks, m: _Model, levels: Tensor) -> Tensor:
    """Derivatives by pose (6), blur (1) and levels (6), and the residual, by tiles: (K, P / 256, 14, 256) float32."""
    a0, ax, ay, p0, px, py = (v[:, None].float() for v in levels.unbind(-1))
    ring, paper = a0 + ax * m.x + ay * m.y, p0 + px * m.x + py * m.y
    contrast = paper - ring
    by_d = contrast * m.by_d
    residual = b.grey - (ring + contrast * m.fraction)
    return _tiled((*(by_d * v for v in m.by_pose), contrast * m.by_q, *_basis(m), residual), b.valid)


def _tiled(planes: tuple[Tensor, ...], valid: Tensor) -> Tensor:
    """Planes (K, P) as (K, P / 256, planes, 256), zero where padded."""
    tiles = torch.stack([p.unflatten(1, (-1, _TILE)) for p in planes], 2)
    return tiles.masked_fill_(valid.unflatten(1, (-1, 1, _TILE)) == 0, 0.0)


def _products(columns: Tensor, weight: Tensor) -> Tensor:
    """Sums over all pixels of weight times the products of every two columns: (K, n, n) float64."""
    weighted = columns * weight.unflatten(1, (-1, 1, _TILE))
    return (weighted @ columns.mT).double().sum(1)


def _first_levels(b: _Blocks, r: Tensor, t: Tensor, blur: Tensor) -> Tensor:
    """Grey levels (K, 6) for the poses that come in: medians, then reweighted linear fits.

    A third of a ring may be covered: a least-squares fit of gradients would bend towards the cover and stay there.
    """
    model = _model(b, r, t, blur)
    columns = _tiled((*_basis(model), b.grey), b.valid)
    none = torch.zeros_like(model.fraction[:, 0])
    ring, paper = _median(b.grey, b.valid * (model.fraction < 0.05)), _median(b.grey, b.valid * (model.fraction > 0.95))
    levels = torch.stack([ring, none, none, paper, none, none], -1).nan_to_num(nan=0.0).double()
    for _ in range(3):
        predicted = (levels.float()[:, None, None] @ columns[:, :, :_LEVELS]).flatten(1)
        residual = b.grey - predicted
        weight = b.valid / (1 + (residual / (2 * _spread(residual, b)[:, None])).square()).square()
        sums = _products(columns, weight)
        levels = _solve(sums[:, :_LEVELS, :_LEVELS], sums[:, :_LEVELS, _LEVELS])
    return levels


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions of small symmetric systems (K, n, n), (K, n); a trace of the diagonal keeps empty blocks solvable."""
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    ridge = 1e-12 * matrix.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
    return torch.linalg.solve(matrix + ridge[:, None, None] * eye, right)


def _median(values: Tensor, where: Tensor) -> Tensor:
    """Medians (K,) of the values (K, P) where the mask is not 0; NaN where it is 0 everywhere."""
    return values.masked_fill(where == 0, torch.nan).nanmedian(-1).values


def _spread(residual: Tensor, b: _Blocks) -> Tensor:
    """Robust standard deviation (K,) from the median absolute residual.

    All markers of a frame share its noise, so none may claim much more than the best of them: cover would.
    """
    own = (1.4826 * _median(residual.abs(), b.valid)).nan_to_num(nan=1.0).clamp_min(math.sqrt(_QUANTISATION))
    least = torch.full((int(b.row.max()) + 1 if len(own) else 0,), torch.inf, dtype=own.dtype, device=own.device)
    least = least.scatter_reduce(0, b.row, own, "amin")
    return torch.minimum(own, _MOST_SPREAD * least[b.row])


def _inliers(residual: Tensor, b: _Blocks) -> Tensor:
    return b.valid * (residual.abs() < _CUT * _spread(residual, b)[:, None])


def _gauss_newton(
    columns: Tensor, weight: Tensor, row: Tensor, rows: int, known: Tensor, moved: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Step (N, 7), level step (K, 6), reduced information (N, 7, 7) and residual variance (N,)."""
    sums = _products(columns, weight)  # (K, 14, 14)
    nn, nb, bb = sums[:, :7, :7], sums[:, :7, 7:13], sums[:, 7:13, 7:13]
    gn, gb = sums[:, :7, 13], sums[:, 7:13, 13]
    ridge = 1e-9 * bb.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
    bb = bb + ridge[:, None, None] * torch.eye(_LEVELS, dtype=bb.dtype, device=bb.device)
    eliminated = torch.linalg.solve(bb, torch.cat([nb.mT, gb[..., None]], -1))  # (K, 6, 8)
    information = segment_sum(nn - nb @ eliminated[..., :7], row, rows)
    right = segment_sum(gn - (nb @ eliminated[..., 7:]).squeeze(-1), row, rows)
    used = segment_sum(weight.sum(-1), row, rows)
    unknowns = 7 + _LEVELS * torch.bincount(row, minlength=rows)
    chi2 = segment_sum(sums[:, 13, 13], row, rows)
    variance = (chi2 / (used - unknowns).clamp_min(1)).clamp_min(_QUANTISATION)
    known = known * variance[:, None, None]
    information = information + known
    step = _solve_scaled(information, right - (known @ moved[..., None]).squeeze(-1))
    level_step = eliminated[..., 7] - (eliminated[..., :7] @ step[row][..., None]).squeeze(-1)
    return step, level_step, information, variance


def _solve_scaled(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves after scaling every unknown by its own information: millimetres and radians differ by orders."""
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).rsqrt()
    return scale * _solve(matrix * scale[:, :, None] * scale[:, None, :], right * scale)
