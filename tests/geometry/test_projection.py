"""Derivatives of images against automatic differentiation."""

import torch

from torchpose.geometry import rotations
from torchpose.geometry.projection import by_pose, image_by_point


def test_derivatives_by_the_pose() -> None:
    g = torch.Generator().manual_seed(0)
    R = rotations.exp(torch.randn(3, dtype=torch.float64, generator=g))
    t = torch.tensor([3.0, -5.0, 80.0], dtype=torch.float64)
    X = 10 * torch.randn(7, 3, dtype=torch.float64, generator=g)

    def image(step: torch.Tensor) -> torch.Tensor:
        x = X @ (rotations.exp(step[3:]) @ R).T + t + step[:3]
        return x[:, :2] / x[:, 2:]

    expected = torch.autograd.functional.jacobian(image, torch.zeros(6, dtype=torch.float64))
    arm = X @ R.T
    found = by_pose(image_by_point(image(torch.zeros(6, dtype=torch.float64)), (arm + t)[:, 2]), arm)
    torch.testing.assert_close(found, expected)
