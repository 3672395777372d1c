"""Hand-eye files: both mounts, both spellings of a pose, and one line for every mistake."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.handeye import HandEye

VECTOR = [0.3, -1.2, 2.0]
MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_rotvec(VECTOR).as_matrix()
MATRIX[:3, 3] = [100.5, -20.0, 812.25]


def load(tmp_path: Path, text: str) -> HandEye:
    path = tmp_path / "handeye.yaml"
    path.write_text(text)
    return HandEye.load(path)


@pytest.mark.parametrize(
    "pose",
    [
        f"{{rotation: {VECTOR}, translation: [100.5, -20, 812.25]}}",
        f"{{matrix: {MATRIX.tolist()}}}",
        f"{{matrix: {MATRIX.round(7).tolist()}}}",  # a file with few digits
    ],
)
def test_camera_on_the_base(tmp_path: Path, pose: str) -> None:
    handeye = load(tmp_path, f"base_from_camera: {pose}\n")
    assert handeye.mount == "base"
    r, t = handeye.base_from_camera()
    np.testing.assert_allclose(r.numpy(), MATRIX[:3, :3], rtol=0, atol=1e-7)
    np.testing.assert_allclose((r.T @ r).numpy(), np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(t.numpy(), MATRIX[:3, 3])
    robot = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), torch.ones(2, 3, dtype=torch.float64)
    assert torch.equal(handeye.base_from_camera(robot)[1], t)


def test_camera_on_the_tool_follows_the_robot(tmp_path: Path) -> None:
    handeye = load(tmp_path, f"tool_from_camera: {{matrix: {MATRIX.tolist()}}}\n")
    assert handeye.mount == "tool"
    tools = np.tile(np.eye(4), (5, 1, 1))
    tools[:, :3, :3] = Rotation.random(5, random_state=1).as_matrix()
    tools[:, :3, 3] = np.random.default_rng(1).normal(0, 300, (5, 3))
    r, t = handeye.base_from_camera((torch.tensor(tools[:, :3, :3]), torch.tensor(tools[:, :3, 3])))
    expected = tools @ MATRIX
    np.testing.assert_allclose(r.numpy(), expected[:, :3, :3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(t.numpy(), expected[:, :3, 3], rtol=0, atol=1e-11)
    with pytest.raises(ConfigError, match=r"handeye\.yaml: tool_from_camera: needs the robot's pose at each frame; "):
        handeye.base_from_camera()


def matrix_with(row: int, column: int, value: float) -> str:
    rows = MATRIX.tolist()
    rows[row][column] = float(value)
    return f"base_from_camera: {{matrix: {rows}}}"


POSE = "{rotation: [0, 0, 0], translation: [1, 2, 3]}"
TRAPS = {
    "both": (f"base_from_camera: {POSE}\ntool_from_camera: {POSE}\n", "file: does not say where the camera is; give "),
    "neither": ("{}", "file: does not say where the camera is; give base_from_camera or tool_from_camera"),
    "unknown mount": (f"base_from_cam: {POSE}\n", r"base_from_cam: unknown key; did you mean base_from_camera\?"),
    "unknown key": (
        "base_from_camera: {rotatoin: [0, 0, 0], translation: [1, 2, 3]}",
        r"base_from_camera\.rotatoin: unknown key; did you mean rotation\?",
    ),
    "half": ("base_from_camera: {rotation: [0, 0, 0]}", "base_from_camera: is not one pose; give rotation and "),
    "nothing": ("base_from_camera: {}", "base_from_camera: is not one pose; "),
    "two spellings": (
        f"base_from_camera: {{rotation: [0, 0, 0], translation: [1, 2, 3], matrix: {MATRIX.tolist()}}}",
        "base_from_camera: is not one pose; ",
    ),
    "short": (
        "base_from_camera: {rotation: [0, 0, 0, 1], translation: [1, 2, 3]}",
        r"base_from_camera\.rotation: has 4 entries; give 3",
    ),
    "degrees": (
        "base_from_camera: {rotation: [0, 180, 0], translation: [1, 2, 3]}",
        r"base_from_camera\.rotation: turns by 180 rad, more than once around; write a rotation vector in rad, not deg",
    ),
    "nan": ("base_from_camera: {rotation: [0, 0, .nan], translation: [1, 2, 3]}", r".*rotation\[2\]: is not finite; "),
    "3x4": (f"base_from_camera: {{matrix: {MATRIX[:3].tolist()}}}", "base_from_camera: matrix is not 4 x 4; "),
    "last row": (matrix_with(3, 0, 1.0), "base_from_camera: matrix has the last row "),
    "skewed": (
        matrix_with(0, 0, MATRIX[0, 0] + 1e-5),
        "base_from_camera: matrix has a rotation part off orthonormal by ",
    ),
    "reflection": (
        "base_from_camera: {matrix: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}",
        "base_from_camera: matrix is a reflection ",
    ),
    "scalar": ("base_from_camera: 5", "base_from_camera: is not a mapping; "),
    "twice": (f"base_from_camera: {POSE}\nbase_from_camera: {POSE}\n", r"base_from_camera: given twice \(line 2\); "),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_traps_name_file_field_and_fix(tmp_path: Path, trap: str) -> None:
    text, message = TRAPS[trap]
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'handeye.yaml'}: {message}") as caught:
        load(tmp_path, text)
    assert len(str(caught.value).splitlines()) == 1


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: file: does not exist; "):
        HandEye.load(tmp_path / "none.yaml")


def test_rotation_of_half_a_turn(tmp_path: Path) -> None:
    handeye = load(tmp_path, f"base_from_camera: {{rotation: [{math.pi!r}, 0, 0], translation: [0, 0, 0]}}")
    np.testing.assert_allclose(handeye.rotation.numpy(), np.diag([1.0, -1, -1]), rtol=0, atol=1e-15)


def test_file_with_covariance_survives(tmp_path: Path) -> None:
    root = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rotation = torch.from_numpy(MATRIX[:3, :3])
    saved = HandEye("tool", rotation, torch.tensor([1.0, -2, 3], dtype=torch.float64), covariance=root @ root.T)
    saved.save(tmp_path / "handeye.yaml")
    read = HandEye.load(tmp_path / "handeye.yaml")
    assert read.mount == "tool"
    assert read.covariance is not None
    np.testing.assert_allclose(read.rotation.numpy(), rotation.numpy(), rtol=0, atol=1e-15)
    assert torch.equal(read.translation, saved.translation)
    assert torch.equal(read.covariance, root @ root.T)


@pytest.mark.parametrize(
    "bad", ["[[1, 0], [0, 1]]", str(np.diag([1.0, 1, 1, 1, 1, -1]).tolist()), str(np.tri(6).tolist())]
)
def test_wrong_covariance_is_one_line(tmp_path: Path, bad: str) -> None:
    with pytest.raises(ConfigError, match="covariance"):
        load(tmp_path, f"base_from_camera: {{rotation: {VECTOR}, translation: [0, 0, 0], covariance: {bad}}}\n")


@pytest.mark.parametrize("mount", ["base", "tool"])
def test_base_covariance_is_the_scatter_of_base_poses(mount: str) -> None:
    g = torch.Generator().manual_seed(3)
    many, sigma = 4000, torch.tensor([0.1, 0.2, 0.3, 1e-3, 2e-3, 3e-3], dtype=torch.float64)
    rotation, translation = torch.from_numpy(MATRIX[:3, :3]), torch.from_numpy(MATRIX[:3, 3])
    known = HandEye(mount, rotation, translation, covariance=torch.diag(sigma**2))  # type: ignore[arg-type]
    tool = None
    if mount == "tool":
        turned = rotations.exp(torch.tensor([[0.4, -0.3, 1.0]], dtype=torch.float64))
        tool = (turned, torch.tensor([[200.0, 50, 300]], dtype=torch.float64))
    seen = torch.tensor([[30.0, -20, 400]], dtype=torch.float64)
    off = sigma * torch.randn(many, 6, dtype=torch.float64, generator=g)
    points = []
    for r, t in zip(rotations.exp(off[:, 3:]) @ rotation, translation + off[:, :3], strict=True):
        base = HandEye(mount, r, t).base_from_camera(tool)  # type: ignore[arg-type]
        points.append((base[0] @ seen[..., None])[..., 0].reshape(-1) + base[1].reshape(-1))
    scatter = torch.cov(torch.stack(points).T)
    center = known.base_from_camera(tool)
    at = ((center[0] @ seen[..., None])[..., 0] + center[1]).reshape(1, 3)
    predicted = known.base_covariance(at, tool)[0, :3, :3]
    assert float((scatter - predicted).abs().max()) < 0.08 * float(predicted.diagonal().max())
    assert not HandEye(mount, rotation, translation).base_covariance(at, tool).any()  # type: ignore[arg-type]
