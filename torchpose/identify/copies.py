"""Copies of a target: poses that share the rings of a frame out among them, each ring to one copy."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.segments import marked, segment_sum

MIN_MARKERS = 3  # seen, that a pose needs
_EQUAL = 1e-6  # difference of scores that rounding may make


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
        count: (H,) number of markers it explains.
        claims: the rings that the poses explain.
        near: the rings near enough to a predicted place to be that marker of the same copy.
        size: number of rows, of rings as they are numbered, and of markers.
    """

    row: Tensor
    score: Tensor
    count: Tensor
    claims: Claims
    near: Claims
    size: tuple[int, int, int]

    def holders(self, copies: Tensor) -> tuple[Tensor, Tensor]:
        """The copy, -1 for none, that has each claimed ring (E,), and that has each near one (S,) as the same marker."""
        _, rings, markers = self.size
        taken = self.claims.where(copies[self.claims.pose])
        nobody = torch.full((rings * (markers + 1),), -1, device=self.row.device)
        nobody[taken.ring] = taken.pose
        nobody[rings + taken.ring * markers + taken.marker] = taken.pose
        return nobody[self.claims.ring], nobody[rings + self.near.ring * markers + self.near.marker]

    def excluded(self, copies: Tensor) -> Tensor:
        """The poses (H,) that share a ring with a copy or are that copy once more, the copies themselves included."""
        holder, near_holder = self.holders(copies)
        some = torch.cat([self.claims.pose[holder >= 0], self.near.pose[near_holder >= 0]])
        return marked(some, len(self.row))


def share_out(rivals: Rivals) -> Tensor:
    """The poses (H,) bool that are copies: with three rings or more that no other copy has.

    First come, by rounds, those that explain most (`_by_support`). Where a copy shares single rings with several poses
    that exclude each other not, and these explain more rings together, they are copies instead of it: so of the copies
    of a tray and of what rings of four of them look like together the former stay, covered rings or not.
    """
    open_ones, pose = rivals.count >= MIN_MARKERS, rivals.claims.pose
    copies = _by_support(rivals, open_ones)
    while True:
        holder, near_holder = rivals.holders(copies)
        held = holder >= 0
        # two rings fix a pose: who shares more than one is the same copy
        shared = torch.bincount(pose[held], minlength=len(copies))
        single = open_ones & ~copies & (shared == 1)
        if not bool(single.any()):
            return copies
        of = torch.zeros_like(rivals.row).index_copy_(0, pose[held], holder[held])
        others = (near_holder >= 0) & (near_holder != of[rivals.near.pose])
        more = _by_support(rivals, single & ~marked(rivals.near.pose[others], len(copies)))
        instead = torch.zeros_like(of).index_add_(0, of[more], rivals.count[more])
        worse = copies & (instead > rivals.count)
        if not bool(worse.any()):
            return copies
        copies = (copies & ~worse) | (more & worse[of])
        copies |= _by_support(rivals, open_ones & ~rivals.excluded(copies))


def _by_support(rivals: Rivals, open_ones: Tensor) -> Tensor:
    """Of the poses that are ``open_ones`` (H,) those that win all rings that they claim.

    In every round each ring backs the best pose that claims it, and the poses that all their rings back are copies.
    They take their rings away, and the poses that would put a marker where a copy has it are that copy once more. A
    round serves all frames and every neighbourhood of a frame at once.

    In a regular tray, rings of four neighbours can have the very layout of one copy. Their rings are claimed twice, each
    by the phantom and by a copy, and so are those of the copies inside the tray; but those at its edge have rings that
    nobody else claims. So claims in dispute count less, and a pose of disputed claims only waits while its frame has
    others: the tray is cleared from its edge.
    """
    row, score, count, claims, _, (rows, rings, markers) = rivals
    kind = segment_sum(_scrambled(claims.ring * markers + claims.marker), claims.pose, len(row))
    copies = torch.zeros_like(open_ones)
    while bool(open_ones.any()):
        some = claims.where(open_ones[claims.pose])
        disputed = segment_sum(_disputed(some, count, kind, rings).long(), some.pose, len(row))
        place = rank(row, torch.where(open_ones, score - disputed / (2 * markers), -torch.inf), rows)
        best = torch.full((rings,), len(row), device=row.device).scatter_reduce_(0, some.ring, place[some.pose], "amin")
        backed = open_ones & ~marked(some.pose[place[some.pose] > best[some.ring]], len(row))
        clear = backed & (disputed < count)
        copies |= backed & (clear | ~marked(row[clear], rows)[row])
        open_ones = open_ones & ~rivals.excluded(copies)
    return copies


def _disputed(claims: Claims, count: Tensor, kind: Tensor, rings: int) -> Tensor:
    """Claims (E,) bool to rings that a pose of other rings claims with as many of them or more."""
    weight, of = count[claims.pose], kind[claims.pose]
    most = torch.zeros(rings, dtype=weight.dtype, device=weight.device).scatter_reduce_(0, claims.ring, weight, "amax")
    first = weight == most[claims.ring]
    low, high = (
        torch.zeros(rings, dtype=of.dtype, device=of.device).scatter_reduce_(
            0, claims.ring[first], of[first], way, include_self=False
        )
        for way in ("amin", "amax")
    )
    return ~first | (low != high)[claims.ring]


def _scrambled(number: Tensor) -> Tensor:
    """Integers (E,) as good as random, whose sum tells sets of numbers apart (splitmix64, Steele et al. 2014)."""
    z = number * -7046029254386353131
    z = (z ^ (z >> 30)) * -4658895280553007687
    z = (z ^ (z >> 27)) * -7723592293110705685
    return z ^ (z >> 31)
