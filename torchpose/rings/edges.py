"""Stage: edge pixels along rough ellipses, then their sub-pixel edges, flat over all rings of a batch.

The paper runs Canny over each region. Here the region is a band around an ellipse already known to a pixel or two, so
the maximum of the gradient along the ellipse's own normal is searched directly: non-maximum suppression with the normal
given, at a few pixels per pixel of perimeter instead of all of the region.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.detect.regions import AGREE_COS
from torchpose.geometry import conics
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import positions, ragged_arange, segment_mean, values_at
from torchpose.rings import zernike

# px searched to either side of the rough ellipse: candidates of covered rings err by two (measured: decisions/0057)
REACH = 4
_SAMPLES_PER_PIXEL = 1.1  # of perimeter: a chain of edge pixels has at most one pixel a pixel of length
STEP_RANGE = (0.4, 2.5)  # of one grey step of a ring to another: light may fall off by 2 across it (convention)


@dataclass(frozen=True, eq=False)
class RingEdges(Rows):
    """Edge points of M rings, flat, sorted by ring.

    Attributes:
        ring: of each point.
        points: px.
        normal: unit, towards increasing grey.
        offset: px along the normal from the centre of the edge's pixel, as measured.
        step: grey step across the edge.
    """

    ring: Int[Tensor, " E"]
    points: Float[Tensor, "E 2"]
    normal: Float[Tensor, "E 2"]
    offset: Float[Tensor, " E"]
    step: Float[Tensor, " E"]


def edge_pixels(
    frames: Tensor, frame: Tensor, ellipses: Tensor, outward: Tensor, reach: Tensor, margin: int = zernike.MASK // 2
) -> tuple[Tensor, Tensor]:
    """Pixels of largest gradient across each ellipse.

    Args:
        frames: (B, H, W), any real dtype. frame: (M,) int64. ellipses: (M, 5) rough, px.
        outward: (M,) +1 where grey rises outwards, -1 where it falls. reach: (M,) px, at most `REACH`, each side.
        margin: px to keep from the border of the frame.

    Returns:
        pixels (E, 2) int64 u, v without repetition and their ring (E,) int64, sorted by ring.
    """
    key = _edge_keys(frames, frame, ellipses, outward, reach, margin)
    return _of_key(key, *frames.shape[-2:])


def _edge_keys(
    frames: Tensor, frame: Tensor, ellipses: Tensor, outward: Tensor, reach: Tensor, margin: int = zernike.MASK // 2
) -> Tensor:
    """`edge_pixels` as keys (E,) int64, rising: (ring, v, u) as one number."""
    height, width = frames.shape[-2:]
    count = (conics.perimeter(ellipses) * _SAMPLES_PER_PIXEL).ceil().long()
    ring, position = ragged_arange(count)
    step = 2 * torch.pi / count.double()
    x, y, nx, ny = conics.boundary(ellipses, ring, position * step.index_select(0, ring))
    k = torch.arange(-REACH - 1, REACH + 2, device=frames.device, dtype=torch.float64)
    u = (x[:, None] + nx[:, None] * k).round_().clamp_(0, width - 1)
    v = (y[:, None] + ny[:, None] * k).round_().clamp_(0, height - 1)
    cell = v.add_(height * frame.index_select(0, ring)[:, None]).mul_(width).add_(u).long()
    grey = values_at(frames, cell)
    rise = (grey[:, 2:] - grey[:, :-2]) * outward.index_select(0, ring)[:, None].float()
    rise = rise.masked_fill_(k[1:-1].abs() > reach.index_select(0, ring)[:, None], -torch.inf)
    value, best = rise.max(-1)
    along = k.index_select(0, best + 1)
    u, v = (x + nx * along).round().long(), (y + ny * along).round().long()
    keep = positions((value > 0) & _clear_of_border(u, v, height, width, margin))
    return _unique(_key(u, v, ring, height, width).index_select(0, keep))


def ring_edges(frames: Tensor, frame: Tensor, ellipses: Tensor, outward: Tensor, reach: Tensor) -> RingEdges:
    """Sub-pixel edge points of rings from rough ellipses; arguments as in `edge_pixels`.

    Each edge point is measured from the window centred on its own pixel. Points with a normal unlike the ellipse's or a
    step far below the ring's mean are left out.
    """
    height, width = frames.shape[-2:]
    key = _edge_keys(frames, frame, ellipses, outward, reach)
    pixel, ring = _of_key(key, height, width)
    found = zernike.locate(frames, frame.index_select(0, ring), pixel)

    # the window of a neighbouring pixel saw the edge: look again, centred where it pointed
    again = positions(~found.inside & (found.offset.abs() < 2))
    u, v = (p.index_select(0, again).round().long() for p in found.points.unbind(-1))
    clear = positions(_clear_of_border(u, v, height, width, zernike.MASK // 2))
    moved = _unique(_key(u, v, ring.index_select(0, again), height, width).index_select(0, clear))
    keep = positions(found.inside)
    kept = torch.nn.functional.pad(key.index_select(0, keep), (0, 1), value=-1)
    fresh = positions(kept.index_select(0, torch.searchsorted(kept[:-1], moved)) != moved)
    moved_pixel, moved_ring = _of_key(moved.index_select(0, fresh), height, width)
    second = zernike.locate(frames, frame.index_select(0, moved_ring), moved_pixel)
    also = positions(second.inside)

    every = torch.cat([_columns(found).index_select(0, keep), _columns(second).index_select(0, also)])
    ring = torch.cat([ring.index_select(0, keep), moved_ring.index_select(0, also)])
    x, y, along_x, along_y, _, step = every.unbind(1)
    nx, ny = _normal(ellipses, ring, x, y)
    aligned = (along_x * nx + along_y * ny) * outward.index_select(0, ring) > AGREE_COS
    mean_step = segment_mean(step, ring, ellipses.shape[0], aligned.double())
    good = positions(aligned & (step > STEP_RANGE[0] * mean_step.index_select(0, ring)))
    order = good[torch.argsort(ring[good], stable=True)]
    every = every.index_select(0, order)
    return RingEdges(ring.index_select(0, order), every[:, :2], every[:, 2:4], every[:, 4], every[:, 5])


def _columns(edges: zernike.Edges) -> Tensor:
    """Points, normals, offsets and steps (E, 6)."""
    return torch.cat([edges.points, edges.normal, edges.offset[:, None], edges.step[:, None]], 1)


def _normal(ellipses: Tensor, ring: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Outward unit normals nx, ny (E,) of the ellipses' level curves through points x, y (E,)."""
    each = torch.cat([conics.inverse_shape(ellipses, 2).flatten(1), ellipses[:, :2]], 1)
    s11, s12, _, s22, cx, cy = each.index_select(0, ring).unbind(1)
    dx, dy = x - cx, y - cy
    nx, ny = s11 * dx + s12 * dy, s12 * dx + s22 * dy
    scale = (nx * nx + ny * ny).rsqrt()
    return nx * scale, ny * scale


def _clear_of_border(u: Tensor, v: Tensor, height: int, width: int, margin: int) -> Tensor:
    return (u >= margin) & (u < width - margin) & (v >= margin) & (v < height - margin)


def _key(u: Tensor, v: Tensor, ring: Tensor, height: int, width: int) -> Tensor:
    return (ring * height + v) * width + u


def _of_key(key: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Pixels (E, 2) u, v and rings (E,) of keys."""
    row = torch.div(key, width, rounding_mode="floor")
    ring = torch.div(row, height, rounding_mode="floor")
    return torch.stack([key - row * width, row - ring * height]).mT, ring


def _unique(key: Tensor) -> Tensor:
    """The keys without repetition, rising."""
    key = key.sort().values
    return key[positions(torch.nn.functional.pad(key[1:] != key[:-1], (1, 0), value=True))] if key.numel() else key
