"""Hand-eye: exact without noise, covariance right with it, one clear error where the motion is not enough."""

import math
from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.calibration import calibration_scenes as scenes
from torchpose.calibration import calibrate_hand_eye
from torchpose.calibration.hand_eye import calibrate_mount, linear_start
from torchpose.calibration.intrinsics import locate_views
from torchpose.calibration.session import calibrate_robot
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

MOUNTS = ("base", "tool")
SIGMA = torch.tensor([0.002, 0.002, 0.01, 2e-5, 2e-5, 1e-5], dtype=torch.float64)  # of the target's poses


def disturbed(pose: scenes.Transform, sigma: torch.Tensor, seed: int) -> scenes.Transform:
    """Poses with noise (6,) in mm and rad."""
    e = sigma * torch.randn(len(pose[1]), 6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return rotations.exp(e[:, 3:]) @ pose[0], pose[1] + e[:, :3]


@given(st.integers(0, 10**6), st.sampled_from(MOUNTS))
@settings(max_examples=20, deadline=None)
def test_linear_start_is_exact_without_noise(seed: int, mount: str) -> None:
    vectors = torch.randn(8, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    b = (rotations.exp(vectors[:, :3]), 100 * vectors[:, 3:])
    robot = scenes.robot_poses(mount, b)
    a = robot if mount == "tool" else rotations.inverse(*robot)
    for found, true in zip(linear_start(a, b), scenes.rig(mount), strict=True):
        assert torch.allclose(found[0], true[0], atol=1e-9)
        assert torch.allclose(found[1], true[1], atol=1e-6)


def test_a_fit_that_is_lost_is_no_mount() -> None:
    """Covariances that have no inverse, as where the wrong mount's fit has gone to infinity."""
    true = scenes.poses(scenes.camera(), 12, seed=3)
    exact = torch.zeros(12, 6, 6, dtype=torch.float64)
    lost = calibrate_hand_eye(scenes.robot_poses("tool", true), true, exact, "tool", robot_sigma=(0.0, 0.0))
    assert math.isnan(lost.chi2)
    with pytest.raises(ConfigError, match="robot and target poses disagree"):
        calibrate_mount(scenes.robot_poses("tool", true), true, exact, robot_sigma=(0.0, 0.0))


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("known", [True, False], ids=["noise known", "noise estimated"])
def test_errors_are_what_the_covariance_says(mount: Literal["base", "tool"], known: bool) -> None:
    noise, trials = (0.02, 1e-4), 40
    sigma = torch.tensor([noise[0]] * 3 + [noise[1]] * 3, dtype=torch.float64)
    x, z = scenes.rig(mount)
    nees, estimated = [], []
    for seed in range(trials):
        true = scenes.poses(scenes.camera(), 20, seed=seed)
        fit = calibrate_hand_eye(
            disturbed(scenes.robot_poses(mount, true), sigma, 10_000 + seed),
            disturbed(true, SIGMA, seed),
            torch.diag(SIGMA**2).expand(20, 6, 6),
            mount,
            robot_sigma=noise if known else None,
        )
        e = torch.cat(
            [
                x[1] - fit.hand_eye.translation,
                rotations.log(x[0] @ fit.hand_eye.rotation.mT),
                z[1] - fit.target_translation,
                rotations.log(z[0] @ fit.target_rotation.mT),
            ]
        )
        nees.append(float(e @ torch.linalg.solve(fit.covariance, e)))
        estimated.append((fit.robot_sigma_mm / noise[0], fit.robot_sigma_rad / noise[1]))
    # noise estimated from 108 degrees of freedom widens the law a little
    assert abs(sum(nees) / trials - 12) < 4 * math.sqrt(2 * 12 / trials)
    if not known:
        assert torch.allclose(torch.tensor(estimated).mean(0), torch.ones(2), atol=0.08)


def test_errors_of_the_intrinsics_shift_all_poses_together() -> None:
    true = scenes.poses(scenes.camera(), 12)
    robot = scenes.robot_poses("base", true)
    spread = torch.diag(SIGMA**2).expand(12, 6, 6)
    # a focal length 0.1 % too long: all distances grow by as much
    gain = torch.zeros(12, 6, 1, dtype=torch.float64)
    gain[:, 2, 0] = true[1][:, 2] / 1500
    covariance = torch.tensor([[2.25]], dtype=torch.float64)
    still = calibrate_hand_eye(robot, true, spread, "base", robot_sigma=(0.01, 1e-5))
    unsure = calibrate_hand_eye(robot, true, spread, "base", robot_sigma=(0.01, 1e-5), intrinsics=(gain, covariance))
    shifted = (true[0], true[1] + 1.5 * gain[..., :3, 0])
    moved = calibrate_hand_eye(robot, shifted, spread, "base", robot_sigma=(0.01, 1e-5))
    change = moved.hand_eye.translation - still.hand_eye.translation
    extra = (unsure.covariance - still.covariance)[:3, :3]
    assert torch.allclose(extra, change[:, None] * change, rtol=0.05, atol=1e-6)


def test_motion_that_is_not_enough_is_named() -> None:
    seen = scenes.poses(scenes.camera(), 8)
    spread = torch.diag(SIGMA**2).expand(8, 6, 6)
    shift = torch.randn(8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    same = torch.eye(3, dtype=torch.float64).expand(8, 3, 3)
    with pytest.raises(ConfigError, match="does not turn"):
        calibrate_hand_eye((same, shift), seen, spread, "base")
    about_z = torch.nn.functional.pad(torch.linspace(-1, 1, 8, dtype=torch.float64)[:, None], (2, 0))
    with pytest.raises(ConfigError, match="one axis only"):
        calibrate_hand_eye((rotations.exp(about_z), shift), seen, spread, "base")
    with pytest.raises(ConfigError, match="3 poses"):
        calibrate_hand_eye((same[:3], shift[:3]), (seen[0][:3], seen[1][:3]), spread[:3], "tool")


@pytest.mark.parametrize("mount", MOUNTS)
def test_mount_follows_from_the_poses(mount: str) -> None:
    camera = scenes.camera()
    true = scenes.poses(camera, 10)
    views, bundle = locate_views(scenes.views(camera, true, scenes.grid(), sigma=0.01), camera)
    noise = torch.tensor([0.02] * 3 + [1e-4] * 3, dtype=torch.float64)
    r, t = disturbed(scenes.robot_poses(mount, true), noise, 7)
    poses = dict(zip(views.names, torch.cat([t, rotations.log(r)], -1).tolist(), strict=True))
    fit = calibrate_robot(views, bundle, None, poses)
    assert fit.hand_eye.mount == mount
    assert fit.hand_eye.covariance is not None
    error = fit.hand_eye.translation - scenes.rig(mount)[0][1]
    assert float((error / fit.hand_eye.covariance.diagonal()[:3].sqrt()).abs().max()) < 5
    # the poses of other frames
    mixed = dict(zip(views.names, [*list(poses.values())[3:], *list(poses.values())[:3]], strict=True))
    with pytest.raises(ConfigError, match="robot and target poses disagree"):
        calibrate_robot(views, bundle, None, mixed)
