"""Pose errors against scipy's rotations and distributions, and against Monte Carlo."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from torchpose.analysis import pose_errors, rms
from torchpose.geometry import rotations
from torchpose.io.truth import Truth
from torchpose.results import Detections, Poses

POSES = 4000


def random_covariance(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Correlated, with the scales of a real pose: 0.3 um, 1.5 um in depth, 50 urad, 5 urad about the axis."""
    scale = torch.tensor([3e-4, 3e-4, 1.5e-3, 5e-5, 5e-5, 5e-6], dtype=torch.float64)
    mixed = torch.randn(*shape, 6, 12, generator=generator, dtype=torch.float64)
    return scale[:, None] * (mixed @ mixed.mT / 12) * scale


@pytest.fixture(scope="module")
def drawn() -> tuple[SimpleNamespace, SimpleNamespace, torch.Tensor]:
    """Estimates scattered around the truth by their covariance, in the convention of `Poses`: R_true = exp(w) R."""
    generator = torch.Generator().manual_seed(3)
    covariance = random_covariance(generator, POSES)
    noise = torch.linalg.cholesky(covariance) @ torch.randn(POSES, 6, 1, generator=generator, dtype=torch.float64)
    t = torch.randn(POSES, 3, generator=generator, dtype=torch.float64) * 20
    vector = torch.randn(POSES, 3, generator=generator, dtype=torch.float64)
    estimated = SimpleNamespace(R=rotations.exp(vector), t=t, covariance=covariance)
    truth = SimpleNamespace(R=rotations.exp(noise[:, 3:, 0]) @ estimated.R, t=t + noise[:, :3, 0])
    return estimated, truth, noise[..., 0]


def test_errors_are_estimate_minus_truth(drawn: tuple[SimpleNamespace, SimpleNamespace, torch.Tensor]) -> None:
    estimated, truth, noise = drawn
    errors = pose_errors(estimated, truth)
    torch.testing.assert_close(errors.translation, -noise[:, :3], rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.rotation, -noise[:, 3:], rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.depth, -noise[:, 2], rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.lateral, noise[:, 0].hypot(noise[:, 1]), rtol=0, atol=1e-12)


def test_rotation_against_scipy() -> None:
    generator = np.random.default_rng(1)
    a, b = Rotation.random(50, generator), Rotation.random(50, generator)
    estimated = SimpleNamespace(
        R=torch.from_numpy(a.as_matrix()),
        t=torch.zeros(50, 3, dtype=torch.float64),
        covariance=torch.eye(6, dtype=torch.float64).expand(50, 6, 6),
    )
    errors = pose_errors(estimated, SimpleNamespace(R=torch.from_numpy(b.as_matrix()), t=estimated.t))
    between = a * b.inv()
    np.testing.assert_allclose(errors.rotation.numpy(), between.as_rotvec(), rtol=0, atol=1e-12)
    np.testing.assert_allclose(errors.angle.numpy(), between.magnitude(), rtol=0, atol=1e-12)


def test_nees_is_chi_squared(drawn: tuple[SimpleNamespace, SimpleNamespace, torch.Tensor]) -> None:
    estimated, truth, _ = drawn
    nees = pose_errors(estimated, truth).nees.numpy()
    assert kstest(nees, chi2(6).cdf).pvalue > 1e-3
    # half the standard deviation everywhere is found out
    confident = SimpleNamespace(R=estimated.R, t=estimated.t, covariance=estimated.covariance / 4)
    np.testing.assert_allclose(pose_errors(confident, truth).nees.numpy(), 4 * nees, rtol=1e-9)


def test_nees_uses_correlations(drawn: tuple[SimpleNamespace, SimpleNamespace, torch.Tensor]) -> None:
    estimated, truth, noise = drawn
    nees = pose_errors(estimated, truth).nees.numpy()
    e, covariance = noise.numpy(), estimated.covariance.numpy()
    np.testing.assert_allclose(nees, np.einsum("ni,nij,nj->n", e, np.linalg.inv(covariance), e), rtol=1e-6)


def test_leading_shape_and_broadcast() -> None:
    generator = torch.Generator().manual_seed(5)
    vector = 0.1 * torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
    t = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
    estimated = SimpleNamespace(R=rotations.exp(vector), t=t, covariance=random_covariance(generator, 2, 3))
    truth = SimpleNamespace(R=torch.eye(3, dtype=torch.float64), t=torch.zeros(3, dtype=torch.float64))
    errors = pose_errors(estimated, truth)
    assert errors.nees.shape == errors.angle.shape == errors.lateral.shape == (2, 3)
    torch.testing.assert_close(errors.rotation, vector, rtol=0, atol=1e-12)
    torch.testing.assert_close(errors.translation, t)


def test_rows_without_a_pose_are_nan_and_left_out() -> None:
    one = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
    unit = torch.eye(6, dtype=torch.float64).repeat(3, 1, 1)
    t = torch.tensor([[3e-3, 4e-3, 0.0]], dtype=torch.float64).repeat(3, 1)
    estimated = SimpleNamespace(R=one.clone(), t=t, covariance=unit)
    estimated.R[1], estimated.t[1], estimated.covariance[1] = torch.nan, torch.nan, torch.nan
    estimated.covariance[2, 5, 5] = -1.0
    truth = Truth(["a", "b", "c"], ["x"] * 3, torch.zeros_like(t), torch.zeros_like(t))
    errors = pose_errors(estimated, truth)
    assert errors.angle.isnan().tolist() == errors.lateral.isnan().tolist() == [False, True, False]
    assert errors.nees.isnan().tolist() == [False, True, True]
    assert rms(errors.lateral).item() == pytest.approx(5e-3, abs=1e-15)
    assert rms(errors.lateral[1:2]).isnan()


def test_poses_and_truth_are_what_is_compared() -> None:
    """The result type of the pipeline and the truth file fit the two arguments."""
    rows = 2
    zeros: dict[str, Any] = {
        name: torch.zeros(rows, dtype=torch.float64) for name in ("rms", "chi2", "rms_alt", "chi2_alt", "residual_chi2")
    }
    names = ("frame", "target", "instance", "copies", "status", "reason", "markers", "misfit", "freedom")
    whole: dict[str, Any] = {n: torch.zeros(rows, dtype=torch.int64) for n in names}
    eye = torch.eye(3, dtype=torch.float64).repeat(rows, 1, 1)
    t = torch.ones(rows, 3, dtype=torch.float64)
    covariance = torch.eye(6, dtype=torch.float64).repeat(rows, 1, 1)
    none = Detections(
        **{name: torch.zeros(0, dtype=torch.int64) for name in ("frame", "target", "instance", "marker")},
        **{name: torch.zeros(0, size) for name, size in (("center", 2), ("outer", 5), ("inner", 5))},
        center_cov=torch.zeros(0, 2, 2),
    )
    parts: dict[str, Any] = {
        "covariance": covariance,
        "noise": covariance,
        "systematic": covariance[..., :0],
        "place": covariance[:, :4, :5],
    }
    poses = Poses(R=eye, t=t, R_alt=eye, t_alt=t, detections=none, **parts, **zeros, **whole)
    truth = Truth(["a", "b"], ["x", "x"], torch.zeros_like(t), torch.zeros_like(t))
    assert pose_errors(poses, truth).nees.tolist() == [3.0, 3.0]
