"""Edge refinement: the pose whose projected circles pass closest to all sub-pixel edge points of all rings.

No ellipse and no centre stands between the edges and the pose, so there is no eccentricity to compensate. An edge point
read at the offset o from its pixel's centre, along the normal of increasing grey, obeys

    deblurred(o) - kappa k = l,

l the offset of the projected circle, k its curvature, kappa the shift of `zernike.curvature_shift`. The blur of each
frame is found along with its pose: the slope of o over l, by direction (`zernike.edge_blur`). Once pose and blur are
nearly known, the last steps read the same edges, and the blur, with matched filters, which scatter less
(`step_filter`).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect.reduce import reduction_for
from torchpose.geometry import blur as blurs
from torchpose.geometry.arguments import checked
from torchpose.geometry.blurred_edge import LEAST
from torchpose.geometry.least_squares import (
    Normal,
    Pose,
    PosePrior,
    Unknowns,
    geman_mcclure,
    minimise,
    solve_scaled,
)
from torchpose.geometry.robust import CUT
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.pose import MarkerNormals
from torchpose.refine.edges.step_filter import StepOffsets, step_offsets, window_correlation
from torchpose.refine.sight import Refined, Sight, refined_by_blur
from torchpose.rings import zernike
from torchpose.rings.edges import RingEdges, ring_edges

_REACH = 2.0  # px searched to either side of the fitted ellipses
_CHAIN = 2 * math.sqrt(2) / math.pi  # edge pixels per px of a circle: mean of max(|cos|, |sin|)
_START_SPREAD = 0.3  # px
_SOFT = 3.0  # Geman-McClure scale in standard deviations
_SOFT_BIAS = 1.17  # of a normal distribution, standard deviation over its RMS under these weights (derived)
_STEPS = 6  # on Zernike edges
_SOFT_STEPS = 2  # of these, the first, that weigh all points instead of leaving some out
_FILTER_STEPS = 2  # on matched filters
_ROOM = 1.2  # of half the ring's width: a filter that sees the other circle takes it for its own
_MOST_BLUR = 3.0  # px, about what a window of the filter holds
_MOST_CHANGE = 0.6  # px, of the blur in a step, times the blur itself: of its variance
_PRODUCTS = 7 * 8  # of derivatives by pose and gain with each other and the error
_CUT_FLOOR = 0.02  # px, added to the cut: what pixels alias to (convention)


@checked
def refine_edges(
    sight: Sight, rotation: Tensor, translation: Tensor, *, prior: Tensor | None = None, thorough: bool = True
) -> Refined:
    """Refines N poses on the edge points of their rings; arguments as in `refine_photometric`.

    There is no second look at what contradicts the model, so ``thorough`` changes nothing.
    """
    factor = reduction_for(blurs.axes(sight.common_blur)[1].clamp_min(0).sqrt(), zernike.WIDEST)
    return refined_by_blur(_refined_in, sight, Pose(rotation, translation), prior, factor)


def _refined_in(sight: Sight, start: Pose, known: PosePrior | None) -> Refined:
    """Rows refined in the frames as they are."""
    fit = _Fit(sight, known)
    unknowns = Unknowns({"pose": start})
    for steps, look in ((_SOFT_STEPS, fit.soft), (_STEPS - _SOFT_STEPS, fit.hard), (_FILTER_STEPS, fit.filtered)):
        found = minimise(look, unknowns, steps, settle=False)
        unknowns = found.unknowns
    covariance, determined = found.covariance()
    good = determined & covariance.isfinite().all(-1).all(-1)
    kept = segment_mean(fit.keep, fit.seen.of, len(sight), fit.seen.sound)
    noise = (fit.variance / fit.correlation).sqrt()
    # what the markers tell after the last step
    step = torch.nn.functional.pad(found.step.own, (0, 1))[:, None, :, None]
    at = fit.normals
    normals = MarkerNormals(at.information, at.right - (at.information @ step)[..., 0])
    none = torch.zeros_like(good)
    return Refined(unknowns.pose.R, unknowns.pose.t, covariance, fit.blur, noise, kept, good, none, normals, none)


class _Fit:
    """The normal equations of N rows in three ways, and the blur, spread and choice of points that the last left."""

    normals: MarkerNormals

    def __init__(self, sight: Sight, prior: PosePrior | None) -> None:
        self.sight, self.prior = sight, prior
        row, marker = sight.mask.nonzero().unbind(-1)
        self.row = row
        both = sight.rings[row, marker]  # (K, 2, 5)
        gap = 0.5 * (both[:, 0, 3] - both[:, 1, 3])
        reach = torch.minimum(gap, 0.6 * both[:, 1, 3]).clamp(1.0, _REACH).repeat_interleave(2)
        side = torch.tensor([1.0, -1.0], dtype=torch.float64, device=both.device)
        outward = (sight.polarity[row, marker, None] * side).flatten()
        edges = ring_edges(sight.frames, sight.frame[row].repeat_interleave(2), both.flatten(0, 1), outward, reach)
        block = edges.ring // 2
        radius = sight.radii[row, marker].flatten()[edges.ring]
        circles = (sight.centers[row, marker][block], sight.normals[row, marker][block], radius)
        self.seen = _seen(edges, sight.camera, outward, row[block], *circles)._replace(room=_ROOM * gap[block])
        # the error of an edge point falls with the height of its step, taken from the whole circle: a high one by
        # chance must not count more
        self.step = segment_mean(edges.step, edges.ring, 2 * row.numel())[edges.ring]
        sound, of, rows = self.seen.sound, self.seen.of, len(sight)
        self.trust = sound * (self.step / segment_mean(self.step, of, rows)[of]).square()
        self.spread = torch.full((rows,), _START_SPREAD, dtype=torch.float64, device=both.device)
        self.blur, self.variance = blurs.isotropic(self.spread), self.spread
        self.keep, self.correlation = sound, 1.0

    def soft(self, unknowns: Unknowns) -> Normal:
        """Zernike edges, all of them, by weight."""
        error, by_pose = self._zernike(unknowns.pose)
        soft = self._robust(error)
        return self._normal(unknowns.pose, error, by_pose, self.trust * soft)

    def hard(self, unknowns: Unknowns) -> Normal:
        """Zernike edges that agree."""
        error, by_pose = self._zernike(unknowns.pose)
        self._robust(error)
        return self._normal(unknowns.pose, error, by_pose, self.trust * self.keep)

    def filtered(self, unknowns: Unknowns) -> Normal:
        """The same edges by matched filters; the blur follows."""
        by_pose, self.across, found = _filter_errors(self.seen, self.sight, unknowns.pose, self.blur)
        self._robust(found.error)
        square = self.keep * self.step.square()
        self._widen(found.widening, square * found.blur_information)
        self.correlation = window_correlation()
        return self._normal(unknowns.pose, found.error, by_pose, square * found.information)

    def _widen(self, widening: Tensor, weight: Tensor) -> None:
        """The blur of each row after widenings (E,) px^2 of these weights across its edges."""
        rows = blurs.columns(*self.across.unbind(-1))
        columns = torch.cat([rows, widening[:, None]], -1) * weight[:, None]
        sums = segment_sum((rows[:, :, None] * columns[:, None]).flatten(1), self.seen.of, len(self.sight))
        matrix, right = sums.unflatten(1, (3, 4)).split([3, 1], -1)
        change = solve_scaled(matrix, right).squeeze(-1)
        limit = _MOST_CHANGE * blurs.axes(self.blur)[1].sqrt()
        change = change * (limit / torch.linalg.vector_norm(change, dim=-1).clamp_min(1e-12)).clamp_max(1.0)[:, None]
        self.blur = blurs.limited(self.blur + change, LEAST**2, _MOST_BLUR**2)

    def _zernike(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """How far Zernike edges lie outside the circles (E,), px, and derivatives (E, 7) of the distance."""
        edges, of, sign, rows = self.seen.edges, self.seen.of, self.seen.sign, len(self.sight)
        distance, bend, _, by_pose = self.seen.circles(pose)
        true = edges.offset - sign * distance  # of the projected circle from the pixel's centre
        found = zernike.edge_blur(edges.offset * self.keep, true * self.keep, edges.normal, of, rows)
        pushed = zernike.curvature_shift(found[of], edges.normal) * bend * sign
        read = zernike.deblur(edges.offset, zernike.slope_across(found[of], edges.normal)) - pushed
        # that is of two pixels: the image's and the kernel's
        self.blur = blurs.limited(found - blurs.pixel(found), LEAST**2, _MOST_BLUR**2)
        self.correlation = _CHAIN * zernike.edge_correlation()
        return (sign * (read - true)).nan_to_num(nan=0.0), by_pose

    def _robust(self, error: Tensor) -> Tensor:
        """Weights (E,) of errors; by their spread, which points agree."""
        of, sound = self.seen.of, self.seen.sound
        soft = sound * geman_mcclure(error / (_SOFT * self.spread)[of])
        self.spread = _SOFT_BIAS * segment_mean(error.square(), of, len(self.sight), soft).sqrt()
        self.keep = sound * (error.abs() < (CUT * self.spread + _CUT_FLOOR)[of])
        return soft

    def _normal(self, pose: Pose, error: Tensor, by: Tensor, weight: Tensor) -> Normal:
        """In units of the points' variance; of neighbours ``correlation`` tell as much as one that is independent."""
        products = by[:, :, None] * torch.cat([by, error[:, None]], -1)[:, None, :]
        extra = torch.stack([weight * error.square(), (weight > 0).double()], -1)
        columns = torch.cat([weight[:, None] * products.flatten(1), extra], -1)
        rows, owner = len(self.sight), self.row
        sums = segment_sum(columns, self.seen.edges.ring // 2, len(owner))
        chi2, count = segment_sum(sums[:, _PRODUCTS:], owner, rows).unbind(-1)
        variance = self.correlation * chi2 / (count - 7 * self.correlation).clamp_min(1)
        self.variance = variance
        each = sums[:, :_PRODUCTS].unflatten(1, (7, 8)) / variance[owner, None, None]
        self.normals = MarkerNormals.laid_out(each[..., :7], -each[..., 7], self.sight.mask)
        every = segment_sum(each[:, :6], owner, rows)
        normal = Normal(every[..., :6], -every[..., 7], chi2 / variance)
        return normal if self.prior is None else normal.with_prior(*self.prior.at(pose))


class _Seen(NamedTuple):
    """Edge points, flat, their rows ``of`` and their circles; 0 in ``sound`` where unusable.

    ray: (E, 3). warp: (E, 2, 2), d(ray)/d(pixel). center, normal: (E, 3), radius: (E,), of the circle. sign: (E,), +1
    where grey rises outwards. room: (E,) px, to either side, to what is not this edge.
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
    room: Tensor

    def circles(self, pose: Pose) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`circle_distance` of the poses of N rows; the last derivative is by the edge gain."""
        of = self.of
        circles = (pose.R[of], pose.t[of], self.center, self.normal, self.radius)
        distance, bend, normal, by = circle_distance(self.ray, self.warp, *circles)
        return distance, bend, normal, torch.cat([by[:, :6], by[:, 6:] * self.sign[:, None]], -1)


def _seen(
    edges: RingEdges, camera: Camera, outward: Tensor, of: Tensor, center: Tensor, normal: Tensor, radius: Tensor
) -> _Seen:
    xy = camera.undistort_points(edges.points)
    warp = torch.linalg.inv(camera.J_distort(xy))
    ray = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
    sound = ray.isfinite().all(-1).double()
    return _Seen(edges, of, ray.nan_to_num(nan=0.0), warp, center, normal, radius, outward[edges.ring], sound, sound)


def _filter_errors(seen: _Seen, sight: Sight, pose: Pose, blur: Tensor) -> tuple[Tensor, Tensor, StepOffsets]:
    """Derivatives (E, 7) of the distance, normals (E, 2), and what the matched filters see in the same windows."""
    edges = seen.edges
    pixel = (edges.points - edges.offset[:, None] * edges.normal).round()
    distance, bend, across, by_pose = seen.circles(pose)
    middle = distance + (across * (pixel - edges.points)).sum(-1)
    frame, curve = sight.frame[seen.of], (across, middle, bend)
    found = step_offsets(sight.frames, frame, pixel.long(), curve, blur[seen.of], seen.room)
    return by_pose, across, StepOffsets(*(x.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0) for x in found))


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
        derivative (E, 7) of the distance by the pose: translation, then rotation from the left; and by the radius.
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
    by = -torch.cat([m, torch.linalg.cross(point - translation, m), torch.ones_like(slope)[:, None]], -1)
    return (reach - radius) / slope, bend, gradient / slope[:, None], by / slope[:, None]
