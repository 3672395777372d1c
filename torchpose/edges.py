"""Stage: edge pixels along rough ellipses, then their sub-pixel edges, flat over all rings of a batch.

The paper runs Canny over each region. Here the region is a band around an ellipse already known to a pixel or two, so
the maximum of the gradient along the ellipse's own normal is searched directly: non-maximum suppression with the normal
given, at a few pixels per pixel of perimeter instead of all of the region.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose import zernike
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, segment_mean

REACH = 4  # px searched to either side of the rough ellipse
_SAMPLES_PER_PIXEL = 1.1  # of perimeter: a chain of edge pixels has at most one pixel a pixel of length
_NORMAL_COS = 0.85  # of the edge's normal with the ellipse's: 32 degrees
_LEAST_STEP = 0.35  # of the mean step of the ring


@dataclass(frozen=True, eq=False)
class RingEdges:
    """Edge points of M rings, flat, sorted by ring.

    Attributes:
        ring: (E,) int64. points: (E, 2) float64, px.
        normal: (E, 2) float64, unit, towards increasing grey.
        offset: (E,) float64, px along the normal from the centre of the edge's pixel, as measured.
        step: (E,) float64, grey step across the edge.
    """

    ring: Tensor
    points: Tensor
    normal: Tensor
    offset: Tensor
    step: Tensor

    def __getitem__(self, index: Tensor) -> RingEdges:
        return RingEdges(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


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
    height, width = frames.shape[-2:]
    count = (conics.perimeter(ellipses) * _SAMPLES_PER_PIXEL).ceil().long()
    ring, position = ragged_arange(count)
    xy = conics.points_on(ellipses[ring], position.double() * (2 * torch.pi) / count[ring])
    normal = _normal(ellipses, ring, xy)
    k = torch.arange(-REACH - 1, REACH + 2, device=frames.device, dtype=torch.float64)
    line = (xy[:, None] + k[:, None] * normal[:, None]).round().long()
    u, v = line[..., 0].clamp(0, width - 1), line[..., 1].clamp(0, height - 1)
    grey = frames.reshape(-1)[(frame[ring, None] * height + v) * width + u].float()
    rise = (grey[:, 2:] - grey[:, :-2]) * outward[ring, None]
    rise = rise.masked_fill(k[1:-1].abs() > reach[ring, None], -torch.inf)
    value, best = rise.max(-1)
    pixel = line[torch.arange(ring.numel(), device=ring.device), best + 1]
    keep = (value > 0) & _clear_of_border(pixel, height, width, margin)
    return _unique(pixel[keep], ring[keep], height, width)


def ring_edges(frames: Tensor, frame: Tensor, ellipses: Tensor, outward: Tensor, reach: Tensor) -> RingEdges:
    """Sub-pixel edge points of rings from rough ellipses; arguments as in `edge_pixels`.

    Each edge point is measured from the window centred on its own pixel. Points with a normal unlike the ellipse's or a
    step far below the ring's mean are left out.
    """
    height, width = frames.shape[-2:]
    pixel, ring = edge_pixels(frames, frame, ellipses, outward, reach)
    found = zernike.locate(frames, frame[ring], pixel)

    # the window of a neighbouring pixel saw the edge: look again, centred where it pointed
    again = (~found.inside & (found.offset.abs() < 2)).nonzero()[:, 0]
    moved = found.points[again].round().long()
    clear = _clear_of_border(moved, height, width, zernike.MASK // 2)
    moved, moved_ring = _unique(moved[clear], ring[again[clear]], height, width)
    keep = found.inside
    fresh = ~torch.isin(_key(moved, moved_ring, height, width), _key(pixel[keep], ring[keep], height, width))
    moved, moved_ring = moved[fresh], moved_ring[fresh]
    second = zernike.locate(frames, frame[moved_ring], moved)

    def both(name: str) -> Tensor:
        return torch.cat([getattr(found, name)[keep], getattr(second, name)[second.inside]])

    ring = torch.cat([ring[keep], moved_ring[second.inside]])
    points, normal, offset, step = both("points"), both("normal"), both("offset"), both("step")
    aligned = (normal * _normal(ellipses, ring, points)).sum(-1) * outward[ring] > _NORMAL_COS
    mean_step = segment_mean(step, ring, ellipses.shape[0], aligned.double())
    good = (aligned & (step > _LEAST_STEP * mean_step[ring])).nonzero()[:, 0]
    order = good[torch.argsort(ring[good], stable=True)]
    return RingEdges(ring[order], points[order], normal[order], offset[order], step[order])


def _normal(ellipses: Tensor, ring: Tensor, points: Tensor) -> Tensor:
    """Outward unit normals (E, 2) of the ellipses' level curves through the points."""
    inverse = torch.linalg.inv(conics.shape_matrix(ellipses))
    normal = ((inverse @ inverse)[ring] @ (points - ellipses[ring, :2])[..., None]).squeeze(-1)
    return normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)


def _clear_of_border(pixel: Tensor, height: int, width: int, margin: int) -> Tensor:
    u, v = pixel.unbind(-1)
    return (u >= margin) & (u < width - margin) & (v >= margin) & (v < height - margin)


def _key(pixel: Tensor, ring: Tensor, height: int, width: int) -> Tensor:
    return (ring * height + pixel[:, 1]) * width + pixel[:, 0]


def _unique(pixel: Tensor, ring: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    key = torch.unique(_key(pixel, ring, height, width))
    rest = key % (height * width)
    return torch.stack([rest % width, rest // width], -1), key // (height * width)
