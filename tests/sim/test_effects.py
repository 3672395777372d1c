"""Defocus, motion, light, clutter, covers and the sensor against brute averages, closed forms and supersampling."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.sim.supersampling import blur_operator
from tests.sim.test_renderer import BROWN, camera, pose, target
from torchpose.camera import Camera
from torchpose.errors import ConfigError, FrameError
from torchpose.geometry import rotations
from torchpose.sim import Defocus, Lighting, Shapes, add_noise, render, shapes

F64 = torch.float64


def shifted(cam: Camera, du: float, dv: float) -> Camera:
    """The camera whose picture lies (du, dv) px further right and down."""
    matrix = cam.matrix.clone()
    matrix[:2, 2] += torch.tensor([du, dv], dtype=F64)
    return replace(cam, matrix=matrix)


def test_defocus_is_the_average_over_the_disc() -> None:
    cam = camera(distortion=BROWN)
    R, t = pose(40, 30, (8.0, -9.0, 200.0))
    lens = Defocus(f_number=2.0, focal_length=8.0, focus_distance=180.0)
    center = R[0] @ target().centers[0] + t[0]
    radius = float(lens.radius(cam, center[2]))
    assert radius == pytest.approx(float(cam.matrix[0, 0]) * 2.0 * abs(1 / float(center[2]) - 1 / 180), rel=1e-12)
    lens = Defocus(f_number=2.0 * radius / 1.7, focal_length=8.0, focus_distance=180.0)  # 1.7 px
    found = render(cam, target(), R, t, psf_sigma=0.6, defocus=lens)
    # 12 rings of 32 points of equal area: the midpoint rule in the area
    area = (torch.arange(12, dtype=F64) + 0.5) / 12
    angle = torch.arange(32, dtype=F64) * (2 * math.pi / 32)
    shift = (1.7 * area.sqrt()[:, None, None] * torch.stack([angle.cos(), angle.sin()], -1)).reshape(-1, 2)
    mean = torch.stack([render(shifted(cam, *d), target(), R, t, psf_sigma=0.6)[0].double() for d in shift.tolist()])
    # the midpoint rule over 12 areas leaves this much of the contrast of 190
    torch.testing.assert_close(found[0].double(), mean.mean(0), rtol=0, atol=0.03)
    sharp = render(cam, target(), R, t, psf_sigma=0.6)
    assert (found - sharp).abs().max() > 15


def test_no_defocus_at_the_focus() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    lens = Defocus(f_number=1.4, focal_length=8.0, focus_distance=200.0)
    torch.testing.assert_close(
        render(camera(), target(), R, t, defocus=lens), render(camera(), target(), R, t), rtol=0, atol=1e-3
    )


def test_each_marker_has_the_disc_of_its_own_depth() -> None:
    cam = camera()
    near, far = shapes.ring((-12, 0, -30.0), 5.0), shapes.ring((12, 0, 0.0), 5.0)
    both = shapes.cat([near, far])
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    lens = Defocus(f_number=0.7, focal_length=8.0, focus_distance=200.0)
    blurred, sharp = (render(cam, both, R, t, light=220.0, defocus=d)[0] for d in (lens, None))
    middle = (cam.width - 1) // 2
    # the pose rolls by 0.4 rad, so each half of the frame holds one of them
    assert (blurred - sharp)[:, :middle].abs().max() > 20
    assert (blurred - sharp)[:, middle + 1 :].abs().max() < 0.01


def test_motion_is_the_average_over_the_exposure() -> None:
    cam = camera(distortion=BROWN)
    R, t = pose(30, 50, (3.0, 2.0, 200.0))
    motion = torch.tensor([[1.5, -0.6, 3.0, 0.01, -0.02, 0.05]], dtype=F64)  # about 4 px
    found = render(cam, target(), R, t, psf_sigma=0.6, motion=motion, plate=(40, 40))
    time = (torch.arange(64, dtype=F64) + 0.5) / 64 - 0.5
    turn = rotations.exp(time[:, None] * motion[:, 3:])
    still = render(cam, target(), turn @ R, t + time[:, None] * motion[:, :3], psf_sigma=0.6, plate=(40, 40))
    torch.testing.assert_close(found[0].double(), still.double().mean(0), rtol=0, atol=8e-3)
    assert (found - render(cam, target(), R, t, psf_sigma=0.6, plate=(40, 40))).abs().max() > 20


def test_motion_and_defocus_are_differentiable() -> None:
    cam = camera(80, 70)
    R, t = pose(20, 40, (-6.0, -8.0, 200.0))
    lens = Defocus(f_number=1.4, focal_length=8.0, focus_distance=180.0)
    motion = torch.tensor([[0.5, 0.3, 0.0, 0.0, 0.0, 0.0]], dtype=F64)
    torch.manual_seed(0)
    weight = torch.randn(cam.height, cam.width)

    def loss(x: Tensor) -> Tensor:
        frame = render(cam, target(), R, t + x, psf_sigma=0.8, motion=motion, defocus=lens)
        return (frame[0] * weight).double().sum()

    x = torch.zeros(3, dtype=F64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(x), x)
    steps = torch.diag(torch.tensor([2e-3, 2e-3, 2e-2], dtype=F64))
    differences = torch.stack([(loss(d) - loss(-d)) / (2 * d.sum()) for d in steps]).detach()
    torch.testing.assert_close(gradient, differences, rtol=2e-3, atol=0.05)


def test_light_gradient_and_vignetting() -> None:
    cam = camera()
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    gain = Lighting(gradient=(0.3, -0.1), vignetting=4.0).gain(cam, R, t)[0].double()
    u, v = np.meshgrid(np.arange(cam.width), np.arange(cam.height))
    x, y = (u - 63.3) / 400, (v - 60.8) / 405
    plane = 1 + 0.3 * (2 * u / (cam.width - 1) - 1) - 0.1 * (2 * v / (cam.height - 1) - 1)
    np.testing.assert_allclose(
        gain.numpy(), plane / (1 + x * x + y * y) ** 2, atol=8e-4
    )  # (8 px / f)^2 of the interpolation


def test_point_light() -> None:
    cam = camera()
    R, t = pose(35, 20, (3.0, -2.0, 200.0))
    light = torch.tensor([40.0, -30.0, 20.0], dtype=F64)
    gain = Lighting(point=tuple(light.tolist())).gain(cam, R, t)[0].double()
    points = torch.tensor([[0.0, 0, 0], [9, 4, 0], [-7, 8, 0], [5, -9, 0]], dtype=F64) @ R[0].T + t
    away = light - points
    expected = -(away @ R[0, :, 2]) / away.norm(dim=1) ** 3
    pixel = cam.project(points)
    grid = 2 * pixel / torch.tensor([cam.width - 1, cam.height - 1]) - 1
    found = torch.nn.functional.grid_sample(gain[None, None], grid[None, None], align_corners=True).flatten()
    torch.testing.assert_close(found, expected / expected[0], rtol=1e-3, atol=0)


def test_light_multiplies_the_picture() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    light = Lighting(gradient=(0.2, 0.0))
    even = render(camera(), target(), R, t)
    torch.testing.assert_close(
        render(camera(), target(), R, t, lighting=light), even * light.gain(camera(), R, t), rtol=1e-6, atol=1e-4
    )


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (shapes.rectangle((3, -2), 14, 9, 0.4), 126.0),
        (shapes.cross((0, 0), 18, 5, 0.3), 18 * 5 * 2 - 25.0),
        (shapes.chessboard_corner((1, 1), 16, 0.7), 128.0),
        (shapes.ring((0, 3), 8, 3), math.pi * 55),
        (shapes.polygon([[[0, 0], [12, 0], [0, 9]]]), 54.0),
        (shapes.polygon([[[-8, -8], [8, -8], [8, 8], [-8, 8]], [[-4, -4], [-4, 4], [4, 4], [4, -4]]]), 192.0),
    ],
)
def test_shapes_have_their_area(shape: Shapes, area: float) -> None:
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
    frame = render(camera(), shape, R, t, light=255.0)[0].double()
    mass = (255 - frame).sum() / (255 - 30)
    torch.testing.assert_close(mass, torch.tensor(area * 400 * 405 / 200**2, dtype=F64), rtol=1e-6, atol=0)


def test_shape_winding_does_not_matter() -> None:
    corners = np.array([[0, 0], [12, 0], [0, 9]])
    R, t = pose(30, 10, (0.0, 0.0, 200.0))
    one, other = (render(camera(), shapes.polygon([c]), R, t) for c in (corners, corners[::-1].copy()))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-4)


def test_text_is_the_traced_picture() -> None:
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
    frame = render(camera(), shapes.text("AB8", (0, 0), 12.0), R, t, light=220.0)[0]
    dark = (frame < 125).numpy()
    rows, columns = np.nonzero(dark)
    # 12 mm are 24.3 px high
    assert 22 <= np.ptp(rows) + 1 <= 29
    assert abs(columns.mean() - 63.3) < 4
    # the holes of A, B (2) and 8 (2), and the outside
    assert cv2.connectedComponents((~dark).astype(np.uint8), connectivity=4)[0] - 1 == 6


def test_cover_over_a_ring_within_what_is_said() -> None:
    # a cover's edge across a ring's edges: the blurred coverages are multiplied
    psf, n, size = 0.7, 16, 60
    cam = replace(camera(size, size), matrix=torch.tensor([[400.0, 0, 30.0], [0, 400.0, 30.0], [0, 0, 1]], dtype=F64))
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
    cover = shapes.rectangle((5.2, 0.7), 8.0, 30.0, 0.5, level=120.0)
    found = render(cam, target(), R, t, psf_sigma=psf, covers=cover)[0].double().numpy()
    pad = int(np.ceil(0.5 + 6.5 * psf))
    axis = -pad - 0.5 + (np.arange((size + 2 * pad) * n) + 0.5) / n
    x, y = ((a - 30.0) / 2 for a in np.meshgrid(axis, axis))
    radius = np.hypot(x, y)
    scene = np.where((radius < 5.0) & (radius > 1.5), 30.0, 220.0)
    along, across = np.cos(0.5) * (x - 5.2) + np.sin(0.5) * (y - 0.7), np.cos(0.5) * (y - 0.7) - np.sin(0.5) * (x - 5.2)
    scene[(abs(along) < 4.0) & (abs(across) < 15.0)] = 120.0
    operator = blur_operator(size, pad, n, psf)
    difference = found - operator @ scene @ operator.T
    near = (abs(abs(along) - 4.0) < 2.5) & (np.minimum(abs(radius - 5), abs(radius - 1.5)) < 2.5)
    crossing = near.reshape(size + 2 * pad, n, -1, n).any((1, 3))[pad:-pad, pad:-pad]
    assert abs(difference[~crossing]).max() < 0.6  # the witness's own hard-edged cells
    assert abs(difference).max() < 25.0
    assert 0 < crossing.sum() < 400


def test_clutter_belongs_to_its_frame() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    R, t = R.expand(3, 3, 3), t.expand(3, 3)
    clutter = shapes.cat([shapes.ring((18, 0), 5, 2, level=100.0, frame=1), shapes.cross((0, 18), 9, 3, frame=2)])
    frames = render(camera(), target(), R, t, clutter=clutter)
    plain = render(camera(), target(), R, t)
    changed = ((frames - plain).abs() > 1).flatten(1).sum(1)
    assert changed[0] == 0
    assert (changed[1:] > 50).all()


def test_background_pictures_lie_behind_the_plate() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    picture = torch.rand(1, 120, 128, generator=torch.Generator().manual_seed(1)) * 255
    frame = render(camera(), target(), R, t, plate=(20, 20), surround=picture)
    assert torch.equal(frame[0, 0], picture[0, 0])
    assert frame[0, 60, 45].item() == pytest.approx(220, abs=1e-3)
    with pytest.raises(ConfigError, match="surround"):
        render(camera(), target(), R, t, surround=picture)
    with pytest.raises(FrameError, match="surround"):
        render(camera(), target(), R, t, plate=(20, 20), surround=picture[:, 1:])


def test_shot_noise_grows_with_the_light() -> None:
    grey = torch.tensor([20.0, 120.0, 220.0])[:, None, None].expand(3, 300, 400)
    z = add_noise(grey, 1.5, seed=4, bits=16, full_well=12000.0).double() * (255 / 65535)
    expected = (1.5**2 + grey[:, 0, 0] * 255 / 12000).sqrt().double()
    n = 300 * 400
    assert (z.flatten(1).std(1) / expected - 1).abs().max() < 4 / math.sqrt(2 * n)
    assert ((z.flatten(1).mean(1) - grey[:, 0, 0]) / expected).abs().max() < 4 / math.sqrt(n)


def test_gamma_comes_before_rounding() -> None:
    out = add_noise(torch.tensor([[[0.0, 51.0, 255.0]]]), 0.0, gamma=2.2)
    assert out.flatten().tolist() == [0, round(255 * 0.2 ** (1 / 2.2)), 255]


@pytest.mark.parametrize("wrong", [{"sigma": -1.0}, {"sigma": 1.0, "full_well": 0.0}, {"sigma": 1.0, "gamma": -2.0}])
def test_bad_sensor(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"negative|above 0"):
        add_noise(torch.zeros(1, 2, 2), **wrong)


def test_bad_lens_and_motion() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    with pytest.raises(ConfigError, match="f_number"):
        Defocus(f_number=0.0, focal_length=8.0, focus_distance=100.0)
    with pytest.raises(FrameError, match="motion"):
        render(camera(), target(), R, t, motion=torch.zeros(6))
