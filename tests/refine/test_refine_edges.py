"""Edge refinement against exact projections, finite differences and simulated frames."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import F64, pinhole, random_poses
from torchpose import ellipse
from torchpose.geometry import conics, rotations
from torchpose.refine import Refined, Sight, refine_edges
from torchpose.refine.edges.fit import circle_distance
from torchpose.sim import add_noise, render

QUAD = tp.Target.load("quad40")


def circle(camera: tp.Camera, count: int = 40) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Pixels on the image of a tilted circle, its pose, and centre, normal, radius; one row a point."""
    r = rotations.exp(torch.tensor([0.5, -0.3, 0.2], dtype=F64))
    t = torch.tensor([6.0, -4.0, 150.0], dtype=F64)
    center, normal = torch.tensor([3.0, 2.0, 0.0], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    angle = torch.arange(count, dtype=F64) * (2 * math.pi / count)
    rim = center + 5.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    uv = camera.project(rim @ r.T + t)
    pose = (r.expand(count, 3, 3), t.expand(count, 3))
    return uv, pose, (center.expand(count, 3), normal.expand(count, 3), torch.full((count,), 5.0, dtype=F64))


def rays(camera: tp.Camera, uv: Tensor) -> tuple[Tensor, Tensor]:
    xy = camera.undistort_points(uv)
    return torch.nn.functional.pad(xy, (0, 1), value=1.0), torch.linalg.inv(camera.J_distort(xy))


@pytest.mark.parametrize("k1", [0.0, -0.25])
def test_points_on_the_circle_have_no_distance(k1: float) -> None:
    camera = dataclasses.replace(pinhole(), distortion=torch.tensor([k1, 0.0, 0.001, 0.0], dtype=F64))
    uv, pose, model = circle(camera)
    distance, _, _, _ = circle_distance(*rays(camera, uv), *pose, *model)
    assert distance.abs().max() < 1e-8


@pytest.mark.parametrize("k1", [0.0, -0.25])
def test_distance_is_in_pixels(k1: float) -> None:
    """A point moved by a hundredth of a pixel across the rim is at that distance, to second order."""
    camera = dataclasses.replace(pinhole(), distortion=torch.tensor([k1, 0.0, 0.0, 0.0], dtype=F64))
    uv, pose, model = circle(camera, 400)
    along = uv.roll(-1, 0) - uv.roll(1, 0)
    outward = torch.stack([along[:, 1], -along[:, 0]], -1) / along.norm(dim=-1, keepdim=True)
    outward = outward * (outward * (uv - uv.mean(0))).sum(-1, keepdim=True).sign()
    distance, _, _, _ = circle_distance(*rays(camera, uv + 0.01 * outward), *pose, *model)
    torch.testing.assert_close(distance, torch.full_like(distance, 0.01), rtol=2e-3, atol=0)


def test_curvature_is_that_of_the_ellipse() -> None:
    camera = pinhole()
    uv, pose, model = circle(camera)
    _, bend, _, _ = circle_distance(*rays(camera, uv), *pose, *model)
    conic = conics.circle_image(pose[0][0], (pose[0][0] @ model[0][0]) + pose[1][0], model[1][0], model[2][0])
    to_px = torch.linalg.inv(camera.matrix)
    image = conics.ellipse_from_conic(conics.from_matrix(to_px.T @ conic @ to_px))
    index = torch.zeros(len(uv), dtype=torch.int64)
    torch.testing.assert_close(bend, ellipse.curvature(uv, index, image[None]), rtol=1e-9, atol=0)


def test_derivative_by_the_pose() -> None:
    camera = dataclasses.replace(pinhole(), distortion=torch.tensor([-0.2, 0.0, 0.0, 0.0], dtype=F64))
    uv, (r, t), model = circle(camera)
    ray, warp = rays(camera, uv)

    def distance(delta: Tensor) -> Tensor:
        return circle_distance(ray, warp, rotations.exp(delta[3:]) @ r, t + delta[:3], *model)[0]

    step = 1e-5 * torch.eye(6, dtype=F64)
    numeric = [(distance(s) - distance(-s)) / 2e-5 for s in step]
    center, normal, radius = model
    larger = circle_distance(ray, warp, r, t, center, normal, radius + 1e-5)[0]
    smaller = circle_distance(ray, warp, r, t, center, normal, radius - 1e-5)[0]
    _, _, _, derivative = circle_distance(ray, warp, r, t, *model)
    torch.testing.assert_close(derivative, torch.stack([*numeric, (larger - smaller) / 2e-5], -1), rtol=1e-6, atol=1e-6)


def refined(noise: float, count: int = 8, prior: Tensor | None = None) -> tuple[Refined, Tensor, Tensor]:
    """Poses refined on simulated frames from starts 20 um and 0.01 degrees off, and the truth."""
    camera = pinhole()
    r, t = random_poses(count, 45, (140, 180), seed=5)
    frames = add_noise(render(camera, QUAD, r, t, psf_sigma=0.8), noise, seed=2)
    x = (r[:, None] @ QUAD.centers[..., None]).squeeze(-1) + t[:, None]
    conic = conics.circle_image(
        r[:, None, None], x[:, :, None], QUAD.normals[:, None], QUAD.radii.expand(count, -1, -1)
    )
    to_px = torch.linalg.inv(camera.matrix)
    shapes = conics.ellipse_from_conic(conics.from_matrix(to_px.T @ conic @ to_px))
    off = rotations.exp(torch.full((3,), 1.0e-4, dtype=F64))
    sight = Sight.of(frames, camera, QUAD, torch.arange(count), shapes)
    out = refine_edges(sight, off @ r, t + 0.02, prior=prior)
    return out, r, t


def test_frames_without_noise() -> None:
    out, r, t = refined(0.0)
    assert out.good.all()
    assert (out.kept > 0.99).all()
    assert (out.t - t).abs().max() < 6e-4
    assert rotations.log(out.R @ r.mT).norm(dim=-1).max() < math.radians(1e-3)
    assert (out.blur - math.sqrt(0.8**2 + 1 / 12)).abs().max() < 0.01


def test_covariance_and_noise() -> None:
    out, r, t = refined(4.0, 24)
    e = torch.cat([out.t - t, rotations.log(out.R @ r.mT)], -1)
    nees = (e[:, None] @ torch.linalg.inv(out.covariance) @ e[..., None]).flatten()
    assert 4.0 < nees.mean() < 8.0  # 24 poses: 6, deviation 0.7
    assert out.noise.mean() == pytest.approx(4.0, rel=0.2)


def test_prior_holds_what_is_known() -> None:
    """With the rotation held at its start, only the translation moves, and the covariance says so."""
    held = torch.diag(torch.tensor([0.0, 0, 0, 1e14, 1e14, 1e14], dtype=F64)).expand(8, 6, 6)
    out, r, t = refined(2.0, 8, held)
    start = torch.full((8, 3), 1.0e-4, dtype=F64)
    torch.testing.assert_close(rotations.log(out.R @ r.mT), start, rtol=0, atol=1e-7)
    std = out.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(std[:, 3:], torch.full_like(start, 1e-7), rtol=1e-3, atol=0)
    assert (out.t - t).abs().max() < 0.01  # from 0.02 mm off


def test_nothing_to_refine() -> None:
    out, _, _ = refined(1.0, 0)
    assert out.R.shape == (0, 3, 3)
    assert out.covariance.shape == (0, 6, 6)
