"""The sectors of a ring: which way from its centre it is seen, one row for each ring.

Whatever covers a ring hides a part of its perimeter. The row is measured where the ring is found, goes along with it,
and every stage that looks closer begins with the row of the one before. Sectors divide the eccentric anomaly of the
ring's outer ellipse, from +u on the circle that its shape matrix makes the ellipse of.
"""

import math
from functools import cache

import torch
from torch import Tensor

from torchpose.geometry import conics

# of a circle: what goes with the end of a cover is 2 % of the perimeter, and a ring of 8 px has a pixel of edge in each
# (convention; figures in docs/tried.md)
SECTORS = 48
MOST = (
    27 / 48
)  # of a perimeter: more than a circle in a square shows, or a ring that is half hidden (derived: both show half)


@cache
def middles(device: torch.device) -> Tensor:
    """Angles (48,) of the middles, half a step off the axes, so that a mirrored ring has the mirrored row."""
    with torch.inference_mode(False):
        return (torch.arange(SECTORS, dtype=torch.float64, device=device) + 0.5) * (2 * torch.pi / SECTORS)


def sector_of(x: Tensor, y: Tensor) -> Tensor:
    """Sectors, int64, of places on the circle, or out from it."""
    turn = (torch.atan2(y, x) * (SECTORS / (2 * math.pi))).floor_().long()
    return turn.remainder_(SECTORS)


def sector_about(u: Tensor, v: Tensor, ellipses: Tensor, owner: Tensor) -> Tensor:
    """Sectors (P,) of points u, v (P,) about the ellipses (K, 5) that own them (P,)."""
    inverse = conics.inverse_shape(ellipses).flatten(1)
    i11, i12, _, i22, cx, cy = torch.cat([inverse, ellipses[:, :2]], 1).index_select(0, owner).unbind(1)
    dx, dy = u - cx, v - cy
    return sector_of(i11 * dx + i12 * dy, i12 * dx + i22 * dy)


def clear_of_ends(seen: Tensor) -> Tensor:
    """Sectors (K, 48) bool whose neighbours are mostly seen, too, and neither next one is hidden.

    Single ones that noise hides stay; next to a cover, its own edge may pass for the circle's.
    """
    around = torch.stack([seen.roll(k, 1) for k in range(-2, 3)]).sum(0) > 2
    return around & around.roll(1, 1) & around.roll(-1, 1)
