from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from torch import Tensor

from tests.sim.supersampling import ring_image
from torchpose.camera import Camera
from torchpose.camera.model import Model
from torchpose.errors import ConfigError, FrameError
from torchpose.geometry import rotations
from torchpose.sim import add_noise, boundary, render
from torchpose.sim.boundary import Boxes, Samples, fill
from torchpose.sim.shapes import rings
from torchpose.target import Target

F64 = torch.float64
DARK, LIGHT = 30.0, 220.0


def camera(
    width: int = 128, height: int = 120, model: Model = "brown_conrady", distortion: tuple[float, ...] = ()
) -> Camera:
    matrix = torch.tensor([[400.0, 0, 63.3], [0, 405.0, 60.8], [0, 0, 1]], dtype=F64)
    return Camera(width, height, matrix, torch.tensor(distortion, dtype=F64), model)


def target(radii: tuple[float, float] = (5.0, 1.5), background: Literal["light", "dark"] = "light") -> Target:
    """Three rings, of which the first has the given radii; the others lie outside the small frames above."""
    far = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0]]
    return Target(
        name="three",
        background=background,
        ids=torch.arange(3),
        centers=torch.tensor([[0.0, 0.0, 0.0], *far], dtype=F64),
        normals=torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(3, 3),
        radii=torch.tensor([radii, [10, 8.0], [10, 7.0]], dtype=F64),
    )


def pose(tilt_deg: float, azimuth_deg: float, t: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    a = math.radians(azimuth_deg)
    tilt = rotations.exp(torch.tensor([math.cos(a), math.sin(a), 0.0], dtype=F64) * math.radians(tilt_deg))
    roll = rotations.exp(torch.tensor([0.0, 0.0, 0.4], dtype=F64))
    return (tilt @ roll)[None], torch.tensor([t], dtype=F64)


BROWN, FISHEYE = (-0.3, 0.1, 1e-3, -2e-3), (-0.2, 0.05, 0.01, -0.02)


@dataclass(frozen=True)
class Witness:
    """Differences between the renderer and the supersampled witness."""

    rms: float  # grey levels, pixels on edges
    edge: float  # px, largest shift of the edge that explains the difference
    centroid: float  # px, of the dark mass
    unconverged: float  # grey levels rms, witness against its own coarser grid


Case = tuple[Model, tuple[float, ...], float, float, tuple[float, float], float]


def compare(
    model: Model,
    distortion: tuple[float, ...],
    tilt: float,
    azimuth: float,
    radii: tuple[float, float],
    psf: float,
    n: int,
    window: tuple[int, int, int, int] = (40, 12, 80, 60),
) -> Witness:
    """The renderer against the witness at n/2 and n samples a pixel, extrapolated to infinitely many."""
    cam = camera(model=model, distortion=distortion)
    R, t = pose(tilt, azimuth, (8.0, -9.0, 200.0))
    ours = render(cam, target(radii), R, t, psf_sigma=psf, dark=DARK, light=LIGHT)[0].double().numpy()
    u0, v0, w, h = window
    ours = ours[v0 : v0 + h, u0 : u0 + w]
    coarse, fine = (
        ring_image(cam, R[0].numpy(), t[0].numpy(), np.zeros(3), radii, psf, window, s, DARK, LIGHT)
        for s in (n // 2, n)
    )
    exact = fine + (fine - coarse) / 3
    edge = (abs(exact - LIGHT) > 1) & (abs(exact - DARK) > 1)
    slope = np.hypot(*np.gradient(exact))
    steep = edge & (slope > 0.2 * slope.max())
    u, v = np.meshgrid(np.arange(w), np.arange(h))

    def centroid(image: np.ndarray) -> np.ndarray:
        mass = LIGHT - image
        return np.array([(mass * u).sum(), (mass * v).sum()]) / mass.sum()

    return Witness(
        rms=float(np.sqrt(np.mean((ours - exact)[edge] ** 2))),
        edge=float((abs(ours - exact)[steep] / slope[steep]).max()),
        centroid=float(np.hypot(*(centroid(ours) - centroid(exact)))),
        unconverged=float(np.sqrt(np.mean((fine - coarse)[edge] ** 2))),
    )


# 2 px a mm: outer radii of 10 and 20 px
CASES = [
    ("brown_conrady", (), 0, 0, (5.0, 1.5), 0.7),
    ("brown_conrady", BROWN, 60, 30, (5.0, 1.5), 0.7),
    ("brown_conrady", BROWN, 60, 77, (5.0, 3.0), 0.4),
    ("brown_conrady", BROWN, 45, 45, (10.0, 5.0), 1.2),
    ("brown_conrady", BROWN, 60, 10, (5.0, 2.0), 2.0),
    ("kannala_brandt", FISHEYE, 30, 200, (10.0, 3.0), 0.5),
]


@pytest.mark.parametrize("case", CASES)
def test_matches_supersampling(case: Case) -> None:
    found = compare(*case, n=16)
    assert found.unconverged < 0.05
    assert found.rms < 0.02
    assert found.edge < 1e-3
    assert found.centroid < 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_matches_converged_supersampling(case: Case) -> None:
    found = compare(*case, n=64)
    print(case, found)
    assert found.unconverged < 2e-3
    assert found.rms < 5e-4
    assert found.edge < 5e-5
    assert found.centroid < 1e-6


# rings of 6 px, tilted by 70 degrees
SMALL: list[Case] = [
    ("brown_conrady", BROWN, 70, 30, (3.0, 1.2), 0.7),
    ("brown_conrady", BROWN, 70, 100, (3.0, 0.9), 0.4),
    ("brown_conrady", (), 70, 0, (3.0, 1.9), 0.5),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", SMALL)
def test_small_steep_rings_match_supersampling_at_128(case: Case) -> None:
    found = compare(*case, n=128, window=(68, 31, 23, 24))
    print(case, found)
    assert found.unconverged < 2e-3
    assert found.rms < 1e-3
    assert found.centroid < 1e-5


def test_dark_mass_is_the_area_of_the_ellipses() -> None:
    # blur keeps the integral; a circle under perspective without distortion is an ellipse of known area and centre
    cam, radii = camera(), (5.0, 2.0)
    R, t = pose(50, 20, (4.0, -3.0, 180.0))
    frame = render(cam, target(radii), R, t, psf_sigma=0.6, dark=0.0, light=1.0)[0].double()
    mass = 1 - frame
    homography = cam.matrix @ torch.stack([R[0, :, 0], R[0, :, 1], t[0]], 1)
    area, moment = 0.0, torch.zeros(2, dtype=F64)
    for radius, sign in zip(radii, (1, -1), strict=True):
        dual = homography @ torch.diag(torch.tensor([1.0, 1.0, -1 / radius**2], dtype=F64)) @ homography.T
        dual = dual / dual[2, 2]
        center = dual[:2, 2]
        ellipse = math.pi * torch.linalg.det(center[:, None] * center - dual[:2, :2]).sqrt()
        area, moment = area + sign * ellipse, moment + sign * ellipse * center
    v, u = torch.meshgrid(torch.arange(cam.height, dtype=F64), torch.arange(cam.width, dtype=F64), indexing="ij")
    centroid = torch.stack([(mass * u).sum(), (mass * v).sum()]) / mass.sum()
    torch.testing.assert_close(mass.sum(), area, rtol=1e-6, atol=0)
    torch.testing.assert_close(centroid, moment / area, rtol=0, atol=1e-5)


def test_plate_edge_is_the_blurred_step() -> None:
    cam, psf = camera(), 0.8
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
    frame = render(cam, target(), R, t, psf_sigma=psf, light=200.0, plate=(40.0, 30.0), surround=50.0)[0]
    left = 63.3 - 400.0 * 20.0 / 200.0

    def expected(u: int) -> float:
        # the pixel averages the blurred step over its width
        return 50 + 150 * integrate.quad(lambda x: stats.norm.cdf((x - left) / psf), u - 0.5, u + 0.5)[0]

    row = int(60.8 + 12 * 405 / 200)
    np.testing.assert_allclose(frame[row, 18:30].numpy(), [expected(u) for u in range(18, 30)], atol=1e-3)


def test_plate_area_under_perspective() -> None:
    cam = camera()
    R, t = pose(40, 70, (2.0, 1.0, 220.0))
    blank = replace(target(), centers=target().centers + torch.tensor([900.0, 0, 0], dtype=F64))
    frame = render(cam, blank, R, t, light=1.0, plate=(30.0, 20.0), surround=0.0)[0].double()
    corners = torch.tensor([[-15, -10, 0], [15, -10, 0], [15, 10, 0], [-15, 10, 0]], dtype=F64)
    p = cam.project(corners @ R[0].T + t)
    q = p.roll(-1, 0)
    area = 0.5 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum().abs()
    torch.testing.assert_close(frame.sum(), area, rtol=1e-6, atol=0)


def test_frame_is_a_window_of_a_larger_one() -> None:
    # whatever crosses the border of the small frame is whole in the large one
    large = camera(200, 190, distortion=BROWN)
    shift = torch.tensor([70, 64])
    matrix = large.matrix.clone()
    matrix[:2, 2] -= shift
    small = replace(large, width=60, height=50, matrix=matrix)
    R, t = pose(30, 50, (4.0, 5.0, 200.0))
    # the ring is cut by the left or upper border, then by the right or lower one
    R, t = R.expand(3, 3, 3), t + torch.tensor([[0, 0, 0], [-3, 8, 0], [24, 9, 0]], dtype=F64)
    kwargs: dict[str, Any] = {"plate": (30.0, 30.0), "psf_sigma": 0.9}
    cut = render(large, target(), R, t, **kwargs)[:, 64:114, 70:130]
    torch.testing.assert_close(render(small, target(), R, t, **kwargs), cut, rtol=0, atol=1e-4)
    assert (cut[:, :, 0].amin(1) < 89).any() or (cut[:, 0].amin(1) < 89).any()


def test_batch_equals_single_frames() -> None:
    cam = camera(distortion=BROWN)
    poses = [pose(10 * i, 40 * i, (i, -i, 180.0 + 5 * i)) for i in range(4)]
    R, t = torch.cat([p[0] for p in poses]), torch.cat([p[1] for p in poses])
    psf, dark = torch.tensor([0.5, 0.7, 0.9, 1.6]), torch.tensor([10.0, 20.0, 30.0, 40.0])
    together = render(cam, target(), R, t, psf_sigma=psf, dark=dark, plate=(40, 40))
    alone = [
        render(cam, target(), R[i : i + 1], t[i : i + 1], psf_sigma=psf[i], dark=dark[i], plate=(40, 40))
        for i in range(4)
    ]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=1e-3)
    assert together.dtype == torch.float32


def test_dark_background_is_the_negative() -> None:
    R, t = pose(30, 10, (0.0, 0.0, 200.0))
    positive = render(camera(), target(), R, t, dark=DARK, light=LIGHT)
    negative = render(camera(), target(background="dark"), R, t, dark=DARK, light=LIGHT)
    torch.testing.assert_close(positive + negative, torch.full_like(positive, DARK + LIGHT), rtol=0, atol=1e-4)
    assert negative[0, 0, 0] == DARK


def test_levels_are_reached() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 100.0))
    frame = render(camera(), target((10.0, 5.0)), R, t, dark=DARK, light=LIGHT)
    assert frame.min().item() == pytest.approx(DARK, abs=1e-3)
    assert frame.max().item() == pytest.approx(LIGHT, abs=1e-3)


def test_target_turned_in_its_own_frame() -> None:
    # rings of any normal: turning the target's coordinates is undone by the pose
    turn = rotations.exp(torch.tensor([2.0, -0.8, 0.5], dtype=F64))
    turned = replace(target(), centers=target().centers @ turn.T, normals=target().normals @ turn.T)
    R, t = pose(30, 80, (0.0, 0.0, 200.0))
    torch.testing.assert_close(
        render(camera(), turned, R @ turn.T, t), render(camera(), target(), R, t), rtol=0, atol=1e-4
    )


def test_drawn_from_either_side() -> None:
    R, t = pose(30, 80, (0.0, 0.0, 200.0))
    front = render(camera(), target(), R, t)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=F64))  # the first ring is its own mirror image
    torch.testing.assert_close(render(camera(), target(), R @ flip, t), front, rtol=0, atol=1e-4)


def test_nothing_behind_the_camera_or_beyond_the_fold() -> None:
    cam = camera(distortion=(-0.3, 0.0, 0.0, 0.0))
    R = torch.eye(3, dtype=F64).expand(2, 3, 3)
    # the second lies beyond the radius from which the distortion folds back into the image
    t = torch.tensor([[0.0, 0.0, -200.0], [360.0, 0.0, 200.0]], dtype=F64)
    frames = render(cam, target(), R, t, light=LIGHT)
    assert (frames == LIGHT).all()


def test_no_plate_that_reaches_behind_the_camera() -> None:
    R, t = pose(80, 0, (0.0, 0.0, 20.0))
    frame = render(camera(), target(), R, t, plate=(70.0, 70.0), surround=90.0, light=220.0)
    assert frame.max() <= 90


def test_bad_arguments() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    with pytest.raises(ConfigError, match="psf_sigma"):
        render(camera(), target(), R, t, psf_sigma=0.0)
    with pytest.raises(FrameError, match="R, t"):
        render(camera(), target(), R[0], t)
    with pytest.raises(ConfigError, match="bits"):
        add_noise(torch.zeros(1, 2, 2), 1.0, bits=17)


def test_settings_by_another_name_are_refused() -> None:
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    with pytest.raises(TypeError, match="psf_sigmas"):
        render(camera(), target(), R, t, psf_sigmas=0.7)


def test_no_frames() -> None:
    assert render(camera(), target(), torch.zeros(0, 3, 3), torch.zeros(0, 3), plate=(9, 9)).shape == (0, 120, 128)
    assert add_noise(torch.zeros(0, 3, 4), 1.0).shape == (0, 3, 4)


def test_fill_gradcheck() -> None:
    theta = torch.arange(20, dtype=F64) * (2 * math.pi / 20)
    position = (6 + 3 * torch.stack([theta.cos(), theta.sin()], 1)).requires_grad_()
    dv = (3 * theta.cos() * (2 * math.pi / 20)).requires_grad_()
    sigma = torch.tensor([0.9, 0.7], dtype=F64).repeat(20, 1).requires_grad_()
    shape = torch.zeros(20, dtype=torch.int64)
    boxes = Boxes(torch.tensor([[1, 0]]), torch.tensor([[11, 12]]))
    assert torch.autograd.gradcheck(
        lambda p, d, s: fill(Samples(shape, shape, p, d, s), boxes).flatten()[::5], (position, dv, sigma)
    )  # fmt: skip
    half, step = torch.full((20,), 0.7, dtype=F64).requires_grad_(), dv.detach()
    assert torch.autograd.gradcheck(
        lambda p, s, w: fill(Samples(shape, shape, p, step, s, w), boxes).flatten()[::5], (position, sigma, half)
    )


def test_motion_of_a_boundary_is_the_derivative_of_what_it_fills() -> None:
    """Against forward-mode differentiation, of rings under lens distortion, cut by the frame."""
    matrix = torch.tensor([[180.0, 0, 40.0], [0, 185.0, 30.0], [0, 0, 1]], dtype=F64)
    lens = Camera(84, 64, matrix, torch.tensor([-0.2, 0.05, 0.01, -0.01], dtype=F64))
    R = rotations.exp(torch.tensor([[0.3, -0.4, 0.5]], dtype=F64))
    t = torch.tensor([[4.0, 2.0, 130.0]], dtype=F64)
    shapes = rings(Target.load("quad40")).to(t).in_frames(torch.zeros(1, dtype=torch.int64))
    edges = boundary.sample_boundary(lens, shapes, R, t, t.new_full((1,), 0.8), t.new_full((len(shapes),), 5.0))
    sigma = t.new_tensor([0.8, 1.0]).expand(len(edges), 2)

    def samples(delta: Tensor) -> Samples:
        pixel, dv = boundary.project(lens, edges, rotations.exp(delta[3:]) @ R, t + delta[:3])
        return Samples(edges.frame, edges.shape, pixel, dv, sigma)

    at = samples(t.new_zeros(6))
    boxes = boundary.boxes_around(at.pixel, at.shape, t.new_full((len(shapes),), 6.0), lens)
    wanted = torch.func.jacfwd(lambda delta: fill(samples(delta), boxes))(t.new_zeros(6))
    moved = replace(at, swept=boundary.swept_by_pose(lens, edges, R, t))
    found = boundary.fill_moved(moved, boxes)
    assert wanted.abs().amax((0, 1)).min() > 0.02
    # the two agree in the continuum; the trapezoidal rule leaves of either what the steps of one sigma do
    assert (found - wanted).abs().amax() < 1e-6 * wanted.abs().amax()


def test_gradient_is_that_of_finite_differences() -> None:
    cam = camera(distortion=BROWN)
    R, t = pose(35, 60, (1.0, 2.0, 190.0))
    torch.manual_seed(0)
    weight = torch.randn(cam.height, cam.width)
    # translation (mm), rotation (rad), blur (px), dark, light: steps that move edges by about 0.01 px
    start = torch.tensor([0, 0, 0, 0, 0, 0, 0.8, DARK, LIGHT], dtype=F64)
    steps = torch.tensor([2e-3] * 2 + [2e-2] + [1e-3] * 2 + [5e-4, 2e-3, 1.0, 1.0], dtype=F64)

    def loss(x: Tensor) -> Tensor:
        frame = render(
            cam, target(), rotations.exp(x[3:6]) @ R, t + x[:3],
            psf_sigma=x[6], dark=x[7], light=x[8], plate=(30.0, 30.0),
        )  # fmt: skip
        return (frame[0] * weight).double().sum()

    x = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(x), x)
    differences = torch.stack([(loss(start + d) - loss(start - d)) / (2 * d.sum()) for d in torch.diag(steps)])
    torch.testing.assert_close(gradient, differences, rtol=2e-3, atol=0.1)


def test_noise_is_independent_of_the_batch() -> None:
    frames = torch.full((5, 40, 61), 100.0)
    together = add_noise(frames, 3.0, seed=9)
    assert together.dtype == torch.uint8
    alone = add_noise(frames[3:4], 3.0, seed=9, index=torch.tensor([3]))
    assert torch.equal(together[3:4], alone)
    assert not torch.equal(together[0], together[1])
    assert not torch.equal(together, add_noise(frames, 3.0, seed=10))


def test_noise_is_white_and_gaussian() -> None:
    sigma = torch.tensor([50.0, 100.0])
    grey = add_noise(torch.full((2, 300, 401), 128.0), sigma, seed=1, bits=16).double() * (255 / 65535)
    inside = grey[0].flatten()
    z = (inside[(inside > 0) & (inside < 255)] - 128) / 50
    limit = 128 / 50
    assert stats.kstest(z.numpy(), stats.truncnorm(-limit, 127 / 50).cdf).pvalue > 1e-3
    z = ((add_noise(torch.full((4, 300, 401), 128.0), 20.0, seed=2).double() - 128) / 20).flatten(1)
    n = z.shape[1]
    assert z.mean(1).abs().max() < 4 / math.sqrt(n)
    assert (z.std(1) - math.sqrt(1 + 1 / 12 / 400)).abs().max() < 4 / math.sqrt(2 * n)
    for lag in (1, 2, 401):
        assert (z[:, lag:] * z[:, :-lag]).mean(1).abs().max() < 4 / math.sqrt(n)
    assert (torch.corrcoef(z) - torch.eye(4)).abs().max() < 4 / math.sqrt(n)


@pytest.mark.parametrize(
    ("bits", "white", "dtype"), [(8, 255, torch.uint8), (10, 1023, torch.uint16), (12, 4095, torch.uint16)]
)
def test_depth_of_the_sensor(bits: int, white: int, dtype: torch.dtype) -> None:
    out = add_noise(torch.tensor([[[-5.0, 0.0, 127.5, 255.0, 300.0]]]), 0.0, bits=bits)
    assert out.dtype == dtype
    levels = out.to(torch.int64).flatten().tolist()
    assert levels[:2] == [0, 0]
    assert abs(levels[2] - white / 2) <= 0.5
    assert levels[3:] == [white, white]
