"""Equations (1) to (6) against finite differences of the camera model."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchpose.analysis import equations
from torchpose.camera import Camera

F64 = torch.float64
MU = 0.0024
LENGTH, FOCAL, TRUE_FOCAL, DISTANCE = 8.0, 8.0, 8.02, 20.0


def camera(f: float) -> Camera:
    return Camera(5472, 3648, torch.tensor([[f / MU, 0, 2735.5], [0, f / MU, 1823.5], [0, 0, 1]], dtype=F64), [])


def extent(f: float, length: float, distance: float) -> float:
    """Pixels between the ends of a length that is seen face on."""
    ends = torch.tensor([[-length / 2, 0, distance], [length / 2, 0, distance]], dtype=F64)
    u = camera(f).project(ends)[:, 0]
    return float(u[1] - u[0])


@given(st.floats(4, 50), st.floats(1, 40), st.floats(30, 500))
def test_distance_and_its_derivative_are_those_of_the_camera(f: float, length: float, distance: float) -> None:
    n = extent(f, length, distance)
    assert equations.distance(length, f, n, MU) == pytest.approx(distance)
    h = 1e-5 * distance
    slope = (extent(f, length, distance + h) - extent(f, length, distance - h)) / (2 * h)
    assert equations.depth_per_pixel(length, f, distance, MU) == pytest.approx(1 / slope, rel=1e-6)
    # the middle of eq. (2)
    assert equations.depth_per_pixel(length, f, distance, MU) == pytest.approx(-length * f / (MU * n**2))


@given(st.floats(4, 50), st.floats(30, 500))
def test_a_pixel_covers_what_the_camera_says(f: float, distance: float) -> None:
    slope = (extent(f, 8.001, distance) - extent(f, 7.999, distance)) / 0.002
    assert equations.lateral_per_pixel(f, distance, MU) == pytest.approx(1 / slope, rel=1e-6)


def test_a_wrong_focal_length_shifts_the_depth_by_its_share() -> None:
    n = extent(TRUE_FOCAL, LENGTH, DISTANCE)
    assert equations.true_distance(LENGTH, TRUE_FOCAL, n, MU) == pytest.approx(DISTANCE)
    assumed = equations.distance(LENGTH, FOCAL, n, MU)
    assert DISTANCE - assumed == pytest.approx(equations.depth_focal_error(DISTANCE, FOCAL, TRUE_FOCAL))


def lateral_difference(dn: float) -> float:
    """What ``dn`` px stand for through the true lens, less what they stand for through the assumed one."""
    return dn * LENGTH / extent(TRUE_FOCAL, LENGTH, DISTANCE) - dn * LENGTH / extent(FOCAL, LENGTH, DISTANCE)


def test_the_sixth_equation_holds_with_the_sign_of_its_middle() -> None:
    value = equations.lateral_focal_error(DISTANCE, 0.2, FOCAL, TRUE_FOCAL, MU)
    assert value == pytest.approx(lateral_difference(0.2), rel=1e-9)
    printed = DISTANCE * MU * 0.2 * (TRUE_FOCAL - FOCAL) / (FOCAL * TRUE_FOCAL)
    assert value == pytest.approx(-printed)


def test_the_term_that_the_paper_neglects_is_negligible_for_an_error_of_extraction_only() -> None:
    pixel = 0.2 * equations.lateral_per_pixel(FOCAL, DISTANCE, MU)
    noise = equations.lateral_focal_error(DISTANCE, 0.2, FOCAL, TRUE_FOCAL, MU)
    assert abs(noise) / pixel == pytest.approx(0.02 / 8.02)
    # a feature 1000 px off the axis at a distance known from elsewhere: 12 times the error of extraction
    offset = equations.lateral_focal_error(DISTANCE, 1000.0, FOCAL, TRUE_FOCAL, MU)
    assert abs(offset) > 12 * pixel
    # unless the distance is estimated with the same wrong focal length
    assumed = DISTANCE - equations.depth_focal_error(DISTANCE, FOCAL, TRUE_FOCAL)
    assert 1000 * MU * assumed / FOCAL == pytest.approx(1000 * MU * DISTANCE / TRUE_FOCAL)


def test_tensors_broadcast() -> None:
    d = torch.tensor([12.0, 32.0], dtype=F64)
    assert equations.depth_per_pixel(torch.tensor(8.0), torch.tensor(8.0), d, torch.tensor(MU)).shape == (2,)
