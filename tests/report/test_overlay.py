"""Overlays: drawn where the numbers say, to a fraction of a pixel; the colour of the plate tells the status."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.report import overlay
from torchpose.report.overlay import Overlay, picture_path
from torchpose.results import Detections, Poses, Reason, Status
from torchpose.target import Target

WIDTH, HEIGHT = 400, 300
CAMERA = Camera(
    WIDTH,
    HEIGHT,
    torch.tensor([[500.0, 0, 199.5], [0, 500, 149.5], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([-0.2, 0.05, 0.001, 0.0, 0.0], dtype=torch.float64),
)
TARGET = Target.load("quad40")
NAN = float("nan")


def one_pose(
    status: Status = Status.OK,
    translation: tuple[float, float, float] = (-10.0, 8.0, 150.0),
    rotation: tuple[float, float, float] = (0.5, -0.3, 0.2),
    reason: Reason = Reason.NONE,
) -> Poses:
    """One pose with two markers whose ellipses are known."""
    none = torch.full((1,), NAN, dtype=torch.float64)
    center = torch.tensor([[120.3, 170.7], [260.25, 200.5]], dtype=torch.float64)
    zero = torch.zeros(2, dtype=torch.int64)
    detections = Detections(
        frame=zero,
        target=zero,
        instance=zero,
        marker=torch.tensor([0, 3]),
        center=center,
        center_cov=1e-4 * torch.eye(2, dtype=torch.float64).repeat(2, 1, 1),
        outer=torch.cat([center, torch.tensor([[30.0, 22.0, 0.4], [25.0, 20.0, 2.1]])], -1),
        inner=torch.cat([center, torch.tensor([[14.0, 10.0, 0.4], [12.0, 9.0, 2.1]])], -1),
    )
    return Poses(
        frame=zero[:1],
        target=zero[:1],
        instance=zero[:1],
        copies=zero[:1] + 1,
        R=rotations.exp(torch.tensor([rotation], dtype=torch.float64)),
        t=torch.tensor([translation], dtype=torch.float64),
        covariance=1e-6 * torch.eye(6, dtype=torch.float64)[None],
        noise=1e-6 * torch.eye(6, dtype=torch.float64)[None],
        systematic=torch.zeros(1, 6, 0, dtype=torch.float64),
        place=torch.zeros(1, 4, 5, dtype=torch.float64),
        misfit=torch.zeros(1, dtype=torch.int64),
        residual_chi2=torch.zeros(1, dtype=torch.float64),
        freedom=torch.zeros(1, dtype=torch.int64),
        rms=torch.full((1,), 0.01, dtype=torch.float64),
        status=zero[:1] + status,
        reason=zero[:1] + reason,
        markers=zero[:1] + 2,
        chi2=none,
        R_alt=none[:, None, None].expand(1, 3, 3),
        t_alt=none[:, None].expand(1, 3),
        rms_alt=none,
        chi2_alt=none,
        detections=detections,
    )


def draw(tmp_path: Path, poses: Poses, frame: torch.Tensor | None = None) -> np.ndarray:
    frame = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8) if frame is None else frame
    return Overlay(CAMERA, [TARGET], tmp_path).draw(frame, poses, "f.png").astype(int)


def share(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """How much of a colour each pixel of a picture drawn on black has, 0 to 1."""
    drawn = np.array(colour, float)
    amount = (picture * drawn).sum(-1) / (drawn**2).sum()
    pure = np.abs(picture - amount[..., None] * drawn).max(-1) < 6
    return np.where(pure & (amount > 0.05), amount, 0)


@pytest.mark.parametrize(("ring", "colour"), [("outer", overlay._OUTER), ("inner", overlay._INNER)])
def test_ellipses_are_drawn_at_their_sub_pixel_place(tmp_path: Path, ring: str, colour: tuple[int, int, int]) -> None:
    poses = one_pose(translation=(NAN, NAN, NAN))
    weight = share(draw(tmp_path, poses), colour)
    for cx, cy, a, b, theta in getattr(poses.detections, ring).tolist():
        v, u = np.nonzero(weight * (np.hypot(*np.ogrid[-cy : HEIGHT - cy, -cx : WIDTH - cx]) < 40))
        x, y = u - cx, v - cy
        along, across = x * np.cos(theta) + y * np.sin(theta), y * np.cos(theta) - x * np.sin(theta)
        radius = np.hypot(along / a, across / b)  # 1 on the ellipse
        distance = (radius - 1) * np.hypot(x, y) / radius
        weights = weight[v, u]
        assert np.abs(distance).max() < 1.7
        assert abs(np.average(distance, weights=weights)) < 0.15
        assert abs(np.average(x, weights=weights)) < 0.25
        assert abs(np.average(y, weights=weights)) < 0.25
        bins = np.histogram(np.arctan2(across, along), 24, (-np.pi, np.pi))[0]
        assert (bins > 0).sum() >= 18  # all round, but where a marker's number lies over it


def test_axes_end_where_the_camera_sees_them_through_its_distortion(tmp_path: Path) -> None:
    poses = one_pose()
    picture = draw(tmp_path, poses)
    length = (TARGET.centers - TARGET.centers.mean(0)).norm(dim=-1).max()
    ends = CAMERA.project(length * poses.R[0].T + poses.t[0]).numpy()
    origin = CAMERA.project(poses.t[0]).numpy()
    for end, colour in zip(ends, overlay._AXES, strict=True):
        v, u = np.nonzero(share(picture, colour) > 0.2)
        pixels = np.stack([u, v], -1)
        assert np.linalg.norm(pixels - end, axis=-1).min() < 1.5
        reach = (pixels - origin) @ (end - origin) / np.sum((end - origin) ** 2)
        assert reach.max() < 1.1


@pytest.mark.parametrize("status", Status)
def test_the_plate_has_the_colour_of_the_status(tmp_path: Path, status: Status) -> None:
    plate = draw(tmp_path, one_pose(status))[1, -2]
    green, amber, red = overlay._GREEN, overlay._AMBER, overlay._RED
    expected = {Status.OK: green, Status.AMBIGUOUS: amber}.get(status, red)
    np.testing.assert_array_equal(plate, expected)


@pytest.mark.parametrize("translation", [(NAN, NAN, NAN), (0.0, 0.0, -100.0), (0.0, 0.0, 5.0), (1e6, 0.0, 1.0)])
def test_poses_that_are_missing_or_out_of_view_draw_no_wrong_axes(
    tmp_path: Path, translation: tuple[float, float, float]
) -> None:
    picture = draw(tmp_path, one_pose(Status.REJECTED, translation, reason=Reason.RESIDUAL))
    assert picture.shape == (HEIGHT, WIDTH, 3)
    if not translation[2] > 0:
        assert all(share(picture, colour).max() < 0.5 for colour in overlay._AXES)


def test_the_frame_shows_through_in_8_and_16_bit_and_is_left_as_it_was(tmp_path: Path) -> None:
    ramp = torch.arange(WIDTH, dtype=torch.int32).expand(HEIGHT, WIDTH)
    nothing = one_pose(translation=(NAN, NAN, NAN))
    for frame in ((ramp // 2).to(torch.uint8), (1000 + 60 * ramp).to(torch.uint16)):
        before = frame.numpy().copy()
        row = draw(tmp_path, nothing, frame)[100, :, 0]
        assert row[0] == 0
        assert (np.diff(row) >= 0).all()
        assert row[-1] == (255 if frame.dtype == torch.uint16 else 199)
        np.testing.assert_array_equal(frame.numpy(), before)


def test_pictures_mirror_the_paths_of_the_frames(tmp_path: Path) -> None:
    assert picture_path(Path("o"), "a/b.PNG") == Path("o/a/b.PNG")
    assert picture_path(Path("o"), "a/b.tif") == Path("o/a/b.tif.png")
    frames = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    Overlay(CAMERA, [TARGET], tmp_path / "new" / "folder").write(frames, one_pose(), ["sub/f.tif"])
    (written,) = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert written == tmp_path / "new" / "folder" / "sub" / "f.tif.png"
    picture = cv2.imread(str(written))
    assert picture is not None
    assert picture.shape == (HEIGHT, WIDTH, 3)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="--overlay: cannot be written"):
        Overlay(CAMERA, [TARGET], tmp_path / "file" / "o")
