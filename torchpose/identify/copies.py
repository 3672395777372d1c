"""Copies of a target: poses that share the rings of a frame out among them, each ring to one copy."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.segments import marked, pairs_in_group, segment_sum

MIN_MARKERS = 3  # seen, that a pose needs (derived: six unknowns)
_EQUAL = 1e-6  # difference of scores that rounding may make (convention)


class Claims(NamedTuple):
    """Rings that poses take for markers, flat: pose (E,), ring (E,), another number for every target, marker (E,)."""

    pose: Tensor
    ring: Tensor
    marker: Tensor

    def where(self, kept: Tensor) -> "Claims":
        """Those of a mask."""
        return Claims(*(value[kept] for value in self))


def rank(row: Tensor, score: Tensor, rows: int) -> Tensor:
    """Place (H,) of each pose from the highest score on; of those that equal the best of their row the first leads."""
    best = torch.full((rows,), -torch.inf, dtype=score.dtype, device=score.device)
    best = best.scatter_reduce_(0, row, score, "amax")[row]
    order = torch.argsort(torch.where(score > best - _EQUAL, best, score), descending=True, stable=True)
    return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))


class Rivals(NamedTuple):
    """H poses of targets that claim rings.

    Attributes:
        row: (H,) frame and target of each.
        score: (H,) number of markers it explains, less a fraction for what they miss by.
        explained: (H,) number of markers of that.
        place: (H,) `rank` of the score.
        gain: (H,) mm, likeliest edge gain of the plate.
        claims: the rings that the poses explain.
        near: the rings near enough to a predicted place to be that marker of the same copy.
        size: number of rows, of rings as they are numbered, and of markers.
    """

    row: Tensor
    score: Tensor
    explained: Tensor
    place: Tensor
    gain: Tensor
    claims: Claims
    near: Claims
    size: tuple[int, int, int]

    def excluded(self, copies: Tensor) -> Tensor:
        """The poses (H,) that share a ring with a copy or are that copy once more, the copies themselves included."""
        _, rings, markers = self.size
        taken = self.claims.where(copies[self.claims.pose])
        shared = self.claims.pose[marked(taken.ring, rings)[self.claims.ring]]
        as_marker = marked(taken.ring * markers + taken.marker, rings * markers)
        same = self.near.pose[as_marker[self.near.ring * markers + self.near.marker]]
        return marked(torch.cat([shared, same]), len(self.row))


def share_out(rivals: Rivals) -> Tensor:
    """The poses (H,) bool that are copies: with three rings or more that no other copy has.

    In every round each ring backs the best pose that claims it, and the poses that all their rings back are copies.
    They take their rings away, and the poses that would put a marker where a copy has it are that copy once more. A
    round serves all frames and every neighbourhood of a frame at once.

    In a regular tray, rings of four neighbours can have the very layout of one copy. Each of their rings is disputed
    then, by the copy that it is of, and so are those of the copies inside the tray; but those at its edge have rings
    that nobody else claims. So disputed claims count less, and a pose of nothing else waits while its frame has others:
    the tray is cleared from its edge.
    """
    row, score, count, _, _, claims, _, (rows, rings, markers) = rivals
    open_ones = _different_ones(rivals)
    claims = claims.where(open_ones[claims.pose])
    claim, by = _disputes(claims, len(row))
    copies = torch.zeros_like(open_ones)
    while bool(open_ones.any()):
        disputed = torch.bincount(claims.pose[marked(claim[open_ones[by]], len(claims.pose))], minlength=len(row))
        clear = open_ones & (disputed < count)
        ready = clear | (open_ones & ~marked(row[clear], rows)[row])
        place = rank(row, torch.where(ready, score - disputed / (2 * markers), -torch.inf), rows)
        some = claims.where(ready[claims.pose])
        best = torch.full((rings,), len(row), device=row.device).scatter_reduce_(0, some.ring, place[some.pose], "amin")
        copies |= ready & ~marked(some.pose[place[some.pose] > best[some.ring]], len(row))
        open_ones = open_ones & ~rivals.excluded(copies)
    return copies


def _different_ones(rivals: Rivals) -> Tensor:
    """The poses (H,) bool that may be copies, of those that claim the same rings the best."""
    able = (rivals.explained >= MIN_MARKERS).nonzero()[:, 0]
    claims = rivals.claims
    kind = segment_sum(_scrambled(claims.ring * rivals.size[2] + claims.marker), claims.pose, len(rivals.row))
    which, group = kind[able].unique(return_inverse=True)
    place = rivals.place[able]
    best = torch.full_like(which, len(rivals.row)).scatter_reduce_(0, group, place, "amin")
    return marked(able[place == best[group]], len(rivals.row))


def _disputes(claims: Claims, poses: int) -> tuple[Tensor, Tensor]:
    """Which claims (D,) are disputed by which poses (D,): those that share the one ring alone.

    Two rings fix a pose: who shares more than one is the same copy, give or take a ring.
    """
    ring, order = claims.ring.sort()
    one, two = (order[index] for index in pairs_in_group(ring, ring))
    _, pair, shared = (claims.pose[one] * poses + claims.pose[two]).unique(return_inverse=True, return_counts=True)
    single = (shared[pair] == 1).nonzero()[:, 0]
    return one[single], claims.pose[two[single]]


def _scrambled(number: Tensor) -> Tensor:
    """Integers (E,) as good as random, whose sum tells sets of numbers apart (splitmix64, Steele et al. 2014)."""
    z = number * -7046029254386353131
    z = (z ^ (z >> 30)) * -4658895280553007687
    z = (z ^ (z >> 27)) * -7723592293110705685
    return z ^ (z >> 31)
