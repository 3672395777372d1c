"""Rings that could be markers beside other ones, whatever their codes are: before any of them is measured.

The size of a ring tells how far away it is, and so two rings tell how far apart they are in space: at any pose as far
as two markers of a target. What has no such ring beside it is in no pose.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.segments import marked, near_pairs
from torchpose.identify.assignments import propose
from torchpose.identify.hypotheses import PLACE_TOLERANCE, SIZE_TOLERANCE
from torchpose.identify.scene import MarkerTable
from torchpose.rings import Rings


@checked
def in_company(rings: Rings, table: MarkerTable, matrix: Tensor) -> Bool[Tensor, " K"]:
    """Which rings have another of their frame and polarity as far away as the markers of a target are from each other.

    Args:
        rings: rough ones will do.
        table: the targets.
        matrix: of the camera.
    """
    return beside_another((rings.frame, rings.polarity, rings.outer.params), table, matrix)


@checked
def beside_another(
    circles: tuple[Int[Tensor, " K"], Float[Tensor, " K"], Float[Tensor, "K 5"]], table: MarkerTable, matrix: Tensor
) -> Bool[Tensor, " K"]:
    """`in_company` of outer circles: frame, polarity and ellipse in ideal pixels. None lies across another one."""
    frame, polarity, outer = circles
    if len(outer) == 0:
        return polarity > 0
    (narrowest, widest), radius = _extents(table)
    focal = matrix[0, 0]
    ray = torch.nn.functional.pad(outer[:, :2], (0, 1), value=1.0) @ torch.linalg.inv(matrix).mT
    length = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)  # of a ray that is 1 deep
    # semi-major axes are those of `hypotheses._miss`, of rings that are a little off yet: (K, T) mm along the ray
    spare = PLACE_TOLERANCE[0]
    nearest = focal * radius[0] / (SIZE_TOLERANCE * (outer[:, 2:3] + spare)) * length
    farthest = focal * radius[1] * SIZE_TOLERANCE / (outer[:, 2:3] - spare).clamp_min(spare) * length.square()
    # a point `widest` away from one of the depth z is seen at most so far from it, in px
    reach = focal * widest * length / (nearest / length - widest).clamp_min(0)
    extent = (outer[:, :2].amax(0) - outer[:, :2].amin(0)).sum()
    reach = reach.amax(1).minimum(extent)
    i, j = near_pairs(outer[:, :2], outer[:, :2], reach, (frame, frame))
    step = torch.linalg.vector_norm(outer[i, :2] - outer[j, :2], dim=-1)
    # what is seen beside the other lies outside the discs that both ellipses hold: else it is the same ring once more
    other = (step + spare >= outer[i, 3] + outer[j, 3]) & (polarity[i] == polarity[j]) & (i != j)
    i, j = i[other], j[other]
    cos = (ray[i] * ray[j]).sum(-1, keepdim=True) / (length[i] * length[j])
    one, two, far_one, far_two = nearest[i], nearest[j], farthest[i], farthest[j]
    # the nearest points of the two stretches have a near end among them, the farthest ones are ends
    least = torch.minimum(
        _apart(one, (one * cos).clamp(two, far_two), cos), _apart((two * cos).clamp(one, far_one), two, cos)
    )
    ends = ((one, far_two), (far_one, two), (far_one, far_two))
    most = torch.stack([_apart(*pair, cos) for pair in ends]).amax(0)
    return marked(i[((least < widest) & (most > narrowest)).any(1)], len(outer))


@checked
def named(rings: Rings, table: MarkerTable, matrix: Tensor) -> Bool[Tensor, " K"]:
    """Which rings have the code of a marker; arguments as for `in_company`."""
    return marked(propose(rings, table, matrix).ring, len(rings))


def _extents(table: MarkerTable) -> tuple[Tensor, Tensor]:
    """Least and largest distance of two markers (2, T), and least and largest outer radius (2, T), mm."""
    both = table.valid[:, :, None] & table.valid[:, None]
    both &= ~torch.eye(both.shape[1], dtype=torch.bool, device=both.device)
    each = (torch.cdist(table.centers, table.centers).flatten(1), both.flatten(1)), (table.radii[..., 0], table.valid)
    distances, radii = (
        torch.stack([mm.where(valid, torch.inf).amin(1), mm.where(valid, 0.0).amax(1)]) for mm, valid in each
    )
    return distances, radii


def _apart(one: Tensor, other: Tensor, cos: Tensor) -> Tensor:
    """Distance of two points so far along rays of this angle."""
    return (one.square() + other.square() - 2 * one * other * cos).clamp_min(0).sqrt()
