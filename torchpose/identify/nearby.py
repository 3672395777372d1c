"""Points near given places of the image, found without looking at the others.

Points are sorted by group, by strip of the image and then from left to right, so that what lies in a box is one run of
every strip that the box meets: the cost follows what is found, not the product of points and places.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchpose.geometry.segments import ragged_arange

_STRIP = 64.0  # px, height of a strip: about the diameter of a marker; cost alone depends on it


class Nearby(NamedTuple):
    """P points in the order of their sorted ``key``: strip of the group, and place along it."""

    order: Tensor
    key: Tensor
    corner: Tensor  # of the box of all points, px
    size: Tensor
    strips: int

    @classmethod
    def of(cls, group: Tensor, points: Tensor) -> Self:
        """Points (P, 2), P > 0, of groups (P,) int64."""
        corner = points.amin(0)
        size = points.amax(0) - corner
        strips = int(size[1] / _STRIP) + 1
        key = (group * strips + ((points[:, 1] - corner[1]) / _STRIP).long()) * (size[0] + 2) + points[:, 0] - corner[0]
        key, order = key.sort(stable=True)
        return cls(order, key, corner, size, strips)

    def within(self, group: Tensor, center: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """Points in square boxes, and above and below to the end of the strip: box (E,) and point (E,), flat.

        Args:
            group: (Q,) int64, of each box; only its points count.
            center: (Q, 2) px.
            reach: (Q,) px, half the side.
        """
        low = center - self.corner - reach[:, None]
        high = low + 2 * reach[:, None]
        meets = ((high >= 0) & (low <= self.size)).all(-1)
        first = (low[:, 1].clamp_min(0) / _STRIP).long()
        last = (torch.minimum(high[:, 1], self.size[1]) / _STRIP).long()
        box, strip = ragged_arange(torch.where(meets, last - first + 1, 0))
        start = (group[box] * self.strips + first[box] + strip) * (self.size[0] + 2)
        # between the runs of two strips lie two pixels, which the last half of one parts
        left = torch.searchsorted(self.key, start + low[box, 0].clamp_min(-0.5))
        right = torch.searchsorted(self.key, start + torch.minimum(high[box, 0], self.size[0] + 0.5), right=True)
        run, offset = ragged_arange((right - left).clamp_min(0))
        return box[run], self.order[left[run] + offset]
