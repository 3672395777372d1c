"""``torchpose calibrate`` as a user types it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import pytest
import torch

import torchpose as tp
from tests.calibration import board_scenes as boards
from torchpose.calibration.grids import Grid
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.handeye import HandEye
from torchpose.sim import add_noise, render

F64 = torch.float64
CAMERA = tp.Camera(
    912,
    608,
    torch.tensor([[751.0, 0, 453], [0, 750, 306], [0, 0, 1]], dtype=F64),
    torch.tensor([-0.05, 0.02, 1e-4, -1e-4], dtype=F64),
)
BASE_FROM_CAMERA = (torch.tensor([3.0, 0.1, -0.2], dtype=F64), torch.tensor([450.0, -80, 600], dtype=F64))
TOOL_FROM_TARGET = (torch.tensor([0.1, 0.05, 0.7], dtype=F64), torch.tensor([5.0, -10, 60], dtype=F64))
VIEWS = 9


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["calibrate", *map(str, arguments)])
    code = end.value.code
    assert isinstance(code, int)
    return code


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A manifest of views with the poses of a robot that carries the target, 10 um and 50 urad off."""
    folder = tmp_path_factory.mktemp("capture")
    g = torch.Generator().manual_seed(5)
    azimuth = 2 * math.pi * torch.arange(VIEWS, dtype=F64) / VIEWS
    tilt = 0.25 + 0.35 * torch.rand(VIEWS, dtype=F64, generator=g)
    r = rotations.exp(tilt[:, None] * torch.stack([azimuth.cos(), azimuth.sin(), 0.5 * azimuth.cos()], -1))
    t = torch.stack([22 * azimuth.sin(), 12 * azimuth.cos(), 160 + 30 * torch.rand(VIEWS, dtype=F64, generator=g)], -1)
    x, z = ((rotations.exp(w), p) for w, p in (BASE_FROM_CAMERA, TOOL_FROM_TARGET))
    tool = rotations.compose(*rotations.compose(*x, r, t), *rotations.inverse(*z))
    noise = torch.randn(VIEWS, 6, dtype=F64, generator=g) * torch.tensor([0.01] * 3 + [5e-5] * 3, dtype=F64)
    vector = rotations.log(rotations.exp(noise[:, 3:]) @ tool[0])
    frames = add_noise(render(CAMERA, tp.Target.load("hexa50"), r, t), 1.0)
    records: list[dict[str, object]] = [{"record": "session", "units": {"length": "m"}}]
    for k in range(VIEWS):
        cv2.imwrite(str(folder / f"{k}.png"), frames[k].numpy())
        pose = [*((tool[1] + noise[:, :3])[k] / 1000).tolist(), *vector[k].tolist()]
        records.append({"record": "frame", "id": k, "image": f"{k}.png", "robot_pose": pose})
    (folder / "manifest.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def test_camera_and_hand_eye_of_a_manifest(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera_file, hand_eye_file, plots = tmp_path / "camera.yaml", tmp_path / "handeye.yaml", tmp_path / "plots"
    manifest = capture / "manifest.jsonl"
    both = ("--out", camera_file, "--hand-eye-out", hand_eye_file, "--plots", plots, "--model", "brown4")
    assert run(manifest, "--target", "hexa50", *both) == 0
    camera = tp.Camera.load(camera_file)
    assert camera.covariance is not None
    error = torch.cat([(camera.matrix - CAMERA.matrix).diagonal()[:2], (camera.matrix - CAMERA.matrix)[:2, 2]])
    # chi-squared with 4 degrees of freedom stays below 23.5 but for once in 10^4
    assert float(error @ torch.linalg.solve(camera.covariance[:4, :4], error)) < 23.5
    assert float(error[:2].abs().max()) < 0.5

    def check() -> None:
        found = HandEye.load(hand_eye_file)
        assert found.mount == "base"
        assert found.covariance is not None
        off = torch.cat(
            [
                BASE_FROM_CAMERA[1] - found.translation,
                rotations.log(rotations.exp(BASE_FROM_CAMERA[0]) @ found.rotation.mT),
            ]
        )
        # 42 residuals give the noise of the robot: a wider law than chi-squared, 27.9 once in 10^4
        assert float(off @ torch.linalg.solve(found.covariance, off)) < 45

    check()
    shown = capsys.readouterr().out
    assert "fx" in shown
    assert "base_from_camera, from 9 poses" in shown
    assert {p.name for p in plots.iterdir()} == {"residuals.png", "residuals.csv", "covariance.csv", "hand_eye.png"}
    assert cv2.imread(str(plots / "residuals.png")) is not None
    # the same with the camera taken as given
    hand_eye_file.unlink()
    assert run(manifest, "--target", "hexa50", "--camera", camera_file, "--hand-eye-out", hand_eye_file) == 0
    check()
    # what it wrote is what estimate reads
    table = tmp_path / "poses.csv"
    options = ["--camera", camera_file, "--target", "hexa50", "--out", table, "--hand-eye", hand_eye_file]
    with pytest.raises(SystemExit) as end:
        main(["estimate", str(capture / "0.png"), *map(str, options)])
    assert end.value.code == 0
    assert "base_tx" in table.read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--out", "c.yaml"), "--target: give either --target or --board"),
        (("--target", "hexa50", "--board", "chessboard:9x6:5mm", "--out", "c.yaml"), "either --target or --board"),
        (("--target", "hexa50"), "--out: nothing to write"),
        (("--target", "hexa50", "--hand-eye-out", "h.yaml"), "--camera: needed"),
        (("--target", "hexa50", "--out", "/proc/missing/c.yaml"), "--out: /proc cannot be written"),
        (("--target", "hexa50", "--out", "c.yaml", "--model", "brown6"), "brown6"),
        (("--board", "chessboard:9x6", "--out", "c.yaml"), "is no board"),
        (
            ("--target", "hexa50", "--out", "c.yaml", "--hand-eye-out", "h.yaml"),
            "robot_pose: missing for 9 of 9 frames",
        ),
    ],
)
def test_wrong_options_are_one_line(
    capture: Path, arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(capture, *arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())


def test_frames_of_two_sizes(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = tmp_path / "other" / "small.png"
    small.parent.mkdir()
    frame = cv2.imread(str(capture / "0.png"), cv2.IMREAD_GRAYSCALE)
    assert frame is not None
    cv2.imwrite(str(small), frame[:500, :700])
    assert run(capture / "0.png", small, "--target", "hexa50", "--out", tmp_path / "c.yaml") == 2
    assert "small.png: INPUT: is 700x500, not 912x608" in capsys.readouterr().err
    assert not (tmp_path / "c.yaml").exists()


def test_too_few_views_and_unreadable_frames(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capture / "0.png", capture / "1.png", "--target", "hexa50", "--out", tmp_path / "c.yaml") == 2
    assert "2 usable views" in capsys.readouterr().err
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no image")
    assert run(broken, "--target", "hexa50", "--out", tmp_path / "c.yaml") == 2
    assert "no frame could be read" in capsys.readouterr().err


def test_a_board_of_dots_in_frames_that_are_not_linear(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """OpenCV's asymmetric grid, files of gamma 1.8: the camera, its covariance, and the tone in the file."""
    azimuth = 2 * math.pi * torch.arange(VIEWS, dtype=F64) / VIEWS
    r = rotations.exp(0.5 * torch.stack([azimuth.cos(), azimuth.sin(), 0.2 * azimuth.cos()], -1))
    depth = torch.linspace(130, 190, VIEWS, dtype=F64)
    t = torch.stack([14 * azimuth.sin(), 9 * azimuth.cos(), depth], -1)
    grid = Grid.parse("acircles:4x11:5mm")
    assert grid is not None
    drawn = boards.shapes(grid, 1.8)
    frames = torch.cat([render(CAMERA, drawn, r[k : k + 1], t[k : k + 1]) for k in range(VIEWS)])
    for k, frame in enumerate(add_noise(frames, 1.0, gamma=1.8)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), frame.numpy())
    file = tmp_path / "camera.yaml"
    assert run(tmp_path, "--board", "acircles:4x11:5mm", "--out", file, "--model", "brown4") == 0
    assert "tone gamma: 1.8" in capsys.readouterr().out.replace("1.79", "1.8").replace("1.81", "1.8")
    camera = tp.Camera.load(file)
    assert camera.tone is not None
    assert camera.tone.gamma == pytest.approx(1.8, abs=0.05)
    assert camera.covariance is not None
    error = torch.cat([(camera.matrix - CAMERA.matrix).diagonal()[:2], (camera.matrix - CAMERA.matrix)[:2, 2]])
    # chi-squared with 4 degrees of freedom stays below 23.5 but for once in 10^4
    assert float(error @ torch.linalg.solve(camera.covariance[:4, :4], error)) < 23.5
    assert float(error.abs().max()) < 0.5
    assert run(tmp_path, "--board", "acircles:5x11:5mm", "--out", file) == 2
    assert "acircles:5x11 is in none of the frames" in capsys.readouterr().err
