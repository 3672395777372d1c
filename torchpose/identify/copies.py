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


def share_out(row: Tensor, score: Tensor, claims: Claims, near: Claims, size: tuple[int, int, int]) -> Tensor:
    """The poses (H,) bool that are copies: with three rings or more that no other copy has.

    In every round each ring backs the best pose that claims it, and the poses that all their rings back are copies.
    They take their rings away, and the poses that would put a marker where a copy has it are that copy once more. A
    round serves all frames and every neighbourhood of a frame at once.

    In a regular tray, rings of four neighbours can have the very layout of one copy. Their rings are claimed twice, each
    by the phantom and by a copy, and so are those of the copies inside the tray; but those at its edge have rings that
    nobody else claims. So claims in dispute count less, and a pose of disputed claims only waits while its frame has
    others: the tray is cleared from its edge.

    Args:
        row: (H,) frame and target of each pose.
        score: (H,) number of markers it explains, less a fraction for what they miss by.
        claims: the rings that the poses explain.
        near: the rings near enough to a predicted place to be that marker of the same copy.
        size: number of rows, of rings as they are numbered, and of markers.
    """
    rows, rings, markers = size
    count = torch.bincount(claims.pose, minlength=len(row))
    kind = segment_sum(_scrambled(claims.ring * markers + claims.marker), claims.pose, len(row))
    copies = torch.zeros_like(count, dtype=torch.bool)
    open_ones = count >= MIN_MARKERS
    while bool(open_ones.any()):
        some = claims.where(open_ones[claims.pose])
        disputed = segment_sum(_disputed(some, count, kind, rings).long(), some.pose, len(row))
        place = rank(row, torch.where(open_ones, score - disputed / (2 * markers), -torch.inf), rows)
        best = torch.full((rings,), len(row), device=row.device).scatter_reduce_(0, some.ring, place[some.pose], "amin")
        backed = open_ones & ~marked(some.pose[place[some.pose] > best[some.ring]], len(row))
        clear = backed & (disputed < count)
        new = backed & (clear | ~marked(row[clear], rows)[row])
        copies |= new
        taken = some.where(new[some.pose])
        gone = marked(taken.ring, rings)[claims.ring]
        same = marked(taken.ring * markers + taken.marker, rings * markers)[near.ring * markers + near.marker]
        open_ones &= ~marked(claims.pose[gone], len(row)) & ~marked(near.pose[same], len(row))
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
