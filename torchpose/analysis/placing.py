"""What a second camera at an angle buys, by the joint Cramer-Rao bound."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.analysis.crlb import pose_crlb
from torchpose.camera import Camera, CameraRig
from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import scaled_inverse
from torchpose.target import Target


def _turns(angle: Tensor) -> Tensor:
    """By angles (A,), rad, about the vertical of the picture (A, 3, 3)."""
    return rotations.exp(angle[:, None] * angle.new_tensor([0.0, 1.0, 0.0]))


@checked
def with_second(camera: Camera, distance: float, angle: float) -> CameraRig:
    """A camera and a second one like it, turned by ``angle`` (rad) about the vertical through the point of the first
    one's axis that is ``distance`` mm away. Their places are exact."""
    t = camera.matrix.new_tensor([0.0, 0.0, distance])
    turn = _turns(t.new_tensor([angle]))[0]
    return CameraRig([camera, camera], torch.stack([torch.eye(3).to(t), turn]), torch.stack([0 * t, t - turn @ t]))


@checked
def second_camera_crlb(
    camera: Camera, target: Target, R: Tensor, t: Tensor, angle: Float[Tensor, " A"], **conditions: Any
) -> Float[Tensor, "A 6 6"]:
    """Bound of a pose that a camera and a second one like it tell together, in the axes of the first.

    The second camera is the first one turned about the target's origin and the vertical of the picture. Places are
    exact. Where the second sees nothing of the target the bound is that of the first alone.

    Args:
        R: (3, 3), target to the first camera.
        t: (3,), mm.
        angle: between the cameras, rad.
        conditions: as of `pose_crlb`.
    """
    turn = _turns(angle)
    bound = pose_crlb(camera, target, torch.cat([R[None], turn @ R]), t.expand(len(angle) + 1, 3), **conditions)
    there = bound.isfinite().flatten(1).all(1)
    fisher, known = scaled_inverse(torch.where(there[:, None, None], bound, torch.eye(6).to(bound)))
    fisher = torch.where((there & known)[:, None, None], fisher, 0.0)
    zero = torch.zeros_like(turn)
    motion = torch.cat([torch.cat([turn, zero], -1), torch.cat([zero, turn], -1)], -2)
    together, known = scaled_inverse(fisher[0] + motion.mT @ fisher[1:] @ motion)
    return torch.where(known[:, None, None], together, torch.nan)
