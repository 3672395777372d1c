"""Stage: concentric pairs. From candidate ellipses to rings with both circles measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from torchpose import ellipse, zernike
from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.edges import REACH, RingEdges, ring_edges
from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.small_rings import fit_small_rings

_ANGLES = 64
_RADII = 72
_INNERMOST, _OUTERMOST = 0.08, 1.12  # of the outer ellipse, the range of the radial profile
_RATIO_RANGE = (0.12, 0.93)  # of inner to outer radius
_LEAST_PEAK = 0.25  # of the outer edge's slope in the mean radial profile
_LEAST_EDGE = 0.5  # of the median rise at the outer edge over all directions, for a direction that counts
_LEAST_COVER = (0.4, 0.33)  # of the perimeter with edge points, outer and inner circle
_SMALL = 4.0  # px: circles of a smaller semi-minor axis fill the mask of an edge
_LEAST_SEMI_MINOR = (4.0, 1.2)  # px, outer and inner circle: smaller ones are letters and specks as well as rings
_LARGE = 20.0  # px, of the outer semi-minor axis, from which on a fit of all pixels costs too much
_EDGE_APART = 0.8  # ... and so do two edges closer than 5 px
_STEP_RANGE = (0.4, 2.5)  # inner to outer grey step


@dataclass(frozen=True, eq=False)
class Rings:
    """K rings with both circles measured, flat.

    Attributes:
        frame: (K,) int64. polarity: (K,) float64, +1 dark ring on light, -1 light on dark.
        outer_raw, inner_raw: (K, 5) float64, ellipses in the pixels of the frame.
        outer, inner: fits in ideal pixels, that is of the same camera without lens distortion.
    """

    frame: Tensor
    polarity: Tensor
    outer_raw: Tensor
    inner_raw: Tensor
    outer: EllipseFit
    inner: EllipseFit

    def __len__(self) -> int:
        return self.frame.shape[0]

    def __getitem__(self, index: Tensor) -> Rings:
        return Rings(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The rings of all parts."""

        def fits(name: str) -> EllipseFit:
            some = [getattr(part, name) for part in parts]
            return EllipseFit(*(torch.cat([getattr(f, n) for f in some]) for n in EllipseFit.__dataclass_fields__))

        def tensor(name: str) -> Tensor:
            return torch.cat([getattr(part, name) for part in parts])

        return cls(
            tensor("frame"), tensor("polarity"), tensor("outer_raw"), tensor("inner_raw"), fits("outer"), fits("inner")
        )

    @property
    def ratio(self) -> Tensor:
        """(K,) inner to outer radius: the square root of the paper's ring-area code."""
        i, o = self.inner.params, self.outer.params
        return (i[:, 2] * i[:, 3] / (o[:, 2] * o[:, 3])).sqrt()


def find_inner(frames: Tensor, candidates: Candidates) -> tuple[Tensor, Tensor, Tensor]:
    """Radius ratio of the circle inside each candidate, from the mean radial profile of grey.

    The profile is taken along radii scaled by the candidate's own ellipse, so it averages over the whole ring: an inner
    circle of two pixels that no region growing would hold together still stands out.

    Returns:
        ratio (M,) float64, found (M,) bool, and seen (M, 64) bool: the directions, evenly spaced in eccentric anomaly
        from +u on the circle that the candidate is the image of, in which its own edge shows.
    """
    height, width = frames.shape[-2:]
    device = frames.device
    rho = torch.linspace(_INNERMOST, _OUTERMOST, _RADII, dtype=torch.float64, device=device)
    angle = torch.arange(_ANGLES, dtype=torch.float64, device=device) * (2 * torch.pi / _ANGLES)
    circle = torch.stack([angle.cos(), angle.sin()])
    shape = conics.shape_matrix(candidates.ellipse)
    uv = (shape @ circle)[:, :, None, :] * rho[:, None] + candidates.ellipse[:, :2, None, None]
    u, v = uv.round().long().unbind(1)
    cell = (candidates.frame[:, None, None] * height + v.clamp(0, height - 1)) * width + u.clamp(0, width - 1)
    grey = frames.reshape(-1)[cell].float()
    at = rho[1:-1]
    # what covers the outer circle on one side hides the inner one there too: only directions that show the outer count
    edge = ((grey[:, 2:] - grey[:, :-2]) * candidates.polarity[:, None, None].float())[:, at > _RATIO_RANGE[1]].amax(1)
    seen = edge > _LEAST_EDGE * edge.nanmedian(-1, keepdim=True).values
    profile = torch.where(seen[:, None], grey, torch.nan).nanmean(-1).double()
    rise = (profile[:, 2:] - profile[:, :-2]) * candidates.polarity[:, None]
    outer = rise.masked_fill(at < _RATIO_RANGE[1], -torch.inf).amax(-1)
    fall = (-rise).masked_fill((at < _RATIO_RANGE[0]) | (at > _RATIO_RANGE[1]), -torch.inf)
    peak, best = fall.max(-1)
    return at[best], (outer > 0) & (peak > _LEAST_PEAK * outer), seen


def measure_rings(frames: Tensor, candidates: Candidates, camera: Camera, *, correct: bool = True) -> Rings:
    """Measures outer and inner circle of every candidate that has both, each fitted separately.

    Args:
        frames: (B, H, W) grey, any real dtype. candidates: with the polarity of the rings looked for.
        camera: its distortion is taken off the sub-pixel points before the final fit.
        correct: free the edges from what blur and curvature do to them; False leaves them as the moments read them.
    """
    ratio, found, seen = find_inner(frames, candidates)
    return _measure(frames, candidates[found], camera, ratio[found], seen[found], correct)[0]


def measure_found(
    frames: Tensor, candidates: Candidates, camera: Camera, ratio: Tensor, *, correct: bool = True
) -> tuple[Rings, Tensor]:
    """The same for candidates whose ratio of radii (M,) is known; also which of them each ring is of, (K,) int64."""
    return _measure(frames, candidates, camera, ratio, find_inner(frames, candidates)[2], correct)


def _measure(
    frames: Tensor, candidates: Candidates, camera: Camera, ratio: Tensor, seen: Tensor, correct: bool
) -> tuple[Rings, Tensor]:
    """Rings of candidates with a rough ratio (M,), see `find_inner`, and their indices into the candidates."""
    clear = clear_directions(seen)
    count = len(candidates)
    outer = candidates.ellipse
    inner = torch.cat([outer[:, :2], outer[:, 2:4] * ratio[:, None], outer[:, 4:]], -1)
    # no search band may reach the other circle, nor the centre
    gap = torch.minimum(0.5 * (1 - ratio), 0.6 * ratio) * outer[:, 3]
    rough = torch.cat([outer, inner])
    frame = candidates.frame.repeat(2)
    reach = torch.cat([gap, gap]).clamp(1.0, REACH)
    outward = torch.cat([candidates.polarity, -candidates.polarity])
    edges = ring_edges(frames, frame, rough, outward, reach)
    edges = edges[clear.repeat(2, 1)[edges.ring, _direction(edges, rough)]]

    raw, keep = ellipse.fit_robust(edges.points, edges.ring, 2 * count, start=rough)
    points = _unbiased(edges, raw, keep, outward, frame, frames.shape[0]) if correct else edges.points
    raw, keep = ellipse.fit_robust(points, edges.ring, 2 * count, start=raw, scales=(0.5,))
    ring, points = edges.ring[keep], points[keep]
    ideal_points = ideal_pixels(camera, points)
    ideal = ellipse.fit(ideal_points, ring, 2 * count)
    fit = ellipse.with_covariance(ideal_points, ring, ideal, correlation=zernike.edge_correlation())

    one = torch.ones_like(ring, dtype=torch.float64)
    cover = segment_sum(one, ring, 2 * count) / conics.perimeter(raw)
    step = segment_mean(edges.step[keep], ring, 2 * count)
    step_ratio = step[count:] / step[:count]
    offset = torch.linalg.vector_norm(raw[count:, :2] - raw[:count, :2], dim=-1)
    # all points lie within reach of the rough ellipse; a fit that does not has followed the stump of a circle cut off
    shift = torch.linalg.vector_norm(raw[:, :2] - rough[:, :2], dim=-1)
    growth = (conics.shape_matrix(raw) - conics.shape_matrix(rough)).abs().amax((1, 2))
    near = torch.maximum(shift, growth) < reach + 1.5
    good = (
        fit.covariance.isfinite().all(-1).all(-1).view(2, count).all(0)
        & near.view(2, count).all(0)
        & (cover[:count] > _LEAST_COVER[0])
        & (cover[count:] > _LEAST_COVER[1])
        & (step_ratio > _STEP_RANGE[0])
        & (step_ratio < _STEP_RANGE[1])
        & (offset < 0.25 * raw[:count, 3])  # concentric up to perspective
        & (raw[count:, 2] < raw[:count, 2])
    )
    small = (torch.minimum((1 - ratio) * _EDGE_APART, ratio) * outer[:, 3] < _SMALL) & (outer[:, 3] < _LARGE)
    index = (good & ~small).nonzero()[:, 0]
    second = index + count
    large = Rings(candidates.frame[index], candidates.polarity[index], raw[index], raw[second], fit[index], fit[second])
    if not bool(small.any()):
        return large, index
    rest = small.nonzero()[:, 0]
    measured, which = _measure_small(frames, candidates[rest], ratio[rest], clear[rest], camera)
    return Rings.cat([large, measured]), torch.cat([index, rest[which]])


def clear_directions(seen: Tensor) -> Tensor:
    """Directions (M, A) bool whose neighbours mostly show the outer edge, too, and neither next one hides it.

    Single ones that noise hides stay clear; next to a cover, its own edge may pass for the circle's.
    """
    around = torch.stack([seen.roll(k, 1) for k in range(-2, 3)]).sum(0) > 2
    return around & around.roll(1, 1) & around.roll(-1, 1)


def _direction(edges: RingEdges, ellipses: Tensor) -> Tensor:
    """Number (E,) of each edge point's direction, see `find_inner`."""
    inverse = torch.linalg.inv(conics.shape_matrix(ellipses))[edges.ring]
    x, y = (inverse @ (edges.points - ellipses[edges.ring, :2])[..., None]).squeeze(-1).unbind(-1)
    return (torch.atan2(y, x) * (_ANGLES / (2 * torch.pi))).round().long() % _ANGLES


def _measure_small(
    frames: Tensor, candidates: Candidates, ratio: Tensor, seen: Tensor, camera: Camera
) -> tuple[Rings, Tensor]:
    """The same for rings whose circles are too close to each other, or too small, to be measured one by one."""
    focal = camera.matrix.diagonal()[:2].mean()
    found = fit_small_rings(frames, candidates.frame, candidates.ellipse, ratio, seen, candidates.polarity, focal)
    least_outer, least_inner = _LEAST_SEMI_MINOR
    large = (found.outer.params[:, 3] > least_outer) & (found.inner.params[:, 3] > least_inner)
    index = (found.good & large).nonzero()[:, 0]
    outer, inner = found.outer[index], found.inner[index]
    rings = Rings(
        candidates.frame[index],
        candidates.polarity[index],
        outer.params,
        inner.params,
        replace(outer, params=_ideal(camera, outer.params)),
        replace(inner, params=_ideal(camera, inner.params)),
    )
    return rings, index


def _ideal(camera: Camera, ellipses: Tensor) -> Tensor:
    """Ellipses (K, 5) of raw pixels in ideal ones."""
    return mapped(ellipses, lambda points: ideal_pixels(camera, points))


def mapped(ellipses: Tensor, mapping: Callable[[Tensor], Tensor]) -> Tensor:
    """Images (K, 5) of ellipses under a mapping of points (P, 2) that is nearly affine across each of them."""
    angle = torch.arange(_ANGLES, dtype=torch.float64, device=ellipses.device) * (2 * torch.pi / _ANGLES)
    points = conics.points_on(ellipses[:, None], angle.expand(ellipses.shape[0], -1)).flatten(0, 1)
    ring = torch.arange(ellipses.shape[0], device=ellipses.device).repeat_interleave(_ANGLES)
    return ellipse.fit(mapping(points), ring, ellipses.shape[0])


def _unbiased(edges: RingEdges, fitted: Tensor, keep: Tensor, outward: Tensor, frame: Tensor, frames: int) -> Tensor:
    """Edge points (E, 2) freed from what each frame's blur and the edges' curvature do to their offsets."""
    sign = outward[edges.ring]
    distance = edges.offset - ellipse.distance(edges.points, edges.ring, fitted) * sign
    group = frame[edges.ring]
    slope = zernike.blur_slope(edges.offset[keep], distance[keep], group[keep], frames)[group]
    pushed = zernike.curvature_shift(slope) * ellipse.curvature(edges.points, edges.ring, fitted)
    change = zernike.deblur(edges.offset, slope) - edges.offset - pushed * sign
    return edges.points + change[:, None] * edges.normal


def ideal_pixels(camera: Camera, points: Tensor) -> Tensor:
    """Pixels (..., 2) that a camera with the same matrix and no distortion would see; float64."""
    k = camera.matrix.to(points.device)
    return camera.undistort_points(points.double()) * k.diagonal()[:2] + k[:2, 2]
