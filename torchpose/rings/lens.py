"""Ellipses and points between the pixels of the frame and ideal ones, of the same camera without distortion."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.least_squares import solve_scaled

_ANGLES = 32  # points of an ellipse that are mapped


@checked
def ideal_pixels(camera: Camera, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Pixels that a camera with the same matrix and no distortion would see; float64."""
    k = camera.matrix.to(points.device)
    return camera.undistort_points(points.double()) * k.diagonal()[:2] + k[:2, 2]


@checked
def mapped(ellipses: Float[Tensor, "K 5"], mapping: Callable[[Tensor], Tensor]) -> Float[Tensor, "K 5"]:
    """Images of ellipses under a mapping of points (P, 2) that is nearly affine across each of them."""
    angle = torch.arange(_ANGLES, dtype=torch.float64, device=ellipses.device) * (2 * torch.pi / _ANGLES)
    points = mapping(conics.points_on(ellipses[:, None], angle).flatten(0, 1)).view(-1, _ANGLES, 2)
    # an affine map takes the circle to centre + axes (cos, sin); what is left makes it a conic that is nearly a circle
    center = points.mean(1)
    axes = (points.mT @ torch.stack([angle.cos(), angle.sin()], -1)) * (2 / _ANGLES)
    x, y = torch.linalg.solve_ex(axes, (points - center[:, None]).mT).result.unbind(1)
    terms = torch.stack([x * x, x * y, y * y, x, y], -1)  # of a conic that is 1 on the circle
    conic = solve_scaled(terms.mT @ terms, terms.sum(1))
    square = conic[:, (0, 1, 1, 2)].unflatten(-1, (2, 2)) * conic.new_tensor([[1.0, 0.5], [0.5, 1.0]])
    inverse = torch.linalg.inv_ex(square).inverse
    shift = -0.5 * (inverse @ conic[:, 3:, None])
    level = 1 + (shift * (square @ shift)).sum((1, 2))
    spread = axes @ inverse @ axes.mT * level[:, None, None]
    return torch.cat([center + (axes @ shift).squeeze(-1), conics.axes_of(spread)], -1)
