"""Predicted covariances beside error propagation, the Cramer-Rao bound and the estimator itself."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

import torchpose as tp
from torchpose.analysis import pose_crlb
from torchpose.analysis.sensitivity import Uncertainty, edge_noise, propagate
from torchpose.design import (
    Imaging,
    WorkingVolume,
    best_focus,
    deviations,
    edge_covariance,
    predicted_covariance,
    sharp_range,
)
from torchpose.design.printing import PRINTS
from torchpose.errors import ConfigError
from torchpose.sim import Defocus, add_noise, render

# torch's forward mode loads a module that warns of torch's own use of torch.jit.script
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")

F64 = torch.float64
VOLUME = WorkingVolume((140.0, 180.0), (6.0, 4.0), math.radians(40))


def camera() -> tp.Camera:
    matrix = torch.tensor([[800.0, 0, 310], [0, 790.0, 250], [0, 0, 1]], dtype=F64)
    return tp.Camera(640, 520, matrix, torch.tensor([-0.1, 0.02, 1e-3, -1e-3], dtype=F64))


def poses(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return VOLUME.random(count, torch.Generator().manual_seed(3))


def stated_by_estimate(
    cam: tp.Camera, target: tp.Target, R: torch.Tensor, t: torch.Tensor, noise: float
) -> torch.Tensor:
    """Median of what the estimator states for each pose in five frames."""
    levels = render(cam, target, R, t, psf_sigma=0.7)
    every = [tp.PoseEstimator(cam, target)(add_noise(levels, noise, seed=seed)) for seed in range(5)]
    assert all((one.status == tp.Status.OK).all() for one in every)
    return torch.stack([deviations(one.covariance) for one in every]).median(0).values


@pytest.mark.parametrize("kind", [None, "plotter"])
def test_edges_are_propagated_as_by_the_sensitivity_analysis(kind: str | None) -> None:
    cam, target, imaging = camera(), tp.Target.load("hexa50"), Imaging(psf_sigma=0.9, noise=3.0)
    target = target if kind is None else PRINTS[kind].stated_by(target)
    R, t = poses(10)
    found = edge_covariance(cam, target, R, t, imaging)
    size = edge_noise(math.sqrt(3.0**2 + 1 / 12), 190.0, 0.9)
    expected = propagate(cam, target, R, t, Uncertainty(image=size), features="rings").total
    scale = expected.diagonal(dim1=1, dim2=2).sqrt()
    both = scale[:, :, None] * scale[:, None]
    torch.testing.assert_close(found / both, expected / both, rtol=0, atol=5e-3)


def test_prediction_lies_a_little_above_the_bound() -> None:
    # gradients of the grey levels and the width of the refinement's band cost 2 to 15 %
    cam, target, imaging = camera(), tp.Target.load("quad40"), Imaging()
    R, t = poses(4)
    found = deviations(predicted_covariance(cam, target, R, t, imaging))
    bound = deviations(pose_crlb(cam, target, R, t, psf_sigma=0.7, noise_sigma=2.0))
    assert (found / bound > 0.98).all()
    assert (found / bound < 1.2).all()


def test_prediction_is_what_the_estimator_states() -> None:
    # of a lens that is known: else a frame counts what its own noise seems to say of it
    cam = replace(camera(), distortion=torch.zeros(4, dtype=F64), covariance=torch.zeros(8, 8, dtype=F64))
    target, imaging = tp.Target.load("quad40"), Imaging(noise=3.0)
    R, t = poses(4)
    stated = stated_by_estimate(cam, target, R, t, 3.0)
    found = deviations(predicted_covariance(cam, target, R, t, imaging))
    torch.testing.assert_close(found, stated, rtol=0.05, atol=0)


@pytest.mark.parametrize("kind", ["plotter", "laser"])
def test_prediction_counts_print_and_camera_as_the_estimator_does(kind: str) -> None:
    square = torch.diag(torch.tensor([0.2, 0.2, 0.1, 0.1], dtype=F64).square())
    cam, target = replace(camera(), covariance=square), PRINTS[kind].stated_by(tp.Target.load("quad40"))
    R, t = poses(4)
    found = deviations(predicted_covariance(cam, target, R, t, Imaging(noise=3.0)))
    torch.testing.assert_close(found, stated_by_estimate(cam, target, R, t, 3.0), rtol=0.05, atol=0)
    exact = deviations(predicted_covariance(camera(), tp.Target.load("quad40"), R, t, Imaging(noise=3.0)))
    assert (found[:, :2] > 2 * exact[:, :2]).all()
    # the closed form that searches go by: without the camera, and the refinement's gradients of light
    quick = deviations(edge_covariance(cam, target, R, t, Imaging(noise=3.0)))
    alone = deviations(predicted_covariance(camera(), target, R, t, Imaging(noise=3.0)))
    assert ((alone / quick - 1).abs() < 0.15).all()


def test_deviations_in_um_and_mdeg() -> None:
    covariance = torch.diag(torch.tensor([1e-3, 2e-3, 3e-3, 1e-5, 2e-5, 3e-5], dtype=F64).square())[None]
    expected = [1.0, 2.0, 3.0, *(math.degrees(x) * 1e3 for x in (1e-5, 2e-5, 3e-5))]
    assert deviations(covariance)[0].tolist() == pytest.approx(expected)


def test_defocus_widens_the_blur() -> None:
    cam = camera()
    lens = Defocus(4.0, 8.0, best_focus(120.0, 240.0))
    assert lens.focus_distance == pytest.approx(160.0)
    near, far = (float(lens.radius(cam, torch.tensor(z))) for z in (120.0, 240.0))
    assert near == pytest.approx(far)
    imaging = Imaging(psf_sigma=0.7, lens=lens)
    low, high = sharp_range(cam, lens, 0.7)
    assert low < 160 < high
    for depth in (low, high):
        assert float(lens.radius(cam, torch.tensor(depth, dtype=F64))) == pytest.approx(1.4)
        assert imaging.blur_at(cam, [depth])[0] == pytest.approx(math.sqrt(2) * 0.7)
    assert sharp_range(cam, replace(lens, f_number=64.0), 0.7)[1] == math.inf
    target = tp.Target.load("quad40")
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 240.0]], dtype=F64)
    sharp, blurred = (deviations(predicted_covariance(cam, target, R, t, some)) for some in (Imaging(), imaging))
    # information over the width of an edge; the disc is not Gaussian and reaches beyond the refinement's band
    ratio = ((imaging.blur_at(cam, [240.0])[0] ** 2 + 1 / 12) / (0.7**2 + 1 / 12)) ** 0.25
    assert 0.97 * ratio < float((blurred / sharp)[0, 0]) < 1.3 * ratio


@pytest.mark.parametrize(
    "wrong",
    [
        {"psf_sigma": 0.0},
        {"psf_sigma": math.nan},
        {"noise": -1.0},
        {"noise": math.nan},
        {"dark": 220.0, "light": 30.0},
        {"light": 300.0},
    ],
)
def test_impossible_conditions_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="; "):
        Imaging(**wrong)
