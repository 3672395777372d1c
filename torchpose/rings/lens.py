"""Ellipses and points between the pixels of the frame and ideal ones, of the same camera without distortion."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked

_ANGLES = 64  # points of an ellipse that are mapped


@checked
def ideal_pixels(camera: Camera, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Pixels that a camera with the same matrix and no distortion would see; float64."""
    k = camera.matrix.to(points.device)
    return camera.undistort_points(points.double()) * k.diagonal()[:2] + k[:2, 2]


@checked
def mapped(ellipses: Float[Tensor, "K 5"], mapping: Callable[[Tensor], Tensor]) -> Float[Tensor, "K 5"]:
    """Images of ellipses under a mapping of points (P, 2) that is nearly affine across each of them."""
    angle = torch.arange(_ANGLES, dtype=torch.float64, device=ellipses.device) * (2 * torch.pi / _ANGLES)
    points = conics.points_on(ellipses[:, None], angle.expand(len(ellipses), -1)).flatten(0, 1)
    ring = torch.arange(len(ellipses), device=ellipses.device).repeat_interleave(_ANGLES)
    return ellipse.fit(mapping(points), ring, len(ellipses))
