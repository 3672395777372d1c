"""From rendered frames to a camera: ring targets and boards, against the truth they were rendered with."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration.boards import Board, find_corners
from torchpose.calibration.session import calibrate_camera, locate_camera
from torchpose.errors import ConfigError
from torchpose.sim import add_noise, render

CAMERA = scenes.camera(scale=0.5)


@pytest.fixture(scope="module")
def rings() -> tuple[list[str], torch.Tensor, scenes.Transform]:
    pose = scenes.poses(CAMERA, 10)
    return [f"{k}.png" for k in range(10)], add_noise(render(CAMERA, tp.Target.load("hexa50"), *pose), 1.0), pose


def test_focal_length_a_quarter_percent_off_is_recovered(
    rings: tuple[list[str], torch.Tensor, scenes.Transform],
) -> None:
    names, frames, pose = rings
    nominal = replace(CAMERA, matrix=CAMERA.matrix * torch.tensor([[1.0025], [1.0025], [1]]), distortion=torch.zeros(4))
    nominal = replace(nominal, distortion=nominal.distortion.double())
    target = tp.Target.load("hexa50")
    found = calibrate_camera(
        lambda: [(names[:4], frames[:4]), (names[4:], frames[4:])], target, nominal, guess=False, lens="brown4"
    )
    error = scenes.intrinsics(found.camera) - scenes.intrinsics(CAMERA)
    assert float((error / found.covariance.diagonal().sqrt()).abs().max()) < 4
    assert float(error[:2].abs().max()) < 2e-4 * 750  # a twelfth of what was wrong
    assert 0.6 < found.reduced_chi2 < 1.5
    assert len(found.views) == 10
    views, bundle = locate_camera(lambda: [(names, frames)], target, CAMERA)
    sigma = bundle.pose_covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sqrt()
    assert float(((bundle.t - pose[1]) / sigma).abs().max()) < 5
    assert views.names == tuple(names)


def test_a_print_that_states_its_errors_keeps_its_views_and_tells_the_camera() -> None:
    """Places 20 um off, rims 15 um, rings turned by 3 mrad against the plane of the file, a camera 0.25 % off."""
    g = torch.Generator().manual_seed(8)
    nominal = tp.Target.load("hexa50")
    off, turned = (sigma * torch.randn(6, 3, dtype=torch.float64, generator=g) for sigma in (0.02, 3e-3))
    normals = torch.nn.functional.normalize(nominal.normals + turned, dim=-1)
    printed = replace(nominal, centers=nominal.centers + off, normals=normals, edge_gain=0.015)
    frames = add_noise(render(CAMERA, printed, *scenes.poses(CAMERA, 12, seed=3)), 1.0)
    start = replace(CAMERA, matrix=CAMERA.matrix * torch.tensor([[1.0025], [1.0025], [1]]))
    stated = replace(nominal, covariance=torch.diag(torch.tensor([0.02] * 19, dtype=torch.float64).square()))
    names = [f"{k}.png" for k in range(12)]
    found, alone = (
        calibrate_camera(lambda: [(names, frames)], target, start, guess=False, lens="brown4")
        for target in (stated, nominal)
    )
    assert len(found.views.view) == len(alone.views.view) == 12 * 6
    assert found.common_sigma_px < 0.02 * alone.common_sigma_px
    error = scenes.intrinsics(found.camera) - scenes.intrinsics(CAMERA)
    assert float(error @ torch.linalg.solve(found.covariance, error)) < 8 + 4 * 4
    # what the print's errors do to the camera is told from its noise
    assert float((found.covariance.diagonal() / alone.covariance.diagonal()).sqrt().max()) < 0.1


def test_frames_without_a_target_are_named() -> None:
    frames = torch.full((3, CAMERA.height, CAMERA.width), 128, dtype=torch.uint8)
    with pytest.raises(ConfigError, match="no marker of target quad40"):
        calibrate_camera(
            lambda: [(["a", "b", "c"], frames)], tp.Target.load("quad40"), CAMERA, guess=True, lens="brown4"
        )
    with pytest.raises(ConfigError, match="the board is in none"):
        calibrate_camera(
            lambda: [(["a", "b", "c"], frames)], Board.parse("chessboard:5x4:8mm"), CAMERA, guess=True, lens="brown4"
        )


def photograph(picture: np.ndarray, mm_per_px: float, pose: scenes.Transform) -> torch.Tensor:
    """Frames (N, H, W) of a flat picture whose first pixel lies at the target's origin, 2 x 2 samples a pixel."""
    fine = 2
    u, v = np.meshgrid(np.arange(CAMERA.width * fine), np.arange(CAMERA.height * fine))
    uv = torch.from_numpy(np.stack([(u - 0.5) / fine, (v - 0.5) / fine], -1)).double()
    ray = torch.nn.functional.pad(CAMERA.undistort_points(uv), (0, 1), value=1.0)
    frames = []
    for r, t in zip(*pose, strict=True):
        depth = (r[:, 2] @ t) / (ray @ r[:, 2])
        across, down = (((depth[..., None] * ray - t) @ r)[..., :2] / mm_per_px).float().unbind(-1)
        fine_frame = cv2.remap(
            picture,
            across.numpy(),
            down.numpy(),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=230,
        )
        frames.append(cv2.resize(fine_frame, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA))
    return torch.from_numpy(np.stack(frames))


@pytest.mark.parametrize("text", ["chessboard:7x5:8mm", "charuco:8x6:8mm:6mm:4X4_50"])
def test_boards(text: str) -> None:
    board, scale = Board.parse(text), 0.1
    if board.charuco is None:
        squares = (np.indices((6, 8)).sum(0) % 2 * 200 + 30).astype(np.uint8)
        picture = np.pad(np.kron(squares, np.ones((80, 80), np.uint8)), 80, constant_values=230)
        corner = 1.5 * 80 + 40 - 0.5  # px of the first inner corner: border, one square
    else:
        picture = np.pad(board.charuco.generateImage((640, 480)), 80, constant_values=230)
        corner = 1.5 * 80 + 40 - 0.5
    r, t = scenes.poses(CAMERA, 6, tilt=(15, 30), seed=3)
    middle = scale * torch.tensor([*(np.array(picture.shape[::-1]) / 2), 0.0], dtype=torch.float64)
    pose = (r, t * 1.1 - (r @ middle[:, None])[..., 0])
    frames = photograph(picture, scale, pose)
    views = find_corners([str(k) for k in range(6)], frames, board)
    assert int((views.counts >= 25).sum()) >= 5
    # corners are where the truth has them
    place = views.points + scale * torch.tensor([corner, corner, 0], dtype=torch.float64)
    true = CAMERA.project((pose[0][views.view] @ place[..., None])[..., 0] + pose[1][views.view])
    assert float((views.pixels - true).norm(dim=-1).median()) < 0.08
    found = calibrate_camera(lambda: [(views.names, frames)], board, CAMERA, guess=True, lens="brown4")
    assert abs(float(found.camera.matrix[0, 0]) - 751.5) < 5 * float(found.covariance[0, 0].sqrt()) + 0.5
    assert 0 < found.common_sigma_px < 0.15


@pytest.mark.parametrize(
    "text",
    ["chess:9x6:5mm", "chessboard:9x6:5", "chessboard:2x6:5mm", "chessboard:9x6:0mm", "charuco:8x6:8mm:9mm:4X4_50",
     "charuco:8x6:8mm:6mm:9X9_50", "charuco:20x20:8mm:6mm:4X4_50"],
)  # fmt: skip
def test_wrong_boards_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--board"):
        Board.parse(text)
