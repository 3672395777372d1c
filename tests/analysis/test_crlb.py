from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.exact import pinhole, random_poses
from torchpose.analysis import pose_crlb
from torchpose.analysis.crlb import _fisher
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.sim import render
from torchpose.sim.blur import blur_of
from torchpose.target import Target

F64 = torch.float64


def camera(distortion: tuple[float, ...] = ()) -> Camera:
    matrix = torch.tensor([[400.0, 0, 150], [0, 400.0, 150], [0, 0, 1]], dtype=F64)
    return Camera(301, 301, matrix, torch.tensor(distortion, dtype=F64))


def tilted() -> tuple[Tensor, Tensor]:
    return rotations.exp(torch.tensor([[0.5, -0.3, 0.7]], dtype=F64)), torch.tensor([[2.0, -3.0, 190.0]], dtype=F64)


@pytest.mark.parametrize(
    ("variance", "smear", "disc"),
    [
        ((0.64, 0.0, 0.64), (0.0, 0.0), 0.0),
        ((1.9, -0.8, 1.3), (0.0, 0.0), 0.0),
        ((0.7, 0.0, 0.6), (2.5, 1.5), 1.2),
    ],
)
def test_is_the_inverse_fisher_information_of_whole_frames(
    variance: tuple[float, float, float], smear: tuple[float, float], disc: float
) -> None:
    cam, target = camera((-0.2, 0.05, 1e-3, -1e-3)), Target.load("quad40")
    R, t = tilted()
    dark, light, noise = 40.0, 200.0, 2.0

    @torch.no_grad()
    def frame(x: Tensor) -> Tensor:
        covariance = torch.stack([variance[0] + x[6], variance[1] + x[7], variance[1] + x[7], variance[2] + x[8]])
        look: dict[str, Any] = {
            "psf_sigma": covariance.view(2, 2),
            "smear": smear,
            "disc": disc,
            "dark": dark,
            "light": light,
        }
        image = render(cam, target, rotations.exp(x[3:6]) @ R, t + x[:3], **look)
        return image[0].double().flatten()

    # central differences, fourth order; steps that move edges by some hundredths of a pixel
    steps = torch.tensor([2e-2, 2e-2, 2e-1, 1e-3, 1e-3, 1e-3, 2e-2, 2e-2, 2e-2], dtype=F64)
    columns = [
        (8 * (frame(d) - frame(-d)) - (frame(2 * d) - frame(-2 * d))) / (12 * d.sum()) for d in torch.diag(steps)
    ]
    # the pixels nearest to a marker share its two grey levels
    zero = frame(torch.zeros(9, dtype=F64))
    centers = cam.project(target.centers @ R[0].T + t)
    v, u = torch.meshgrid(torch.arange(301.0), torch.arange(301.0), indexing="ij")
    grid = torch.stack([u, v], -1).reshape(-1, 1, 2)
    nearest = (grid - centers).norm(dim=-1).argmin(1)
    darkness = (light - zero) / (light - dark)
    for marker in range(4):
        own = (nearest == marker).double()
        columns += [own * darkness, own * (1 - darkness)]
    jacobian = torch.stack(columns, 1)
    information = jacobian.T @ jacobian / (noise**2 + 1 / 12)
    expected = torch.linalg.inv(information)[:6, :6]

    s11, s12, s22 = variance
    look: dict[str, Any] = {"psf_sigma": torch.tensor([[s11, s12], [s12, s22]]), "smear": smear, "disc": disc}
    found = pose_crlb(cam, target, R, t, **look, dark=dark, light=light, noise_sigma=noise)[0]
    # paper far from the markers tells a little more of the light levels: the reason for 1e-3
    std, expected_std = found.diagonal().sqrt(), expected.diagonal().sqrt()
    torch.testing.assert_close(std, expected_std, rtol=1e-3, atol=0)
    torch.testing.assert_close(
        found / (std * std[:, None]), expected / (expected_std * expected_std[:, None]), rtol=0, atol=1e-3
    )


def test_lateral_information_is_that_of_straight_edges() -> None:
    # derived: a blurred edge of contrast h and length L fixes its offset with information
    # h^2 L / (2 sqrt(pi) s noise^2); a circle of radius r px seen frontally has pi r px of it along each axis
    cam, target = camera(), Target.load("quad40")
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 120.0]], dtype=F64)
    psf, contrast, noise = 0.8, 190.0, 3.0
    bound = pose_crlb(cam, target, R, t, psf_sigma=psf, dark=30.0, light=220.0, noise_sigma=noise, bits=16)
    scale = 400.0 / 120.0  # px/mm
    blur = math.sqrt(psf**2 + 1 / 12)
    length = math.pi * scale * float(target.radii.sum())
    expected = contrast**2 * length * scale**2 / (2 * math.sqrt(math.pi) * blur * noise**2)
    information = torch.linalg.inv(bound[0])
    assert information[0, 0].item() == pytest.approx(expected, rel=0.01)
    assert information[1, 1].item() == pytest.approx(expected, rel=0.01)


def test_turns_with_the_camera() -> None:
    # a quarter turn of the whole scene about the optical axis maps pixels onto pixels and rotates the covariance
    cam, target = camera(), Target.load("quad40")
    R, t = tilted()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=F64)
    bound = pose_crlb(cam, target, R, t)[0]
    turned = pose_crlb(cam, target, quarter @ R, t @ quarter.T)[0]
    turn = torch.block_diag(quarter, quarter)
    scale = turned.diagonal().sqrt()
    difference = (turned - turn @ bound @ turn.T) / (scale * scale[:, None])
    # the tails of the blur that are left out are other ones along rows than along columns
    assert difference.abs().max() < 1e-4


def test_scales_with_noise_and_contrast() -> None:
    cam, target = camera(), Target.load("quad40")
    R, t = tilted()
    R, t = R.expand(4, 3, 3), t.expand(4, 3)
    noise, light = torch.tensor([1.0, 3.0, 1.0, 1.0]), torch.tensor([130.0, 130.0, 230.0, 130.0])
    bound = pose_crlb(cam, target, R, t, dark=30.0, light=light, noise_sigma=noise, bits=16)
    torch.testing.assert_close(bound[1], 9 * bound[0], rtol=1e-5, atol=0)
    torch.testing.assert_close(bound[2], bound[0] / 4, rtol=1e-5, atol=0)
    torch.testing.assert_close(bound[3], bound[0], rtol=1e-12, atol=0)
    eight = pose_crlb(cam, target, R[:1], t[:1], dark=30.0, light=130.0, noise_sigma=0.0)
    torch.testing.assert_close(eight[0], bound[0] / 12, rtol=1e-5, atol=0)


def test_batch_equals_single_poses_beyond_one_chunk() -> None:
    cam, target = camera(), Target.load("quad40")
    w = torch.linspace(-0.5, 0.5, 18, dtype=F64)
    R = rotations.exp(torch.stack([w, -w, 2 * w], 1))
    t = torch.stack([w, w, 180 + 20 * w], 1)
    together = pose_crlb(cam, target, R, t)
    for i in (0, 17):
        torch.testing.assert_close(
            together[i : i + 1], pose_crlb(cam, target, R[i : i + 1], t[i : i + 1]), rtol=1e-4, atol=0
        )


def test_no_pose_without_markers_in_view() -> None:
    target = Target.load("quad40")
    R = torch.eye(3, dtype=F64).expand(2, 3, 3)
    t = torch.tensor([[0.0, 0.0, 150.0], [0.0, 0.0, -150.0]], dtype=F64)
    bound = pose_crlb(camera(), target, R, t)
    assert bound[0].isfinite().all()
    assert bound[1].isnan().all()
    assert pose_crlb(camera(), target, R[1:], t[1:]).isnan().all()


def test_no_pose_from_one_ring() -> None:
    # a ring looks the same after a turn about its axis
    target = Target.load("quad40")
    R, _ = tilted()
    center = R[0] @ target.centers[0]
    one = torch.tensor([[0.0, 0.0, 25.0]], dtype=F64) - center
    assert pose_crlb(camera(), target, R, one).isnan().all()
    # at a distance the others come into view
    assert pose_crlb(camera(), target, R, one + torch.tensor([0.0, 0.0, 200.0])).isfinite().all()


def test_blur_must_be_positive() -> None:
    R, t = tilted()
    with pytest.raises(ConfigError, match="psf_sigma"):
        pose_crlb(camera(), Target.load("quad40"), R, t, psf_sigma=-1.0)


def test_a_keyword_that_is_none_is_refused() -> None:
    camera, target = pinhole(), Target.load("quad40")
    r, t = random_poses(1, 10, (150, 160))
    with pytest.raises(TypeError, match="noise"):
        pose_crlb(camera, target, r, t, noise=2.0)


@pytest.mark.parametrize(("distance", "most"), [((140, 200), 7e-5), ((460, 465), 4e-4)])
def test_three_unknowns_of_the_blur_cost_little_more_than_one(distance: tuple[float, float], most: float) -> None:
    """One is the sum of both variances' columns; rings of 30 to 40 px radius, and of 12, round blur of 0.7 px."""
    r, t = random_poses(24, 45, distance, seed=7)
    round_ = blur_of(0.7, None, 0.0, t)
    three = _fisher(pinhole(), Target.load("quad40"), r, t, round_, torch.full_like(t[:, 0], 190.0))
    same = torch.zeros(9, 7, dtype=F64)
    same[:6, :6], same[6, 6], same[8, 6] = torch.eye(6, dtype=F64), 1.0, 1.0
    deviations = [
        torch.linalg.inv(f)[:, :6, :6].diagonal(dim1=1, dim2=2).sqrt() for f in (three, same.T @ three @ same)
    ]
    rise = (deviations[0] / deviations[1]).amax() - 1
    assert 0 < rise < most
