"""How the image of a point moves with the point, and with the pose of the body that it belongs to."""

import torch
from jaxtyping import Float
from torch import Tensor


def image_by_point(xy: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 3"]:
    """Derivatives of the image on the plane z = 1 by the point, in camera axes, from image and depth of the point."""
    eye = torch.eye(2, dtype=xy.dtype, device=xy.device).expand(*xy.shape[:-1], 2, 2)
    return torch.cat([eye, -xy[..., None]], -1) / depth[..., None, None]


def by_pose(by_point: Float[Tensor, "*batch k 3"], arm: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch k 6"]:
    """Derivatives by the pose from those by the point: translation, then rotation from the left, R' = exp(w) R.

    Args:
        by_point: of anything, by the point in camera axes.
        arm: R X, the point about the target's origin, camera axes.
    """
    return torch.cat([by_point, torch.linalg.cross(arm[..., None, :].expand_as(by_point), by_point)], -1)
