"""Straight edges and the polygons they form: the other interpretations that ELSDc weighs against ellipses."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.detect.regions import (
    BESIDE,
    MIN_CELLS,
    ON_EDGE,
    PHASE,
    SECTORS,
    Gradient,
    Regions,
    connected_components,
    level_line_regions,
)
from torchpose.detect.validation import edges_at, log10_nfa
from torchpose.geometry import segments
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import marked, positions, segment_mean, segment_sum


@dataclass(frozen=True, eq=False)
class Segments(Rows):
    """Straight edges, directed so that the lighter side is on the left seen along the edge, v down.

    Attributes:
        ends: start and end, px.
        log10_nfa: log10 of the number of false alarms.
        chain: number of the polygon that the edge is a side of, -1 for none.
        place: position along the polygon.
        chain_log10_nfa: of that polygon, NaN for none.
    """

    frame: Int[Tensor, " N"]
    ends: Float[Tensor, "N 2 2"]
    log10_nfa: Float[Tensor, " N"]
    chain: Int[Tensor, " N"]
    place: Int[Tensor, " N"]
    chain_log10_nfa: Float[Tensor, " N"]


@dataclass(frozen=True, eq=False)
class _Lines(Rows):
    """Straight regions: the number of samples along them and the sum of their errors."""

    frame: Int[Tensor, " N"]
    ends: Float[Tensor, "N 2 2"]
    size: Float[Tensor, " N"]
    error: Float[Tensor, " N"]


def find_segments(grad: Gradient, cells: Int[Tensor, " P"]) -> Segments:
    """Validated straight edges among flat strong cells, chained to polygons where they meet; reduced px.

    Edges are regions whose directions fall into one sector of the circle, for two divisions of the circle, half a
    sector apart, so that none is lost on a border.
    """
    phases = (level_line_regions(grad, cells, MIN_CELLS, SECTORS, phase) for phase in (0.0, PHASE))
    found = _Lines.cat([_straight(grad, regions) for regions in phases])
    _, height, width = grad.shape
    pixels = math.log10(max(2, height * width))
    nfa = log10_nfa(math.log10(2) + 2.5 * pixels, found.size, found.error)
    keep = positions(nfa < 0)
    keep = keep[torch.argsort(nfa[keep], stable=True)]
    keep = keep[torch.argsort(found.frame[keep], stable=True)]
    keep = keep[~_repeated(found.frame[keep], found.ends[keep])]
    found, nfa = found[keep], nfa[keep]

    chain, place = _chains(found.frame, found.ends)
    side = positions(chain >= 0)
    count = int(chain.max()) + 1 if chain.numel() else 0
    sides = torch.bincount(chain[side], minlength=count).double()
    size, error = (segment_sum(v[side], chain[side], count) for v in (found.size, found.error))
    # 2^(d + 1) (h w)^(d + 3/2) tests of polygons with d sides (Patraucean et al.)
    chain_nfa = log10_nfa((sides + 1) * math.log10(2) + (sides + 1.5) * pixels, size, error)
    least = torch.full_like(chain_nfa, torch.inf).scatter_reduce_(0, chain[side], nfa[side], "amin")
    side = side[chain_nfa[chain[side]] < least[chain[side]]]
    chain_nfa = torch.full_like(nfa, torch.nan).index_copy(0, side, chain_nfa[chain[side]])
    wins = chain_nfa.isfinite()
    return Segments(found.frame, found.ends, nfa, torch.where(wins, chain, -1), torch.where(wins, place, 0), chain_nfa)


def _straight(grad: Gradient, regions: Regions) -> _Lines:
    xy = grad.centers(regions.cell)
    index, count = regions.region, regions.frame.numel()
    weight = torch.linalg.vector_norm(regions.gradient, dim=-1).double()
    middle = segment_mean(xy, index, count, weight)
    x, y = (xy - middle[index]).unbind(-1)
    xx, xyp, yy = segment_mean(torch.stack([x * x, x * y, y * y], -1), index, count, weight).T
    angle = 0.5 * torch.atan2(2 * xyp, xx - yy)
    across = 0.5 * (xx + yy) - torch.hypot(0.5 * (xx - yy), xyp)
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    side = segment_sum((regions.gradient.double() * _left(direction)[index]).sum(-1), index, count)
    direction = torch.where(side[:, None] < 0, -direction, direction)
    along = ((xy - middle[index]) * direction[index]).sum(-1)
    low = torch.zeros(count, dtype=along.dtype, device=along.device).scatter_reduce(0, index, along, "amin")
    high = torch.zeros_like(low).scatter_reduce(0, index, along, "amax")
    good = positions((across.clamp_min(0).sqrt() < ON_EDGE) & (high - low > 3))
    reach, direction, frame = torch.stack([low, high], -1)[good], direction[good], regions.frame[good]
    ends = middle[good, None] + reach[..., None] * direction[:, None]

    which, position = segments.ragged_arange((reach[:, 1] - reach[:, 0]).ceil().long())
    at = ends[which, 0] + (position[:, None] + 0.5) * direction[which]
    error = edges_at(grad, frame, which, at, _left(direction)[which]).error
    size = torch.bincount(which, minlength=len(good)).double()
    return _Lines(frame, ends, size, segment_sum(error, which, len(good)))


def _left(direction: Tensor) -> Tensor:
    """Normals (N, 2) on the lighter side."""
    return torch.stack([direction[:, 1], -direction[:, 0]], -1)


def _repeated(frame: Tensor, ends: Tensor) -> Tensor:
    """Segments (N,) bool that lie along an earlier one of their frame, which has fewer false alarms."""
    i, j = segments.earlier_in_group(frame)
    axis = ends[j, 1] - ends[j, 0]
    length = torch.linalg.vector_norm(axis, dim=-1)
    axis = (axis / length[:, None])[:, None]
    local = ends[i] - ends[j, :1]
    along = (local * axis).sum(-1)
    across = local[..., 0] * axis[..., 1] - local[..., 1] * axis[..., 0]
    inside = torch.minimum(along.amax(-1), length) - along.amin(-1).clamp_min(0)
    covered = along[:, 1] - along[:, 0]
    same = (across.abs() < ON_EDGE).all(-1) & (inside > 0.5 * covered) & (covered > 0)
    return marked(i[same], len(frame))


def _chains(frame: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Polygon (N,) int64 of each segment, -1 for none, and its place along it, by mutually nearest ends."""
    count = frame.numel()
    i, j = segments.pairs_in_group(frame, frame)
    gap = torch.linalg.vector_norm(ends[j, 0] - ends[i, 1], dim=-1)
    meets = positions((gap < BESIDE) & (i != j))
    i, j, gap = i[meets], j[meets], gap[meets]
    far = torch.full((count,), torch.inf, dtype=gap.dtype, device=gap.device)
    after, before = far.scatter_reduce(0, i, gap, "amin"), far.scatter_reduce(0, j, gap, "amin")
    mutual = (gap == after[i]) & (gap == before[j])
    i, j = i[mutual], j[mutual]
    label = connected_components(i, j, count)
    large = torch.bincount(label, minlength=count) > 1
    chain = torch.where(large, large.cumsum(0) - 1, -1)[label]
    # list ranking: steps back to the head; a closed polygon is opened at its first segment
    alone = torch.arange(count, device=frame.device)
    headed = marked(label[~marked(j, count)], count)
    link = (label[j] != j) | headed[label[j]]
    previous = alone.index_copy(0, j[link], i[link])
    place = (previous != alone).long()
    for _ in range(max(1, count).bit_length()):
        place = place + place[previous]
        previous = previous[previous]
    return chain, place
