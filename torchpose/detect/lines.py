"""Straight edges and the polygons they form: the other interpretations that ELSDc weighs against ellipses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.detect.arcs import cells_at
from torchpose.detect.regions import Gradient, Regions, connected_components, level_line_regions
from torchpose.geometry.segments import pairs_in_group, ragged_arange, segment_mean, segment_sum

_SECTORS = 8  # directions of one edge stay within 45 degrees
_MIN_CELLS = 10
_STRAIGHT = 1.2  # cells, RMS distance of the cells from their line
_JOIN = 4.0  # cells between the end of one side of a polygon and the start of the next
_OVERLAP = 2.0  # cells from another segment over most of the length: the same edge


@dataclass(frozen=True, eq=False)
class Segments:
    """N straight edges, flat, directed so that the lighter side is on the left seen along the edge, v down.

    Attributes:
        frame: (N,) int64. ends: (N, 2, 2) float64, start and end, px. log10_nfa: (N,) float64.
        chain: (N,) int64, number of the polygon that the edge is a side of, -1 for none; place: (N,) int64, its
            position along the polygon.
        chain_log10_nfa: (N,) float64, log10 of the number of false alarms of that polygon, NaN for none.
    """

    frame: Tensor
    ends: Tensor
    log10_nfa: Tensor
    chain: Tensor
    place: Tensor
    chain_log10_nfa: Tensor

    def __len__(self) -> int:
        return self.frame.shape[0]

    def __getitem__(self, index: Tensor) -> Segments:
        return Segments(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def find_segments(grad: Gradient, cells: Tensor) -> Segments:
    """Validated straight edges among flat strong cells (P,) int64, chained to polygons where they meet; reduced px.

    Edges are regions whose directions fall into one sector of the circle, for two divisions of the circle, half a
    sector apart, so that none is lost on a border.
    """
    found = [_straight(grad, level_line_regions(grad, cells, _MIN_CELLS, _SECTORS, phase)) for phase in (0.0, 0.5)]
    frame, ends, n, k = (torch.cat(pair) for pair in zip(*found, strict=True))
    _, height, width = grad.shape
    pixels = math.log10(max(2, height * width))
    nfa = math.log10(2) + 2.5 * pixels + _log10_tail(n, k)
    keep = (nfa < 0).nonzero()[:, 0]
    keep = keep[torch.argsort(nfa[keep], stable=True)]
    keep = keep[torch.argsort(frame[keep], stable=True)]
    keep = keep[~_repeated(frame[keep], ends[keep])]
    frame, ends, n, k, nfa = frame[keep], ends[keep], n[keep], k[keep], nfa[keep]

    chain, place = _chains(frame, ends)
    count = int(chain.max()) + 1 if chain.numel() else 0
    member = chain >= 0
    sums = segment_sum(torch.stack([torch.ones_like(n), n, k], -1)[member], chain[member], count)
    d, n_all, k_all = sums.unbind(-1)
    # 2^(d + 1) (h w)^(d + 3/2) tests of polygons with d sides (Patraucean et al.)
    chain_nfa = (d + 1) * math.log10(2) + (d + 1.5) * pixels + _log10_tail(n_all, k_all)
    least = torch.full((count,), torch.inf, dtype=nfa.dtype, device=nfa.device)
    least.scatter_reduce_(0, chain[member], nfa[member], "amin")
    wins = torch.cat([chain_nfa < least, torch.zeros(1, dtype=torch.bool, device=nfa.device)])
    value = torch.cat([chain_nfa, chain_nfa.new_full((1,), torch.nan)])
    chain = torch.where(wins[chain], chain, -1)
    return Segments(frame, ends, nfa, chain, torch.where(chain >= 0, place, 0), value[chain])


def _log10_tail(n: Tensor, k: Tensor) -> Tensor:
    """log10 of k^n / n!, the bound of the probability that n uniform errors sum to less than k."""
    return n * k.clamp_min(1e-12).log10() - torch.lgamma(n + 1) / math.log(10)


def _straight(grad: Gradient, regions: Regions) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines of straight regions: frame (N,), ends (N, 2, 2), number of samples (N,) and sum of their errors (N,)."""
    _, height, width = grad.shape
    inside = regions.cell % (height * width)
    xy = torch.stack([inside % width, inside // width], -1).double() + 0.5
    index, count = regions.region, regions.frame.numel()
    weight = torch.linalg.vector_norm(regions.gradient, dim=-1).double()
    middle = segment_mean(xy, index, count, weight)
    d = xy - middle[index]
    xx, xyp, yy = segment_mean(torch.stack([d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2], -1), index, count, weight).T
    angle = 0.5 * torch.atan2(2 * xyp, xx - yy)
    across = 0.5 * (xx + yy) - torch.hypot(0.5 * (xx - yy), xyp)
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    normal = torch.stack([direction[:, 1], -direction[:, 0]], -1)
    side = segment_sum((regions.gradient.double() * normal[index]).sum(-1), index, count)
    direction = torch.where(side[:, None] < 0, -direction, direction)
    along = (d * direction[index]).sum(-1)
    low = torch.zeros(count, dtype=along.dtype, device=along.device).scatter_reduce(0, index, along, "amin")
    high = torch.zeros_like(low).scatter_reduce(0, index, along, "amax")
    good = ((across.clamp_min(0).sqrt() < _STRAIGHT) & (high - low > 3)).nonzero()[:, 0]
    direction, frame, middle, low, high = direction[good], regions.frame[good], middle[good], low[good], high[good]
    ends = middle[:, None] + torch.stack([low, high], -1)[..., None] * direction[:, None]

    which, position = ragged_arange((high - low).ceil().long())
    at = ends[which, 0] + (position[:, None] + 0.5) * direction[which]
    cell, on_frame = cells_at(grad, frame[which], at)
    g = grad.at(cell).double()
    normal = torch.stack([direction[:, 1], -direction[:, 0]], -1)[which]
    cos = (g * normal).sum(-1) / torch.linalg.vector_norm(g, dim=-1).clamp_min(1e-6)
    error = torch.where(on_frame, cos.clamp(-1, 1).acos() / torch.pi, 0.5)
    n, k = segment_sum(torch.stack([torch.ones_like(error), error], -1), which, good.numel()).unbind(-1)
    return frame, ends, n, k


def _repeated(frame: Tensor, ends: Tensor) -> Tensor:
    """Segments (N,) bool that lie along an earlier one of their frame, which has fewer false alarms."""
    i, j = pairs_in_group(frame, frame)
    earlier = j < i
    i, j = i[earlier], j[earlier]
    axis = ends[j, 1] - ends[j, 0]
    length = torch.linalg.vector_norm(axis, dim=-1)
    axis = axis / length[:, None]
    local = ends[i] - ends[j, :1]
    along, across = (
        (local * axis[:, None]).sum(-1),
        (local[..., 0] * axis[:, None, 1] - local[..., 1] * axis[:, None, 0]),
    )
    inside = torch.minimum(along.amax(-1), length) - along.amin(-1).clamp_min(0)
    same = (
        (across.abs() < _OVERLAP).all(-1) & (inside > 0.5 * (along[:, 1] - along[:, 0])) & (along[:, 1] > along[:, 0])
    )
    out = torch.zeros_like(frame, dtype=torch.bool)
    out[i[same]] = True
    return out


def _chains(frame: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Polygon (N,) int64 of each segment, -1 for none, and its place along it, by mutually nearest ends."""
    count = frame.numel()
    i, j = pairs_in_group(frame, frame)
    gap = torch.linalg.vector_norm(ends[j, 0] - ends[i, 1], dim=-1)
    meets = ((gap < _JOIN) & (i != j)).nonzero()[:, 0]
    i, j, gap = i[meets], j[meets], gap[meets]
    far = torch.full((count,), torch.inf, dtype=gap.dtype, device=gap.device)
    after, before = far.scatter_reduce(0, i, gap, "amin"), far.scatter_reduce(0, j, gap, "amin")
    mutual = (gap == after[i]) & (gap == before[j])
    i, j = i[mutual], j[mutual]
    label = connected_components(i, j, count)
    size = torch.bincount(label, minlength=count)
    number = (size > 1).cumsum(0) - 1
    chain = torch.where(size[label] > 1, number[label], -1)
    # list ranking: steps back to the head; a closed polygon is opened at its first segment
    previous = torch.arange(count, device=frame.device)
    opened = label[j] != j
    headless = torch.ones(count, dtype=torch.bool, device=frame.device)
    has_head = torch.ones(count, dtype=torch.bool, device=frame.device)
    has_head[j] = False
    headless[label[has_head]] = False
    link = opened | ~headless[label[j]]
    previous[j[link]] = i[link]
    place = (previous != torch.arange(count, device=frame.device)).long()
    for _ in range(max(1, count).bit_length()):
        place = place + place[previous]
        previous = previous[previous]
    return chain, place
