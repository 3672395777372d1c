"""Stage: concentric pairs. From candidate ellipses to rings with both circles measured."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.detect import Candidates
from torchpose.detect.reduce import only_reduced, reduction_for
from torchpose.ellipse import EllipseFit
from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.blurred_edge import LEAST, MOST
from torchpose.geometry.constants import finite
from torchpose.geometry.rows import Rows, replace
from torchpose.geometry.sectors import SECTORS, clear_of_ends, sector_about
from torchpose.geometry.segments import marked, segment_mean, segment_sum
from torchpose.rings import zernike
from torchpose.rings.edges import REACH, STEP_RANGE, RingEdges, ring_edges
from torchpose.rings.inner_circles import InnerCircles, find_inner
from torchpose.rings.lens import ideal_pixels, mapped
from torchpose.rings.small_rings import BLURRED, fit_small_rings

# of the perimeter with edge points, outer and inner circle: a third covered and noise beside (convention)
_LEAST_COVER = (0.4, 0.33)
# px: circles of a smaller semi-minor axis fill the mask of an edge (derived: half of 7 px, and half of one)
_SMALL = 4.0
# px, outer and inner circle: smaller ones are letters and specks as well as rings (measured: decisions/0051)
_LEAST_SEMI_MINOR = (4.0, 1.2)
LARGE = 20.0  # px, of the outer semi-minor axis, from which on a fit of all pixels costs too much (convention)
# px, along the minor axis: what is soft along lines alone may be fields of an interlaced frame (measured:
# `scripts/corruption_statistics.py --only interlacing`)
_SOFT_ALL_AROUND = 1.0
_ROUGH = 0.5  # px, of a candidate's centre and axes
_SCALES = (2.0, 1.0, 0.5)  # px, see `ellipse.fit_robust`: from a candidate's error down to a few times that of edges


@dataclass(frozen=True, eq=False)
class Rings(Rows):
    """K rings with both circles measured, flat.

    Attributes:
        frame: of each ring.
        polarity: +1 dark ring on light, -1 light on dark.
        outer_raw: ellipses in the pixels of the frame.
        inner_raw: the same.
        outer: fits in ideal pixels, that is of the same camera without lens distortion.
        inner: the same.
        blur: of the ring's edges, px^2, see `geometry.blur`.
        clipped: whether the lighter side of the edges is clipped, which moves them all towards the darker side.
        seen: sectors in which its edges were measured, see `geometry.sectors`.
        disc: whether its blur was seen to be a disc's, that of a frame out of focus.
    """

    frame: Int[Tensor, " K"]
    polarity: Float[Tensor, " K"]
    outer_raw: Float[Tensor, "K 5"]
    inner_raw: Float[Tensor, "K 5"]
    outer: EllipseFit
    inner: EllipseFit
    blur: Float[Tensor, "K 3"]
    clipped: Bool[Tensor, " K"]
    seen: Bool[Tensor, "K 48"]
    disc: Bool[Tensor, " K"]

    @property
    def ratio(self) -> Tensor:
        """(K,) inner to outer radius: the square root of the paper's ring-area code."""
        i, o = self.inner.params, self.outer.params
        return (i[:, 2] * i[:, 3] / (o[:, 2] * o[:, 3])).sqrt()


@checked
def measure_rings(frames: Tensor, candidates: Candidates, camera: Camera, *, correct: bool = True) -> Rings:
    """Measures outer and inner circle of every candidate that has both, each fitted separately.

    Args:
        frames: (B, H, W) grey, any real dtype. candidates: with the polarity of the rings looked for.
        camera: its distortion is taken off the sub-pixel points before the final fit.
        correct: free the edges from what blur and curvature do to them; False leaves them as the moments read them.
    """
    return _both(frames, find_circles(frames, candidates, camera), camera, correct)[0]


@dataclass(frozen=True, eq=False)
class Circles(Rows):
    """Candidates with a circle inside, neither of them measured yet.

    Attributes:
        outer: the candidates.
        inside: what is inside of each.
    """

    outer: Candidates
    inside: InnerCircles

    def __len__(self) -> int:
        return len(self.outer)


@checked
def find_circles(frames: Tensor, candidates: Candidates, camera: Camera) -> Circles:
    """Those of the candidates that have a circle inside; arguments as for `measure_rings`."""
    if len(candidates) == 0:  # frames without any cost nothing here
        none, found = candidates.ellipse, candidates.frame > 0
        seen = found.new_empty(0, SECTORS)
        return Circles(candidates, InnerCircles(candidates.polarity, found, none, seen, none[:, :3], found))
    inside = find_inner(frames, candidates, camera)
    return Circles(candidates, inside)[inside.found]


@checked
def rough_rings(circles: Circles, camera: Camera) -> Rings:
    """The circles as rings of the accuracy that they have now: good to name them, at a hundredth of the cost."""
    outer, inner = circles.outer.ellipse, circles.inside.ellipse
    if len(circles) == 0:
        return _no_rings(circles.outer)
    covariance = _ROUGH**2 * torch.eye(5, dtype=outer.dtype, device=outer.device).expand(len(outer), 5, 5)
    one = torch.ones_like(circles.outer.polarity)

    ideal = mapped(torch.cat([outer, inner]), lambda points: ideal_pixels(camera, points))
    first, second = (EllipseFit(ellipses, covariance, _ROUGH * one, one) for ellipses in ideal.split(len(outer)))
    inside = circles.inside
    known = (inside.blur, inside.clipped, inside.seen, torch.zeros_like(inside.clipped))
    return Rings(circles.outer.frame, circles.outer.polarity, outer, inner, first, second, *known)


@checked
def measure_circles(
    frames: Tensor, circles: Circles, camera: Camera, *, correct: bool = True, hopeful: bool = False
) -> tuple[Rings, Tensor]:
    """`measure_rings` of circles found before, and which circle each ring is of.

    Rings of a wide blur are measured by the quicker model of `fit_small_rings` alone; with ``hopeful`` those are among
    them that only the exact one may explain.
    """
    if len(circles) == 0:
        return _no_rings(circles.outer), circles.outer.frame
    return _measured(frames, circles, camera, _How(correct, hopeful))


def _no_rings(candidates: Candidates) -> Rings:
    """Of no candidates."""
    frame, polarity, none = candidates.frame, candidates.polarity, candidates.ellipse
    fit = EllipseFit(none, none.new_empty(0, 5, 5), polarity, polarity)
    seen = (frame > 0)[:, None].expand(-1, SECTORS)
    return Rings(frame, polarity, none, none, fit, fit, none[:, :3], frame > 0, seen, frame > 0)


@checked
def measure_predicted(
    frames: Tensor, candidates: Candidates, inner: Tensor, camera: Camera, *, correct: bool = True
) -> tuple[Rings, Tensor]:
    """The same where the inner ellipses (M, 5) are known, about; also which candidate each ring is of, (K,) int64."""
    inside = find_inner(frames, candidates, camera, inner)
    return _both(frames, Circles(candidates, inside), camera, correct)


def _both(frames: Tensor, circles: Circles, camera: Camera, correct: bool) -> tuple[Rings, Tensor]:
    """Rings of circles by both models, and whose they are."""
    rings, of = measure_circles(frames, circles, camera, correct=correct, hopeful=True)
    rings, which = measure_exactly(frames, rings, camera)
    return rings, of[which]


@checked
def measure_exactly(frames: Tensor, rings: Rings, camera: Camera) -> tuple[Rings, Tensor]:
    """Rings measured before, those whose blur is wide for their size again, by the exact model of `fit_small_rings`.

    Also which of the rings each is.
    """
    if len(rings) == 0:
        return rings, rings.frame
    # a ring that reads its own blur too narrow is told by those beside it
    own = blurs.axes(rings.blur)[1].sqrt()
    if not bool((own.max() > BLURRED * rings.inner_raw[:, 3]).any()):
        return rings, torch.arange(len(rings), device=own.device)
    usual = segment_mean(own, rings.frame, int(rings.frame.max()) + 1)[rings.frame]
    blurred = own.maximum(usual) > BLURRED * rings.inner_raw[:, 3]
    left, index = (part.nonzero()[:, 0] for part in (~blurred, blurred))
    some = rings[index]
    if len(some) == 0:
        return rings, left
    candidates = Candidates.unscored(some.frame, some.outer_raw, some.polarity)
    inside = replace(find_inner(frames, candidates, camera, some.inner_raw), blur=some.blur)
    again, of = _measured(frames, Circles(candidates, inside), camera, _How(correct=True, begun=True))
    return Rings.cat([rings[left], again]), torch.cat([left, index[of]])


class _How(NamedTuple):
    """correct, hopeful: as for `measure_circles`. begun: as for `fit_small_rings`. reduced: in frames that are."""

    correct: bool
    hopeful: bool = False
    begun: bool = False
    reduced: bool = False


def _measured(frames: Tensor, circles: Circles, camera: Camera, how: _How) -> tuple[Rings, Tensor]:
    """Rings of circles, each in frames reduced as far as its blur asks for, and whose they are.

    A mask or a band of a fixed size sees little of an edge that is wider; in a frame of half the size it is not.
    """
    candidates, inside = circles.outer, circles.inside
    by_blur = reduction_for(_in_common(blurs.axes(inside.blur)[1].sqrt(), candidates.frame), zernike.WIDEST)
    # a ring keeps a pixel more than the least has
    factor = by_blur.minimum(reduction_for(candidates.ellipse[:, 3], 2 * (_LEAST_SEMI_MINOR[0] + 1)))
    values, rings, which = factor.unique().tolist(), [], []
    if values == [1]:
        found, of = _measure(frames, circles, camera, how)
        order = torch.argsort(of)
        return found[order], of[order]
    for value in values:
        index = (factor == value).nonzero()[:, 0]
        small, own, frame = only_reduced(frames, candidates.frame[index], value)
        outer, inner = (conics.rescaled(e[index], 1 / value) for e in (candidates.ellipse, inside.ellipse))
        some = replace(candidates[index], frame=own, ellipse=outer)
        part = replace(inside[index], ellipse=inner, blur=blurs.reduced(inside.blur[index], value))
        found, of = _measure(small, Circles(some, part), camera.reduced(value), how._replace(reduced=value > 1))
        rings.append(_enlarged(replace(found, frame=frame[found.frame]), value))
        which.append(index[of])
    if not rings:
        return _no_rings(candidates), candidates.frame
    order = torch.argsort(torch.cat(which))
    return Rings.cat(rings)[order], torch.cat(which)[order]


def _in_common(blur: Tensor, frame: Tensor) -> Tensor:
    """Blurs (K,) px of the rings of frames (K,); those of a frame that differ little count as one, and so each frame is
    reduced in one way."""
    logarithm = blur.log()
    usual = segment_mean(logarithm, frame, int(frame.max()) + 1)[frame]
    return torch.where((logarithm - usual).abs() < 0.5 * math.log(2), usual, logarithm).exp()


def _enlarged(rings: Rings, factor: int) -> Rings:
    """Rings measured in frames reduced by ``factor``, in pixels of the frames themselves."""
    if factor == 1:
        return rings

    def fit(small: EllipseFit) -> EllipseFit:
        params = conics.rescaled(small.params, factor)
        return replace(small, params=params, covariance=small.covariance * factor**2, sigma=small.sigma * factor)

    return replace(
        rings,
        outer_raw=conics.rescaled(rings.outer_raw, factor),
        inner_raw=conics.rescaled(rings.inner_raw, factor),
        outer=fit(rings.outer),
        inner=fit(rings.inner),
        blur=blurs.enlarged(rings.blur, factor),
    )


def _measure(frames: Tensor, circles: Circles, camera: Camera, how: _How) -> tuple[Rings, Tensor]:
    """Rings of circles in the frames as they are, and whose they are."""
    outer, inner = circles.outer.ellipse, circles.inside.ellipse
    ratio = (inner[:, 2:4].prod(-1) / outer[:, 2:4].prod(-1)).sqrt()
    inside = replace(circles.inside, ratio=ratio, seen=clear_of_ends(circles.inside.seen))
    circles = replace(circles, inside=inside)
    if how.begun:
        return _as_a_whole(frames, circles, camera, how)
    # ... and so do two edges with less than a pixel beside it
    narrow = torch.minimum((1 - ratio) * outer[:, 3] - 1, ratio * outer[:, 3]) < _SMALL
    # a frame was reduced because a mask sees little of such edges; the whole ring tells as much, and its blur as well
    small = (narrow | (how.reduced & how.correct)) & (outer[:, 3] < LARGE)
    parts, index = [], (~small).nonzero()[:, 0]
    if index.numel():
        rings, of = _by_edges(frames, circles[index], camera, how)
        # a narrow ring may hide its blur from its profile, not from its edges
        wide = _soft(rings.blur) & (outer[index[of], 3] < LARGE)
        parts.append((rings[~wide], index[of[~wide]]))
        small = small.index_fill(0, index[of[wide]], True)
    index = small.nonzero()[:, 0]
    if index.numel():
        rings, of = _as_a_whole(frames, circles[index], camera, how)
        parts.append((rings, index[of]))
    return Rings.cat([rings for rings, _ in parts]), torch.cat([which for _, which in parts])


def _soft(blur: Tensor) -> Tensor:
    """Whether edges of these blurs (K, 3) are too wide for a mask, all around."""
    least, most = blurs.axes(blur)
    return (least > _SOFT_ALL_AROUND**2) & (most > zernike.WIDEST**2)


def _by_edges(frames: Tensor, circles: Circles, camera: Camera, how: _How) -> tuple[Rings, Tensor]:
    """Rings of circles whose edges are measured one by one, and whose they are."""
    candidates, inside = circles.outer, circles.inside
    outer, inner, clear, ratio = candidates.ellipse, inside.ellipse, inside.seen, inside.ratio
    count = len(candidates)
    # no search band may reach the other circle, nor the centre
    gap = torch.minimum(0.5 * (1 - ratio), 0.6 * ratio) * outer[:, 3]
    rough = torch.cat([outer, inner])
    frame = candidates.frame.repeat(2)
    reach = torch.cat([gap, gap]).clamp(1.0, REACH)
    outward = torch.cat([candidates.polarity, -candidates.polarity])
    edges = ring_edges(frames, frame, rough, outward, reach)
    u, v = edges.points.unbind(-1)
    sector = sector_about(u, v, rough, edges.ring)
    shown = clear.repeat(2, 1)[edges.ring, sector]
    edges, sector = edges[shown], sector[shown]

    points, blur, keep = _freed(edges, rough, outward, how.correct)
    ring, points = edges.ring[keep], points[keep]
    ideal_points = ideal_pixels(camera, points)
    # as the frame shows them, and without the lens
    each = torch.cat([points, ideal_points]), torch.cat([ring, ring + 2 * count])
    raw, ideal = ellipse.fit(*each, 4 * count).tensor_split(2)
    fit = ellipse.with_covariance(ideal_points, ring, ideal, correlation=zernike.edge_correlation())

    one = torch.ones_like(ring, dtype=torch.float64)
    cover = segment_sum(one, ring, 2 * count) / conics.perimeter(raw)
    step = segment_mean(edges.step[keep], ring, 2 * count)
    step_ratio = step[count:] / step[:count]
    offset = torch.linalg.vector_norm(raw[count:, :2] - inner[:, :2], dim=-1)
    good = (
        finite(fit.covariance, (1, 2)).view(2, count).all(0)
        & _within(reach, raw, rough).view(2, count).all(0)
        & (cover[:count] > _LEAST_COVER[0])
        & (cover[count:] > _LEAST_COVER[1])
        & (step_ratio > STEP_RANGE[0])
        & (step_ratio < STEP_RANGE[1])
        & (offset < 0.25 * raw[:count, 3])  # concentric but for perspective
        & (raw[count:, 2] < raw[:count, 2])
    )
    index = good.nonzero()[:, 0]
    second = index + count
    blur = blurs.limited(blur - blurs.pixel(blur), LEAST**2, MOST**2)[index]  # less that of the mask
    frame, polarity = candidates.frame[index], candidates.polarity[index]
    follows = marked((edges.ring * SECTORS + sector)[keep], 2 * count * SECTORS).view(2, count, SECTORS)[0, index]
    known = (blur, inside.clipped[index], clear[index] & follows, torch.zeros_like(inside.clipped[index]))
    return Rings(frame, polarity, raw[index], raw[second], fit[index], fit[second], *known), index


def _within(reach: Tensor, fitted: Tensor, rough: Tensor) -> Tensor:
    """Whether ellipses (N, 5) lie along their rough ones, (N,): all points are within reach of those, and a fit that is
    not has followed the stump of a circle cut off."""
    shift = torch.linalg.vector_norm(fitted[:, :2] - rough[:, :2], dim=-1)
    now, before = conics.shape_matrix(torch.stack([fitted, rough]))
    growth = (now - before).abs().amax((1, 2))
    return torch.maximum(shift, growth) < reach + 1.5


def _freed(edges: RingEdges, rough: Tensor, outward: Tensor, correct: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Edge points (E, 2) freed of what blur and curvature do to them, the blur (M / 2, 3), and which are of a circle.

    Args:
        edges: of M circles, the outer ones first.
        rough: their ellipses (M, 5). outward: (M,), as for `ring_edges`.
        correct: free them; else they stay as the moments read them.
    """
    count, outside = len(rough) // 2, outward[edges.ring]
    near = ellipse.Near.of(edges.points, edges.ring, rough)
    conic, keep = near.robust(near.circle, _SCALES)
    kept = near.tiles.flat(keep) > 0
    distance = edges.offset - near.tiles.flat(near.distances(conic)) * outside
    blur = zernike.edge_blur(edges.offset[kept], distance[kept], edges.normal[kept], edges.ring[kept] % count, count)
    points = edges.points
    if correct:
        bend = near.tiles.flat(near.curvatures(conic)) * outside
        points = points + _correction(edges, blur, bend)[:, None] * edges.normal
        near = near.moved(points)
    _, keep = near.robust(conic, _SCALES[-1:])
    return points, blur, near.tiles.flat(keep) > 0


def _as_a_whole(frames: Tensor, circles: Circles, camera: Camera, how: _How) -> tuple[Rings, Tensor]:
    """The same for rings whose circles are too close to each other, or too small, to be measured one by one."""
    focal = camera.matrix.diagonal()[:2].mean()
    candidates = circles.outer
    found = fit_small_rings(frames, candidates, circles.inside, focal, begun=how.begun)
    least_outer, least_inner = _LEAST_SEMI_MINOR
    large = (found.outer.params[:, 3] > least_outer) & (found.inner.params[:, 3] > least_inner)
    index = ((found.good & large) | (found.promising & how.hopeful)).nonzero()[:, 0]
    outer, inner = found.outer[index], found.inner[index]

    both = torch.cat([outer.params, inner.params])
    ideal_outer, ideal_inner = mapped(both, lambda points: ideal_pixels(camera, points)).tensor_split(2)
    rings = Rings(
        candidates.frame[index],
        candidates.polarity[index],
        outer.params,
        inner.params,
        replace(outer, params=ideal_outer),
        replace(inner, params=ideal_inner),
        found.blur[index],
        circles.inside.clipped[index],
        found.seen[index],
        found.disc[index],
    )
    return rings, index


def _correction(edges: RingEdges, blur: Tensor, bend: Tensor) -> Tensor:
    """What each ring's blur (M / 2, 3) and the edges' curvature do to their offsets, taken off: (E,) px.

    ``bend`` (E,) is the curvature, 1/px, positive where the edge's normal points outwards.
    """
    blur = blur[edges.ring % len(blur)]
    slope = zernike.slope_across(blur, edges.normal)
    return zernike.deblur(edges.offset, slope) - edges.offset - zernike.curvature_shift(blur, edges.normal) * bend
