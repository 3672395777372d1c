"""What is unknown of a plate: gauge, priors, derivatives, and the covariance against an independent joint bound."""

import argparse
import math
from dataclasses import replace

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

import torchpose as tp
from scripts import measured_target_statistics as statistics
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.bundle import Places, _Problem
from torchpose.calibration.intrinsics import measure_plate
from torchpose.calibration.lenses import moved_camera
from torchpose.calibration.measured import Distance, measured_target, scale_sigma, scaled_by_distance
from torchpose.calibration.plate import free_plate, motions, stated_plate
from torchpose.calibration.rings import measure_centers, rims_by_camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import Pose, Step, Unknowns, Vector
from torchpose.geometry.rotations import plane_axes
from torchpose.sim import add_noise, render

F64 = torch.float64
OPTIONS = argparse.Namespace(
    targets=["quad40"], views=12, tests=4, size=(912, 608), noise=2.0, print=0.02, bow=0.04, gain=0.015
)


def test_places_move_in_their_best_frame_alone() -> None:
    """However far they go, shift, turn and scale that bring them nearest to the nominal places are none."""
    nominal = tp.Target.load("hexa50").centers
    plate = free_plate(torch.arange(6), nominal)
    assert len(plate) == 3 * 6 - 7
    z = 2.0 * torch.randn(len(plate), dtype=F64, generator=torch.Generator().manual_seed(1))
    places = plate.at(z).places
    assert float((places - nominal).norm(dim=-1).max()) > 1
    a, b = nominal - nominal.mean(0), places - places.mean(0)
    u, s, v = torch.linalg.svd(b.mT @ a)
    torch.testing.assert_close(places.mean(0), nominal.mean(0))
    torch.testing.assert_close((u @ v), torch.eye(3, dtype=F64))
    assert float(s.sum() / a.square().sum()) == pytest.approx(1.0)


def test_a_stated_covariance_is_that_of_its_plate() -> None:
    g = torch.Generator().manual_seed(2)
    root = torch.randn(12, 7, dtype=F64, generator=g)
    nominal, gain = tp.Target.load("quad40"), torch.full((1, 1), 1e-4, dtype=F64)
    plate = stated_plate(replace(nominal, covariance=torch.block_diag(root @ root.mT, gain)))
    assert plate is not None
    assert len(plate) == 7 + 1 + 3 * 4  # and the gain, and a size and two tilts a ring
    columns = plate.places.flatten(0, 1)
    torch.testing.assert_close(columns @ columns.mT, root @ root.mT)
    assert float(plate.gain.norm()) == pytest.approx(0.01)
    assert stated_plate(nominal) is None


def seen_by_two(views: Views, camera: tp.Camera) -> tuple[Views, tp.CameraRig]:
    """Every other point is seen by a second camera, 40 mm away and turned."""
    turn, shift = rotations.exp(torch.tensor([0.05, -0.3, 0.1], dtype=F64)), torch.tensor([40.0, -5, 9], dtype=F64)
    rims, lens = views.rims, torch.arange(len(views.view)) % 2
    assert rims is not None
    second = lens == 1
    R = torch.where(second[:, None, None], turn @ rims.R, rims.R)
    t = torch.where(second[:, None], rims.t @ turn.mT + shift, rims.t)
    by_camera = torch.zeros(len(lens), 7, 16, dtype=F64)
    by_camera[~second, :, :8], by_camera[second, :, 8:] = rims.by_camera[~second], rims.by_camera[second]
    rims = replace(rims, R=R, t=t, by_camera=by_camera, cameras=(camera, camera))
    eye = torch.eye(3, dtype=F64)
    rig = tp.CameraRig((camera, replace(camera)), torch.stack([eye, turn]), torch.stack([0 * shift, shift]))
    pixels = torch.where(second[:, None], camera.project(t), views.pixels)
    return replace(views, camera=lens, rims=rims, pixels=pixels), rig


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("rims", [True, False])
def test_gradient_of_the_adjustment(cameras: int, rims: bool) -> None:
    """Half the derivative of chi-squared by every unknown, by differences, is less the right-hand side."""
    scene = statistics.random_scene(OPTIONS, 3)
    views = statistics.drawn_views(scene, scene.views, torch.Generator().manual_seed(1))
    plate = free_plate(scene.nominal.ids, scene.nominal.centers, scene.nominal.normals)
    rig = tp.CameraRig.alone(scene.start)
    if cameras == 2:
        views, rig = seen_by_two(views, scene.start)
    if not rims:
        plate, views = free_plate(scene.nominal.ids, scene.nominal.centers), replace(views, rims=None)
    problem = _Problem(views, rig, plate, True)
    z = 1e-3 * torch.randn(1, len(plate), dtype=F64, generator=torch.Generator().manual_seed(2))
    intrinsics = Vector(torch.full((1, 8 * cameras), 1e-4, dtype=F64))
    places = {"places": Places(rig.R[None, 1:], rig.t[None, 1:])} if cameras == 2 else {}
    own: dict[str, Vector | Places] = {"intrinsics": intrinsics, **places, "plate": Vector(z)}
    at = Unknowns(own, {"pose": Pose(*scene.views)}, torch.zeros(len(views), dtype=torch.int64))
    normal = problem(at)
    assert normal.eliminated is not None

    def cost(own_step: Tensor, pose_step: Tensor) -> float:
        moved = at.moved(Step(own_step, pose_step, none, none, none))
        return float(problem(moved).cost)

    count, none = 8 * cameras + 6 * (cameras - 1) + len(plate), torch.zeros(len(views), 6, dtype=F64)
    scale = normal.information[0].diagonal().clamp_min(1e-6).rsqrt()
    for k in range(count):
        step = torch.zeros(1, count, dtype=F64)
        step[0, k] = 1e-2 * scale[k]
        slope = (cost(step, none) - cost(-step, none)) / (4 * float(step[0, k]))
        # turns of rings by some mrad are taken for small: all views' add up in the place of a camera
        assert -slope == pytest.approx(float(normal.right[0, k]), rel=1e-2, abs=1e-3 / float(scale[k]))
    for k in range(6):
        step, size = none.clone(), float(normal.eliminated.information[2, k, k]) ** -0.5
        step[2, k] = 1e-2 * size
        slope = (cost(none[:1].new_zeros(1, count), step) - cost(none.new_zeros(1, count), -step)) / (4e-2 * size)
        assert -slope == pytest.approx(float(normal.eliminated.right[2, k]), rel=2e-3, abs=1e-3 / size)


def test_rings_follow_the_camera_that_they_are_fitted_with() -> None:
    """Rims seen by one camera and fitted with another: place and tilt move as `rims_by_camera` says."""
    camera = scenes.camera()
    R, t = scenes.poses(camera, 5)
    target = tp.Target.load("quad40")
    radii = target.radii[1:2].expand(5, 2)
    normals = target.normals[:1].expand(5, 3)
    change = torch.tensor([0.6, -0.4, 1.5, -1.0, 2e-3, -1e-3, 3e-4, 2e-4], dtype=F64)
    other = moved_camera(camera, change)
    assert other is not None
    expected = -(rims_by_camera(camera, R, t, normals, radii) @ change)
    for k in range(5):
        rims = statistics.rim_points(torch.zeros(1, 3, dtype=F64), normals[:1], radii[:1])[0]
        pixels = camera.project((R[k] @ rims[..., None])[..., 0] + t[k])
        rays = torch.nn.functional.pad(other.undistort_points(pixels), (0, 1), value=1.0)
        one, two = plane_axes(R[k] @ normals[k])

        def off(step: Tensor, k: int = k, rays: Tensor = rays, axes: tuple[Tensor, Tensor] = (one, two)) -> Tensor:
            step = torch.as_tensor(step, dtype=F64)
            turn = rotations.exp(step[3] * axes[0] + step[4] * axes[1])
            normal, center = turn @ R[k] @ normals[k], t[k] + step[:3]
            foot = rays * ((normal @ center) / (rays @ normal))[..., None] - center
            edge = radii[k] + step[5] * torch.tensor([1.0, -1.0], dtype=F64)
            return ((foot.norm(dim=-1) - edge[:, None]) * 1e3).flatten()

        found = torch.as_tensor(least_squares(lambda x: off(x).numpy(), [0.0] * 6, x_scale=[1e-3] * 6).x)
        turned = found[3] * one + found[4] * two
        mine = torch.cat([found[:3], turned, found[5:]])
        # weights along the rim differ between px and mm: what is left is of second order in the ring's size
        assert float((mine - expected[k])[:2].abs().max()) < 2e-4
        assert float((mine - expected[k])[2].abs()) < 0.02 * abs(float(expected[k, 2])) + 1e-3
        assert float((mine - expected[k])[3:6].norm()) < 0.05 * float(expected[k, 3:6].norm()) + 1e-5


def test_covariance_is_the_joint_bound_and_errors_are_within_it() -> None:
    rows = [statistics.drawn_set(OPTIONS, seed) for seed in range(4)]
    for name in ("places_claimed", "focal_claimed"):
        claimed = sorted(row[name] for row in rows)
        # residuals that are large by chance widen a covariance, never narrow it
        assert claimed[0] == pytest.approx(1.0, abs=0.02)
        assert claimed[1] == pytest.approx(1.0, abs=0.02)
    # four deviations of the mean of chi-squared over its degrees: 6 of places, 8 of intrinsics, 24 of poses a set
    for name, degrees in (("places_nees", 6), ("intrinsics_nees", 8), ("poses_nees", 24)):
        mean = sum(row[name] for row in rows) / len(rows)
        assert abs(mean - 1) < 4 * math.sqrt(2 / (degrees * len(rows))), name


def calibrated(distance: Distance | None = None) -> tuple[statistics.Scene, tp.Target, tp.Camera]:
    scene = statistics.random_scene(OPTIONS, 5)
    views = statistics.drawn_views(scene, scene.views, torch.Generator().manual_seed(3))
    nominal = scene.nominal
    plate = free_plate(nominal.ids, nominal.centers, nominal.normals)
    found = calibrate_intrinsics(views, [scene.start], lens="brown4", plate=plate)
    if distance is not None:
        found = scaled_by_distance(found, distance)
    return scene, *measured_target(found, nominal)


def test_a_distance_gives_the_scale() -> None:
    scene = statistics.random_scene(OPTIONS, 5)
    true = float((scene.printed.centers[0] - scene.printed.centers[2]).norm())
    _, target, _ = calibrated(Distance(0, 2, true, 0.003))
    between = target.centers[0] - target.centers[2]
    assert float(between.norm()) == pytest.approx(true, abs=1e-9)
    assert target.covariance is not None
    along = torch.zeros(13, dtype=F64)
    along[:3], along[6:9] = between / between.norm(), -between / between.norm()
    # the covariance knows the distance; how far it may be off is the scale's, that of places and radii
    assert abs(float(along @ target.covariance @ along)) < 1e-12
    assert scale_sigma(target, Distance(0, 2, true, 0.003)) == pytest.approx(0.003 / true)
    # radii and places grow together: another marker's distance is right, too, as far as its shape is known
    other = float((target.centers[1] - target.centers[3]).norm())
    assert other == pytest.approx(float((scene.printed.centers[1] - scene.printed.centers[3]).norm()), abs=2e-3)
    size = float((target.radii / scene.nominal.radii).mean())
    assert size == pytest.approx(1.0, abs=3e-5)  # the print's rings are those of the file
    with pytest.raises(ConfigError, match=r"--distance: target quad40 has no marker 9; its ids are \[0, 1, 2, 3\]"):
        Distance(0, 9, 1.0).check(scene.nominal)


def test_scale_by_the_mean_is_that_of_the_nominal_places() -> None:
    scene, target, camera = calibrated()
    assert target.covariance is not None
    frame = motions(scene.nominal.centers)
    assert float((frame.mT @ (target.centers - scene.nominal.centers).flatten()).abs().max()) < 1e-9
    assert float((target.covariance[:-1, :-1] @ frame).abs().max()) < 1e-12
    assert camera.adjustment == target.adjustment is not None
    assert target.cross_covariance is not None
    assert target.cross_covariance.shape == (13, 8)


def test_a_held_camera_carries_its_covariance_to_the_target() -> None:
    """How places follow the camera, by differences of measurements with cameras that are a deviation off."""
    scene = statistics.random_scene(OPTIONS, 6)
    views = statistics.drawn_views(scene, scene.views, torch.Generator().manual_seed(4))
    nominal = scene.nominal
    plate = free_plate(nominal.ids, nominal.centers, nominal.normals)
    sigma = torch.tensor([0.01, 0.01, 0.02, 0.02], dtype=F64)
    camera = replace(scene.camera, covariance=torch.diag(sigma.square()))

    def measured(step: Tensor) -> tuple[Tensor, tp.Target]:
        moved = moved_camera(camera, step)
        assert moved is not None
        target, _ = measured_target(measure_plate(views, moved, plate), nominal)
        return target.centers.flatten(), target

    _, target = measured(torch.zeros(8, dtype=F64))
    exact = measure_plate(views, scene.camera, plate)
    noise = (plate.places.flatten(0, 1) @ exact.joint[8:, 8:]) @ plate.places.flatten(0, 1).mT
    steps = torch.eye(8, dtype=F64)[:4] * sigma[:, None]
    gain = torch.stack([(measured(s)[0] - measured(-s)[0]) / 2 for s in steps], -1)
    assert target.covariance is not None
    expected = noise + gain @ gain.mT
    assert float((target.covariance[:-1, :-1] - expected).norm() / expected.norm()) < 0.03


def test_places_that_are_stated_only_widen_the_camera() -> None:
    """Print errors repeat in every view: with their deviation stated the camera's NEES is right, else it is larger."""
    stated_nees: list[float] = []
    exact_nees: list[float] = []
    for seed in range(6):
        scene = statistics.random_scene(
            argparse.Namespace(**{**vars(OPTIONS), "bow": 0.0, "targets": ["hexa50"], "views": 50}), 20 + seed
        )
        views = replace(statistics.drawn_views(scene, scene.views, torch.Generator().manual_seed(seed)), rims=None)
        assert scene.nominal.covariance is not None
        plate = stated_plate(scene.nominal)
        truth = statistics.intrinsics(scene.camera)
        for prior, every in ((plate, stated_nees), (None, exact_nees)):
            found = calibrate_intrinsics(views, [scene.start], lens="brown4", plate=prior)
            every.append(statistics.nees(statistics.intrinsics(found.camera) - truth, found.covariance))
    assert abs(sum(stated_nees) / 6 - 1) < 4 * math.sqrt(2 / (8 * 6))
    assert sum(exact_nees) > 1.3 * sum(stated_nees)


def test_dot_gain_is_told_by_single_rings_and_moves_no_centre() -> None:
    """Rings rendered 15 um larger, holes smaller: centres and gains of single rings are within their covariance."""
    camera = scenes.camera(scale=0.35)
    target = tp.Target.load("quad40")
    pose = scenes.poses(camera, 4)
    frames = add_noise(render(camera, replace(target, edge_gain=0.015), *pose), 2.0)
    views = measure_centers([str(k) for k in range(4)], frames, camera, target, tilts="open")
    assert views.rims is not None
    true = camera.project((pose[0][views.view] @ views.points[..., None])[..., 0] + pose[1][views.view])
    error = (views.pixels - true)[..., None]
    nees = (error.mT @ torch.linalg.solve(views.covariance, error)).flatten()
    # four deviations of the mean of 16 chi-squares with two degrees
    assert float(nees.mean()) < 2 + 4 * math.sqrt(2 * 2 / 16)
    off = (views.rims.gain + views.rims.best[:, 6] - 0.015) / views.rims.covariance[:, 6, 6].sqrt()
    assert float(views.rims.covariance[:, 6, 6].sqrt().max()) < 2e-3
    assert float(off.square().mean()) < 1 + 4 * math.sqrt(2 / 16)
