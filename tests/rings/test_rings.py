"""Rings of the sample frames and of rendered ones against exact projections of their circles."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import torch

from tests.exact import exact_ellipses
from torchpose.camera import Camera
from torchpose.detect import find_candidates
from torchpose.geometry import conics, rotations
from torchpose.io.truth import read_truth
from torchpose.rings import Rings, ideal_pixels, measure_rings
from torchpose.rings.inner_circles import find_inner
from torchpose.sim import add_noise, render
from torchpose.target import Target

SAMPLE = Path(__file__).parents[2] / "data" / "sample"


def match(rings: Rings, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Marker (K,) and true circles (K, 2, 5) of each ring, by its outer centre."""
    far = (rings.outer.params[:, None, :2] - truth[rings.frame, :, 0, :2]).norm(dim=-1)
    distance, marker = far.min(-1)
    assert (distance < 2).all()
    return marker, truth[rings.frame, marker]


def measured(frames: torch.Tensor, camera: Camera, polarity: float = 1.0) -> Rings:
    found = find_candidates(frames)
    return measure_rings(frames, found[found.polarity == polarity], camera)


@pytest.fixture(scope="module")
def sample() -> tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor]:
    camera, target = Camera.load(SAMPLE / "camera.yaml"), Target.load(SAMPLE / "target.yaml")
    truth = read_truth(SAMPLE / "truth.csv")
    pictures = [cv2.imread(str(SAMPLE / "frames" / name), cv2.IMREAD_UNCHANGED) for name in truth.frame]
    frames = torch.stack([torch.from_numpy(picture) for picture in pictures])
    rings = measured(frames, camera)
    marker, circles = match(rings, exact_ellipses(target, camera, truth.R, truth.t))
    return camera, target, frames, rings, marker, circles


def test_each_ring_once(sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor]) -> None:
    _, target, frames, rings, marker, _ = sample
    assert torch.bincount(rings.frame * len(target) + marker).tolist() == [1] * (len(frames) * len(target))
    assert (rings.polarity == 1).all()


@pytest.mark.parametrize("which", ["outer", "inner"])
def test_centres_within_their_covariance(
    sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor], which: str
) -> None:
    rings, circles = sample[3], sample[5]
    fit, circle = getattr(rings, which), circles[:, 0 if which == "outer" else 1]
    error = fit.params[:, :2] - circle[:, :2]
    assert error.norm(dim=-1).max() < 0.03
    assert error.square().mean().sqrt() < 0.006
    nees = (error[:, None] @ torch.linalg.solve(fit.center_covariance, error[..., None])).flatten()
    # 48 values of two degrees of freedom: mean 2. `zernike.edge_correlation` counts slanted edges a little too high
    assert 1.0 < nees.mean() < 2.6
    assert nees.max() < 16


@pytest.mark.parametrize("which", ["outer", "inner"])
def test_shapes(sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor], which: str) -> None:
    rings, circles = sample[3], sample[5]
    fit, circle = getattr(rings, which), circles[:, 0 if which == "outer" else 1]
    error = conics.shape_matrix(fit.params) - conics.shape_matrix(circle)
    noise = 4 * fit.covariance[:, 2:, 2:].diagonal(dim1=1, dim2=2).amax(-1).sqrt()
    # what is left of the edges' curvature, 0.06 px^2 over the smallest radius of curvature
    bias = 0.06 * circle[:, 2] / circle[:, 3].square()
    assert (error.abs().amax((1, 2)) < noise + bias).all()


def test_ratio_codes(sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor]) -> None:
    _, target, _, rings, marker, _ = sample
    code = rings.ratio.square()
    assert (code - target.codes[marker]).abs().max() < 3e-3


def test_raw_ellipses_are_those_of_the_frame(
    sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor],
) -> None:
    """The raw ellipse's points, undistorted, lie on the ideal ellipse."""
    camera, _, _, rings, _, circles = sample
    angle = torch.arange(12, dtype=torch.float64) / 2
    for raw, circle in ((rings.outer_raw, circles[:, 0]), (rings.inner_raw, circles[:, 1])):
        points = ideal_pixels(camera, conics.points_on(raw[:, None].expand(-1, 12, -1), angle))
        local = torch.linalg.solve(conics.shape_matrix(circle), (points - circle[:, None, :2]).mT)
        assert (local.norm(dim=1) - 1).abs().max() < 0.01


def test_batch_equals_single_frames(
    sample: tuple[Camera, Target, torch.Tensor, Rings, torch.Tensor, torch.Tensor],
) -> None:
    camera, _, frames, rings, _, _ = sample
    for k in (0, 7):
        alone, mine = measured(frames[k : k + 1], camera), rings.frame == k
        for name in ("outer", "inner"):
            one, other = getattr(alone, name), getattr(rings, name)[mine]
            torch.testing.assert_close(one.params[:, :2], other.params[:, :2], rtol=0, atol=1e-6)
            # not the angles, which a circle leaves open
            shapes = conics.shape_matrix(one.params), conics.shape_matrix(other.params)
            torch.testing.assert_close(*shapes, rtol=0, atol=1e-6)
            # the offsets are products in float32, whose last digit depends on the size of the batch
            torch.testing.assert_close(one.center_covariance, other.center_covariance, rtol=1e-5, atol=1e-12)


def scene(
    outer: float = 30.0,
    ratio: float = 0.5,
    background: Literal["light", "dark"] = "light",
    width: int = 400,
    height: int = 300,
) -> tuple[Camera, Target]:
    """Camera without distortion at which 1 mm is 1 px; of the target's rings only the first is in view."""
    matrix = torch.tensor([[1000.0, 0, (width - 1) / 2], [0, 1000, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width, height, matrix, torch.zeros(0, dtype=torch.float64))
    centers = torch.tensor([[0.0, 0, 0], [2000, 0, 0], [0, 2000, 0]], dtype=torch.float64)
    others = [r for r in (0.2, 0.45, 0.7) if abs(r - ratio) > 0.1][:2]
    radii = outer * torch.tensor([[1, r] for r in (ratio, *others)], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, 1]], dtype=torch.float64).expand(3, 3)
    return camera, Target("scene", background, torch.arange(3), centers, normals, radii)


def poses(offsets: list[tuple[float, float]], tilt: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """R, t of targets 1 m away, shifted by px."""
    t = torch.tensor([[u, v, 1000.0] for u, v in offsets], dtype=torch.float64)
    rotation = rotations.exp(torch.tensor([0.6 * tilt, 0.8 * tilt, 0.0], dtype=torch.float64))
    return rotation.expand(len(t), 3, 3), t


OFFSETS = [(0.13, 0.21), (10.37, -5.44), (-7.26, 3.08), (0.5, 0.5)]


@pytest.mark.parametrize("background", ["light", "dark"])
@pytest.mark.parametrize("psf", [0.5, 0.8, 1.1])
@pytest.mark.parametrize(("outer", "ratio"), [(16.0, 0.5), (40.0, 0.3), (40.0, 0.8)])
def test_radii_without_noise(background: Literal["light", "dark"], psf: float, outer: float, ratio: float) -> None:
    camera, target = scene(outer, ratio, background)
    R, t = poses(OFFSETS, tilt=0.3)
    rings = measured(render(camera, target, R, t, psf_sigma=psf), camera, 1.0 if background == "light" else -1.0)
    assert rings.frame.tolist() == [0, 1, 2, 3]
    truth = exact_ellipses(target, camera, R, t)[:, 0]
    for k, fit in enumerate((rings.outer, rings.inner)):
        radius = truth[:, k, 2:4].prod(-1).sqrt()
        error = fit.params[:, 2:4].prod(-1).sqrt() - radius
        # uncorrected, the mask and the blur give 1.25 to 1.7 px^2 / R
        assert (error.abs() < 0.1 / radius).all()
        torch.testing.assert_close(fit.params[:, :2], truth[:, k, :2], rtol=0, atol=0.01)


def test_small_inner_circle() -> None:
    camera, target = scene(20.0, 0.28)  # 5.6 px: below what region growing holds together in noise
    R, t = poses(OFFSETS)
    clean = render(camera, target, R, t)
    rings = measured(add_noise(clean, 3.0, seed=1), camera)
    assert rings.frame.tolist() == [0, 1, 2, 3]
    assert (rings.ratio - 0.28).abs().max() < 0.01
    truth = exact_ellipses(target, camera, R, t)[:, 0, 1]
    assert (rings.inner.params[:, :2] - truth[:, :2]).norm(dim=-1).max() < 0.08


def test_find_inner() -> None:
    for ratio in (0.2, 0.5, 0.85):
        camera, target = scene(40.0, ratio)
        frames = render(camera, target, *poses(OFFSETS))
        found = find_candidates(frames)
        found = found[(found.polarity == 1) & (found.ellipse[:, 2] > 35)]
        inner = find_inner(frames, found)
        assert inner.found.all()
        torch.testing.assert_close(inner.ratio, torch.full_like(inner.ratio, ratio), rtol=0, atol=0.03)


def test_full_disc_is_no_ring() -> None:
    camera, target = scene(30.0, 0.5)
    frames = render(camera, target, *poses(OFFSETS))
    v, u = torch.meshgrid(torch.arange(300), torch.arange(400), indexing="ij")
    for k, (du, dv) in enumerate(OFFSETS):
        filled = torch.hypot(u - 199.5 - du, v - 149.5 - dv) < 22
        frames[k][filled] = 30.0
    found = find_candidates(frames)
    assert (found.polarity == 1).any()
    assert len(measured(frames, camera)) == 0


@pytest.mark.parametrize("ratio", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_cut_by_the_border_is_unbiased_or_absent(ratio: float, noise: float) -> None:
    camera, target = scene(30.0, ratio)
    # the centre from 40 px inside the left border to 25 px outside, in steps of 2.5 px
    R, t = poses([(u - 199.5, 3.3) for u in np.arange(40, -25, -2.5)])
    rings = measured(add_noise(render(camera, target, R, t), noise, seed=2), camera)
    assert set(range(10)) <= set(rings.frame.tolist())  # to 15 px from the border: a quarter of its width cut off
    assert rings.frame.max() < 19
    truth = exact_ellipses(target, camera, R, t)[rings.frame, 0]
    for k, fit in enumerate((rings.outer, rings.inner)):
        error = fit.params[:, :2] - truth[:, k, :2]
        nees = (error[:, None] @ torch.linalg.solve(fit.center_covariance, error[..., None])).flatten()
        assert nees.max() < 20
        assert error.norm(dim=-1).max() < 0.25 * noise


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32, torch.float64])
def test_dtypes(dtype: torch.dtype) -> None:
    camera, target = scene()
    R, t = poses(OFFSETS[:2])
    frames = render(camera, target, R, t).round()
    rings = measured(frames.to(dtype), camera)
    reference = measured(frames, camera)
    torch.testing.assert_close(rings.outer.params[:, :4], reference.outer.params[:, :4], rtol=0, atol=1e-4)
    assert rings.outer.params.dtype == torch.float64


@pytest.mark.parametrize("shape", [(0, 40, 50), (2, 0, 5), (2, 1, 40), (2, 6, 6), (1, 64, 64)])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32, torch.bool])
def test_nothing_to_see(shape: tuple[int, int, int], dtype: torch.dtype) -> None:
    camera, _ = scene()
    rings = measured(torch.ones(shape).to(dtype), camera)
    assert len(rings) == 0
    assert rings.outer.covariance.shape == (0, 5, 5)
    assert rings.ratio.shape == (0,)


def test_nan_pixels_cost_little() -> None:
    camera, target = scene()
    R, t = poses(OFFSETS[:1])
    frames = render(camera, target, R, t)
    whole = measured(frames, camera)
    frames[0, 149, 170] = torch.nan  # on the outer edge
    frames[0, 150, 200] = torch.nan  # in the hole
    broken = measured(frames, camera)
    torch.testing.assert_close(broken.outer.params[:, :2], whole.outer.params[:, :2], rtol=0, atol=0.01)
