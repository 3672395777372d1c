"""Ellipses through a lens, against conics of exactly mapped points."""

import math

import torch
from torch import Tensor

from torchpose import ellipse
from torchpose.geometry import conics
from torchpose.rings import mapped


def on_ellipses(ellipses: Tensor, points: Tensor) -> Tensor:
    """Distances (K, P), nearly, of points (K, P, 2) from ellipses (K, 5)."""
    shape = conics.shape_matrix(ellipses)
    inside = torch.linalg.solve(shape, (points - ellipses[:, None, :2]).mT)
    return (torch.linalg.vector_norm(inside, dim=1) - 1) * ellipses[:, 3:4]


def test_projective_images_are_exact() -> None:
    """A projective map takes ellipses to ellipses, whose points are those of the images."""
    ellipses = torch.tensor([[300.0, 200, 40, 12, 0.4], [900, 700, 25, 25, 0.0], [600, 100, 60, 30, 3.1]])
    ellipses = ellipses.double()
    matrix = torch.tensor([[1.1, 0.2, 30], [-0.1, 0.9, 5], [3e-5, -2e-5, 1]], dtype=torch.float64)

    def project(points: Tensor) -> Tensor:
        uvw = torch.nn.functional.pad(points, (0, 1), value=1.0) @ matrix.T
        return uvw[..., :2] / uvw[..., 2:]

    angle = torch.arange(50, dtype=torch.float64) * (2 * math.pi / 50)
    points = project(conics.points_on(ellipses[:, None], angle))
    found = mapped(ellipses, project)
    assert (found[:, 2] >= found[:, 3]).all()
    assert on_ellipses(found, points).abs().max() < 1e-9


def test_bent_images_have_the_ellipse_of_least_distances() -> None:
    """Radial distortion bends an ellipse of 60 px by 0.03 px; the direct fit of many points is independent."""
    ellipses = torch.tensor([[300.0, 200, 40, 12, 0.4], [500, 300, 60, 30, 1.1]], dtype=torch.float64)

    def bend(points: Tensor) -> Tensor:
        return points * (1 - 0.1 * (points / 1000).square().sum(-1, keepdim=True))

    angle = torch.arange(500, dtype=torch.float64) * (2 * math.pi / 500)
    points = bend(conics.points_on(ellipses[:, None], angle))
    direct = ellipse.fit_blocks(points, method="taubin")
    torch.testing.assert_close(mapped(ellipses, bend), direct, rtol=0, atol=1e-3)
