"""What became of the ellipses that were looked at: false alarms, duplicates, and edges that others explain better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

import torch
from torch import Tensor

from torchpose.detect.arcs import cells_at, perimeter_samples
from torchpose.detect.regions import Gradient
from torchpose.geometry import conics
from torchpose.geometry.segments import ragged_arange, segment_sum

WHOLE = 0.9  # cover from which on an ellipse is seen whole
SAME = 0.08  # of the semi-minor axis, plus a pixel: ellipses nearer than that are one
LEAST_COVER = 0.58  # a circle in a square is covered by 0.5
_COVER_ERROR = 0.125  # 22.5 degrees in units of pi: a sample with a smaller error belongs to the arc


class Verdict(IntEnum):
    """What became of an ellipse that was looked at."""

    ACCEPTED = 0
    TOO_SMALL = 1  # semi-minor axis below 2 reduced px
    TOO_FLAT = 2  # axes' ratio below 0.12
    TOO_LARGE = 3  # wider than the frame
    OFF_ELLIPSE = 4  # most of the region is not on its ellipse
    FALSE_ALARM = 5  # noise would give as much
    DUPLICATE = 6  # the same ellipse was found better
    FRAGMENT = 7  # too little of its perimeter is there
    POLYGON = 8  # straight sides explain it better
    EXPLAINED = 9  # it is put together from edges of better ellipses


@dataclass(frozen=True, eq=False)
class Candidates:
    """Ellipses found in B frames, flat, in full-frame pixels (pixel centre at integer coordinates).

    Attributes:
        frame: (M,) int64. ellipse: (M, 5) float64, cx, cy, a, b, theta.
        polarity: (M,) float64, +1 where the inside is darker than the outside, -1 where lighter.
        log10_nfa: (M,) float64, log10 of the number of false alarms, negative for each candidate.
        cover: (M,) float64, fraction of the perimeter with the gradient of the ellipse.
        verdict: (M,) int64, `Verdict`.
    """

    frame: Tensor
    ellipse: Tensor
    polarity: Tensor
    log10_nfa: Tensor
    cover: Tensor
    verdict: Tensor

    def __len__(self) -> int:
        return self.frame.shape[0]

    def __getitem__(self, index: Tensor) -> Candidates:
        return Candidates(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def replaced(self, index: Tensor, other: Candidates) -> Candidates:
        """These candidates, with the rows ``index`` taken from ``other``."""
        names = self.__dataclass_fields__
        return Candidates(*(getattr(self, name).index_copy(0, index, getattr(other, name)) for name in names))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The candidates of all parts."""
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


def accepted(found: Candidates) -> Candidates:
    """Those that were accepted."""
    return found[found.verdict == Verdict.ACCEPTED]


@dataclass(frozen=True, eq=False)
class Samples:
    """What lies along the perimeters of M ellipses, one sample a pixel.

    Attributes:
        of: (S,) int64, the ellipse. xy: (S, 2) float64, cells. gradient: (S, 2) float64, in the cell there.
        error: (S,) float64 in [0, 1], angle between gradient and normal, divided by pi; 0.5 beyond the frame.
    """

    of: Tensor
    xy: Tensor
    gradient: Tensor
    error: Tensor


def sample_edges(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Samples:
    """Samples of ellipses (M, 5), cells, of frames (M,) int64 and polarities (M,) +1 or -1."""
    which, xy, normal, _ = perimeter_samples(ellipses)
    cell, on_frame = cells_at(grad, frame.index_select(0, which), xy)
    gx, gy = (g.double() for g in grad.components(cell))
    nx, ny = normal.unbind(-1)
    length = (gx * gx + gy * gy).sqrt().clamp_min(1e-6)
    cos = (gx * nx + gy * ny) * polarity.index_select(0, which) / length
    error = torch.where(on_frame, cos.clamp(-1, 1).acos() / torch.pi, 0.5)  # 0.5: neither for nor against
    return Samples(which, xy, torch.stack([gx, gy]).mT, error)


def score(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Candidates:
    """Ellipses with their numbers of false alarms, of which noise gives less than one a frame below 1."""
    samples = sample_edges(grad, frame, ellipses, polarity)
    log10_nfa, cover = false_alarms(grad, samples.error, samples.of, ellipses.shape[0])
    verdict = torch.where(log10_nfa < 0, int(Verdict.ACCEPTED), int(Verdict.FALSE_ALARM))
    verdict = torch.where((log10_nfa < 0) & (cover < LEAST_COVER), int(Verdict.FRAGMENT), verdict)
    return Candidates(frame, ellipses, polarity, log10_nfa, cover, verdict)


def false_alarms(grad: Gradient, error: Tensor, of: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """log10 of the number of false alarms (count,) of samples with errors (S,), and the share that is on the arc.

    Under the null hypothesis the angle error of a sample, divided by pi, is uniform in [0, 1], and the sum k of n of
    them is below its value with probability at most k^n / n!. The number of tests is the number of distinguishable
    ellipses, (h w)^(5/2): five parameters, each with as many values as the frame has pixels on a side.
    """
    _, height, width = grad.shape
    size = torch.bincount(of, minlength=count).double()
    k, on_arc = segment_sum(error, of, count), segment_sum((error < _COVER_ERROR).double(), of, count)
    log_tests = 2.5 * math.log10(max(1, height * width))
    log10_nfa = log_tests + size * k.clamp_min(1e-12).log10() - torch.lgamma(size + 1) / math.log(10)
    return log10_nfa, on_arc / size.clamp_min(1)


def merge_duplicates(found: Candidates, tolerance: float = SAME, *, explain: bool = False) -> Candidates:
    """Of candidates that are the same ellipse the one with the fewest false alarms, sorted by frame and false alarms.

    Two are the same if neither centre nor shape differ by more than a pixel plus ``tolerance`` of the semi-minor axis.

    Args:
        explain: mark the others as `Verdict.DUPLICATE` instead of leaving them out; what was rejected before stays as
            it is and never counts as better.
    """
    order = torch.argsort(found.log10_nfa, stable=True)  # NaN, of those rejected without a score, comes last
    found = found[order[torch.argsort(found.frame[order], stable=True)]]
    frames = int(found.frame[-1]) + 1 if len(found) else 0
    per_frame = torch.bincount(found.frame, minlength=frames)
    start = (per_frame.cumsum(0) - per_frame)[found.frame]
    position = torch.arange(len(found), device=start.device) - start
    # each against those before it in its frame, which have fewer false alarms
    later, rank = ragged_arange(position)
    better = start[later] + rank
    p, q = found.ellipse[later], found.ellipse[better]
    shape = (conics.shape_matrix(p) - conics.shape_matrix(q)).flatten(1).abs().amax(-1)
    apart = torch.maximum(torch.linalg.vector_norm(p[:, :2] - q[:, :2], dim=-1), shape)
    same = (found.polarity[later] == found.polarity[better]) & (apart < 1.0 + tolerance * q[:, 3])
    if explain:
        same &= (found.verdict[later] == Verdict.ACCEPTED) & (found.verdict[better] == Verdict.ACCEPTED)
    again = torch.zeros(len(found), dtype=torch.bool, device=start.device)
    again[later[same]] = True
    if not explain:
        return found[~again]
    return replace(found, verdict=torch.where(again, int(Verdict.DUPLICATE), found.verdict))
