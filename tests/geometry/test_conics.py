"""Conics against sampled points, closed forms and SciPy."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.special import ellipe

from torchpose.geometry import conics, rotations

no_deadline = settings(deadline=None)
ANGLES = torch.arange(24, dtype=torch.float64) * (2 * math.pi / 24)


def on_conic(matrix: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """First-order distances (..., P) of points (..., P, 2) to conic matrices (..., 3, 3)."""
    x = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
    line = x @ matrix
    return (line * x).sum(-1) / (2 * torch.linalg.vector_norm(line[..., :2], dim=-1))


@st.composite
def ellipses(draw: Callable[..., Any]) -> torch.Tensor:
    a = draw(st.floats(0.5, 500))
    ratio = draw(st.one_of(st.just(1.0), st.floats(0.02, 1)))
    cx, cy = draw(st.floats(-5000, 5000)), draw(st.floats(-5000, 5000))
    theta = draw(
        st.one_of(st.sampled_from([0.0, math.pi / 2, math.nextafter(math.pi, 0)]), st.floats(0, math.pi - 1e-9))
    )
    return torch.tensor([cx, cy, a, a * ratio, theta], dtype=torch.float64)


@st.composite
def circles(draw: Callable[..., Any]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rotation, centre, normal, radius of a circle wholly in front of the camera and not edge-on."""
    axis = [draw(st.floats(-1, 1)) for _ in range(3)]
    rotation = rotations.exp(torch.tensor(axis, dtype=torch.float64))
    x, y, z = draw(st.floats(-150, 150)), draw(st.floats(-150, 150)), draw(st.floats(200, 2000))
    azimuth, polar = draw(st.floats(0, 2 * math.pi)), draw(st.floats(0, 0.6))
    across = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
    size = draw(st.floats(1, 40))
    center, normal, radius = (torch.tensor(v, dtype=torch.float64) for v in ([x, y, z], across, size))
    assume(abs((rotation @ normal) @ center) > 0.05 * center.norm())
    return rotation, center, normal, radius


def circle_points(
    rotation: torch.Tensor, center: torch.Tensor, normal: torch.Tensor, radius: torch.Tensor
) -> torch.Tensor:
    """Points (P, 3) of the circle, its basis from an SVD."""
    n = rotation @ normal
    basis = torch.linalg.svd(n[None])[2][1:]
    return center + radius * (ANGLES.cos()[:, None] * basis[0] + ANGLES.sin()[:, None] * basis[1])


@no_deadline
@given(ellipses())
def test_ellipse_conic_round_trip(ellipse: torch.Tensor) -> None:
    back = conics.ellipse_from_conic(conics.conic_from_ellipse(ellipse))
    # the constant term of a far-off small ellipse holds (centre / b)^2 times its size
    digits = 1e-15 * (1 + (ellipse[:2] / ellipse[3]).square().sum() * (ellipse[2] / ellipse[3]).square())
    tolerance = float(ellipse[2] * digits.clamp_min(1e-12)) + 1e-9
    assert back[2] >= back[3]
    assert 0 <= back[4] < math.pi
    torch.testing.assert_close(back[:4], ellipse[:4], rtol=0, atol=tolerance)
    torch.testing.assert_close(
        conics.shape_matrix(back), conics.shape_matrix(ellipse), rtol=0, atol=2 * tolerance, check_dtype=True
    )


@no_deadline
@given(ellipses())
def test_points_lie_on_the_ellipse(ellipse: torch.Tensor) -> None:
    at_origin = torch.cat([torch.zeros(2, dtype=torch.float64), ellipse[2:]])
    xy = conics.points_on(at_origin.expand(24, 5), ANGLES)
    matrix = conics.to_matrix(conics.conic_from_ellipse(at_origin))
    assert on_conic(matrix, xy).abs().max() < 1e-10 * ellipse[2]
    # the same set of points through the symmetric square root
    direction = torch.linalg.solve(conics.shape_matrix(at_origin), xy.mT)
    torch.testing.assert_close(direction.square().sum(0), torch.ones(24, dtype=torch.float64), rtol=0, atol=1e-9)


@no_deadline
@given(ellipses())
def test_inverse_shapes(ellipse: torch.Tensor) -> None:
    shape, eye = conics.shape_matrix(ellipse), torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(shape @ conics.inverse_shape(ellipse), eye, rtol=0, atol=1e-9)
    torch.testing.assert_close(shape @ shape @ conics.inverse_shape(ellipse, 2), eye, rtol=0, atol=1e-7)


@no_deadline
@given(ellipses(), st.floats(-1e3, 1e3).filter(lambda s: abs(s) > 1e-3))
def test_scale_and_sign_of_the_conic_do_not_matter(ellipse: torch.Tensor, scale: float) -> None:
    at_origin = torch.cat([torch.zeros(2, dtype=torch.float64), ellipse[2:]])
    conic = conics.conic_from_ellipse(at_origin)
    one, other = conics.ellipse_from_conic(conic), conics.ellipse_from_conic(scale * conic)
    torch.testing.assert_close(conics.shape_matrix(one), conics.shape_matrix(other), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "conic",
    [
        [1.0, 0, -1, 0, 0, -1],  # hyperbola
        [1.0, 0, 0, 0, -1, 0],  # parabola
        [1.0, 0, 1, 0, 0, 1],  # imaginary
        [1.0, 0, 1, 0, 0, 0],  # a point
        [0.0, 0, 0, 1, 1, 0],  # a line
        [0.0, 0, 0, 0, 0, 0],
        [math.nan, 0, 1, 0, 0, -1],
    ],
)
def test_no_ellipse_is_nan(conic: list[float]) -> None:
    good = [2.0, 0, 8, 0, 0, -8]
    out = conics.ellipse_from_conic(torch.tensor([good, conic], dtype=torch.float64))
    torch.testing.assert_close(out[0], torch.tensor([0, 0, 2, 1, 0], dtype=torch.float64))
    assert out[1].isnan().all()


def test_matrix_round_trip() -> None:
    conic = torch.randn(3, 4, 6, dtype=torch.float64)
    torch.testing.assert_close(conics.from_matrix(conics.to_matrix(conic)), conic, rtol=0, atol=0)


def test_perimeter() -> None:
    ratio = torch.tensor([1.0, 0.7, 0.3, 0.1, 0.02], dtype=torch.float64)
    ellipse = torch.stack([0 * ratio, 0 * ratio, 10 + 0 * ratio, 10 * ratio, 0 * ratio], -1)
    exact = 40 * torch.from_numpy(ellipe((1 - ratio**2).numpy()))
    error = conics.perimeter(ellipse) / exact - 1
    assert error[:4].abs().max() < 1e-4
    assert error.abs().max() < 4.1e-4


@no_deadline
@given(circles())
def test_circle_image_holds_the_points(circle: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]) -> None:
    x = circle_points(*circle)
    matrix = conics.circle_image(*circle)
    assert on_conic(matrix, x[:, :2] / x[:, 2:]).abs().max() < 1e-11


@no_deadline
@given(circles())
def test_eccentricity(circle: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]) -> None:
    """The ellipse's centre is h33 h3 - r^2 a: methods.md, 'Exact ellipse centre of a circle'."""
    rotation, center, normal, radius = circle
    basis = torch.linalg.svd((rotation @ normal)[None])[2][1:]
    h = torch.cat([basis, center[None]]).T
    a = h @ torch.tensor([1.0, 1, 0], dtype=torch.float64).diag() @ h.T[:, 2]
    e = h[2, 2] * center - radius.square() * a
    ellipse = conics.ellipse_from_conic(conics.from_matrix(conics.circle_image(*circle)))
    torch.testing.assert_close(ellipse[:2], e[:2] / e[2], rtol=0, atol=1e-10)


@no_deadline
@given(circles())
def test_circle_poses_hold_the_truth(circle: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]) -> None:
    rotation, center, normal, radius = circle
    n = rotation @ normal
    n = n if n @ center > 0 else -n
    centers, normals = conics.circle_poses(conics.circle_image(*circle), radius)
    assert (centers[:, 2] > 0).all()
    assert ((centers * normals).sum(-1) > 0).all()
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(2, dtype=torch.float64))
    # at a frontal view both solutions meet and the normal is the square root of a rounding error
    error = (centers - center).norm(dim=-1) / center.norm() + (normals - n).norm(dim=-1)
    assert error.min() < 1e-5


@no_deadline
@given(circles())
def test_both_circle_poses_have_the_same_image(
    circle: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
) -> None:
    matrix = conics.circle_image(*circle)
    centers, normals = conics.circle_poses(matrix, circle[3])
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    again = conics.circle_image(eye, centers, normals, circle[3].expand(2))
    unit = matrix / torch.linalg.matrix_norm(matrix)
    again = again / torch.linalg.matrix_norm(again)[:, None, None]
    again = again * (again * unit).sum((1, 2)).sign()[:, None, None]
    torch.testing.assert_close(again, unit.expand(2, 3, 3), rtol=0, atol=1e-9)


def test_circle_poses_batch_and_sign() -> None:
    rotation = rotations.exp(torch.randn(5, 3, dtype=torch.float64) * 0.3)
    center = torch.tensor([10.0, -20, 300], dtype=torch.float64).expand(5, 3)
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(5, 3)
    matrix = conics.circle_image(rotation, center, normal, torch.full((5,), 4.0, dtype=torch.float64))
    radius = torch.full((5,), 4.0, dtype=torch.float64)
    centers, _ = conics.circle_poses(matrix, radius)
    flipped, _ = conics.circle_poses(-7 * matrix, radius)
    single, _ = conics.circle_poses(matrix[3], radius[3])
    pair = torch.cdist(centers, flipped).amin(-1)
    assert pair.max() < 1e-8
    assert torch.cdist(centers[3], single).amin(-1).max() < 1e-8


def test_boundary_is_points_on_and_the_normals_of_the_distance() -> None:
    ellipses = torch.tensor([[3.0, -2.0, 5.0, 2.0, 0.4], [1.0, 1.0, 2.0, 2.0, 0.0]], dtype=torch.float64)
    index = torch.tensor([0, 1, 0, 0, 1])
    angle = torch.tensor([0.1, 2.0, 3.3, 5.9, 4.4], dtype=torch.float64)
    x, y, nx, ny = conics.boundary(ellipses, index, angle)
    expected = conics.points_on(ellipses[index], angle)
    torch.testing.assert_close(torch.stack([x, y], -1), expected)
    conic = conics.conic_from_ellipse(ellipses[index]).unbind(-1)
    distance, *normal = conics.signed_distance(conic, *expected.unbind(-1))
    torch.testing.assert_close(distance, torch.zeros_like(distance), rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.stack([nx, ny]), torch.stack(normal))
