"""Bundle adjustment: Jacobians against differences, exact recovery, covariance against Monte Carlo."""

import math
from dataclasses import replace

import pytest
import torch

import torchpose as tp
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration import LENS_MODELS, calibrate_intrinsics
from torchpose.calibration.bundle import adjust
from torchpose.calibration.intrinsics import start_cameras
from torchpose.calibration.lenses import moved_camera
from torchpose.camera.derivatives import by_intrinsics

TRUE = {
    "pinhole": [],
    "brown4": [-0.08, 0.03, 2e-4, -1.5e-4],
    "brown5": [-0.08, 0.03, 2e-4, -1.5e-4, -0.01],
    "rational8": [0.1, 0.03, 2e-4, -1.5e-4, 0.02, 0.18, 0.01, 0.003],
    "kannala_brandt": [-0.03, 0.01, -0.004, 0.001],
}


def lens(name: str) -> tp.Camera:
    camera = scenes.camera(TRUE[name], model=LENS_MODELS[name][0])
    if name == "rational8":  # its terms can only be told apart far from the axis
        camera = replace(camera, matrix=camera.matrix * torch.tensor([[0.4, 1, 1], [1, 0.4, 1], [1, 1, 1]]))
    return camera


@pytest.mark.parametrize("name", TRUE)
def test_jacobian_by_intrinsics_is_that_of_differences(name: str) -> None:
    camera = lens(name)
    xy = 0.5 * torch.rand(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.25
    jacobian = by_intrinsics(camera, xy)
    n = jacobian.shape[-1]
    for k in range(n):
        step = torch.zeros(n, dtype=torch.float64)
        step[k] = 1e-5
        ahead, behind = moved_camera(camera, step), moved_camera(camera, -step)
        assert ahead is not None
        assert behind is not None
        difference = (ahead.distort(xy) - behind.distort(xy)) / 2e-5
        assert torch.allclose(jacobian[..., k], difference, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", TRUE)
def test_exact_views_give_the_exact_camera(name: str) -> None:
    true = lens(name)
    points = scenes.grid(40.0, 9, 7) if name == "rational8" else scenes.grid()
    pose = scenes.poses(true, 12)
    views = scenes.views(true, pose, points, said=1.0)
    found = calibrate_intrinsics(views, start_cameras(true.width, true.height, name), lens=name)
    error = scenes.intrinsics(found.camera) - scenes.intrinsics(true)
    assert float(error[:4].abs().max()) < 1e-4
    assert float(found.bundle.residual.abs().max()) < 1e-6
    assert torch.allclose(found.bundle.t, pose[1], atol=1e-4)
    assert not found.left_out


def test_covariance_is_the_scatter_of_repeated_calibrations() -> None:
    true = scenes.camera()
    pose, points = scenes.poses(true, 12), scenes.grid()
    trials = 40
    nees, pose_nees, chi2 = [], [], []
    for seed in range(trials):
        views = scenes.views(true, pose, points, sigma=0.05, seed=seed)
        found = calibrate_intrinsics(views, [true], lens="brown4")
        e = scenes.intrinsics(found.camera) - scenes.intrinsics(true)
        nees.append(float(e @ torch.linalg.solve(found.covariance, e)))
        d = (found.bundle.t - pose[1])[3]
        pose_nees.append(float(d @ torch.linalg.solve(found.pose_covariance[3, :3, :3], d)))
        chi2.append(found.reduced_chi2)
    # four standard deviations of the mean of chi-squared with 8 and with 3 degrees of freedom
    assert abs(sum(nees) / trials - 8) < 4 * math.sqrt(2 * 8 / trials)
    assert abs(sum(pose_nees) / trials - 3) < 4 * math.sqrt(2 * 3 / trials)
    assert abs(sum(chi2) / trials - 1) < 4 * math.sqrt(2 / (found.degrees * trials))


def test_gain_is_how_poses_follow_the_camera() -> None:
    true = scenes.camera()
    pose = scenes.poses(true, 5)
    views = scenes.views(true, pose, scenes.grid(), sigma=0.02)
    held = adjust(views, true, *pose, free=False)
    step = torch.tensor([0.3, -0.2, 0.4, 0.1, 1e-4, 0, 0, 0], dtype=torch.float64)
    moved = moved_camera(true, step)
    assert moved is not None
    again = adjust(views, moved, *pose, free=False)
    assert torch.allclose(again.t - held.t, (held.gain @ step)[:, :3], rtol=2e-2, atol=2e-5)
