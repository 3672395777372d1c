"""Cameras without a common view, tied by a robot: derivatives, noise, brute force, statistics, and what is missing."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares, minimize
from torch import Tensor

from scripts import rig_calibration_statistics as statistics
from tests.calibration.test_several import held, of_seed
from torchpose.calibration import Views
from torchpose.calibration.hand_eye import restricted_noise
from torchpose.calibration.plate import Plate
from torchpose.calibration.rig_session import RobotPoses, hand_eye_of
from torchpose.calibration.robot import Robot
from torchpose.calibration.several import RigCalibration, calibrate_rig
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

F64 = torch.float64
MOUNTS: tuple[Literal["base", "tool"], ...] = ("base", "tool")


def random_transforms(count: int, seed: int) -> tuple[Tensor, Tensor]:
    vectors = torch.randn(count, 6, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return rotations.exp(vectors[:, :3]), 100 * vectors[:, 3:]


def tied(
    mount: Literal["base", "tool"], seed: int, cameras: int = 2, moments: int = 40
) -> tuple[RigCalibration, Tensor]:
    """A rig of known lenses whose cameras share no moment, and the errors of its places."""
    scene, views = of_seed(cameras, moments, seed)
    robot = statistics.robot_poses(scene, mount, seed)
    found = calibrate_rig(held(scene, statistics.shared_out(views)), lens=None, robot=robot)
    return found, statistics.errors(found.rig, scene.rig).flatten()


def nees(found: RigCalibration, off: Tensor) -> float:
    assert found.rig.covariance is not None
    return float(off @ torch.linalg.solve(found.rig.covariance, off))


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_chain_closes_and_its_derivatives_are_those_of_differences(mount: Literal["base", "tool"]) -> None:
    (x, z), (R, t) = (((r[0], s[0]) for r, s in (random_transforms(1, k) for k in (1, 2)))), random_transforms(5, 3)
    y = rotations.compose(*x, R, t)
    whole = (
        rotations.compose(*y, *rotations.inverse(*z))
        if mount == "base"
        else rotations.compose(*z, *rotations.inverse(*y))
    )
    robot = Robot(*whole, mount, x, z, (0.5, 0.25))
    closure = robot.closed(x, z, R, t)
    torch.testing.assert_close(closure.residual, torch.zeros(5, 6, dtype=F64), rtol=0, atol=1e-12)
    assert closure.weight[0].tolist() == [4.0] * 3 + [16.0] * 3

    def moved(transform: tuple[Tensor, Tensor], step: Tensor) -> tuple[Tensor, Tensor]:
        return rotations.exp(step[3:]) @ transform[0], transform[1] + step[:3]

    for k in range(6):
        step = 1e-6 * torch.eye(6, dtype=F64)[k]
        ends = [
            [
                robot.closed(moved(x, s), z, R, t),
                robot.closed(x, moved(z, s), R, t),
                robot.closed(x, z, *moved((R, t), s)),
            ]
            for s in (step, -step)
        ]
        by_x, by_z, by_view = ((b.residual - a.residual) / 2e-6 for a, b in zip(*ends, strict=True))
        for found, expected in (
            (closure.by_chain[..., k], by_x),
            (closure.by_chain[..., 6 + k], by_z),
            (closure.by_view[..., k], by_view),
        ):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_the_noise_is_that_of_the_dense_restricted_likelihood() -> None:
    """Of numbers alone, with something known of the unknowns, by scipy."""
    g = torch.Generator().manual_seed(5)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=F64, generator=g)

    count, size = 12, 4
    columns, root, known = normal(count, 6, size), 0.3 * normal(count, 6, 6), normal(size, 2)
    covariance, information = root @ root.mT + 0.05 * torch.eye(6, dtype=F64), known @ known.mT
    parts = torch.stack(
        [torch.diag(torch.tensor([1.0] * 3 + [0.0] * 3)), torch.diag(torch.tensor([0.0] * 3 + [1.0] * 3))]
    )
    parts = parts.to(F64)[:, None].expand(2, count, 6, 6)
    right, y = information @ normal(size, 1), normal(count, 6) * torch.tensor([1.0] * 3 + [0.6] * 3, dtype=F64)

    def minus_log_likelihood(log: np.ndarray) -> float:
        variance = torch.as_tensor(np.exp(2 * log))
        spread = covariance + (variance[:, None, None, None] * parts).sum(0)
        whole, x, seen = torch.block_diag(*spread), columns.flatten(0, 1), y.flatten()
        inner = information + x.mT @ torch.linalg.solve(whole, x)
        pull = right[:, 0] + x.mT @ torch.linalg.solve(whole, seen)
        square = seen @ torch.linalg.solve(whole, seen) - pull @ torch.linalg.solve(inner, pull)
        return float(torch.logdet(whole) + torch.logdet(inner) + square)

    best = minimize(minus_log_likelihood, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12})
    found = restricted_noise(y, columns, covariance, parts, torch.cat([information, right], -1), (3.0, 3.0))
    np.testing.assert_allclose(found, np.exp(best.x), rtol=1e-5)


@pytest.mark.parametrize("mount", MOUNTS)
def test_exact_views_and_poses_give_the_exact_rig(mount: Literal["base", "tool"]) -> None:
    """Two cameras that see the target together and one that does so alone, lenses unknown."""
    scene, views = of_seed(3, 60, 2, sigma=0.0)
    apart = [
        own.of_views(torch.tensor([int(name.removesuffix(".png")) % 2 == (k == 2) for name in own.names]))
        for k, own in enumerate(views)
    ]
    robot = statistics.robot_poses(scene, mount, 0, noise=(0.0, 0.0))
    found = calibrate_rig(statistics.located(scene, apart), lens=statistics.LENS, robot=robot)
    assert found.common[:2, 2].tolist() == [0, 0]
    assert int(found.common[0, 1]) > 0
    off = statistics.errors(found.rig, scene.rig)
    assert float(off[:, :3].abs().max()) < 1e-4
    assert float(off[:, 3:].abs().max()) < 1e-6
    assert found.hand_eye is not None
    assert found.hand_eye.hand_eye.mount == mount
    assert found.hand_eye.robot_sigma_mm < 1e-3


def test_places_and_their_covariance_are_those_of_brute_force() -> None:
    """Two cameras that are known, four moments of each, by scipy from numbers alone, at the noise that was found."""
    scene, views = of_seed(2, 40, 3)
    views = statistics.shared_out(views)
    views = [own.of_views(torch.arange(len(own)) < 4) for own in views]
    robot = statistics.robot_poses(scene, "tool", 3)
    found = calibrate_rig(held(scene, views), lens=None, robot=robot)
    assert found.hand_eye is not None
    sigma = np.repeat([found.hand_eye.robot_sigma_mm, found.hand_eye.robot_sigma_rad], 3)
    names = [name for own in views for name in own.names]
    at = torch.tensor([int(name.removesuffix(".png")) for name in names])
    said = torch.tensor([robot[name] for name in names], dtype=F64)

    def transform(values: Tensor) -> tuple[Tensor, Tensor]:
        return rotations.exp(values[..., 3:]), values[..., :3]

    def residuals(numbers: np.ndarray) -> np.ndarray:
        values = torch.as_tensor(numbers, dtype=F64).view(-1, 6)
        place, x, z, (R, t) = *(transform(values[k]) for k in range(3)), transform(values[3:])
        off, first = [], 0
        for number, own in enumerate(views):
            rows = slice(first, first + len(own))
            pose = (R[rows], t[rows]) if number == 0 else rotations.compose(*place, R[rows], t[rows])
            point = (pose[0][own.view] @ own.points[..., None])[..., 0] + pose[1][own.view]
            off.append((scene.rig.cameras[number].project(point) - own.pixels).flatten() / statistics.SIGMA)
            first += len(own)
        tool = rotations.compose(*z, *rotations.inverse(*rotations.compose(*x, R, t)))
        turn = rotations.log(rotations.exp(said[:, 3:]) @ tool[0].mT)
        off.append((torch.cat([said[:, :3] - tool[1], turn], -1) / torch.as_tensor(sigma)).flatten())
        return torch.cat(off).numpy()

    def numbers(R: Tensor, t: Tensor) -> Tensor:
        return torch.cat([t, rotations.log(R)], -1).view(-1, 6)

    fit = found.hand_eye
    begin = [
        numbers(scene.rig.R[1], scene.rig.t[1]),
        numbers(fit.hand_eye.rotation, fit.hand_eye.translation),
        numbers(fit.target_rotation, fit.target_translation),
        numbers(scene.R[at], scene.t[at]),
    ]
    best = least_squares(residuals, torch.cat(begin).flatten().numpy(), x_scale="jac", xtol=1e-14, ftol=1e-14)
    shift, vector = torch.as_tensor(best.x[:3]), torch.as_tensor(best.x[3:6])
    assert found.rig.covariance is not None
    scale = found.rig.covariance.diagonal().sqrt()
    off = torch.cat([found.rig.t[1] - shift, rotations.log(found.rig.R[1] @ rotations.exp(vector).mT)]) / scale
    assert float(off.abs().max()) < 0.02
    step = 1e-6 * torch.eye(3, dtype=F64)
    by_vector = (
        torch.stack([rotations.log(rotations.exp(vector + s) @ rotations.exp(vector).mT) for s in step], -1) / 1e-6
    )
    gain = torch.block_diag(torch.eye(3, dtype=F64), by_vector)
    expected = gain @ torch.as_tensor(np.linalg.inv(best.jac.T @ best.jac))[:6, :6] @ gain.mT
    torch.testing.assert_close(
        found.rig.covariance / scale / scale[:, None], expected / scale / scale[:, None], rtol=0, atol=0.02
    )


@pytest.mark.parametrize("mount", MOUNTS)
def test_errors_are_within_their_covariance_and_the_noise_is_found(mount: Literal["base", "tool"]) -> None:
    sets = [tied(mount, seed) for seed in range(4)]
    freedom = 6 * len(sets)
    assert abs(sum(nees(*one) for one in sets) - freedom) < 4 * math.sqrt(2 * freedom)
    fits = [found.hand_eye for found, _ in sets if found.hand_eye is not None]
    assert [fit.hand_eye.mount for fit in fits] == [mount] * len(sets)
    mm = sum(fit.robot_sigma_mm for fit in fits) / len(fits)
    rad = sum(fit.robot_sigma_rad for fit in fits) / len(fits)
    assert mm == pytest.approx(statistics.ROBOT[0], rel=0.2)
    assert rad == pytest.approx(statistics.ROBOT[1], rel=0.3)


def test_sharp_points_do_not_follow_a_coarse_robot() -> None:
    """Six points a view, known to 0.001 px, a robot off by 0.3 px, lenses unknown: residuals are the points'."""
    sigma = 0.001
    scene, views = of_seed(2, 30, 8, sigma=sigma)
    six = torch.tensor([0, 2, 4, 15, 17, 19])
    few = [own[torch.isin(own.point, six)] for own in statistics.shared_out(views)]
    few = [replace(own, covariance=own.covariance * (sigma / statistics.SIGMA) ** 2) for own in few]
    robot = statistics.robot_poses(scene, "tool", 1)
    found = calibrate_rig(statistics.located(scene, few), lens=statistics.LENS, robot=robot)
    assert found.common_sigma_px < 0.5 * sigma
    assert float(found.rms_px.max()) < 1.2 * sigma * math.sqrt(2)
    assert nees(found, statistics.errors(found.rig, scene.rig).flatten()) < 6 + 4 * math.sqrt(12)
    assert found.hand_eye is not None
    assert found.hand_eye.robot_sigma_mm == pytest.approx(statistics.ROBOT[0], rel=0.3)


def test_a_wrong_robot_pose_is_left_out_and_told_and_so_are_few() -> None:
    scene, views = of_seed(2, 60, 1)
    views = statistics.shared_out(views)
    robot = dict(statistics.robot_poses(scene, "tool", 1))
    odd = views[0].names[2]
    robot[odd] = (robot[odd][0] + 5.0, *robot[odd][1:])
    few = {name: pose for name, pose in robot.items() if name in (*views[0].names, *views[1].names[:2])}
    found = calibrate_rig(held(scene, views), lens=None, robot=few)
    assert nees(found, statistics.errors(found.rig, scene.rig).flatten()) < 6 + 4 * math.sqrt(12)
    assert [text for text in found.warnings if text.startswith(f"robot poses of 1 moment ({odd}) contradict")]
    assert [
        text for text in found.warnings if text.startswith("cam1 is tied to the others by the robot in 2 moments only")
    ]


def test_a_robot_is_left_alone_where_moments_tie_the_cameras() -> None:
    scene, views = of_seed(2, 30, 3)
    with_robot, without = (
        calibrate_rig(held(scene, views), lens=None, robot=robot)
        for robot in (statistics.robot_poses(scene, "tool", 3), None)
    )
    assert with_robot.hand_eye is None
    assert torch.equal(with_robot.rig.t, without.rig.t)
    # where the first camera is on it is asked afterwards
    exact = hand_eye_of(without, statistics.robot_poses(scene, "tool", 3, noise=(0.0, 0.0))).hand_eye
    noisy = hand_eye_of(without, statistics.robot_poses(scene, "tool", 3)).hand_eye
    assert exact.mount == noisy.mount == "tool"
    assert noisy.covariance is not None
    off = torch.cat([exact.translation - noisy.translation, rotations.log(exact.rotation @ noisy.rotation.mT)])
    assert float(off @ torch.linalg.solve(noisy.covariance, off)) < 6 + 4 * math.sqrt(12)


def test_what_is_unknown_of_the_plate_stands_beside_the_chain() -> None:
    """A plate that its file has to 0.1 um is the same as an exact one, to a hundredth of a deviation."""
    scene, views = of_seed(2, 40, 3)
    cameras, robot = held(scene, statistics.shared_out(views)), statistics.robot_poses(scene, "base", 3)
    count = len(scene.points)
    places = 1e-4 * torch.eye(3 * count, dtype=F64).unflatten(0, (count, 3))
    none = torch.zeros_like(places)
    numbers = (none[:, 0, 0], places, none[0, 0], none[:, 0], none, places.new_ones(3 * count))
    plate = Plate(torch.arange(count), scene.points, *numbers)
    one, other = (calibrate_rig(cameras, lens=None, plate=known, robot=robot) for known in (plate, None))
    assert one.joint.shape[0] == 2 * 8 + 6 + 12 + len(plate)
    assert one.hand_eye is not None
    assert other.rig.covariance is not None
    sigma = other.rig.covariance.diagonal().sqrt()
    assert float((statistics.errors(one.rig, other.rig).flatten() / sigma).abs().max()) < 0.01
    torch.testing.assert_close(one.joint[16:34, 16:34], other.joint[16:34, 16:34], rtol=0.01, atol=1e-9)


def none(robot: RobotPoses, views: list[Views]) -> RobotPoses:
    return {}


def of_first(robot: RobotPoses, views: list[Views]) -> RobotPoses:
    return {name: robot[name] for name in views[0].names}


def about_one_axis(robot: RobotPoses, views: list[Views]) -> RobotPoses:
    return {name: (*pose[:3], 0.0, 0.0, pose[5]) for name, pose in robot.items()}


def three(robot: RobotPoses, views: list[Views]) -> RobotPoses:
    return {name: robot[name] for own in views for name in own.names[:3]}


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (none, "the target is seen by one of each at no moment; .* robot poses of these moments in a capture manifest"),
        (of_first, "and no robot pose is known of the moments in which cam1 has the target; add them to the manifest"),
        (about_one_axis, "and the robot does not tie them: robot_pose: the robot turns about one axis only"),
        (three, "and the robot does not tie them: robot_pose: 3 poses with the target in view; .* takes 4 at least"),
    ],
)
def test_what_is_missing_is_one_line(spoilt: Callable[[RobotPoses, list[Views]], RobotPoses], message: str) -> None:
    scene, views = of_seed(2, 40, 1)
    views = statistics.shared_out(views)
    robot = spoilt(statistics.robot_poses(scene, "tool", 1), views)
    with pytest.raises(ConfigError, match=rf"^INPUT: cameras cam0 \| cam1 are apart[:,] {message}") as caught:
        calibrate_rig(held(scene, views), lens=None, robot=robot)
    assert "\n" not in str(caught.value)
