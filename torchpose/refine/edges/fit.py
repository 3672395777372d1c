"""Edge refinement: the pose whose projected circles pass closest to all sub-pixel edge points of all rings.

No ellipse and no centre stands between the edges and the pose, so there is no eccentricity to compensate. An edge point
read at the offset o from its pixel's centre, along the normal of increasing grey, obeys

    deblurred(o) - kappa k = l,

l the offset of the projected circle, k its curvature, kappa the shift of `zernike.curvature_shift`. The blur of each
frame is found along with its pose: the slope of o over l (`zernike.blur_slope`). Once pose and blur are nearly known,
the last steps read the same edges, and the blur, with matched filters, which scatter less (`step_filter`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.refine.edges.step_filter import StepOffsets, step_offsets, window_correlation
from torchpose.refine.photometric.gauss_newton import solve_scaled
from torchpose.refine.result import Refined
from torchpose.rings import zernike
from torchpose.rings.edges import RingEdges, ring_edges

_REACH = 2.0  # px searched to either side of the fitted ellipses
_CHAIN = 2 * math.sqrt(2) / math.pi  # edge pixels per px of a circle: mean of max(|cos|, |sin|)
_START_SPREAD = 0.3  # px
_SOFT = 3.0  # Geman-McClure scale in standard deviations
_SOFT_BIAS = 1.17  # of a normal distribution, standard deviation over its RMS under these weights
_STEPS = 6  # on Zernike edges
_SOFT_STEPS = 2  # of these, the first, that weigh all points instead of leaving some out
_FILTER_STEPS = 2  # on matched filters
_LEAST_BLUR = 0.3  # px, point-spread function and pixel: a pixel alone
_MOST_CHANGE = 0.3  # px, of the blur in a step
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
    circles = (centers[row, marker][block], normals[row, marker][block], radii[row, marker].flatten()[edges.ring])
    seen = _seen(edges, camera, outward, row[block], *circles)
    of, sound = seen.of, seen.sound
    # the error of an edge point falls with the height of its step, taken from the whole circle: a high one by chance
    # must not count more
    step = segment_mean(edges.step, edges.ring, 2 * row.numel())[edges.ring]
    trust = sound * (step / segment_mean(step, of, rows)[of]).square()

    r, t = rotation, translation
    known = torch.zeros(rows, 6, 6, dtype=torch.float64, device=r.device) if prior is None else prior
    moved = torch.zeros(rows, 6, dtype=torch.float64, device=r.device)
    spread = torch.full((rows,), _START_SPREAD, dtype=torch.float64, device=r.device)
    blur, keep = torch.zeros_like(spread), sound
    for i in range(_STEPS + _FILTER_STEPS):
        if i < _STEPS:
            error, by_pose, blur = _zernike_errors(seen, r, t, keep, rows)
            soft, keep, spread = _robust(error, spread, sound, of, rows)
            weight, correlation = trust * (soft if i < _SOFT_STEPS else keep), _CHAIN * zernike.edge_correlation()
        else:
            by_pose, found = _filter_errors(seen, frames, frame, r, t, blur)
            error = found.error
            _, keep, spread = _robust(error, spread, sound, of, rows)
            weight, correlation = keep * found.information * step.square(), window_correlation()
            blur_weight = keep * found.blur_information * step.square()
            blur = blur + segment_mean(found.widening, of, rows, blur_weight).clamp(-_MOST_CHANGE, _MOST_CHANGE)
            blur = blur.clamp_min(_LEAST_BLUR)
        step_pose, information, variance = _step(error, by_pose, weight, of, rows, known, moved, correlation)
        moved = moved + step_pose
        r, t = rotations.exp(step_pose[:, 3:]) @ r, t + step_pose[:, :3]

    inverse, info = torch.linalg.inv_ex(information)
    covariance = inverse * variance[:, None, None]
    kept = segment_mean(keep, of, rows, sound)
    good = (info == 0) & covariance.isfinite().all(-1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    return Refined(r, t, covariance, blur, (variance / correlation).sqrt(), kept, good)


class _Seen(NamedTuple):
    """Edge points, flat, their rows ``of`` and their circles; 0 in ``sound`` where unusable.

    ray: (E, 3). warp: (E, 2, 2), d(ray)/d(pixel). center, normal: (E, 3), radius: (E,), of the circle. sign: (E,), +1
    where grey rises outwards.
    """

    edges: RingEdges
    of: Tensor
    ray: Tensor
    warp: Tensor
    center: Tensor
    normal: Tensor
    radius: Tensor
    sign: Tensor
    sound: Tensor

    def circles(self, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`circle_distance` of the poses (N, 3, 3), (N, 3)."""
        return circle_distance(self.ray, self.warp, r[self.of], t[self.of], self.center, self.normal, self.radius)


def _seen(
    edges: RingEdges, camera: Camera, outward: Tensor, of: Tensor, center: Tensor, normal: Tensor, radius: Tensor
) -> _Seen:
    xy = camera.undistort_points(edges.points)
    warp = torch.linalg.inv(camera.J_distort(xy))
    ray = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
    sound = ray.isfinite().all(-1).double()
    return _Seen(edges, of, ray.nan_to_num(nan=0.0), warp, center, normal, radius, outward[edges.ring], sound)


def _zernike_errors(seen: _Seen, r: Tensor, t: Tensor, keep: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """How far Zernike edges lie outside the circles (E,), px, derivatives (E, 6) of the distance, and blur (N,)."""
    edges, of, sign = seen.edges, seen.of, seen.sign
    distance, bend, _, by_pose = seen.circles(r, t)
    true = edges.offset - sign * distance  # of the projected circle from the pixel's centre
    slope = zernike.blur_slope(edges.offset * keep, true * keep, of, rows)
    read = zernike.deblur(edges.offset, slope[of]) - zernike.curvature_shift(slope[of]) * bend * sign
    # the slope tells of two pixels: the image's and the kernel's
    blur = (((1 - slope) * zernike.MASK**2 - 1) / 12).clamp_min(_LEAST_BLUR**2).sqrt()
    return (sign * (read - true)).nan_to_num(nan=0.0), by_pose, blur


def _filter_errors(
    seen: _Seen, frames: Tensor, frame: Tensor, r: Tensor, t: Tensor, blur: Tensor
) -> tuple[Tensor, StepOffsets]:
    """Derivatives (E, 6) of the distance, and what the matched filters see in the windows of the same pixels."""
    edges = seen.edges
    pixel = (edges.points - edges.offset[:, None] * edges.normal).round()
    distance, bend, across, by_pose = seen.circles(r, t)
    middle = distance + (across * (pixel - edges.points)).sum(-1)
    found = step_offsets(frames, frame[seen.of], pixel.long(), across, middle, bend, blur[seen.of])
    return by_pose, StepOffsets(*(x.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0) for x in found))


def _robust(error: Tensor, spread: Tensor, sound: Tensor, of: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Geman-McClure weights (E,) of errors, the hard choice (E,) by their spread, and that spread (N,)."""
    soft = sound * (1 + (error / (_SOFT * spread)[of]).square()).reciprocal().square()
    spread = _SOFT_BIAS * segment_mean(error.square(), of, rows, soft).sqrt()
    return soft, sound * (error.abs() < (_CUT * spread + _CUT_FLOOR)[of]), spread


def _step(
    error: Tensor,
    by_pose: Tensor,
    weight: Tensor,
    of: Tensor,
    rows: int,
    known: Tensor,
    moved: Tensor,
    correlation: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton step (N, 6), information (N, 6, 6) at unit variance, and the variance (N,).

    Errors of neighbouring points are correlated: ``correlation`` of them tell as much as one that is independent.
    """
    products = by_pose[:, :, None] * torch.cat([by_pose, error[:, None]], -1)[:, None, :]
    extra = torch.stack([weight * error.square(), (weight > 0).double()], -1)
    sums = segment_sum(torch.cat([weight[:, None] * products.flatten(1), extra], -1), of, rows)
    information, right = sums[:, :42].unflatten(1, (6, 7)).split([6, 1], -1)
    chi2, count = sums[:, 42:].unbind(-1)
    variance = correlation * chi2 / (count - 7 * correlation).clamp_min(1)
    information = information + known * variance[:, None, None]
    pull = variance[:, None, None] * (known @ moved[..., None])
    return solve_scaled(information, -right - pull).squeeze(-1), information, variance


def circle_distance(
    ray: Tensor, warp: Tensor, rotation: Tensor, translation: Tensor, center: Tensor, normal: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distances of image points from projected circles, in pixels and to first order.

    Args:
        ray: (E, 3) points on the plane z = 1. warp: (E, 2, 2), d(ray)/d(pixel).
        rotation, translation: (E, 3, 3), (E, 3) target to camera.
        center, normal: (E, 3) of the circle, target frame. radius: (E,).

    Returns:
        distance (E,) px, positive outside; curvature (E,) 1/px of the circle's image; its unit normal (E, 2) there;
        derivative (E, 6) of the distance by the pose: translation, then rotation from the left.
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
    return (reach - radius) / slope, bend, gradient / slope[:, None], by_pose
