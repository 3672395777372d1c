"""Rings that could be markers beside other ones, whatever their codes are: before any of them is measured.

The size of a ring tells how far away it is, and so two rings tell how far apart they are in space: at any pose no
farther than two markers of a target. What has no such ring beside it is in no pose.
"""

import torch
from jaxtyping import Bool
from torch import Tensor

from torchpose.geometry.segments import marked, near_pairs
from torchpose.identify.assignments import propose
from torchpose.identify.hypotheses import PLACE_TOLERANCE, SIZE_TOLERANCE
from torchpose.identify.scene import MarkerTable
from torchpose.rings import Rings

_ANYWHERE = 1e6  # px, beyond any frame


def in_company(rings: Rings, table: MarkerTable, matrix: Tensor) -> Bool[Tensor, " K"]:
    """Which rings have another of their frame and polarity as near as the markers of a target are at any pose.

    Args:
        rings: rough ones will do.
        table: the targets.
        matrix: of the camera.
    """
    widest, radius = _extents(table)
    outer, focal = rings.outer.params, matrix[0, 0]
    ray = torch.nn.functional.pad(outer[:, :2], (0, 1), value=1.0) @ torch.linalg.inv(matrix).mT
    length = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)  # of a ray that is 1 deep
    # semi-major axes are those of `hypotheses._miss`, of rings that are a little off yet: (K, T) mm along the ray
    spare = PLACE_TOLERANCE[0]
    nearest = focal * radius[0] / (SIZE_TOLERANCE * (outer[:, 2:3] + spare)) * length
    farthest = focal * radius[1] * SIZE_TOLERANCE / (outer[:, 2:3] - spare).clamp_min(spare) * length.square()
    # a point `widest` away from one of the depth z is seen at most so far from it, in px
    depth = nearest / length
    reach = torch.where(depth > widest, focal * widest * length / (depth - widest), _ANYWHERE).amax(1)
    i, j = near_pairs(outer[:, :2], outer[:, :2], reach.clamp_max(_ANYWHERE), (rings.frame, rings.frame))
    other = (i != j) & (rings.polarity[i] == rings.polarity[j])
    i, j = i[other], j[other]
    cos = (ray[i] * ray[j]).sum(-1, keepdim=True) / (length[i] * length[j])
    # the nearest points of the two stretches: one of them is a near end
    one, two = nearest[i], nearest[j]
    least = torch.minimum(
        _apart(one, (one * cos).clamp(two, farthest[j]), cos), _apart((two * cos).clamp(one, farthest[i]), two, cos)
    )
    return marked(i[(least < widest).any(1)], len(rings))


def named(rings: Rings, table: MarkerTable, matrix: Tensor) -> Bool[Tensor, " K"]:
    """Which rings have the code of a marker; arguments as for `in_company`."""
    return marked(propose(rings, table, matrix).ring, len(rings))


def _extents(table: MarkerTable) -> tuple[Tensor, Tensor]:
    """Largest distance (T,) of two markers, and least and largest outer radius (2, T), mm."""
    both = table.valid[:, :, None] & table.valid[:, None]
    widest = torch.where(both, torch.cdist(table.centers, table.centers), 0.0).amax((1, 2))
    outer = table.radii[..., 0]
    least, most = outer.where(table.valid, torch.inf).amin(1), outer.where(table.valid, 0.0).amax(1)
    return widest, torch.stack([least, most])


def _apart(one: Tensor, other: Tensor, cos: Tensor) -> Tensor:
    """Distance of two points so far along rays of this angle."""
    return (one.square() + other.square() - 2 * one * other * cos).clamp_min(0).sqrt()
