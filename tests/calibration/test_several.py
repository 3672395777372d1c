"""Rigs of cameras in one adjustment: exact recovery, brute force, statistics, chains, and what is wrong."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

import torchpose as tp
from scripts import rig_calibration_statistics as statistics
from torchpose.calibration import Views
from torchpose.calibration.lenses import moved_camera
from torchpose.calibration.several import Located, RigCalibration, calibrate_rig
from torchpose.calibration.ties import check_connected
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

F64 = torch.float64


def held(scene: statistics.Drawn, views: list[Views]) -> list[Located]:
    """Every camera as it is, with the true poses of its views, some mm off."""
    found = []
    for number, own in enumerate(views):
        at = [int(name.removesuffix(".png")) for name in own.names]
        R, t = scene.rig.seen_by(number, scene.R[at], scene.t[at])
        off = torch.randn(len(at), 3, dtype=F64, generator=torch.Generator().manual_seed(number))
        found.append(Located(f"cam{number}", scene.rig.cameras[number], own, R, t + off))
    return found


def of_seed(
    cameras: int, moments: int, seed: int, sigma: float = statistics.SIGMA
) -> tuple[statistics.Drawn, list[Views]]:
    scene = statistics.drawn(cameras, moments, seed)
    return scene, [statistics.views_of(scene, number, seed, sigma) for number in range(cameras)]


@pytest.mark.parametrize("cameras", statistics.RIGS)
def test_exact_views_give_the_exact_rig(cameras: int) -> None:
    scene, views = of_seed(cameras, 10 * cameras + 10, 1, sigma=0.0)
    found = calibrate_rig(statistics.located(scene, views), lens=statistics.LENS)
    assert float(statistics.errors(found.rig, scene.rig)[:, :3].abs().max()) < 1e-5
    assert float(statistics.errors(found.rig, scene.rig)[:, 3:].abs().max()) < 1e-7
    if cameras > 2:  # the ends of the arc never see the plate together
        assert int(found.common[0, -1]) == 0
    for camera, true in zip(found.rig.cameras, scene.rig.cameras, strict=True):
        torch.testing.assert_close(camera.matrix, true.matrix, rtol=0, atol=1e-4)


def test_places_and_their_covariance_are_those_of_brute_force() -> None:
    """Two cameras that are known and four moments, by scipy from numbers alone."""
    scene, views = of_seed(2, 30, 3)
    both = [name for name in views[0].names if name in views[1].names][:4]
    views = [own.of_views(torch.tensor([name in both for name in own.names])) for own in views]
    found = calibrate_rig(held(scene, views), lens=None)

    def residuals(x: np.ndarray) -> np.ndarray:
        values = torch.as_tensor(x, dtype=F64).view(-1, 6)
        off = []
        for number, own in enumerate(views):
            R, t = rotations.exp(values[1:, 3:]), values[1:, :3]
            if number:
                R, t = rotations.exp(values[0, 3:]) @ R, t @ rotations.exp(values[0, 3:]).mT + values[0, :3]
            at = (R[own.view] @ own.points[..., None])[..., 0] + t[own.view]
            off.append((scene.rig.cameras[number].project(at) - own.pixels).flatten() / statistics.SIGMA)
        return torch.cat(off).numpy()

    at = [int(name.removesuffix(".png")) for name in both]
    places = torch.cat([scene.rig.t[1:], rotations.log(scene.rig.R[1:])], -1)
    start = torch.cat([places, torch.cat([scene.t[at], rotations.log(scene.R[at])], -1)]).flatten()
    fit = least_squares(residuals, start.numpy(), x_scale="jac", xtol=1e-14, ftol=1e-14)
    shift, turn = torch.as_tensor(fit.x[:3]), rotations.exp(torch.as_tensor(fit.x[3:6]))
    torch.testing.assert_close(found.rig.t[1], shift, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.rig.R[1], turn, rtol=0, atol=1e-7)
    # of scipy's rotation vector to a turn from the left, by differences
    step = 1e-6 * torch.eye(3, dtype=F64)
    vector = torch.as_tensor(fit.x[3:6])
    by_vector = torch.stack([rotations.log(rotations.exp(vector + s) @ turn.mT) for s in step], -1) / 1e-6
    gain = torch.block_diag(torch.eye(3, dtype=F64), by_vector)
    expected = gain @ torch.as_tensor(np.linalg.inv(fit.jac.T @ fit.jac))[:6, :6] @ gain.mT
    assert found.rig.covariance is not None
    scale = expected.diagonal().rsqrt()
    torch.testing.assert_close(
        found.rig.covariance * scale * scale[:, None], expected * scale * scale[:, None], rtol=0, atol=1e-3
    )


def test_errors_of_places_and_lenses_are_within_their_covariance() -> None:
    rows = [statistics.drawn_set(3, 40, seed, compare=False) for seed in range(3)]
    freedom = 12 * len(rows)
    # four standard deviations of chi-squared with that freedom
    assert abs(sum(row.nees for row in rows) - freedom) < 4 * math.sqrt(2 * freedom)
    for row in rows:
        assert row.found.common_sigma_px < 0.5 * statistics.SIGMA  # by chance, more than none
        assert row.found.joint.shape == (3 * 8 + 12, 3 * 8 + 12)


def test_known_cameras_carry_their_covariance_to_the_places() -> None:
    """By differences of calibrations with cameras a deviation off."""
    scene, views = of_seed(2, 30, 5)
    sigma = torch.tensor([0.3, 0.0, 0.4, 0.0], dtype=F64)

    def calibrated(step: Tensor, number: int, covariance: Tensor | None = None) -> RigCalibration:
        cameras = held(scene, views)
        moved = moved_camera(cameras[number].camera, torch.nn.functional.pad(step, (0, 4)))
        assert moved is not None
        cameras[number] = replace(cameras[number], camera=moved)
        cameras = [replace(one, camera=replace(one.camera, covariance=covariance)) for one in cameras]
        return calibrate_rig(cameras, lens=None)

    none = torch.zeros(4, dtype=F64)
    exact, carried = calibrated(none, 0), calibrated(none, 0, torch.diag(sigma.square()))
    columns = []
    for number in range(2):
        for step in torch.diag(0.1 * sigma)[sigma > 0]:
            one, two = calibrated(step, number).rig, calibrated(-step, number).rig
            columns.append(statistics.errors(two, one).flatten() / 0.2)
    gain = torch.stack(columns, -1)
    assert exact.rig.covariance is not None
    assert carried.rig.covariance is not None
    expected = exact.rig.covariance + gain @ gain.mT
    scale = expected.diagonal().rsqrt()
    off = (carried.rig.covariance - expected) * scale * scale[:, None]
    assert float(off.abs().max()) < 0.03
    assert carried.rig.cameras[0].covariance is not None


def test_cameras_that_no_moment_ties_together_are_named() -> None:
    scene, views = of_seed(3, 40, 2)
    in_first = set(views[0].names)
    apart = [own.of_views(torch.tensor([name not in in_first for name in own.names])) for own in views[1:]]
    with pytest.raises(ConfigError, match=r"INPUT: cameras cam0 \| cam1 and cam2 are apart: .*; add moments"):
        calibrate_rig(held(scene, [views[0], *apart]), lens=None)
    common = torch.tensor([[4, 0, 2, 0], [0, 4, 0, 1], [2, 0, 4, 0], [0, 1, 0, 4]])
    with pytest.raises(ConfigError, match=r"a and c \| b and d are apart"):
        check_connected("abcd", common)
    common[0, 1] = common[1, 0] = 1
    check_connected("abcd", common)


def test_a_moment_in_which_the_target_moved_is_left_out_and_told() -> None:
    """5 mm between the pictures of two cameras; the others keep their places."""
    scene, views = of_seed(2, 30, 4)
    odd = next(name for name in views[0].names if name in views[1].names)
    at = views[1].names.index(odd)
    shifted = torch.where((views[1].view == at)[:, None], views[1].pixels + 35.0, views[1].pixels)
    found = calibrate_rig(held(scene, [views[0], replace(views[1], pixels=shifted)]), lens=None)
    assert found.left_out >= 20
    error = statistics.errors(found.rig, scene.rig).flatten()
    assert found.rig.covariance is not None
    assert float(error @ torch.linalg.solve(found.rig.covariance, error)) < 6 + 4 * math.sqrt(12)
    assert any(odd in warning and "moved" in warning for warning in found.warnings)


def test_few_ties_are_told() -> None:
    scene, views = of_seed(2, 30, 6)
    both = [name for name in views[0].names if name in views[1].names]
    keep = torch.tensor([name not in both[2:] for name in views[1].names])
    found = calibrate_rig(held(scene, [views[0], views[1].of_views(keep)]), lens=None)
    assert [warning for warning in found.warnings if "tied to the others by 2 moments" in warning]


def test_a_chain_is_as_loose_as_its_links() -> None:
    """Along six cameras on an arc each is known worse than the one before."""
    scene, views = of_seed(6, 60, 0)
    found = calibrate_rig(held(scene, views), lens=None)
    assert found.rig.covariance is not None
    sizes = found.rig.covariance.diagonal().view(-1, 6)[:, :3].sum(-1).tolist()
    assert all(a < b for a, b in pairwise(sizes))
    assert isinstance(found.rig, tp.CameraRig)
