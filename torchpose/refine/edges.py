"""Edge refinement: the pose whose projected circles pass closest to all sub-pixel edge points of all rings.

No ellipse and no centre stands between the edges and the pose, so there is no eccentricity to compensate. An edge point
read at the offset o from its pixel's centre, along the normal of increasing grey, obeys

    deblurred(o) - kappa k = l,

l the offset of the projected circle, k its curvature, kappa the shift of `zernike.curvature_shift`. The blur of each
frame is found along with its pose: the slope of o over l (`zernike.blur_slope`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpose import zernike
from torchpose.camera import Camera
from torchpose.edges import ring_edges
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.refine.gauss_newton import solve_scaled
from torchpose.refine.result import Refined

_REACH = 2.0  # px searched to either side of the fitted ellipses
_CHAIN = 2 * math.sqrt(2) / math.pi  # edge pixels per px of a circle: mean of max(|cos|, |sin|)
_START_SPREAD = 0.3  # px
_SOFT = 3.0  # Geman-McClure scale in standard deviations
_SOFT_BIAS = 1.17  # of a normal distribution, standard deviation over its RMS under these weights
_STEPS = 6
_SOFT_STEPS = 2  # of these, the first, that weigh all points instead of leaving some out
_CUT = 4.0  # robust standard deviations beyond which an edge point is left out
_CUT_FLOOR = 0.02  # px, added to the cut: what pixels alias to


def refine_edges(
    frames: Tensor,
    camera: Camera,
    frame: Tensor,
    rotation: Tensor,
    translation: Tensor,
    mask: Tensor,
    rings: Tensor,
    polarity: Tensor,
    centers: Tensor,
    normals: Tensor,
    radii: Tensor,
    *,
    prior: Tensor | None = None,
) -> Refined:
    """Refines N poses on the edge points of their rings.

    Args:
        frames: (B, H, W) grey, any real dtype, in grey levels. frame: (N,) int64.
        rotation, translation: (N, 3, 3), (N, 3) to start from, within about a pixel.
        mask: (N, M) bool, markers seen. rings: (N, M, 2, 5) their fitted ellipses in raw pixels, outer and inner.
        polarity: (N, M), +1 dark ring on light, -1 light on dark.
        centers, normals: (N, M, 3) in the target frame. radii: (N, M, 2), mm.
        prior: (N, 6, 6), as in `refine_photometric`.
    """
    rows = rotation.shape[0]
    row, marker = mask.nonzero().unbind(-1)
    both = rings[row, marker]  # (K, 2, 5)
    gap = 0.5 * (both[:, 0, 3] - both[:, 1, 3])
    reach = torch.minimum(gap, 0.6 * both[:, 1, 3]).clamp(1.0, _REACH).repeat_interleave(2)
    side = torch.tensor([1.0, -1.0], dtype=torch.float64, device=both.device)
    outward = (polarity[row, marker, None] * side).flatten()
    edges = ring_edges(frames, frame[row].repeat_interleave(2), both.flatten(0, 1), outward, reach)

    block = edges.ring // 2
    of = row[block]
    sign, radius = outward[edges.ring], radii[row, marker].flatten()[edges.ring]
    center, normal = centers[row, marker][block], normals[row, marker][block]
    xy = camera.undistort_points(edges.points)
    warp = torch.linalg.inv(camera.J_distort(xy))
    ray = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
    sound = ray.isfinite().all(-1).double()
    ray = ray.nan_to_num(nan=0.0)
    # the error of an edge point falls with the height of its step, taken from the whole circle: a high one by chance
    # must not count more
    step = segment_mean(edges.step, edges.ring, 2 * row.numel())[edges.ring]
    trust = sound * (step / segment_mean(step, of, rows)[of]).square()

    r, t = rotation, translation
    keep = sound
    spread = torch.full((rows,), _START_SPREAD, dtype=torch.float64, device=r.device)
    slope = torch.ones(rows, dtype=torch.float64, device=r.device)
    information = torch.zeros(rows, 6, 6, dtype=torch.float64, device=r.device)
    variance = torch.ones(rows, dtype=torch.float64, device=r.device)
    known = torch.zeros_like(information) if prior is None else prior
    moved = torch.zeros(rows, 6, dtype=torch.float64, device=r.device)
    for i in range(_STEPS):
        distance, bend, by_pose = circle_distance(ray, warp, r[of], t[of], center, normal, radius)
        true = edges.offset - sign * distance  # of the projected circle from the pixel's centre
        slope = zernike.blur_slope(edges.offset * keep, true * keep, of, rows)
        read = zernike.deblur(edges.offset, slope[of]) - zernike.curvature_shift(slope[of]) * bend * sign
        error = (sign * (read - true)).nan_to_num(nan=0.0)  # outside the circle where positive
        soft = sound * (1 + (error / (_SOFT * spread)[of]).square()).reciprocal().square()
        spread = _SOFT_BIAS * segment_mean(error.square(), of, rows, soft).sqrt()
        keep = sound * (error.abs() < (_CUT * spread + _CUT_FLOOR)[of])
        weight = trust * (soft if i < _SOFT_STEPS else keep)
        products = by_pose[:, :, None] * torch.cat([by_pose, error[:, None]], -1)[:, None, :]
        extra = torch.stack([weight * error.square(), (weight > 0).double()], -1)
        sums = segment_sum(torch.cat([weight[:, None] * products.flatten(1), extra], -1), of, rows)
        information, right = sums[:, :42].unflatten(1, (6, 7)).split([6, 1], -1)
        variance = _CHAIN * zernike.edge_correlation() * sums[:, 42] / (sums[:, 43] - 7).clamp_min(1)
        information = information + known * variance[:, None, None]
        pull = variance[:, None] * (known @ moved[..., None]).squeeze(-1)
        step_pose = solve_scaled(information, -right - pull[..., None]).squeeze(-1)
        moved = moved + step_pose
        r, t = rotations.exp(step_pose[:, 3:]) @ r, t + step_pose[:, :3]
    inverse, info = torch.linalg.inv_ex(information)
    covariance = inverse * variance[:, None, None]
    kept = segment_mean(keep, of, rows, sound)
    good = (info == 0) & covariance.isfinite().all(-1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    blur = ((1 - slope) * zernike.MASK**2 - 1).clamp_min(0).div(12).sqrt()
    noise = (
        (variance / (_CHAIN * zernike.edge_correlation())).sqrt()
        * slope
        * segment_mean(step, of, rows)
        / zernike.offset_noise()
    )
    return Refined(r, t, covariance, blur, noise, kept, good)


def circle_distance(
    ray: Tensor, warp: Tensor, rotation: Tensor, translation: Tensor, center: Tensor, normal: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Distances of image points from projected circles, in pixels and to first order.

    Args:
        ray: (E, 3) points on the plane z = 1. warp: (E, 2, 2), d(ray)/d(pixel).
        rotation, translation: (E, 3, 3), (E, 3) target to camera.
        center, normal: (E, 3) of the circle, target frame. radius: (E,).

    Returns:
        distance (E,) px, positive outside; curvature (E,) 1/px of the circle's image; derivative (E, 6) of the distance
        by the pose: translation, then rotation from the left.
    """
    n = (rotation @ normal[..., None]).squeeze(-1)
    c = (rotation @ center[..., None]).squeeze(-1) + translation
    along = (n * ray).sum(-1)
    depth = (n * c).sum(-1) / along
    point = depth[:, None] * ray
    arm = point - c
    reach = torch.linalg.vector_norm(arm, dim=-1)
    e = arm / reach[:, None]
    # a pixel's ray moves its point in the plane by depth m . d(ray)
    m = e - n * ((e * ray).sum(-1) / along)[:, None]
    gradient = ((depth[:, None] * m[:, :2])[:, None] @ warp).squeeze(1)
    slope = torch.linalg.vector_norm(gradient, dim=-1)
    # |det| of pixel -> plane, and with it the curvature of the level line
    area = depth.square() * torch.linalg.det(warp).abs() / along.abs()
    bend = area.square() / (slope.pow(3) * reach)
    by_pose = -torch.cat([m, torch.linalg.cross(point - translation, m)], -1) / slope[:, None]
    return (reach - radius) / slope, bend, by_pose
