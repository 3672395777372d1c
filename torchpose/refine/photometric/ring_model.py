"""What the pixels around the edges of a ring should show: prediction and derivatives, for padded blocks of pixels.

    F = E(d_outer) + 1 - E(d_inner)

is the fraction of paper in a pixel; d is its distance in px from the projected circle, and E what the blur makes of an
edge of that curvature and direction (`geometry.blurred_edge`). The distortion of the lens enters once, as the ray of
each pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.camera.model import Slopes
from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import HOLDS, Spread
from torchpose.geometry.constants import constant, either, finite
from torchpose.geometry.grey import full_scale
from torchpose.geometry.robust import CUT, LEAST_KEPT
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows, replace, shared
from torchpose.geometry.sectors import SECTORS, sector_about
from torchpose.geometry.segments import values_at
from torchpose.refine.photometric.band import band_pixels
from torchpose.refine.sight import Sight

# blur's variance over the squared radius of curvature: nearer to its centre edges are on all sides (measured: with 0.16
# a third of the pixels of a covered ring under 2.5 px of blur is lost, tests/refine/test_sectors.py)
_CURVED = 0.2
# pixels summed in float32 at a time; sums of tiles are float64, so padding changes no digit that counts (convention)
TILE = 256


@dataclass(frozen=True, eq=False)
class PixelBlocks(Rows):
    """Pixels of K markers, padded to P, a multiple of `TILE`.

    Attributes:
        row: whose marker it is.
        origin: a ray near each marker, on the plane z = 1, as (x, y, 1).
        rays: the pixels' rays from there, x, y and 1, by tiles.
        warp: by tiles d(ray)/d(pixel), row by row, and the size of its determinant.
        grey: values of the pixels.
        valid: 1 or 0.
        sector: of the ring, see `geometry.sectors`.
        seen: 1 or 0, whether the ring was seen there so far; 1 all around where that is less than half of it.
        size: pixels of each marker; what follows in its row repeats the last one and is not valid.
        rings: ellipses of its two circles, outer one first.
        frame: two axes of the marker's plane, its normal and its centre as columns, target frame.
        radii: outer and inner.
        polarity: as in `Sight`.
        limits: the grey levels at which the frame's noise is clipped, -inf and inf where it is not.
        quantisation: variance of rounding, grey levels^2.
        rows: how many there are.
    """

    row: Int[Tensor, " K"]
    origin: Float[Tensor, "K 3 1"]
    rays: Float[Tensor, "K T 3 S"]
    warp: Float[Tensor, "K T 5 S"]
    grey: Float[Tensor, "K P"]
    valid: Float[Tensor, "K P"]
    sector: Int[Tensor, "K P"]
    seen: Float[Tensor, "K P"]
    size: Int[Tensor, " K"]
    rings: Float[Tensor, "K 2 5"]
    frame: Float[Tensor, "K 3 4"]
    radii: Float[Tensor, "K 2"]
    polarity: Float[Tensor, " K"]
    limits: Float[Tensor, "K 2"]
    quantisation: float = shared()
    rows: int = shared()

    def wider(self, gain: Tensor) -> PixelBlocks:
        """The same with every dark edge outwards by the edge gain (N,) of its row, mm."""
        grown = (self.polarity * gain[self.row])[:, None] * gain.new_tensor([1.0, -1.0])
        return replace(self, radii=self.radii + grown)

    @property
    def center(self) -> Float[Tensor, "K 3"]:
        """Of the marker, target frame."""
        return self.frame[..., 3]

    def every(self, nth: int, most: int | None = None) -> PixelBlocks:
        """The same with one pixel of ``nth``, or as many fewer as leave ``most`` of a marker; all of up to a tile.

        Of a marker 6 px wide a sixth of its pixels would not tell its 15 unknowns.
        """
        count = -(-self.grey.shape[1] // (nth * TILE)) * TILE
        count = count if most is None else min(count, most)
        i = torch.arange(count, device=self.row.device)
        more = torch.div(self.size - 1, TILE, rounding_mode="floor")  # tiles beyond the first one
        stretched = torch.where(more > 0, self.size.clamp_min(nth * count), count)
        index = i * stretched[:, None] // count
        inside = index < self.size[:, None]
        index = index.minimum((self.size[:, None] - 1).clamp_min(0))
        planes = {name: getattr(self, name).gather(1, index) for name in ("grey", "valid", "sector", "seen")}
        planes["valid"] *= inside
        tile = torch.div(index, TILE, rounding_mode="floor") * TILE  # places of a plane of all tiles of a marker
        for name in ("rays", "warp"):
            old = getattr(self, name)
            n = old.shape[2]
            place = (n * tile + index - tile)[:, None] + torch.arange(0, n * TILE, TILE, device=index.device)[:, None]
            new = old.flatten(1).gather(1, place.flatten(1)).view(len(old), n, count // TILE, TILE)
            planes[name] = new.transpose(1, 2).contiguous()
        return replace(self, **planes)


class RingModel(NamedTuple):
    """Prediction and derivatives at one pose; planes (K, T, S) in float32.

    fraction: of paper, F. by_d: dF/dd through both circles. by_blur: 3 planes. by_pose: (K, T, 6, S), derivative of d.
    by_gain: dF/d(edge gain), 1/mm; None if not asked for.
    x, y: plane coordinates over the outer radius. sound: bool, False where the expansions below do not hold: deep in
    a hole that is small for its blur, or where it is flat; None if not asked for.
    """

    fraction: Tensor
    by_d: Tensor
    by_blur: tuple[Tensor, ...]
    by_pose: Tensor
    by_gain: Tensor | None
    x: Tensor
    y: Tensor
    sound: Tensor | None


def gather_pixels(sight: Sight, band: Tensor) -> PixelBlocks:
    """The pixels within ``band`` (N,) px of either circle of every marker seen."""
    frames, camera, frame = sight.frames, sight.camera, sight.frame
    height, width = frames.shape[-2:]
    row, marker = sight.mask.nonzero().unbind(-1)
    both = sight.rings[row, marker]  # (K, 2, 5)
    block, u, v = band_pixels(both[:, 0], both[:, 1], band[row], height, width)
    if block.numel() == 0:  # of rings beyond the frame: one pixel that does not count
        block, u, v = (torch.zeros(min(1, row.numel()), dtype=torch.int64, device=frames.device) for _ in range(3))
    count = row.numel()
    size = torch.bincount(block, minlength=count)
    most = (int(size.max()) // TILE + 1) * TILE if count else TILE
    first = size.cumsum(0) - size
    place = torch.arange(most, device=block.device)
    inside, last = place < size[:, None], (size[:, None] - 1).clamp_min(0)
    index = (first[:, None] + torch.minimum(place, last)).clamp_max(block.numel() - 1).flatten()

    of = row.index_select(0, block)
    grey = values_at(frames, (frame.index_select(0, of) * height + v) * width + u)
    limits = _clipping(grey, of, frame.numel()).index_select(0, row)
    low, high = limits.mT.contiguous().index_select(1, block)
    xy, slopes = camera.rays(torch.stack([u, v]).double())
    # what is clipped is no measurement
    sound = finite(xy, 0) & (grey > low) & (grey < high)  # NaN is neither
    # rays count from that of the marker's middle pixel; what is not sound gets one of the marker, too, and stays finite
    origin = xy.index_select(1, (first + size // 2).clamp_max(block.numel() - 1)).nan_to_num(nan=0.0)
    aside = (both[:, 0, 2] / camera.matrix[0, 0]).to(xy).index_select(0, block)
    xy = torch.where(sound, xy - origin.index_select(1, block), aside).index_select(1, index).view(2, count, most)
    flat = torch.cat([_by_pixel(slopes, camera).float(), torch.stack([grey, torch.ones_like(grey)])])
    flat = torch.where(sound, flat, constant(((1.0,), (0.0,), (0.0,), (1.0,), (1.0,), (0.0,), (0.0,)), flat))
    *warped, grey, valid = flat.index_select(1, index).view(len(flat), count, most)
    sector = sector_about(u, v, both[:, 0], block).index_select(0, index).view(count, most)
    normal = sight.normals[row, marker]
    return PixelBlocks(
        row,
        torch.nn.functional.pad(origin, (0, 0, 0, 1), value=1.0).mT[..., None],
        _tiled(*xy, torch.ones_like(xy[0])),
        _tiled(*warped),
        grey,
        valid * inside,
        sector,
        _seen(sight, row, marker).gather(1, sector),
        size,
        both,
        torch.stack([*plane_axes(normal), normal, sight.centers[row, marker]], -1),
        sight.radii[row, marker],
        sight.polarity[row, marker],
        limits,
        sight.quantisation,
        len(sight),
    )


def _by_pixel(slopes: Slopes, camera: Camera) -> Tensor:
    """d(ray)/d(pixel) (5, P) as in `PixelBlocks.warp`, by the slopes of the lens."""
    back = slopes.inverse()
    fx, fy = camera.matrix.diagonal()[:2]
    (xx, yy), mixed = back.straight, back.mixed
    return torch.stack([xx / fx, mixed / fy, mixed / fx, yy / fy, back.determinant.abs() / (fx * fy)])


def _tiled(*planes: Tensor) -> Tensor:
    """(K, T, n, S) of n planes (K, P)."""
    return torch.stack([plane.view(len(plane), plane.shape[1] // TILE, TILE) for plane in planes], 2)


def _seen(sight: Sight, row: Tensor, marker: Tensor) -> Tensor:
    """Sectors (K, 48) of markers, 1 or 0, see `PixelBlocks.seen`."""
    if sight.seen is None:
        return torch.ones(len(row), SECTORS, dtype=torch.float32, device=row.device)
    seen = sight.seen[row, marker].float()
    return either(seen.mean(-1, keepdim=True) < LEAST_KEPT, 1.0, seen)


def _clipping(grey: Tensor, row: Tensor, rows: int) -> Tensor:
    """Limits (N, 2) at which each row's grey values are clipped: 0, and the full scale of its brightest pixel."""
    darkest = grey.new_full((rows,), torch.inf).scatter_reduce_(0, row, grey, "amin")
    brightest = grey.new_full((rows,), -torch.inf).scatter_reduce_(0, row, grey, "amax")
    low = either(darkest <= 0, 0.0, -torch.inf)
    return torch.stack([low, full_scale(brightest)], -1)


class _Foot(NamedTuple):
    """Where the ray of every pixel meets the marker's plane; planes (K, T, S), float32.

    place: (K, T, 2, S), x and y in mm, about the circles' centre. radius: their length. past: (2, K, T, S), less that
    of the outer and the inner circle. toward: growth of the depth with the ray's angle, 1 / (n . ray). depth: of the
    point over that of the plane's foot. normal: (K, 3, 1), of the plane, camera axes.
    lever: (K, 5, 3), from (x, y, 1) to the point about the target's origin. by_foot: (K, 7, 3), from the direction of
    (x, y) and the radius to m, and to the first two of h, see `_rims`. Of both the first two come once more after the
    third, so that a cross product is two products of slices.
    """

    place: Tensor
    radius: Tensor
    past: Tensor
    toward: Tensor
    depth: Tensor
    normal: Tensor
    lever: Tensor
    by_foot: Tensor


def _feet(blocks: PixelBlocks, R: Tensor, t: Tensor) -> _Foot:
    """The radius in the plane is formed in float64, what is small beside it in float32."""
    # the arm: marker's centre about the target's origin, camera axes
    frame = torch.bmm(R.index_select(0, blocks.row), blocks.frame)
    plane, normal, arm = frame.split_with_sizes([2, 1, 1], -1)
    center = arm + t.index_select(0, blocks.row)[..., None]
    away = (normal * center).sum(1, keepdim=True)
    # a displacement w of the ray's foot, or of the plane against it, changes x and y by these times w
    axes = (plane - normal * torch.bmm(center.mT, plane) / away).mT
    # the ray of the pixel meets the plane at depth * ray; coordinates there, about the circle's centre, are quotients
    # of linear functions of the ray, which counts from a ray near the marker, so that float32 holds it
    linear = torch.cat([normal.mT, away * axes], 1)
    linear = torch.cat([linear[..., :2], torch.bmm(linear, blocks.origin)], -1)
    planes = by_tiles(linear, blocks.rays)
    toward = planes[:, :, 0].reciprocal()
    place = planes[:, :, 1:] * toward[:, :, None]
    x, y = place.unbind(2)
    radius = torch.addcmul(x * x, y, y).sqrt_().clamp_min_(1e-9)
    past = (radius - blocks.radii.mT[..., None, None]).float()
    toward = toward.float()
    first = torch.cat([axes.mT, normal / -away], -1)
    across = torch.nn.functional.pad(torch.stack([axes[:, 1, :2], -axes[:, 0, :2]], -1), (0, 1))
    by_foot = torch.cat([first, first[:, :2], across], 1).float()
    lever = torch.cat([plane, arm], -1)
    lever = torch.cat([lever, lever[:, :2]], 1).float()
    depth = toward * away.float()
    return _Foot(place.float(), radius.float(), past, toward, depth, normal.float(), lever, by_foot)


def by_tiles(matrix: Tensor, planes: Tensor) -> Tensor:
    """Matrices (K, n, m) times the planes (K, T, m, S) of every tile."""
    count, tiles, _, size = planes.shape
    each = matrix.index_select(0, _of_tiles(count, tiles, matrix.device))
    return torch.bmm(each, planes.flatten(0, 1)).view(count, tiles, matrix.shape[-2], size)


@lru_cache(maxsize=64)
def _of_tiles(count: int, tiles: int, device: torch.device) -> Tensor:
    """Which of K blocks each of their tiles is of, (K T,) int64."""
    with torch.inference_mode(False):
        return torch.arange(count, device=device).repeat_interleave(tiles)


class _Rim(NamedTuple):
    """Image of the circles through every pixel; planes (K, T, S) float32.

    per_mm: px for a mm of radius. bend: curvature of the circle's image, 1/px. second: to second order in the distance,
    half the second over the first derivative of the radius, 1/px. normal: (nu, nv) of the image. by_pose: derivatives
    (K, T, 6, S) of the distance. turn: by how much the normal at the edge is turned against that in the pixel, rad a px
    between them, where it is asked for.
    """

    per_mm: Tensor
    bend: Tensor
    second: Tensor
    normal: tuple[Tensor, Tensor]
    by_pose: Tensor
    turn: Tensor | None


def _rims(blocks: PixelBlocks, foot: _Foot, *, turning: bool) -> _Rim:
    radius, toward, depth, warp = foot.radius, foot.toward, foot.depth, blocks.warp
    # a displacement w of the ray's foot, or of the plane against it, changes the radius by m . w; h is as m, but across
    both = by_tiles(foot.by_foot, torch.cat([foot.place / radius[:, :, None], radius[:, :, None]], 2))
    m, h0, h1 = both[:, :, :3], both[:, :, 5], both[:, :, 6]
    w00, w01, w10, w11, area = warp.unbind(2)
    gu, gv = torch.addcmul(m[:, :, 0] * w00, m[:, :, 1], w10), torch.addcmul(m[:, :, 0] * w01, m[:, :, 1], w11)
    # gradient of the radius in the image, over the depth
    flat = torch.addcmul(gu * gu, gv, gv).clamp_min_(1e-30).rsqrt_()
    per_mm = flat / depth
    square = depth * depth
    area = square * area * toward  # of a pixel in the plane, mm^2, but for its sign
    bend = area * area * per_mm.pow(3) / radius
    # along the image's normal the radius bends where that normal is oblique in the plane, and by perspective
    nu, nv = gu * flat, gv * flat
    ray_u, ray_v = torch.addcmul(w00 * nu, w01, nv), torch.addcmul(w10 * nu, w11, nv)
    oblique = torch.addcmul(h0 * ray_u, h1, ray_v)
    n0, n1 = foot.normal[:, :2, None].unbind(1)
    recede = torch.addcmul(n0 * ray_u, n1, ray_v) * toward
    steep = square * per_mm / radius
    second = torch.addcmul(-recede, oblique * oblique, steep, value=0.5)
    at = by_tiles(foot.lever, torch.nn.functional.pad(foot.place, (0, 0, 0, 1), value=1.0))
    turned = torch.addcmul(at[:, :, 1:4] * both[:, :, 2:5], at[:, :, 2:], both[:, :, 1:4], value=-1)
    by_pose = torch.cat([m, turned], 2) * -per_mm[:, :, None]
    turn = None
    if turning:  # the mixed second derivative of the radius, along the normal and across it, over the first
        along_u, along_v = w01 * nu - w00 * nv, w11 * nu - w10 * nv
        across = h0 * along_u + h1 * along_v
        turn = oblique * across * steep
        turn = turn - (n0 * along_u + n1 * along_v) * toward
    return _Rim(per_mm, bend, second, (nu, nv), by_pose, turn)


def _normals(rim: _Rim, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Normals (nu, nv) of the edges at distances (2, K, T, S): what a blur with a direction does depends on them."""
    nu, nv = rim.normal
    if rim.turn is None:
        return nu, nv
    turn = rim.turn * distance
    length = (1 + turn.square()).rsqrt()
    return (nu + turn * nv) * length, (nv - turn * nu) * length


def ring_model(
    blocks: PixelBlocks, R: Tensor, t: Tensor, spread: Spread, *, check: bool = False, gain: bool = True
) -> RingModel:
    """Predicts every pixel at poses (N, 3, 3), (N, 3) and N blurs, and with ``check`` says where that is sound."""
    foot = _feet(blocks, R, t)
    rim = _rims(blocks, foot, turning=spread.kind == "line")
    straight = foot.past * rim.per_mm
    distance = torch.addcmul(straight, straight * straight, rim.second)
    edges = spread.at(blocks.row, *_normals(rim, distance), dims=2)
    sound = None
    if check:
        blur = spread.covariance.index_select(0, blocks.row).float()
        most, across = blurs.axes(blur)[1][:, None, None], edges.across
        if across is None:
            across = blurs.across(blur[:, None, None], *rim.normal)
        near = (rim.bend.square() * most < _CURVED) & ((rim.second * straight[1]).abs() < HOLDS)
        sound = near | (distance[1].square() > CUT**2 * across)
    both = edges(distance, rim.bend)
    by_blur = tuple(one - other for one, other in both.by_blur)
    place = foot.place / blocks.radii[:, :1, None, None].float()
    fraction, by_d = both.fraction[0] + 1 - both.fraction[1], both.by_distance[0] - both.by_distance[1]
    by_gain = None
    if gain:  # dark edges move outwards: those of a dark ring away from each other
        by_gain = both.by_distance.sum(0) * rim.per_mm * -blocks.polarity[:, None, None].float()
    x, y = place.unbind(2)
    return RingModel(fraction, by_d, by_blur, rim.by_pose, by_gain, x, y, sound)
