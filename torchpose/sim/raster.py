"""Circles as a raster printer draws them: every cell whose centre lies inside is black."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry.segments import ragged_arange


def raster_sides(
    center: Float[Tensor, "K 2"], radius: Float[Tensor, " K"], cell: float, phase: Float[Tensor, "K 2"]
) -> tuple[Int[Tensor, " E"], Float[Tensor, "E 2 2"]]:
    """Outlines of rastered circles: whose they are and the ends of their sides, which run from x towards y.

    Args:
        center: of the circles, mm.
        radius: mm.
        cell: side of the raster's cells, mm.
        phase: a corner of the raster, mm.
    """
    middle = (center - phase) / cell
    reach = radius / cell
    lowest = (middle[:, 1] - reach - 0.5).ceil().long()  # rows of cells whose centres lie inside
    count = ((middle[:, 1] + reach - 0.5).floor().long() - lowest + 1).clamp(min=0)
    circle, number = ragged_arange(count)
    row = (lowest[circle] + number).to(radius)
    half = (reach[circle].square() - (row + 0.5 - middle[circle, 1]).square()).clamp_min(0).sqrt()
    left = (middle[circle, 0] - half - 0.5).ceil()
    right = (middle[circle, 0] + half - 0.5).floor() + 1
    empty = right <= left
    point = middle[:, 0].round()
    left, right = (torch.where(empty, point[circle], x) for x in (left, right))

    if len(circle) == 0:
        return circle, radius.new_zeros(0, 2, 2)
    # along the lower edge of every row, and of one more above the last, from the row below to this one
    every, step = ragged_arange(count + 1)
    here, below = step < count[every], step > 0
    item = torch.cumsum(here, 0) - 1  # of the row here, or of the one below behind the last row

    def at(of: Tensor, there: Tensor, index: Tensor) -> Tensor:
        """Column of the row of that index where there is one, else the point in which the outline begins and ends."""
        return torch.where(there, of[index.clamp(0, len(of) - 1)], point[every])

    level, lower = (lowest[every] + step).to(radius), item - here.long()
    right_here, left_here = at(right, here, item), at(left, here, item)
    right_below, left_below = at(right, below, lower), at(left, below, lower)
    parts = [
        (circle, (right, row), (right, row + 1)),
        (circle, (left, row + 1), (left, row)),
        (every, (right_below, level), (right_here, level)),
        (every, (left_here, level), (left_below, level)),
    ]
    of = torch.cat([part[0] for part in parts])
    ends = torch.cat([torch.stack([torch.stack(a, -1), torch.stack(b, -1)], 1) for _, a, b in parts])
    long = (ends[:, 0] != ends[:, 1]).any(1)
    return of[long], ends[long] * cell + phase[of[long], None]
