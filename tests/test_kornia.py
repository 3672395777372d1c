"""Torchpose among kornia's modules: filters before it, kornia's types after it, and kornia's maths beside ours."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import kornia
import pytest
import torch
from torch import Tensor, nn

import torchpose as tp
from torchpose.geometry import rotations
from torchpose.geometry.grey import grey
from torchpose.pnp import solve

SAMPLE = Path(__file__).parents[1] / "data" / "sample"
F64 = torch.float64


@pytest.fixture(scope="module")
def frame() -> Tensor:
    """(1, 1, H, W) float32 of 0..1."""
    image = cv2.imread(str(SAMPLE / "frames" / "003.png"), cv2.IMREAD_GRAYSCALE)
    return torch.from_numpy(image)[None, None].float() / 255


@pytest.fixture(scope="module")
def estimator() -> tp.PoseEstimator:
    return tp.PoseEstimator(tp.Camera.load(SAMPLE / "camera.yaml"), tp.Target.load(SAMPLE / "target.yaml"))


@pytest.fixture(scope="module")
def plain(estimator: tp.PoseEstimator, frame: Tensor) -> tp.Poses:
    poses: tp.Poses = estimator(frame)
    assert poses.ok.all()
    return poses


def assert_near(poses: tp.Poses, plain: tp.Poses, deviations: float) -> None:
    assert poses.ok.all()
    assert ((poses.t - plain.t).abs() < deviations * plain.std[:, :3]).all()
    assert (rotations.angle_between(poses.R, plain.R) < deviations * plain.std[:, 3:].norm(dim=-1)).all()


def test_estimator_behind_kornias_filters(estimator: tp.PoseEstimator, frame: Tensor, plain: tp.Poses) -> None:
    """The snippet of docs/kornia.md: dead pixels are filtered away, then the pose is measured."""
    broken = kornia.augmentation.RandomSaltAndPepperNoise(amount=(0.001, 0.001), p=1.0)(frame)
    pipeline = nn.Sequential(kornia.filters.MedianBlur((3, 3)), estimator)
    assert_near(pipeline(broken), plain, 3)


def test_colour_batches_through_kornia(estimator: tp.PoseEstimator, frame: Tensor, plain: tp.Poses) -> None:
    colour = frame.repeat(2, 3, 1, 1)
    pipeline = nn.Sequential(
        kornia.color.RgbToGrayscale(), kornia.filters.GaussianBlur2d((3, 3), (0.3, 0.3)), estimator
    )
    poses = pipeline(colour)
    assert len(poses) == 2
    for row in (0, 1):
        assert_near(poses[row : row + 1], plain, 4)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_grey_is_opencvs_luma(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    colour = torch.rand(2, 3, 30, 40, generator=generator)
    if dtype != torch.float32:
        top = torch.iinfo(dtype).max
        colour = (colour * top).to(torch.int32).to(dtype)
    expected = torch.stack(
        [torch.from_numpy(cv2.cvtColor(c.permute(1, 2, 0).contiguous().numpy(), cv2.COLOR_RGB2GRAY)) for c in colour]
    )
    ours = grey(colour)
    assert ours.dtype == dtype
    assert ours.shape == (2, 30, 40)
    if dtype == torch.uint16:  # OpenCV rounds a fixed-point sum
        assert (ours.to(torch.int32) - expected.to(torch.int32)).abs().max() <= 1
    else:
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-6 if dtype == torch.float32 else 0)


def poses_of(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    return (
        rotations.exp(0.4 * torch.randn(count, 3, generator=generator, dtype=F64)),
        torch.tensor([1.0, -2, 160], dtype=F64) + torch.randn(count, 3, generator=generator, dtype=F64),
    )


def test_pinhole_projects_as_ours_from_target_to_pixels() -> None:
    """Integer pixel centres, extrinsics that map target to camera, pixels as x, y: kornia's conventions are ours."""
    camera = tp.Camera(1824, 1216, [[1100.0, 0, 911.5], [0, 1110, 600], [0, 0, 1]], [])
    R, t = poses_of(5)
    points = torch.tensor([[-20.0, -20, 0], [20, -20, 1], [20, 20, 0]], dtype=F64)
    theirs = camera.pinhole(R, t)
    assert (theirs.height.tolist(), theirs.width.tolist()) == ([1216.0] * 5, [1824.0] * 5)
    ours = camera.project(points @ R.mT + t[:, None])
    torch.testing.assert_close(theirs.project(points.expand(5, 3, 3)), ours, rtol=0, atol=1e-9)
    back = tp.Camera.from_pinhole(theirs, 3)
    assert (back.width, back.height, back.model) == (1824, 1216, "brown_conrady")
    torch.testing.assert_close(back.matrix, camera.matrix, rtol=0, atol=0)
    torch.testing.assert_close(camera.pinhole().extrinsics, torch.eye(4, dtype=F64)[None])
    skewed = camera.pinhole()
    skewed.intrinsics[0, 0, 1] = 0.5
    with pytest.raises(tp.ConfigError, match="skew"):
        tp.Camera.from_pinhole(skewed)


def test_se3_is_the_pose(plain: tp.Poses) -> None:
    pose = plain.se3()
    points = torch.tensor([[3.0, -4.0, 5.0]], dtype=F64)
    torch.testing.assert_close((pose * points).detach(), points @ plain.R[0].mT + plain.t, rtol=0, atol=1e-12)
    torch.testing.assert_close(pose.quaternion.data, plain.quaternion)  # Hamilton, w first
    R, t = pose.so3.matrix().detach(), pose.t.detach()  # the way back
    torch.testing.assert_close(R, plain.R, rtol=0, atol=1e-13)
    assert torch.equal(t, plain.t)
    # a step from the left, as our covariance counts it
    step = torch.tensor([[0.0, 0, 0, 1e-3, -2e-3, 5e-4]], dtype=F64)
    turned = (kornia.geometry.liegroup.Se3.exp(step) * pose).so3.matrix().detach()
    torch.testing.assert_close(turned, rotations.exp(step[:, 3:]) @ plain.R, rtol=0, atol=1e-13)


def test_undistortion_of_kornia_stops_short_where_ours_does_not() -> None:
    """Why `Camera.undistort_points` stays: kornia's fixed-point iteration leaves pixels at the corners."""
    camera = tp.Camera.load(SAMPLE / "camera.yaml")
    strong = tp.Camera(camera.width, camera.height, camera.matrix, [-0.3, 0.12, 1e-3, -2e-3])
    corner = torch.tensor([[0.0, 0.0], [1823, 1215], [900, 600]], dtype=F64)
    undistort = kornia.geometry.calibration.undistort_points
    theirs = undistort(corner[None], strong.matrix[None], strong.distortion[None], torch.eye(3, dtype=F64)[None])[0]
    error = (strong.distort(theirs) - corner).norm(dim=-1)
    ours = (strong.distort(strong.undistort_points(corner)) - corner).norm(dim=-1)
    assert ours.max() < 1e-10
    assert error[2] < 1e-6
    assert error[:2].max() > 1e-3  # pixels


def test_pnp_of_kornia_is_for_solid_point_sets_alone() -> None:
    """`solve_pnp_dlt` refuses a plane; on a solid it agrees with ours, which also refines."""
    camera = tp.Camera.ideal(1824, 1216, 1100.0)
    R, t = poses_of(1)
    generator = torch.Generator().manual_seed(1)
    solid = 20 * torch.randn(9, 3, generator=generator, dtype=F64)
    for points in (solid, solid * torch.tensor([1.0, 1.0, 0.0], dtype=F64)):
        pixels = camera.project(points @ R.mT + t[:, None])
        ours = solve(points, pixels, camera)
        torch.testing.assert_close(ours.t, t, rtol=0, atol=1e-7)
        arguments = points[None], pixels, camera.matrix[None]
        if points is solid:
            theirs = kornia.geometry.solve_pnp_dlt(*arguments, svd_eps=1e-12)
            torch.testing.assert_close(theirs[:, :, 3], t, rtol=0, atol=1e-6)
        else:
            with pytest.raises(AssertionError, match="singular value"):
                kornia.geometry.solve_pnp_dlt(*arguments)


IMPORTED = """
import sys
from torchpose.cli.main import main
try:
    main()
except SystemExit:
    pass
print([name for name in sys.modules if name.split(".")[0] in ("kornia", "kornia_rs")])
"""


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["estimate", "--help"],
        [
            *("estimate", str(SAMPLE / "frames" / "003.png"), "--camera", str(SAMPLE / "camera.yaml"), "--quiet"),
            *("--target", str(SAMPLE / "target.yaml"), "--threads", "1", "--out", "poses.jsonl"),
        ],
    ],
    ids=["help", "estimate --help", "estimate"],
)
def test_the_command_line_does_not_wait_for_kornia(tmp_path: Path, arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    loaded = eval(done.stdout.strip().splitlines()[-1])
    assert "kornia" not in loaded  # half a second; the decoder alone takes milliseconds
    assert ("kornia_rs" in loaded) == ("--out" in arguments)
