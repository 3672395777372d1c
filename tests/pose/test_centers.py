"""Eq. (7) against the exact image of the common centre."""

from __future__ import annotations

import math

import pytest
import torch

from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics, rotations
from torchpose.pose import common_center, compensate
from torchpose.pose.centers import exact

F64 = torch.float64
FOCAL, DISTANCE = 3333.33, 160.0
RADII = torch.tensor([[5.0, 2.5]], dtype=F64)  # the paper's Table IV: diameters 10 and 5 mm


def circle_fit(tilt_deg: float, radius: float) -> tuple[EllipseFit, torch.Tensor]:
    """Exact ellipse of a tilted circle on the optical axis, and the image of its centre, px."""
    rotation = rotations.exp(torch.tensor([[math.radians(tilt_deg), 0.0, 0.0]], dtype=F64))
    center = torch.tensor([[0.0, 0.0, DISTANCE]], dtype=F64)
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)
    conic = conics.circle_image(rotation, center, normal, torch.tensor([radius], dtype=F64))
    to_normalised = torch.diag(torch.tensor([1 / FOCAL, 1 / FOCAL, 1.0], dtype=F64))
    params = conics.ellipse_from_conic(conics.from_matrix(to_normalised @ conic @ to_normalised))
    one = torch.ones(1, dtype=F64)
    return EllipseFit(params, 0.01 * torch.eye(5, dtype=F64)[None], one, one), torch.zeros(1, 2, dtype=F64)


@pytest.mark.parametrize("tilt_deg", [5.0, 10.0])
def test_table_four(tilt_deg: float) -> None:
    """At the paper's Table IV the outer centre is off by tenths of a pixel, the compensated one by less than 1e-3."""
    outer, truth = circle_fit(tilt_deg, 5.0)
    inner, _ = circle_fit(tilt_deg, 2.5)
    center, _ = compensate(outer, inner, RADII)
    raw = torch.linalg.vector_norm(outer.params[:, :2] - truth)
    tilt = math.radians(tilt_deg)
    assert raw == pytest.approx(FOCAL * 25 * math.sin(tilt) * math.cos(tilt) / DISTANCE**2, rel=0.01)
    assert torch.linalg.vector_norm(center - truth) < 1e-3


def test_residual_is_of_higher_order() -> None:
    """Eq. (7) is first order in r^2: halving both radii divides what it leaves by 16."""
    left = []
    for scale in (1.0, 0.5):
        outer, truth = circle_fit(60.0, 5.0 * scale)
        inner, _ = circle_fit(60.0, 2.5 * scale)
        left.append(torch.linalg.vector_norm(compensate(outer, inner, RADII)[0] - truth))
    assert left[0] / left[1] == pytest.approx(16, rel=0.05)


def test_covariance_is_that_of_the_linear_combination() -> None:
    outer, _ = circle_fit(10.0, 5.0)
    inner, _ = circle_fit(10.0, 2.5)
    _, covariance = compensate(outer, inner, RADII)
    k1, k2 = 25 / (25 - 6.25), 6.25 / (25 - 6.25)
    torch.testing.assert_close(covariance[0], 0.01 * (k1**2 + k2**2) * torch.eye(2, dtype=F64))


def test_no_ring() -> None:
    outer, _ = circle_fit(0.0, 5.0)
    none = torch.zeros(0, dtype=torch.int64)
    center, covariance = compensate(outer[none], outer[none], RADII[none])
    assert center.shape == (0, 2)
    assert covariance.shape == (0, 2, 2)


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0, 45.0, 70.0, 85.0])
def test_exact_at_any_tilt(tilt_deg: float) -> None:
    outer, truth = circle_fit(tilt_deg, 5.0)
    inner, _ = circle_fit(tilt_deg, 2.5)
    center, _ = common_center(outer, inner, RADII)
    torch.testing.assert_close(center, truth, rtol=0, atol=1e-9)


def test_exact_from_many_circles_off_the_axis() -> None:
    radii = torch.tensor([1.0, 2.0, 3.0, 4.5, 6.0], dtype=F64)
    rotation = rotations.exp(torch.tensor([0.9, -0.4, 0.2], dtype=F64))
    center = torch.tensor([30.0, -20.0, DISTANCE], dtype=F64)
    conic = conics.circle_image(rotation, center, torch.tensor([0.0, 0.0, 1.0], dtype=F64), radii)
    to_px = torch.tensor([[1 / FOCAL, 0, -700 / FOCAL], [0, 1 / FOCAL, -500 / FOCAL], [0, 0, 1.0]], dtype=F64)
    ellipses = conics.ellipse_from_conic(conics.from_matrix(to_px.T @ conic @ to_px))
    covariances = torch.eye(2, dtype=F64).expand(5, 2, 2)
    found, _ = exact(ellipses[[2, 0, 4, 1, 3]], covariances, radii[[2, 0, 4, 1, 3]])
    torch.testing.assert_close(found, center[:2] / center[2] * FOCAL + torch.tensor([700.0, 500.0], dtype=F64))


def test_exact_covariance_by_monte_carlo() -> None:
    """Noise on the centres alone, then on the shapes as well: these hardly matter."""
    g = torch.Generator().manual_seed(2)
    outer, truth = circle_fit(50.0, 5.0)
    inner, _ = circle_fit(50.0, 2.5)
    ellipses = torch.stack([outer.params[0], inner.params[0]]).repeat(20_000, 1, 1)
    noise = 0.01 * torch.randn(ellipses.shape, dtype=F64, generator=g)
    noise[..., 4] = 0
    covariances = 1e-4 * torch.eye(2, dtype=F64).expand(20_000, 2, 2, 2)
    found, covariance = exact(ellipses + noise, covariances, RADII.expand(20_000, 2))
    sample = (found - truth).T.cov()
    torch.testing.assert_close(sample, covariance[0], rtol=0.04, atol=5e-6)


def test_exact_of_a_fit_that_failed_is_nan() -> None:
    outer, _ = circle_fit(10.0, 5.0)
    inner, _ = circle_fit(10.0, 2.5)
    inner.params[:] = math.nan
    assert common_center(outer, inner, RADII)[0].isnan().all()
