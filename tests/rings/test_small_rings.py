"""Whole-ring fits of rendered rings too small for separate edges."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.exact import exact_ellipses, pinhole, random_poses
from torchpose.detect import Candidates
from torchpose.geometry.blur import isotropic
from torchpose.geometry.sectors import SECTORS
from torchpose.identify.assignments import ratio_tolerance
from torchpose.rings.inner_circles import InnerCircles
from torchpose.rings.small_rings import SmallRings, fit_small_rings
from torchpose.sim import add_noise, render
from torchpose.target import Target

FOCAL = torch.tensor(1111.11)


def begun(frame: Tensor, outer: Tensor, ratio: Tensor) -> tuple[Candidates, InnerCircles]:
    """Rough dark rings, seen all around, of a blur of 0.8 px."""
    one = torch.ones_like(ratio)
    candidates = Candidates(frame, outer, one, -one, one, torch.zeros_like(frame))
    inner = torch.cat([outer[:, :2], outer[:, 2:4] * ratio[:, None], outer[:, 4:]], -1)
    seen = torch.ones(len(frame), SECTORS, dtype=torch.bool)
    return candidates, InnerCircles(ratio, one > 0, inner, seen, isotropic(0.8 * one), one < 0)


def by_both(frames: Tensor, candidates: Candidates, inside: InnerCircles) -> SmallRings:
    """The first fit, continued by the exact one where the blur is wide."""
    first = fit_small_rings(frames, candidates, inside, FOCAL)
    outer, inner = first.outer.params, first.inner.params
    ratio = (inner[:, 2:4].prod(-1) / outer[:, 2:4].prod(-1)).sqrt()
    inside = replace(inside, ratio=ratio, ellipse=inner, blur=first.blur)
    second = fit_small_rings(frames, replace(candidates, ellipse=outer), inside, FOCAL, begun=True)
    return second.where(first.promising, first)


@pytest.mark.parametrize("tilt", [0.1, 40.0])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_within_their_own_covariance(tilt: float, noise: float) -> None:
    camera, target = pinhole(1111.11, 400, 300), Target.load("quad40")
    r, t = random_poses(12, tilt, (600, 800), seed=4)
    t[:, :2] = 0
    frames = add_noise(render(camera, target, r, t, psf_sigma=0.8), noise, seed=1)
    truth = exact_ellipses(target, camera, r, t).flatten(0, 1)
    frame = torch.arange(12).repeat_interleave(4)
    rough = truth[:, 0].clone()
    rough[:, :2] += 0.4
    rough[:, 2:4] += 0.3
    ratio = truth[:, 1, 3] / truth[:, 0, 3] + 0.05
    found = fit_small_rings(frames, *begun(frame, rough, ratio), FOCAL)
    assert found.good.all()
    for fit, exact in ((found.outer, truth[:, 0]), (found.inner, truth[:, 1])):
        error = fit.params[:, :2] - exact[:, :2]
        nees = (error[:, None] @ torch.linalg.solve(fit.center_covariance, error[..., None])).flatten()
        assert error.norm(dim=-1).max() < 0.04 + 0.03 * noise
        if tilt < 1:  # perspective parts the centres of tilted circles, see the module
            assert nees.mean() < 3.0  # 1 expected: each circle is given twice the variance of the common fit
    code = (found.inner.params[:, 2:4].prod(-1) / found.outer.params[:, 2:4].prod(-1)).sqrt()
    assert (code - truth[:, 1, 3] / truth[:, 0, 3]).abs().max() < 0.01 + 0.01 * noise


def read(**imaging: float) -> tuple[SmallRings, Tensor, Tensor]:
    """Rings of 7 to 10 px under a wide blur as they are found, their true ellipses, and errors of their codes."""
    camera, target = pinhole(1111.11, 400, 300), Target.load("quad40")
    r, t = random_poses(10, 30.0, (560, 700), seed=2)
    t[:, :2] = 0
    frames = add_noise(render(camera, target, r, t, **imaging), 1.0, seed=1)
    truth = exact_ellipses(target, camera, r, t).flatten(0, 1)
    rough = truth[:, 0].clone()
    rough[:, 2:4] += 0.5
    frame, start = torch.arange(10).repeat_interleave(4), torch.full((40,), 0.45, dtype=torch.float64)
    found = by_both(frames, *begun(frame, rough, start))
    code = (found.inner.params[:, 2:4].prod(-1) / found.outer.params[:, 2:4].prod(-1)).sqrt()
    return found, truth, (code - truth[:, 1, 3] / truth[:, 0, 3]).abs()


@pytest.mark.parametrize("blur", [1.7, 2.5])
def test_codes_of_much_blurred_rings(blur: float) -> None:
    """Rings of 7 to 10 px under a blur of half their inner circle or more: the codes stay within their tolerance."""
    found, truth, error = read(psf_sigma=blur)
    off = error / ratio_tolerance(truth[:, 0, 3])
    assert found.good.double().mean() >= 0.8  # where the blur leaves the code open, the fit says so
    assert off[found.good].quantile(0.95) < 1


def test_codes_without_noise() -> None:
    """A blur of 0.37 of the outer radius; to first order in the distance the codes would be wrong by 0.1 to 0.2."""
    camera, target = pinhole(1111.11, 200, 200), Target.load("quad40")
    r = torch.eye(3, dtype=torch.float64)[None]
    frame = render(camera, target, r, torch.tensor([[0.0, 0, 790]], dtype=torch.float64), psf_sigma=2.6)
    truth = exact_ellipses(target, camera, r, torch.tensor([[0.0, 0, 790]], dtype=torch.float64))[0]
    rough = truth[:, 0] + torch.tensor([0.2, -0.1, 0.4, 0.4, 0], dtype=torch.float64)
    nought, start = torch.zeros(4, dtype=torch.int64), torch.full((4,), 0.4, dtype=torch.float64)
    found = by_both(frame, *begun(nought, rough, start))
    code = (found.inner.params[:, 2:4].prod(-1) / found.outer.params[:, 2:4].prod(-1)).sqrt()
    assert found.good.all()
    assert (code - truth[:, 1, 3] / truth[:, 0, 3])[:3].abs().max() < 0.005
    assert abs(code[3] - 0.6) < 0.05


@pytest.mark.parametrize("radius", [3.4, 4.2])
def test_codes_of_rings_out_of_focus(radius: float) -> None:
    """Rings of 7 to 10 px; under a Gaussian the codes would be off by 0.17 and 0.29."""
    found, _, off = read(psf_sigma=0.7, disc=radius)
    assert found.good.double().mean() >= 0.9
    assert found.disc[found.promising].double().mean() >= 0.9
    assert off[found.good].quantile(0.95) < 0.03


def test_no_rings() -> None:
    nothing = begun(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 5).double(), torch.zeros(0).double())
    for again in (False, True):
        assert len(fit_small_rings(torch.zeros(1, 9, 9), *nothing, FOCAL, begun=again).good) == 0


def test_refuses_what_is_no_ring() -> None:
    frames = 128 + 20 * torch.randn(1, 80, 80, generator=torch.Generator().manual_seed(1))
    frames[0, 30:50, 30:50] = 20.0  # a square without a hole
    v, u = torch.meshgrid(torch.arange(80), torch.arange(80), indexing="ij")
    frames[0] -= 100 * torch.sigmoid(3 * (7 - torch.hypot(u - 60.0, v - 60.0)))  # a disc without a hole
    rough = [[20.0, 20, 7, 7, 0], [40, 40, 9, 9, 0], [1, 40, 7, 7, 0], [60, 60, 7, 7, 0]]
    half = torch.full((4,), 0.5, dtype=torch.float64)
    frame = torch.zeros(4, dtype=torch.int64)
    found = fit_small_rings(frames, *begun(frame, torch.tensor(rough).double(), half), FOCAL)
    assert not found.good.any()
