"""A target measured from frames: end to end as a user types it, and what it warns of."""

from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch

import torchpose as tp
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration import Views, calibrate_intrinsics
from torchpose.calibration.measured import check_seen, doubts
from torchpose.calibration.plate import free_plate, motions
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.sim import add_noise, render

F64 = torch.float64
CAMERA = scenes.camera(scale=0.35)
NOMINAL = tp.Target.load("hexa50")
OFF = 0.02 * torch.randn(6, 3, dtype=F64, generator=torch.Generator().manual_seed(4))
PRINTED = replace(NOMINAL, centers=NOMINAL.centers + OFF, edge_gain=0.015)
VIEWS = 8


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["calibrate", *map(str, arguments)])
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("views")
    frames = add_noise(render(CAMERA, PRINTED, *scenes.poses(CAMERA, VIEWS)), 2.0)
    for k, frame in enumerate(frames):
        cv2.imwrite(str(place / f"{k}.png"), frame.numpy())
    return place


def check_places(target: tp.Target) -> None:
    """Places are those of the print in the frame that fits the nominal ones best, within their deviations."""
    gauge = torch.linalg.qr(motions(NOMINAL.centers)).Q
    true = OFF.flatten() - gauge @ (gauge.mT @ OFF.flatten())
    error = (target.centers - NOMINAL.centers).flatten() - true
    assert target.covariance is not None
    sigma = target.covariance.diagonal()[:-1].sqrt()
    assert float(sigma.max()) < 1.5e-3
    assert float((error / sigma.clamp_min(1e-5)).abs().max()) < 5
    assert target.edge_gain == pytest.approx(0.015, abs=6 * float(target.covariance[-1, -1].sqrt()) + 3e-4)


def test_target_and_camera_together_then_the_target_alone(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target_file, camera_file, plots = tmp_path / "measured.yaml", tmp_path / "camera.yaml", tmp_path / "plots"
    both = ("--measure-target", target_file, "--out", camera_file, "--model", "brown4", "--plots", plots)
    assert run(folder, "--target", "hexa50", *both) == 0
    printed = capsys.readouterr().out
    assert "places x:" in printed
    assert "edge gain" in printed
    target, camera = tp.Target.load(target_file), tp.Camera.load(camera_file)
    check_places(target)
    assert camera.covariance is not None
    assert camera.covariance.shape == (8, 8)
    error = scenes.intrinsics(camera) - scenes.intrinsics(CAMERA)
    assert float((error / camera.covariance.diagonal().sqrt()).abs().max()) < 5
    assert camera.adjustment == target.adjustment is not None
    assert target.cross_covariance is not None
    assert target.cross_covariance.shape == (19, 8)
    assert {path.name for path in plots.iterdir()} == {
        "places.csv", "residuals.csv", "covariance.csv", "residuals.png", "target.png",
    }  # fmt: skip
    alone = tmp_path / "alone.yaml"
    true = float((PRINTED.centers[0] - PRINTED.centers[3]).norm())
    exact = tmp_path / "exact.yaml"
    CAMERA.save(exact)
    held = ("--camera", exact, "--measure-target", alone, "--distance", 0, 3, true, 0.002)
    assert run(folder, "--target", "hexa50", *held) == 0
    again = tp.Target.load(alone)
    assert float((again.centers[0] - again.centers[3]).norm()) == pytest.approx(true, abs=1e-9)
    assert again.covariance is not None
    spread = again.covariance[:3, :3] + again.covariance[9:12, 9:12] - 2 * again.covariance[:3, 9:12]
    assert float(spread[0, 0]) < 1e-10  # the distance is known; how far it may be off belongs to the scale
    assert again.scale_sigma == pytest.approx(0.002 / true)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--measure-target", "t.yaml"), "--camera: needed to find --measure-target; "),
        (("--distance", 0, 1, 25, "--out", "c.yaml"), "--distance: scales a measured target; "),
        (("--measure-target", "t.yaml", "--out", "c.yaml", "--distance", 0, 9, 25), "--distance: target hexa50 has no"),
        (("--measure-target", "t.yaml", "--out", "c.yaml", "--distance", 0, 1, -1), "--distance: give two different"),
        (("--measure-target", "t.yaml", "--out", "c.yaml", "--distance", 0, 1, 25, "nan"), "--distance: give two diff"),
        (
            ("--measure-target", "t.yaml", "--out", "c.yaml", "--distance", 0, 1, 1e300),
            "--distance: markers 0 and 1 of",
        ),
        (("--measure-target", "t.yaml", "--out", "t.yaml"), "t.yaml: --measure-target: is the file of --out"),
        (("--measure-target", ".", "--out", "c.yaml"), ".: --measure-target: is a folder; "),
    ],
)
def test_wrong_options(
    folder: Path, options: tuple[object, ...], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, "--target", "hexa50", *options) == 2
    assert message in capfd.readouterr().err


def measured_from(views: Views) -> list[str]:
    target = NOMINAL
    found = calibrate_intrinsics(views, [scenes.camera()], lens="brown4", plate=free_plate(target.ids, target.centers))
    return doubts(found, target)


def test_nothing_to_doubt_and_a_marker_that_moved_and_a_plate_that_bends() -> None:
    camera = scenes.camera()
    pose = scenes.poses(camera, 20)
    views = scenes.views(camera, pose, PRINTED.centers, sigma=0.01)
    views = replace(views, points=NOMINAL.centers[views.point])
    assert measured_from(views) == []
    moved = (views.point == 4) & (views.view >= 15)
    aside = replace(views, pixels=views.pixels + torch.where(moved[:, None], 0.5, 0.0))
    (warning,) = measured_from(aside)
    assert warning.startswith("marker 4 is elsewhere in 5 views (15.png, 16.png, 17.png and others)")
    shape = 0.1 * torch.randn(20, 6, 2, dtype=F64, generator=torch.Generator().manual_seed(6))
    bent = replace(views, pixels=views.pixels + shape[views.view, views.point])
    (warning,) = measured_from(bent)
    assert "the plate changes its shape between views" in warning


def test_views_too_much_alike_and_too_few() -> None:
    camera = scenes.camera()
    views = scenes.views(camera, scenes.poses(camera, 12, tilt=(28, 30)), PRINTED.centers, sigma=0.5)
    found = measured_from(replace(views, points=NOMINAL.centers[views.point]))
    assert any("is known to" in warning for warning in found)
    few = views[(views.point != 2) | (views.view < 2)]
    with pytest.raises(ConfigError, match="marker 2 of target hexa50 is in fewer than 3 views"):
        check_seen(few, NOMINAL)
