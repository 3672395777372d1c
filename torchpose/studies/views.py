"""Views that the studies draw at random."""

import math

import torch
from torch import Tensor

from torchpose.geometry import rotations


def turned(tilt: Tensor | float, azimuth: Tensor, roll: Tensor) -> Tensor:
    """R (N, 3, 3): a roll about the target's normal, then a tilt (rad) about an axis in the plane of the image.

    Args:
        tilt: (N,) or one for all.
        azimuth: (N,) of the axis of tilt, in parts of a turn.
        roll: (N,) in parts of a turn.
    """
    zero, azimuth = torch.zeros_like(roll), 2 * math.pi * azimuth
    axis = torch.stack([azimuth.cos(), azimuth.sin(), zero], -1)
    lean = rotations.exp(axis * torch.as_tensor(tilt, dtype=axis.dtype)[..., None])
    return lean @ rotations.exp(torch.stack([zero, zero, 2 * math.pi * roll], -1))
