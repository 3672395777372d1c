"""Rotations against scipy and kornia, at zero, small angles and half a turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchpose.geometry import rotations

F64 = torch.float64
ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.3, math.pi / 2, math.pi - 1e-4, math.pi - 1e-9]


def vectors(angle: float, count: int = 200) -> Tensor:
    """Rotation vectors of one length in all directions."""
    axis = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    return angle * axis / axis.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_log_and_quaternion_equal_scipy(angle: float) -> None:
    v = vectors(angle)
    theirs = Rotation.from_rotvec(v.numpy())
    ours = rotations.exp(v)
    np.testing.assert_allclose(ours, theirs.as_matrix(), rtol=0, atol=2e-15)
    np.testing.assert_allclose(rotations.log(ours), v, rtol=1e-9, atol=2e-15)
    quaternion = np.roll(theirs.as_quat(canonical=True), 1, axis=-1)
    np.testing.assert_allclose(rotations.quaternion(ours), quaternion, rtol=0, atol=1e-9 if angle > 3.1 else 2e-15)


@pytest.mark.parametrize("angle", [*ANGLES, 1.3])
def test_kornia_says_the_same(angle: float) -> None:
    """Ours stay for their time on few rotations and for kornia's import (docs/kornia.md), not for their digits."""
    v = vectors(angle)
    torch.testing.assert_close(rotations.exp(v), axis_angle_to_rotation_matrix(v), rtol=0, atol=3e-15)
    R = rotations.exp(v)
    torch.testing.assert_close(rotations.log(R), rotation_matrix_to_axis_angle(R), rtol=0, atol=3e-15)
    q = rotation_matrix_to_quaternion(R)
    torch.testing.assert_close(rotations.quaternion(R), torch.where(q[:, :1] < 0, -q, q), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 3.0, math.pi - 1e-6])
def test_kornias_gradients_are_the_same(angle: float) -> None:
    weight = torch.arange(9.0, dtype=F64).view(3, 3)
    slopes = []
    for exp, log in (
        (rotations.exp, rotations.log),
        (axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle),
    ):
        v = vectors(angle, 5).requires_grad_()
        R = exp(v)
        slopes.append([*torch.autograd.grad((weight * R).sum() + log(R).sum(), v)])
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-10, atol=1e-11)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_compose_and_inverse_are_those_of_the_group(numbers: list[float]) -> None:
    v, t = torch.tensor(numbers, dtype=F64).split(3)
    r = rotations.exp(v)
    r_back, t_back = rotations.inverse(r, t)
    eye, zero = rotations.compose(r, t, r_back, t_back)
    torch.testing.assert_close(eye, torch.eye(3, dtype=F64), rtol=0, atol=1e-14)
    torch.testing.assert_close(zero, torch.zeros(3, dtype=F64), rtol=0, atol=1e-13)
    point = torch.tensor([1.0, -2.0, 3.0], dtype=F64)
    ra, ta = rotations.compose(r, t, r_back, t)
    torch.testing.assert_close(ra @ point + ta, r @ (r_back @ point + t) + t, rtol=0, atol=1e-13)


def test_log_of_half_a_turn_has_length_pi() -> None:
    for axis in torch.eye(3, dtype=F64):
        half = 2 * torch.outer(axis, axis) - torch.eye(3, dtype=F64)
        torch.testing.assert_close(rotations.log(half).abs(), math.pi * axis, rtol=0, atol=1e-15)


def test_angle_between_is_the_length_of_the_step() -> None:
    r = rotations.exp(vectors(0.7))
    for angle in (1e-9, 1e-3, 2.0):
        step = rotations.exp(vectors(angle).flip(0))
        torch.testing.assert_close(
            rotations.angle_between(step @ r, r), torch.full((200,), angle, dtype=F64), rtol=1e-6, atol=0
        )


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 3.0])
def test_gradients_hold_everywhere(angle: float) -> None:
    v = vectors(angle, 3).requires_grad_()
    assert torch.autograd.gradcheck(rotations.exp, v)
    assert torch.autograd.gradcheck(lambda x: rotations.log(rotations.exp(x)), v, atol=1e-4)


def test_skew_is_the_cross_product() -> None:
    a, b = vectors(1.0), vectors(2.0).roll(1, 0)
    torch.testing.assert_close((rotations.skew(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b))
