"""Stage: which ring is which marker. The ring-area code proposes, the geometry of the target decides.

Noise, a neighbour's reflection or a stray washer can give a ring the code of another marker. So the code only narrows
the choice: pairs of rings give full poses of the target (each ring's ellipse tilts the plane, the other ring turns it),
and the poses under which most markers have a ring of the right place, size and code share out the rings: one copy of
the target each. All pairs of all frames are tried in one flat batch.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import marked, pairs_in_group, segment_sum
from torchpose.identify.assignments import Assignments, Codes, propose, ratio_tolerance
from torchpose.identify.copies import MIN_MARKERS, Claims, Rivals, rank, share_out
from torchpose.identify.hypotheses import Hypotheses, hypotheses
from torchpose.identify.scene import MOST_GAIN, MarkerTable
from torchpose.rings import Rings

# of the tolerances, mean over the markers: a false code of rings of 13 px misses by 0.2 more (derived), a right one by
# less than 0.1 (the frames of `corruption_statistics.py --only over-exposure`)
_AS_WELL = 0.1

__all__ = ["Identified", "identify", "ratio_tolerance"]


@dataclass(frozen=True, eq=False)
class Identified(Rows):
    """Rings of N rows by marker: a row for every frame and target, and one for each further copy found of it.

    Rows are sorted by frame, target and support.

    Attributes:
        group: frame and target of each row, frame times T plus target.
        ring: index into the rings, -1 where the marker was not found.
        R: the rough pose that the rings were assigned under; NaN without one.
        t: the same, mm.
        copies: how many copies the rings of the row's frame show, each by three markers or more.
        gain: mm, the edge gain of the plate as the codes tell it and the target's file allows; 0 where nothing tells.
        turnable: whether the marks of a board may be those of the board turned as well.
        proposal: group, marker and ring of every ring with the code of a marker, whether or not it fits.
    """

    group: Int[Tensor, " N"]
    ring: Int[Tensor, "N M"]
    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    copies: Int[Tensor, " N"]
    gain: Float[Tensor, " N"]
    turnable: Bool[Tensor, " N"]
    proposal: Int[Tensor, "A 3"] = shared()

    def proposed(self, unclaimed: Bool[Tensor, " K"]) -> Tensor:
        """Number (N,) of different markers whose code was read from rings that are ``unclaimed``."""
        group, marker, ring = self.proposal.unbind(-1)
        free = unclaimed[ring]
        count = int(self.group.max()) + 1 if len(self) else 0
        return _different(group[free], marker[free], (count, self.ring.shape[1]))[self.group]


@checked
def identify(rings: Rings, table: MarkerTable, camera: Camera, frames: int, instances: int | None = None) -> Identified:
    """Assigns rings to the markers of every target in every frame; two rings at least, three for further copies.

    Args:
        rings: K rings, in ideal pixels.
        table: the targets.
        camera: for its matrix.
        frames: number of frames.
        instances: most copies of a target in a frame, the best-supported ones; None for all.
    """
    rows, device = frames * len(table), rings.frame.device
    one = propose(rings, table, camera.matrix)
    proposal = torch.stack([one.row, one.marker, one.ring], -1)
    if len(one) == 0:
        return _nothing(rows, table.ids.shape[1], proposal)
    tried, rivals = _tried(one, table, camera.matrix, (rows, len(rings) * len(table), table.ids.shape[1]))
    row, place, claims = rivals.row, rivals.place, rivals.claims
    copies = share_out(rivals)
    found = torch.bincount(row[copies], minlength=rows)

    # of each row the best copies, or the best pose where there is none, or no pose
    best = torch.full((rows,), len(row), device=device).scatter_reduce_(0, row, place, "amin")
    kept = (copies | ((found == 0)[row] & (place == best[row]))).nonzero()[:, 0]
    kept = kept[torch.argsort(row[kept] * len(row) + place[kept])]
    if instances is not None:
        number = torch.arange(len(kept), device=device) - torch.searchsorted(row[kept], row[kept])
        kept = kept[number < instances]
    if len(one.number.unique()) < len(one):  # rings with several codes
        kept = kept[~_contested(rivals, kept)]
    group, at = row[kept], torch.arange(len(kept), device=device)
    without = (~marked(group, rows)).nonzero()[:, 0]
    if without.numel():
        group, order = torch.cat([group, without]).sort(stable=True)
        at = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=device))[: len(kept)]
    result = _empty(group, table.ids.shape[1], found[group], proposal)
    result.R[at], result.t[at] = tried.R[kept], tried.t[kept]
    to = torch.full_like(row, -1).index_copy_(0, kept, at)[claims.pose]
    chosen = (to >= 0).nonzero()[:, 0]
    result.ring[to[chosen], claims.marker[chosen]] = claims.ring[chosen] % len(rings)
    result.gain[at] = rivals.gain[kept]
    if without.numel():
        # no pair, no pose: the code is all there is, where it is not clipped
        plain = ~one.clipped & (one.codes_of().under(torch.zeros_like(one.likely)) < 1)
        alone = (marked(without, rows)[one.row] & plain).nonzero()[:, 0]
        result.ring[torch.searchsorted(group, one.row[alone]), one.marker[alone]] = one.ring[alone]
    return result


def likely_gain(codes: Codes, told: Tensor, pose: Tensor, scale: Tensor) -> Tensor:
    """The likeliest edge gain (H,) under every pose, mm, by the codes of its rings.

    Args:
        codes: (S,), of rings taken for markers.
        told: (S,) bool, which of them count.
        pose: (S,), of each.
        scale: (H,) mm, standard deviation of the gain.
    """
    weight = either(told, (MOST_GAIN * codes.per_unit).square(), 0.0)
    known, sums = (segment_sum(value, pose, len(scale)) for value in (weight, weight * codes.moved))
    return sums / (known + scale.pow(-2))


def _contested(rivals: Rivals, kept: Tensor) -> Tensor:
    """Poses ``kept`` (P,) bool that another one explains as well by other codes of the same rings.

    Codes read up to a displacement let a small target turn, by a code and a corner. What it costs is that the rings'
    size, moved with their edges, no longer suits their distances.
    """
    claims = rivals.claims
    number = torch.full_like(rivals.row, -1).index_copy_(0, kept, torch.arange(len(kept), device=kept.device))
    own = claims.where(number[claims.pose] >= 0)
    ring, order = claims.ring.sort()
    i, j = pairs_in_group(own.ring, ring)
    j = order[j]
    one, two = own.pose[i], claims.pose[j]
    worse = (rivals.score[one] - rivals.score[two]) * (2 * rivals.size[2]) / rivals.explained[one]
    other = (claims.marker[j] != own.marker[i]) & (rivals.explained[two] >= rivals.explained[one]) & (worse < _AS_WELL)
    return marked(number[one[other]], len(kept))


def _tried(
    one: Assignments, table: MarkerTable, matrix: Tensor, size: tuple[int, int, int]
) -> tuple[Hypotheses, Rivals]:
    """Poses of targets seen from their printed side; from behind too where these explain too few rings."""
    tried = hypotheses(one, table, matrix, 1.0)
    rivals = _weighed(tried, one, table, size)
    lacking = ~marked(rivals.row[rivals.explained >= MIN_MARKERS], size[0])[one.row]
    if not bool(lacking.any()):
        return tried, rivals
    read = _different(one.row, one.marker, (size[0], size[2]))
    behind = (lacking & (read >= MIN_MARKERS)[one.row]).nonzero()[:, 0]
    if behind.numel() == 0:
        return tried, rivals
    tried = tried.and_of(hypotheses(one[behind], table, matrix, -1.0), behind)
    return tried, _weighed(tried, one, table, size)


def _different(row: Tensor, marker: Tensor, size: tuple[int, int]) -> Tensor:
    """How many different markers each row has, of rows (E,) and markers (E,)."""
    return marked(row * size[1] + marker, size[0] * size[1]).view(size).sum(-1)


def _weighed(tried: Hypotheses, one: Assignments, table: MarkerTable, size: tuple[int, int, int]) -> Rivals:
    """The poses with the nearest ring of each of their markers; ``size`` as in `Rivals`."""
    member, pose, markers = tried.member, tried.pose, size[2]
    every = Claims(pose, one.number[member], one.marker[member])
    # the code has its say, too: markers of neighbouring codes must not change places
    # and gain or clipping move the edges of all rings as far as those of the one that the pose comes from
    codes = one.codes_of(member)
    off = codes.under(one.common(tried.origin[pose], member))
    cost = either((tried.miss < 1) & (off < 1), 0.5 * (tried.miss + off), torch.inf)
    slot = pose * markers + every.marker
    per_marker = torch.full((len(tried.R) * markers,), torch.inf, dtype=cost.dtype, device=cost.device)
    per_marker.scatter_reduce_(0, slot, cost, "amin")
    chosen = (cost == per_marker[slot]) & cost.isfinite()
    gain = likely_gain(codes, chosen & ~one.clipped[member], pose, table.gain_scale[one.target[tried.origin]])
    per_marker = per_marker.view(-1, markers)
    found = per_marker.isfinite()
    count = found.sum(-1)
    score = count - either(found, per_marker, 0.0).sum(-1) / (2 * markers)
    row = one.row[tried.origin]
    return Rivals(row, score, count, rank(row, score, size[0]), gain, every.where(chosen), every, size)


def _empty(group: Tensor, markers: int, copies: Tensor, proposal: Tensor) -> Identified:
    """Rows without a ring."""
    count, nowhere = len(group), torch.tensor(torch.nan, dtype=torch.float64, device=group.device)
    return Identified(
        group,
        torch.full((count, markers), -1, device=group.device),
        nowhere.repeat(count, 3, 3),
        nowhere.repeat(count, 3),
        copies,
        torch.zeros(count, dtype=torch.float64, device=group.device),
        torch.zeros(count, dtype=torch.bool, device=group.device),
        proposal,
    )


def _nothing(rows: int, markers: int, proposal: Tensor) -> Identified:
    """Of frames in which no ring has the code of a marker."""
    group = torch.arange(rows, device=proposal.device)
    return _empty(group, markers, torch.zeros_like(group), proposal)
