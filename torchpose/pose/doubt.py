"""Poses from three markers that put a fourth where it cannot be: three centres fit many a mix-up."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.segments import marked
from torchpose.identify import MarkerTable
from torchpose.rings import Rings

_ACROSS = 0.3  # of the semi-major axis: rings so far across each other are not both there (convention)


@checked
def crossed_out(
    rings: Rings,
    frame: Int[Tensor, " N"],
    R: Float[Tensor, "N 3 3"],
    t: Float[Tensor, "N 3"],
    markers: MarkerTable,
    seen: Bool[Tensor, "N M"],
    matrix: Float[Tensor, "3 3"],
) -> Bool[Tensor, " N"]:
    """Poses under which a marker that was not seen would lie across a ring that was, where none can be.

    Args:
        rings: ideal px.
        frame: of each pose.
        R: of the poses.
        t: the same, mm.
        markers: of the target of each pose.
        seen: markers; the others are asked for.
        matrix: of the camera.
    """
    x = (R[:, None] @ markers.centers[..., None]).squeeze(-1) + t[:, None]
    at = (x @ matrix.T)[..., :2] / x[..., 2:]
    size = matrix[0, 0] * markers.radii[..., 0] / x[..., 2]
    # every unseen marker with every ring of its frame
    unseen = markers.valid & ~seen
    row, marker, ring = ((frame[:, None] == rings.frame)[:, None] & unseen[..., None]).nonzero().unbind(-1)
    outer = rings.outer.params[ring]
    apart = torch.linalg.vector_norm(at[row, marker] - outer[:, :2], dim=-1)
    reach = torch.minimum(size[row, marker], outer[:, 2])
    across = (apart < outer[:, 3] + _ACROSS * reach) & (apart > _ACROSS * reach) & (x[row, marker, 2] > 0)
    return marked(row[across], len(frame))
