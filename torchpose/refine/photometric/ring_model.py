"""What the pixels around the edges of a ring should show: prediction and derivatives, for padded blocks of pixels.

    F = E(d_outer) + 1 - E(d_inner)

is the fraction of paper in a pixel; d is its distance in px from the projected circle, and E what the blur makes of an
edge of that curvature and direction (`geometry.blurred_edge`). The distortion of the lens enters once, as the ray of
each pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import HOLDS, Spread
from torchpose.geometry.grey import full_scale
from torchpose.geometry.robust import CUT, LEAST_KEPT
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.sectors import SECTORS, sector_about
from torchpose.geometry.segments import values_at
from torchpose.refine.photometric.band import band_pixels
from torchpose.refine.sight import Sight

# blur's variance over the squared radius of curvature: nearer to its centre edges are on all sides (measured: with 0.16
# a third of the pixels of a covered ring under 2.5 px of blur is lost, tests/refine/test_sectors.py)
_CURVED = 0.2


@dataclass(frozen=True, eq=False)
class PixelBlocks(Rows):
    """Pixels of K markers, padded to P; one plane of numbers for every component.

    Attributes:
        row: whose marker it is.
        origin: a ray near each marker, on the plane z = 1.
        ray_x: the pixels' rays from there.
        ray_y: the same.
        warp: d(ray)/d(pixel), row by row.
        grey: values of the pixels.
        valid: 1 or 0.
        sector: of the ring, see `geometry.sectors`.
        seen: 1 or 0, whether the ring was seen there so far; 1 all around where that is less than half of it.
        size: pixels of each marker; what follows in its row repeats the last one and is not valid.
        rings: ellipses of its two circles, outer one first.
        center: of the marker, target frame.
        normal: the same.
        radii: outer and inner.
        polarity: as in `Sight`.
        limits: the grey levels at which the frame's noise is clipped, -inf and inf where it is not.
        quantisation: variance of rounding, grey levels^2.
    """

    row: Int[Tensor, " K"]
    origin: Float[Tensor, "K 2"]
    ray_x: Float[Tensor, "K P"]
    ray_y: Float[Tensor, "K P"]
    warp: tuple[Tensor, Tensor, Tensor, Tensor]
    grey: Float[Tensor, "K P"]
    valid: Float[Tensor, "K P"]
    sector: Int[Tensor, "K P"]
    seen: Float[Tensor, "K P"]
    size: Int[Tensor, " K"]
    rings: Float[Tensor, "K 2 5"]
    center: Float[Tensor, "K 3"]
    normal: Float[Tensor, "K 3"]
    radii: Float[Tensor, "K 2"]
    polarity: Float[Tensor, " K"]
    limits: Float[Tensor, "K 2"]
    quantisation: float = shared()

    def wider(self, gain: Tensor) -> PixelBlocks:
        """The same with every dark edge outwards by the edge gain (N,) of its row, mm."""
        grown = (self.polarity * gain[self.row])[:, None] * gain.new_tensor([1.0, -1.0])
        return replace(self, radii=self.radii + grown)

    def every(self, nth: int, most: int | None = None, whole: int = 0) -> PixelBlocks:
        """The same with one pixel of ``nth``, or as many fewer as leave ``most`` of a marker; all of up to ``whole``.

        The padded length is a multiple of ``whole``.

        Of a marker 6 px wide a sixth of its pixels would not tell its 15 unknowns.
        """
        grain = max(1, whole)
        count = -(-self.grey.shape[1] // (nth * grain)) * grain
        count = count if most is None else min(count, most)
        i = torch.arange(count, device=self.row.device)
        stretched = torch.where(self.size <= min(whole, count), count, self.size.clamp_min(nth * count))
        index = i * stretched[:, None] // count
        inside = index < self.size[:, None]
        index = index.minimum((self.size[:, None] - 1).clamp_min(0))
        planes = {n: getattr(self, n).gather(1, index) for n in ("ray_x", "ray_y", "grey", "valid", "sector", "seen")}
        planes["valid"] *= inside
        w00, w01, w10, w11 = (w.gather(1, index) for w in self.warp)
        return replace(self, **planes, warp=(w00, w01, w10, w11))


class RingModel(NamedTuple):
    """Prediction and derivatives at one pose; planes (K, P) in float32.

    fraction: of paper, F. by_d: dF/dd through both circles. by_blur: 3 planes. by_pose: (6, K, P), derivative of d.
    by_gain: dF/d(edge gain), 1/mm.
    x, y: plane coordinates over the outer radius. sound: bool, False where the expansions below do not hold: deep in
    a hole that is small for its blur, or where it is flat; None if not asked for.
    """

    fraction: Tensor
    by_d: Tensor
    by_blur: tuple[Tensor, ...]
    by_pose: Tensor
    by_gain: Tensor
    x: Tensor
    y: Tensor
    sound: Tensor | None


def gather_pixels(sight: Sight, band: Tensor, grain: int) -> PixelBlocks:
    """The pixels within ``band`` (N,) px of either circle of every marker seen.

    ``grain``: the padded length P is a multiple of it.
    """
    frames, camera, frame = sight.frames, sight.camera, sight.frame
    height, width = frames.shape[-2:]
    row, marker = sight.mask.nonzero().unbind(-1)
    both = sight.rings[row, marker]  # (K, 2, 5)
    block, u, v = band_pixels(both[:, 0], both[:, 1], band[row], height, width)
    if block.numel() == 0:  # of rings beyond the frame: one pixel that does not count
        block, u, v = (torch.zeros(min(1, row.numel()), dtype=torch.int64, device=frames.device) for _ in range(3))
    count = row.numel()
    size = torch.bincount(block, minlength=count)
    most = (int(size.max()) // grain + 1) * grain if count else grain
    first = size.cumsum(0) - size
    place = torch.arange(most, device=block.device)
    inside = place < size[:, None]
    index = (first[:, None] + torch.minimum(place, (size[:, None] - 1).clamp_min(0))).clamp_max(block.numel() - 1)

    def padded(values: Tensor) -> Tensor:
        return values.float().index_select(0, index.flatten()).view_as(index)

    of = row.index_select(0, block)
    grey = values_at(frames, (frame.index_select(0, of) * height + v) * width + u)
    limits = _clipping(grey, of, frame.numel())[row]
    low, high = (limit.contiguous().index_select(0, block) for limit in limits.unbind(-1))
    xy = camera.undistort_points(torch.stack([u, v]).double().mT)
    x, y = xy.unbind(-1)
    # what is clipped is no measurement
    sound = (x + y).isfinite() & grey.isfinite() & (grey > low) & (grey < high)
    # rays count from that of the marker's middle pixel; what is not sound gets one of the marker, too, and stays finite
    origin = xy.index_select(0, (first + size // 2).clamp_max(block.numel() - 1)).nan_to_num(nan=0.0)
    x0, y0 = (o.contiguous().index_select(0, block) for o in origin.unbind(-1))
    aside = (both[:, 0, 2] / camera.matrix[0, 0].to(x)).index_select(0, block)
    x, y = (torch.where(sound, ray - start, aside) for ray, start in ((x, x0), (y, y0)))
    j00, j01, j10, j11 = camera.slopes((x0 + x).float(), (y0 + y).float())
    det = j00 * j11 - j01 * j10
    sector = sector_about(u, v, both[:, 0], block).index_select(0, index.flatten()).view_as(index)
    return PixelBlocks(
        row,
        origin,
        padded(x),
        padded(y),
        (padded(j11 / det), padded(-j01 / det), padded(-j10 / det), padded(j00 / det)),
        padded(torch.where(sound, grey, 0.0)),
        padded(sound) * inside,
        sector,
        _seen(sight, row, marker).gather(1, sector),
        size,
        both,
        sight.centers[row, marker],
        sight.normals[row, marker],
        sight.radii[row, marker],
        sight.polarity[row, marker],
        limits,
        sight.quantisation,
    )


def _seen(sight: Sight, row: Tensor, marker: Tensor) -> Tensor:
    """Sectors (K, 48) of markers, 1 or 0, see `PixelBlocks.seen`."""
    if sight.seen is None:
        return torch.ones(len(row), SECTORS, dtype=torch.float32, device=row.device)
    seen = sight.seen[row, marker].float()
    return torch.where(seen.mean(-1, keepdim=True) < LEAST_KEPT, 1.0, seen)


def _clipping(grey: Tensor, row: Tensor, rows: int) -> Tensor:
    """Limits (N, 2) at which each row's grey values are clipped: 0, and the full scale of its brightest pixel."""
    ends = grey.new_tensor([torch.inf, -torch.inf]).repeat(rows, 1)
    darkest = ends[:, 0].scatter_reduce(0, row, grey, "amin")
    brightest = ends[:, 1].scatter_reduce(0, row, grey, "amax")
    low = torch.where(darkest <= 0, 0.0, -torch.inf)
    return torch.stack([low, full_scale(brightest)], -1)


class _Foot(NamedTuple):
    """Where the ray of every pixel meets the marker's plane; planes (K, P) or (K, 1), float32.

    x, y: mm, about the circles' centre. radius: their length. outer, inner: less that of the circle. toward: growth of
    the depth with the ray's angle, 1 / (n . ray). depth: of the point over that of the plane's foot.
    axes: (4, 3, K, 1), of the plane, its normal and the arm of the marker, camera axes. one_c, two_c: the circles'
    centre along the axes. away: distance of the plane, over which it is 1 / away.
    """

    x: Tensor
    y: Tensor
    radius: Tensor
    outer: Tensor
    inner: Tensor
    toward: Tensor
    depth: Tensor
    axes: Tensor
    one_c: Tensor
    two_c: Tensor
    over_away: Tensor


def _feet(blocks: PixelBlocks, R: Tensor, t: Tensor) -> _Foot:
    """The radius in the plane is formed in float64, what is small beside it in float32."""
    # the arm: marker's centre about the target's origin, camera axes
    normal, arm = torch.bmm(R[blocks.row], torch.stack([blocks.normal, blocks.center], -1)).unbind(-1)
    center = arm + t[blocks.row]
    one, two = plane_axes(normal)
    # the ray of the pixel meets the plane at depth * ray; coordinates there, about the circle's centre, are quotients
    # of linear functions of the ray, which counts from a ray near the marker, so that float32 holds it
    away = (normal * center).sum(-1, keepdim=True)
    near = torch.nn.functional.pad(blocks.origin, (0, 1), value=1.0)
    over = (normal * near).sum(-1, keepdim=True)

    one_c, two_c = (one * center).sum(-1, keepdim=True), (two * center).sum(-1, keepdim=True)
    linear = torch.stack([normal, away * one - one_c * normal, away * two - two_c * normal]) / over
    at_x, at_y, _ = linear.split(1, -1)
    planes = (linear * near).sum(-1, keepdim=True) + at_x * blocks.ray_x + at_y * blocks.ray_y
    toward = planes[0].reciprocal()
    x, y = (planes[1:] * toward).unbind(0)
    radius = (x * x + y * y).sqrt().clamp_min(1e-9)
    outer, inner = (radius - blocks.radii.mT[..., None]).float().unbind(0)
    x, y, radius, toward = (v.float() for v in (x, y, radius, toward / over))
    axes = torch.stack([one, two, normal, arm]).float().mT.unsqueeze(-1)
    depth, over_away = away.float() * toward, 1 / away.float()
    return _Foot(x, y, radius, outer, inner, toward, depth, axes, one_c.float(), two_c.float(), over_away)


class _Rim(NamedTuple):
    """Image of the circles through every pixel; planes (K, P) float32.

    per_mm: px for a mm of radius. bend: curvature of the circle's image, 1/px. second: to second order in the distance,
    half the second over the first derivative of the radius, 1/px. normal: (nu, nv) of the image. by_pose: derivatives
    (6, K, P) of the distance. turn: by how much the normal at the edge is turned against that in the pixel, rad a px
    between them, where it is asked for.
    """

    per_mm: Tensor
    bend: Tensor
    second: Tensor
    normal: tuple[Tensor, Tensor]
    by_pose: Tensor
    turn: Tensor | None


def _rims(blocks: PixelBlocks, foot: _Foot, *, turning: bool) -> _Rim:
    x, y, radius, toward, depth = foot.x, foot.y, foot.radius, foot.toward, foot.depth
    one, two, normal, arm = foot.axes.unbind(0)
    ex, ey = x / radius, y / radius
    # a displacement w of the ray's foot, or of the plane against it, changes the radius by m . w
    s = (radius + ex * foot.one_c + ey * foot.two_c) * foot.over_away
    m = ex * one + ey * two - s * normal
    w00, w01, w10, w11 = blocks.warp
    gu, gv = m[0] * w00 + m[1] * w10, m[0] * w01 + m[1] * w11  # gradient of the radius in the image, over the depth
    flat = (gu.square() + gv.square()).clamp_min(1e-30).rsqrt()
    per_mm = flat / depth
    area = depth.square() * (w00 * w11 - w01 * w10).abs() * toward.abs()  # of a pixel in the plane, mm^2
    bend = area.square() * per_mm.pow(3) / radius
    # along the image's normal the radius bends where that normal is oblique in the plane, and by perspective
    nu, nv = gu * flat, gv * flat
    side = (ex * foot.two_c - ey * foot.one_c) * foot.over_away
    h = ex * two[:2] - ey * one[:2] - side * normal[:2]  # as m, but across the radius
    ray_u, ray_v = w00 * nu + w01 * nv, w10 * nu + w11 * nv
    oblique = h[0] * ray_u + h[1] * ray_v
    recede = (normal[0] * ray_u + normal[1] * ray_v) * toward
    second = 0.5 * oblique.square() * depth * flat / radius - recede
    by_pose = torch.cat([m, torch.linalg.cross(x * one + y * two + arm, m, dim=0)]) * -per_mm
    turn = None
    if turning:  # the mixed second derivative of the radius, along the normal and across it, over the first
        along_u, along_v = w01 * nu - w00 * nv, w11 * nu - w10 * nv
        across = h[0] * along_u + h[1] * along_v
        turn = oblique * across * depth.square() * per_mm / radius
        turn = turn - (normal[0] * along_u + normal[1] * along_v) * toward
    return _Rim(per_mm, bend, second, (nu, nv), by_pose, turn)


def _normals(rim: _Rim, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Normals (nu, nv) of the edges at these distances (2, K, P): what a blur with a direction does depends on them."""
    nu, nv = rim.normal
    if rim.turn is None:
        return nu, nv
    turn = rim.turn * distance
    length = (1 + turn.square()).rsqrt()
    return (nu + turn * nv) * length, (nv - turn * nu) * length


def ring_model(blocks: PixelBlocks, R: Tensor, t: Tensor, spread: Spread, *, check: bool = False) -> RingModel:
    """Predicts every pixel at poses (N, 3, 3), (N, 3) and N blurs, and with ``check`` says where that is sound."""
    foot = _feet(blocks, R, t)
    rim = _rims(blocks, foot, turning=spread.kind == "line")
    straight = foot.inner * rim.per_mm
    d_outer, d_inner = (d + rim.second * d.square() for d in (foot.outer * rim.per_mm, straight))
    sound = None
    if check:
        blur = spread.covariance[blocks.row].float()
        most = blurs.axes(blur)[1][:, None]
        near = (rim.bend.square() * most < _CURVED) & ((rim.second * straight).abs() < HOLDS)
        sound = near | (d_inner.square() > CUT**2 * blurs.across(blur[:, None], *rim.normal))
    distance = torch.stack([d_outer, d_inner])
    both = spread.at(blocks.row, *_normals(rim, distance))(distance, rim.bend)
    by_blur = tuple(one - other for one, other in both.by_blur)
    size = blocks.radii[:, :1].float()
    fraction, by_d = both.fraction[0] + 1 - both.fraction[1], both.by_distance[0] - both.by_distance[1]
    # dark edges move outwards: those of a dark ring away from each other
    by_gain = -blocks.polarity[:, None].float() * both.by_distance.sum(0) * rim.per_mm
    return RingModel(fraction, by_d, by_blur, rim.by_pose, by_gain, foot.x / size, foot.y / size, sound)
