"""What became of the ellipses that were looked at: false alarms, duplicates, and edges that others explain better.

An edge is explained once, after the exclusion principle of a-contrario detection (Desolneux, Moisan and Morel 2008):
what is seen belongs to its best interpretation, the one with the fewest false alarms, and the others are judged by what
is left. Two circles side by side have arcs that a third ellipse joins, too long to be an accident, and yet it is none.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.arcs import cells_at, perimeter_samples
from torchpose.detect.regions import AGREE_COS, ON_EDGE, Gradient
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either
from torchpose.geometry.rows import Rows, replace
from torchpose.geometry.sectors import MOST
from torchpose.geometry.segments import marked, members, near_pairs, positions, segment_sum

WHOLE = 0.9  # cover from which on an ellipse is seen whole: a tenth may be lost to noise (convention)
# of the semi-minor axis, plus a pixel: ellipses nearer than that are one (convention; with 0.1 the same rings are
# found)
SAME = 0.08
_ROUNDS = 4
# 22.5 degrees in units of pi: a sample with a smaller error is on the arc, in noise one of eight (convention)
_COVER_ERROR = 0.125

_GLANCE = 48  # samples of an ellipse: of half a perimeter they tell to a fifteenth (convention)


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
    UNWANTED = 10  # seen in part, and not what was asked for


@dataclass(frozen=True, eq=False)
class Candidates(Rows):
    """Ellipses found in a batch of frames, in full-frame pixels (pixel centre at integer coordinates).

    Attributes:
        ellipse: cx, cy, a, b, theta.
        polarity: +1 where the inside is darker than the outside, -1 where lighter.
        log10_nfa: log10 of the number of false alarms, negative for each accepted candidate.
        cover: fraction of the perimeter with the gradient of the ellipse.
        verdict: `Verdict`.
    """

    frame: Int[Tensor, " M"]
    ellipse: Float[Tensor, "M 5"]
    polarity: Float[Tensor, " M"]
    log10_nfa: Float[Tensor, " M"]
    cover: Float[Tensor, " M"]
    verdict: Int[Tensor, " M"]

    @classmethod
    def unscored(cls, frame: Tensor, ellipse: Tensor, polarity: Tensor, verdict: Tensor | int = 0) -> "Candidates":
        """Ellipses whose false alarms nobody has counted; accepted, unless another verdict is given."""
        unknown = torch.full_like(ellipse[:, 0], torch.nan)
        return cls(frame, ellipse, polarity, unknown, unknown, torch.zeros_like(frame) + verdict)


@dataclass(frozen=True, eq=False)
class Wanted:
    """What is asked for: by default every ellipse. The rest costs little, and need not be found.

    Attributes:
        polarity: +1 dark inside, -1 light inside, 0 either.
        semi_minor: px, the least.
        concentric: outer circles of rings only.
    """

    polarity: float = 0.0
    semi_minor: float = 0.0
    concentric: bool = False

    @classmethod
    def of(cls, polarities: Float[Tensor, " T"], semi_minor: float) -> "Wanted":
        """Rings of any of these polarities, of at least such a semi-minor axis, px."""
        each = polarities.unique()
        return cls(float(each) if each.numel() == 1 else 0.0, semi_minor, concentric=True)

    def reduced(self, factor: int) -> "Wanted":
        """The same in a frame reduced by a factor."""
        return replace(self, semi_minor=self.semi_minor / factor)

    def admits(self, found: Candidates) -> Bool[Tensor, " M"]:
        """Which candidates are asked for, by their ellipses alone."""
        return (found.ellipse[:, 3] >= self.semi_minor) & (found.polarity * self.polarity >= 0)


ANYTHING = Wanted()


def accepted(found: Candidates) -> Candidates:
    """Those that were accepted."""
    return found[found.verdict == Verdict.ACCEPTED]


@dataclass(frozen=True, eq=False)
class Samples(Rows):
    """What lies along curves, one sample a pixel."""

    of: Int[Tensor, " S"]  # the curve
    xy: Float[Tensor, "S 2"]  # cells
    gradient: Float[Tensor, "S 2"]  # in the cell there
    error: Float[Tensor, " S"]  # angle between gradient and normal, divided by pi; 0.5 beyond the frame


def sample_edges(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor, most: int | None = None) -> Samples:
    """Samples of ellipses (M, 5), cells, of frames (M,) int64 and polarities (M,) +1 or -1; ``most`` of each."""
    at = perimeter_samples(ellipses, most)
    return edges_at(grad, frame, at.of, at.xy, at.normal * polarity.index_select(0, at.of)[:, None])


def edges_at(grad: Gradient, frame: Tensor, of: Tensor, xy: Tensor, normal: Tensor) -> Samples:
    """Samples at positions (S, 2) of the curves ``of`` (S,) of frames (M,), where edges rise along normals (S, 2)."""
    cell, _, _, on_frame = cells_at(grad, frame.index_select(0, of), *xy.unbind(-1))
    gx, gy = (g.double() for g in grad.components(cell))
    nx, ny = normal.unbind(-1)
    cos = (gx * nx + gy * ny) / (gx * gx + gy * gy).sqrt().clamp_min(1e-6)
    error = either(on_frame, cos.clamp(-1, 1).acos() / torch.pi, 0.5)  # 0.5: neither for nor against
    return Samples(of, xy, torch.stack([gx, gy]).mT, error)


def glance(grad: Gradient, some: Candidates, least: float) -> Bool[Tensor, " M"]:
    """Whether such a cover of each ellipse is not yet ruled out by a few samples, at three of their deviations."""
    samples = sample_edges(grad, some.frame, some.ellipse, some.polarity, _GLANCE)
    _, cover = false_alarms(grad, samples.error, samples.of, len(some))
    deviation = math.sqrt(least * (1 - least) / _GLANCE)
    return cover > least - 3 * deviation


def score(grad: Gradient, frame: Tensor, ellipses: Tensor, polarity: Tensor) -> Candidates:
    """Ellipses with their numbers of false alarms, of which noise gives less than one a frame below 1."""
    samples = sample_edges(grad, frame, ellipses, polarity)
    nfa, cover = false_alarms(grad, samples.error, samples.of, ellipses.shape[0])
    verdict = either(nfa < 0, int(Verdict.ACCEPTED), int(Verdict.FALSE_ALARM))
    verdict = either((nfa < 0) & (cover < MOST), int(Verdict.FRAGMENT), verdict)
    return Candidates(frame, ellipses, polarity, nfa, cover, verdict)


def false_alarms(grad: Gradient, error: Tensor, of: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """log10 of the number of false alarms (count,) of samples with errors (S,), and the share that is on the arc.

    The number of tests is the number of distinguishable ellipses, (h w)^(5/2): five parameters, each with as many
    values as the frame has pixels on a side.
    """
    _, height, width = grad.shape
    size = torch.bincount(of, minlength=count).double()
    k, on_arc = segment_sum(error, of, count), segment_sum((error < _COVER_ERROR).double(), of, count)
    return log10_nfa(2.5 * math.log10(max(1, height * width)), size, k), on_arc / size.clamp_min(1)


def log10_nfa(log_tests: float | Tensor, size: Tensor, total: Tensor) -> Tensor:
    """log10 of the number of false alarms of so many tests, of ``size`` samples whose errors sum to ``total``.

    Under the null hypothesis the angle error of a sample, divided by pi, is uniform in [0, 1], and the sum k of n of
    them is below its value with probability at most k^n / n!.
    """
    return log_tests + size * total.clamp_min(1e-12).log10() - torch.lgamma(size + 1) / math.log(10)


@checked
def merge_duplicates(found: Candidates, tolerance: float = SAME, *, explain: bool = False) -> Candidates:
    """Of candidates that are the same ellipse the one with the fewest false alarms, sorted by frame and false alarms.

    Two are the same if neither centre nor shape differ by more than a pixel plus ``tolerance`` of the semi-minor axis.
    With ``explain`` the others are marked as `Verdict.DUPLICATE` instead of left out; what was rejected before stays as
    it is and never counts as better.
    """
    order = torch.argsort(found.log10_nfa, stable=True)  # NaN, of those rejected without a score, comes last
    found = found[order[torch.argsort(found.frame[order], stable=True)]]
    # each against those near it that come before it in its frame, which have fewer false alarms
    every = torch.arange(len(found), device=found.frame.device)
    some = positions(found.verdict == Verdict.ACCEPTED) if explain else every
    better, later = same_ellipses(found[some], found[some], tolerance)
    later = later[positions(better < later)]
    again = marked(some[later], len(found))
    if not explain:
        return found[~again]
    return replace(found, verdict=either(again, int(Verdict.DUPLICATE), found.verdict))


@checked
def same_ellipses(ones: Candidates, others: Candidates, tolerance: float = SAME) -> tuple[Tensor, Tensor]:
    """Pairs (i, j) that are the same ellipse of the same frame, to within a part of the minor axis of ``ones``."""
    reach = 1.0 + tolerance * ones.ellipse[:, 3]
    i, j = near_pairs(ones.ellipse[:, :2], others.ellipse[:, :2], reach, (ones.frame, others.frame))
    alike = positions(ones.polarity[i] == others.polarity[j])
    i, j = i[alike], j[alike]
    p, q = ones.ellipse[i], others.ellipse[j]
    one, other = conics.shape_matrix(torch.stack([p, q]))
    shape = (one - other).flatten(1).abs().amax(-1)
    apart = torch.maximum(torch.linalg.vector_norm(p[:, :2] - q[:, :2], dim=-1), shape)
    same = positions(apart < reach[i])
    return i[same], j[same]


def without_known(found: Candidates, known: Candidates) -> Candidates:
    """The same candidates; those accepted that are among ``known``, with fewer false alarms there, are duplicates."""
    i, j = same_ellipses(known, found)
    again = marked(j[known.log10_nfa[i] < found.log10_nfa[j]], len(found)) & (found.verdict == Verdict.ACCEPTED)
    return replace(found, verdict=either(again, int(Verdict.DUPLICATE), found.verdict))


def explain_once(grad: Gradient, found: Candidates, known: Candidates | None = None) -> Candidates:
    """The same candidates; those of which too little remains without the edges of better ones become `EXPLAINED`.

    Ellipses that are seen whole stay as they are. All are in cells; ``known`` are accepted ellipses of a finer scale.
    """
    part = positions((found.verdict == Verdict.ACCEPTED) & (found.cover <= WHOLE))
    if part.numel() == 0:
        return found
    weak, every = found[part], found if known is None else Candidates.cat([found, known])
    samples = sample_edges(grad, weak.frame, weak.ellipse, weak.polarity)
    sample, other = _explained(samples, weak, every)
    # who explains must be kept itself: the rounds close in, from below and above, on the choice made one by one in the
    # order of false alarms
    kept = torch.ones(len(every), dtype=torch.bool, device=part.device)
    for _ in range(_ROUNDS):
        free = ~marked(sample[kept[other]], len(samples))
        nfa, cover = false_alarms(grad, samples.error[free], samples.of[free], part.numel())
        kept[part] = (nfa < 0) & (cover >= MOST)
    return replace(found, verdict=either(kept[: len(found)], found.verdict, int(Verdict.EXPLAINED)))


def _overlapping(some: Candidates, others: Candidates) -> tuple[Tensor, Tensor]:
    """Pairs (i, j) of the same frame whose circumscribed circles overlap, or nearly: a few others are among them."""
    a, b = some.ellipse[:, 2] + ON_EDGE, others.ellipse[:, 2] + ON_EDGE
    frames = some.frame, others.frame
    # the centres are nearer than twice the larger of both
    i, j = near_pairs(some.ellipse[:, :2], others.ellipse[:, :2], 2 * a, frames)
    larger = positions(a[i] >= b[j])
    q, p = near_pairs(others.ellipse[:, :2], some.ellipse[:, :2], 2 * b, frames[::-1])
    smaller = positions(a[p] < b[q])
    return torch.cat([i[larger], p[smaller]]), torch.cat([j[larger], q[smaller]])


def _explained(samples: Samples, weak: Candidates, every: Candidates) -> tuple[Tensor, Tensor]:
    """Which of the samples of ``weak`` (Q,) lie on the edges of which better ones of ``every`` (Q,)."""
    best = positions(every.verdict == Verdict.ACCEPTED)
    i, j = _overlapping(weak, every[best])
    j = best[j]
    apart = torch.linalg.vector_norm(weak.ellipse[i, :2] - every.ellipse[j, :2], dim=-1)
    meet = (every.log10_nfa[j] < weak.log10_nfa[i]) & (apart < weak.ellipse[i, 2] + every.ellipse[j, 2] + ON_EDGE)
    i, j = i[meet], j[meet]
    pair, sample = members(torch.bincount(samples.of, minlength=len(weak)), i)
    other = j[pair]
    conic = conics.conic_from_ellipse(every.ellipse[other]).unbind(-1)
    off, nx, ny = conics.signed_distance(conic, *samples.xy[sample].unbind(-1))
    gradient = samples.gradient[sample]
    rise = (gradient[:, 0] * nx + gradient[:, 1] * ny) * every.polarity[other]
    on = (off.abs() < ON_EDGE) & (rise > AGREE_COS * torch.linalg.vector_norm(gradient, dim=-1))
    return sample[on], other[on]
