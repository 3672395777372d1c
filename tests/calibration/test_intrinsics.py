"""What calibration does with doubtful data: outliers, unknown noise, few views, views that are alike."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchpose as tp
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.intrinsics import common_sigma, locate_views, start_cameras
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

F64 = torch.float64
CAMERA = scenes.camera()
STARTS = start_cameras(CAMERA.width, CAMERA.height, "brown4")


def test_wrong_points_are_left_out() -> None:
    views = scenes.views(CAMERA, scenes.poses(CAMERA, 12), scenes.grid(), sigma=0.02)
    pixels = views.pixels.clone()
    pixels[[17, 100]] += torch.tensor([3.0, -2.0], dtype=torch.float64)
    found = calibrate_intrinsics(replace(views, pixels=pixels), STARTS, lens="brown4")
    assert found.left_out == 2
    assert not {17, 100} & set((found.views.view * 20 + found.views.point).tolist())
    assert abs(float(found.camera.matrix[0, 0]) - 1503) < 5 * float(found.covariance[0, 0].sqrt())


@pytest.mark.parametrize("said", [0.0, 0.01], ids=["unknown", "too small"])
def test_common_error_is_found(said: float) -> None:
    views = scenes.views(CAMERA, scenes.poses(CAMERA, 15), scenes.grid(), sigma=0.1, said=said)
    found = calibrate_intrinsics(views, STARTS, lens="brown4")
    assert found.common_sigma_px == pytest.approx((0.01 - said**2) ** 0.5, rel=0.1)
    assert found.reduced_chi2 == pytest.approx(1, abs=1e-3)


def test_no_common_error_where_the_covariances_hold() -> None:
    views = scenes.views(CAMERA, scenes.poses(CAMERA, 15), scenes.grid(), sigma=0.1)
    assert calibrate_intrinsics(views, STARTS, lens="brown4").common_sigma_px == 0


@given(sigma=st.floats(1e-4, 10), seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_common_sigma_of_points_without_covariance_is_their_rms(sigma: float, seed: int) -> None:
    residual = sigma * torch.randn(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    expected = float((residual.square().sum() / 70).sqrt())
    assert common_sigma(residual, torch.zeros(50, 2, 2, dtype=torch.float64), 70) == pytest.approx(expected, rel=1e-4)


def test_few_views_are_refused() -> None:
    with pytest.raises(ConfigError, match="2 usable views"):
        calibrate_intrinsics(scenes.views(CAMERA, scenes.poses(CAMERA, 2), scenes.grid(), sigma=0.1), STARTS)
    few = scenes.views(CAMERA, scenes.poses(CAMERA, 4, tilt=(20, 30)), scenes.grid(40.0, 2, 2), sigma=0.1)
    with pytest.raises(ConfigError, match="4 views with 16 points do not determine 8 intrinsics"):
        calibrate_intrinsics(few, STARTS, lens="brown4")


def test_frontal_views_are_refused_or_doubted() -> None:
    plain = scenes.camera([])
    frontal = scenes.views(plain, scenes.poses(plain, 10, tilt=(0, 0)), scenes.grid(), said=0.1)
    with pytest.raises(ConfigError, match="too alike"):
        calibrate_intrinsics(frontal, [plain], lens="pinhole")
    little = scenes.views(CAMERA, scenes.poses(CAMERA, 10, tilt=(1, 3)), scenes.grid(), sigma=0.05)
    found = calibrate_intrinsics(little, [CAMERA], lens="brown4")
    assert any("tilts differ" in w for w in found.warnings)
    assert any("focal length is known to" in w for w in found.warnings)
    varied = scenes.views(CAMERA, scenes.poses(CAMERA, 15), scenes.grid(20, 6, 4), sigma=0.05)
    assert not calibrate_intrinsics(varied, [CAMERA], lens="brown4").warnings


def test_views_of_a_known_camera() -> None:
    pose = scenes.poses(CAMERA, 4)
    views, bundle = locate_views(scenes.views(CAMERA, pose, scenes.grid(), sigma=0.02), CAMERA)
    assert len(views) == 4
    assert bundle.camera is CAMERA
    error = (bundle.t - pose[1]).abs() / bundle.pose_covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sqrt()
    assert float(error.max()) < 5


def test_unknown_lens_is_named() -> None:
    with pytest.raises(ConfigError, match="brown6"):
        start_cameras(10, 10, "brown6")


def test_errors_of_pixels_are_warned_of() -> None:
    views = scenes.views(CAMERA, scenes.poses(CAMERA, 15), scenes.grid(20, 6, 4), sigma=3.0, said=0.01)
    assert any("px off" in w for w in calibrate_intrinsics(views, [CAMERA], lens="brown4").warnings)


def _chessboards(distortion: list[float], count: int = 13, noise: float = 0.2) -> tuple[tp.Camera, Views]:
    """Views of 9 x 6 corners by a camera of 640 x 480 px, all over the frame, covariances unknown."""
    cam = tp.Camera(640, 480, [[532.0, 0, 342], [0, 532, 233], [0, 0, 1]], distortion)
    u = torch.rand(count, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    azimuth = 2 * math.pi * torch.arange(count, dtype=F64) / count
    turn = torch.stack([azimuth.cos(), azimuth.sin(), 0.3 * azimuth.sin()], -1)
    t = torch.stack([(u[:, 0] - 0.5) * 230, (u[:, 1] - 0.5) * 170, 330 + 120 * u[:, 2]], -1)
    pose = rotations.exp((0.2 + 0.5 * u[:, 2:]) * turn), t
    return cam, scenes.views(cam, pose, scenes.grid(25.0, 9, 6), sigma=noise, said=0.0)


def test_a_start_that_loses_views_is_no_better_for_it() -> None:
    """Where the model of a start folds back within the frame, views near the border have no pose from it."""
    cam, views = _chessboards([-0.3, 0.14, 1e-3, 3e-4, 0.0])
    plain = start_cameras(640, 480, "brown5")[1]
    folds = replace(plain, distortion=torch.tensor([-0.9, 0, 0, 0, 0], dtype=F64))
    found = calibrate_intrinsics(views, [folds, plain])
    assert len(found.views) == len(views)
    error = scenes.intrinsics(found.camera) - scenes.intrinsics(cam)
    assert float(error @ torch.linalg.solve(found.covariance, error)) < 34  # 9 degrees of freedom, 1e-4


def test_points_that_are_mixed_up_are_no_calibration() -> None:
    """What a chessboard search makes of a board of rings: every view shows something, no two the same."""
    _, views = _chessboards([-0.3, 0.14, 1e-3, 3e-4, 0.0])
    g = torch.Generator().manual_seed(3)
    moved = 30 * torch.randn(views.pixels.shape, dtype=F64, generator=g)
    with pytest.raises(tp.ConfigError, match=r"px apart fit to|agree with each other"):
        calibrate_intrinsics(replace(views, pixels=views.pixels + moved), start_cameras(640, 480, "brown5"))


def test_a_rational_lens_whose_coefficients_cancel_is_refused() -> None:
    _, views = _chessboards([-0.3, 0.14, 1e-3, 3e-4, 0.0])
    with pytest.raises(tp.ConfigError, match="use brown5"):
        calibrate_intrinsics(views, start_cameras(640, 480, "rational8"), lens="rational8")
