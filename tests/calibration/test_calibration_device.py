"""Tensors are made where the inputs are."""

from dataclasses import replace

import torch

import torchpose as tp
from tests.calibration import calibration_scenes as scenes
from tests.devices import DeviceNamed
from torchpose.calibration import calibrate_hand_eye, calibrate_intrinsics
from torchpose.calibration.boards import Board, find_corners
from torchpose.calibration.intrinsics import locate_views, start_cameras
from torchpose.calibration.rings import find_rings, measure_centers
from torchpose.calibration.session import calibrate_robot
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

CAMERA = scenes.camera(scale=0.5)


def test_intrinsics_and_hand_eye_follow_their_inputs() -> None:
    pose = scenes.poses(CAMERA, 8)
    views = scenes.views(CAMERA, pose, scenes.grid(6.0), sigma=0.02)
    views = replace(views, pixels=views.pixels.index_add(0, torch.tensor([5]), views.pixels.new_tensor([[4.0, 0]])))
    starts = start_cameras(CAMERA.width, CAMERA.height, "brown4")
    off = 1e-4 * torch.randn(8, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    r, t = scenes.robot_poses("tool", pose)
    robot = dict(zip(views.names, torch.cat([t + off, rotations.log(r)], -1).tolist(), strict=True))
    with DeviceNamed("calibration"):
        found = calibrate_intrinsics(views, starts, lens="brown4")
        located, bundle = locate_views(views, CAMERA)
        fit = calibrate_robot(located, bundle, found.covariance[:4, :4], robot)
        again = calibrate_hand_eye(
            (r, t), (bundle.R, bundle.t), found.pose_covariance, "tool", robot_sigma=(1e-3, 1e-5)
        )
    assert found.left_out
    for value in (found.covariance, found.pose_covariance, bundle.gain, fit.covariance, again.residual):
        assert value.device.type == "cpu"
        assert value.dtype == torch.float64


def test_rings_and_boards_follow_the_frames() -> None:
    target = tp.Target.load("quad40")
    frames = add_noise(render(CAMERA, target, *scenes.poses(CAMERA, 2)), 1.0)
    board = Board.parse("chessboard:5x4:8mm")
    with DeviceNamed("calibration"):
        rough = find_rings(["a", "b"], frames, [CAMERA], target)[0]
        exact = measure_centers(["a", "b"], frames, CAMERA, target)
        empty = find_corners(["a", "b"], frames, board)
    assert len(rough.view) == len(exact.view) == 8
    for views in (rough, exact, empty):
        assert all(value.device.type == "cpu" for value in (views.view, views.points, views.pixels, views.covariance))
