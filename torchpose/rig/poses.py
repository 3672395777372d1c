"""Poses of the tool as six numbers ``(x, y, z, rx, ry, rz)``: position in mm, rotation vector in rad."""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import FiniteFloat
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.rig.settings import AS_TUPLE

_F = FiniteFloat
Pose = Annotated[tuple[_F, _F, _F, _F, _F, _F], AS_TUPLE]


def as_pose(numbers: Any) -> Pose:
    """Six numbers as a pose. Raises ValueError or TypeError where they are none, or not six."""
    x, y, z, rx, ry, rz = map(float, numbers)
    return x, y, z, rx, ry, rz


def to_transform(pose: Any) -> tuple[Float[Tensor, "*N 3 3"], Float[Tensor, "*N 3"]]:
    """R and t (mm), float64, of one pose or of many."""
    numbers = torch.as_tensor(pose, dtype=torch.float64)
    return rotations.exp(numbers[..., 3:]), numbers[..., :3]


def from_transform(R: Float[Tensor, "3 3"], t: Float[Tensor, " 3"]) -> Pose:
    """The pose of one R, t (mm)."""
    return as_pose([*t.tolist(), *rotations.log(R).tolist()])


def difference(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """Distance in mm and angle in degrees between two poses."""
    R, _ = to_transform([list(first), list(second)])
    return math.dist(first[:3], second[:3]), math.degrees(float(rotations.angle_between(R[0], R[1])))


def middle(first: Sequence[float], second: Sequence[float]) -> Pose:
    """The pose half-way between two near ones, whichever of the equivalent rotation vectors they have."""
    R, t = to_transform([list(first), list(second)])
    return from_transform(rotations.exp(0.5 * rotations.log(R[1] @ R[0].mT)) @ R[0], t.mean(0))
