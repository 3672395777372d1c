"""``torchpose calibrate --cameras-out`` as a user types it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml

import torchpose as tp
from scripts import rig_calibration_statistics as statistics
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
MOMENTS = 12


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([*map(str, arguments)])
    code = end.value.code
    assert isinstance(code, int)
    return code


def kalibr(path: Path) -> list[dict[str, Any]]:
    """A camchain as Kalibr's own tools read it: plain YAML, four keys of each camera, T_cn_cnm1 in metres."""
    chain = yaml.safe_load(path.read_text())
    cameras, whole = [], np.eye(4)
    for number in range(len(chain)):
        entry = chain[f"cam{number}"]
        assert entry["camera_model"] == "pinhole"
        assert entry["distortion_model"] == "radtan"
        fx, fy, cx, cy = entry["intrinsics"]
        if number:
            whole = np.array(entry["T_cn_cnm1"]) @ whole
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        cameras.append(
            {"K": matrix, "D": np.array(entry["distortion_coeffs"]), "T": whole, "size": entry["resolution"]}
        )
    return cameras


@pytest.fixture(scope="module")
def scene() -> statistics.Drawn:
    return statistics.drawn(2, MOMENTS, 8)


@pytest.fixture(scope="module")
def shots(scene: statistics.Drawn, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder a camera; one picture is missing in each."""
    folder = tmp_path_factory.mktemp("shots")
    for number, camera in enumerate(scene.rig.cameras):
        (folder / f"cam{number}").mkdir()
        R, t = scene.rig.seen_by(number, scene.R, scene.t)
        frames = add_noise(render(camera, tp.Target.load("hexa50"), R, t * 1.1), 1.0, seed=number)
        for k in range(MOMENTS):
            if k != number:
                cv2.imwrite(str(folder / f"cam{number}" / f"{k}.png"), frames[k].numpy())
    return folder


@pytest.fixture(scope="module")
def true(scene: statistics.Drawn) -> tp.CameraRig:
    """Everything a tenth farther away, so that all of hexa50 is in view."""
    return tp.CameraRig(scene.rig.cameras, scene.rig.R, 1.1 * scene.rig.t)


def chi_squared(rig: tp.CameraRig, true: tp.CameraRig) -> float:
    """Of the places of the cameras, with 6 degrees of freedom."""
    assert rig.covariance is not None
    off = statistics.errors(rig, true).flatten()
    return float(off @ torch.linalg.solve(rig.covariance, off))


def test_a_folder_a_camera_gives_the_file_that_kalibr_reads(
    shots: Path, true: tp.CameraRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, plots = tmp_path / "rig.yaml", tmp_path / "plots"
    assert (
        run("calibrate", shots, "--target", "hexa50", "--model", "brown4", "--cameras-out", out, "--plots", plots, "-q")
        == 0
    )
    said = capsys.readouterr().out
    assert "cam1: 11 moments" in said
    assert "12 of 12 moments" in said
    rig = tp.CameraRig.load(out)
    assert rig.covariance is not None
    assert chi_squared(rig, true) < 30  # of chi-squared with 6: one in 25,000
    assert float(rig.covariance.diagonal()[:3].sqrt().max()) < 0.05
    for read, camera, number in zip(kalibr(out), rig.cameras, range(2), strict=True):
        assert camera.covariance is not None
        np.testing.assert_allclose(read["K"], camera.matrix.numpy(), rtol=1e-12)
        np.testing.assert_allclose(read["D"], camera.distortion.numpy(), rtol=1e-12)
        np.testing.assert_allclose(read["T"][:3, 3] * 1000, rig.t[number].numpy(), atol=1e-9)
        np.testing.assert_allclose(read["T"][:3, :3], rig.R[number].numpy(), atol=1e-12)
        # a point goes through OpenCV where it goes through ours
        point = np.array([[3.0, -4.0, 180.0]])
        seen = cv2.projectPoints(
            point, cv2.Rodrigues(read["T"][:3, :3])[0], 1000 * read["T"][:3, 3], read["K"], read["D"]
        )
        ours = camera.project(torch.as_tensor(point) @ rig.R[number].mT + rig.t[number])
        np.testing.assert_allclose(seen[0].reshape(1, 2), ours.numpy(), atol=1e-6)
    assert {path.name for path in plots.iterdir()} == {"rig.png", "residuals.png", "ties.png", "residuals.csv"}
    with (plots / "residuals.csv").open() as file:
        assert {row["camera"] for row in csv.DictReader(file)} == {"cam0", "cam1"}


def test_known_cameras_are_held_and_the_target_is_measured(shots: Path, true: tp.CameraRig, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.yaml" for name in ("left", "right")]
    for camera, file in zip(true.cameras, files, strict=True):
        camera.save(file)
    out, measured = tmp_path / "rig.yaml", tmp_path / "measured.yaml"
    known = [word for file in files for word in ("--cameras", file)]
    more = ("--cameras-out", out, "--measure-target", measured, "-q")
    assert run("calibrate", shots, "--target", "hexa50", *known, *more) == 0
    rig, target = tp.CameraRig.load(out), tp.Target.load(str(measured))
    assert rig.cameras[1].covariance is None
    torch.testing.assert_close(rig.cameras[1].matrix, true.cameras[1].matrix)
    assert rig.covariance is not None
    assert chi_squared(rig, true) < 30
    nominal = tp.Target.load("hexa50")
    assert target.covariance is not None
    sigma = target.covariance.diagonal()[:-1].sqrt().view(-1, 3)
    assert float(((target.centers - nominal.centers) / sigma.clamp_min(1e-5)).abs().max()) < 5
    assert float(sigma.max()) < 0.01


@pytest.fixture(scope="module")
def session(scene: statistics.Drawn, true: tp.CameraRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A manifest of two cameras on a robot that see the target in turns, and what is known of their lenses."""
    folder = tmp_path_factory.mktemp("session")
    (folder / "images").mkdir()
    at = statistics.Drawn(true, scene.points, scene.R, 1.1 * scene.t)
    robot = statistics.robot_poses(at, "tool", 1)
    records: list[dict[str, Any]] = [{"record": "session", "units": {"length": "mm"}}]
    for number, camera in enumerate(true.cameras):
        camera.save(folder / f"{number}.yaml")
        R, t = true.seen_by(number, at.R, at.t)
        frames = add_noise(render(camera, tp.Target.load("hexa50"), R, t), 1.0, seed=number)
        for k in range(MOMENTS):
            image = f"images/{k}_cam{number}.png"
            seen = frames[k] if k % 2 == number else torch.full_like(frames[k], 200)
            cv2.imwrite(str(folder / image), seen.numpy())
            record = {"record": "frame", "id": f"{number}-{k}", "image": image, "camera": f"cam{number}"}
            records.append(record | {"robot_pose": robot[f"{k}.png"]})
    (folder / "manifest.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def test_cameras_that_never_see_the_target_together_are_tied_by_the_robot(
    session: Path, true: tp.CameraRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = ("--cameras", session / "0.yaml", "--cameras", session / "1.yaml")
    out, hand_eye, plots = tmp_path / "rig.yaml", tmp_path / "handeye.yaml", tmp_path / "plots"
    words = ("--target", "hexa50", *known, "--cameras-out", out, "-q")
    more = ("--hand-eye-out", hand_eye, "--plots", plots)
    assert run("calibrate", session / "manifest.jsonl", *words, *more) == 0
    said = capsys.readouterr().out
    assert "cam0 | cam1: tied by the robot, cameras on its tool" in said
    assert "robot noise" in said
    rig = tp.CameraRig.load(out)
    assert rig.covariance is not None
    assert chi_squared(rig, true) < 40  # noise of 12 poses, and of 1 in 10^5 sets
    assert 0.01 < float(rig.covariance.diagonal()[:3].sqrt().max()) < 0.2
    assert tp.HandEye.load(hand_eye).mount == "tool"
    assert "robot.png" in {path.name for path in plots.iterdir()}
    # the same pictures without the robot
    for number in range(2):
        (tmp_path / "shots" / f"cam{number}").mkdir(parents=True)
        for path in (session / "images").glob(f"*_cam{number}.png"):
            (tmp_path / "shots" / f"cam{number}" / path.name.replace(f"_cam{number}", "")).symlink_to(path)
    assert run("calibrate", tmp_path / "shots", *words) == 2
    said = capsys.readouterr().err
    assert "cameras cam0 | cam1 are apart" in said
    assert "robot poses of these moments in a capture manifest would tie them" in said
    assert run("calibrate", tmp_path / "shots", *words, "--hand-eye-out", hand_eye) == 2
    assert "robot_pose: missing; --hand-eye-out needs a manifest with robot poses" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("--out", "camera.yaml", "--cameras-out", "rig.yaml"),
            "--out: is of one camera; leave it out with --cameras-out",
        ),
        (("--cameras", "rig.yaml", "--out", "camera.yaml"), "--cameras: goes with --cameras-out"),
        (("--cameras-out", "rig.yaml"), "INPUT: has 1 folders of cameras; give one folder a camera"),
    ],
)
def test_what_does_not_go_together_is_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "shots" / "cam0").mkdir(parents=True)
    words = [str(tmp_path / word) if word.endswith(".yaml") else word for word in arguments]
    assert run("calibrate", tmp_path / "shots", "--target", "quad40", *words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_what_a_second_camera_buys_is_the_joint_bound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table of angles against `rig_crlb` of a rig with that angle."""
    camera, target = tp.Camera.ideal(640, 480, 620.0), tp.Target.load("quad40")
    camera.save(tmp_path / "camera.yaml")
    distance = ("--distance", 110, 130, "--steps", 3, "--noise", 2)
    out = tmp_path / "out"
    assert (
        run(
            "sensitivity",
            "--camera",
            tmp_path / "camera.yaml",
            "--target",
            "quad40",
            *distance,
            "--second-camera",
            "--out",
            out,
        )
        == 0
    )
    assert "times less" in capsys.readouterr().out
    with (out / "second_camera.csv").open() as file:
        rows = {float(row["angle deg"]): row for row in csv.DictReader(file)}
    turn = rotations.exp(torch.tensor([0.0, torch.pi / 6, 0.0], dtype=F64))
    t = torch.tensor([0.0, 0.0, 120.0], dtype=F64)
    eye = torch.eye(3, dtype=F64)
    rig = tp.CameraRig([camera, camera], torch.stack([eye, turn]), torch.stack([0 * t, t - turn @ t]))
    bound = tp.analysis.rig_crlb(rig, target, eye[None], t[None], psf_sigma=0.7, noise_sigma=2.0)[0]
    assert float(rows[30.0]["z um"]) == pytest.approx(1e3 * float(bound[2, 2].sqrt()), rel=1e-6)
    assert float(rows[30.0]["z um"]) < 0.6 * float(rows[0.0]["z um"])
    rig.save(tmp_path / "rig.yaml")
    assert run("sensitivity", "--cameras", tmp_path / "rig.yaml", "--target", "quad40", *distance, "--out", out) == 0
    with (out / "cameras.csv").open() as file:
        together = [row for row in csv.DictReader(file) if row["cameras"] == "all" and float(row["distance mm"]) == 120]
    assert float(together[0]["x um"]) == pytest.approx(1e3 * float(bound[0, 0].sqrt()), rel=1e-6)
