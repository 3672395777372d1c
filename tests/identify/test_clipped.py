"""Rings whose light side is clipped: the codes are read up to a displacement, and the layout tells which."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import torchpose as tp
from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.detect import find_candidates
from torchpose.geometry import rotations
from torchpose.identify import Identified, MarkerTable, identify
from torchpose.rings import Rings, measure_rings
from torchpose.sim import add_noise, render
from torchpose.target import Target

CAMERA = pinhole()
SMALL = (320.0, 440.0)  # mm: radii of 13 to 18 px, of which a pixel is more than half a code


def moved(target: Target, px: float, count: int = 40) -> tuple[Rings, torch.Tensor]:
    """Rings of ``count`` frames whose edges lie ``px`` nearer to the middle of the ring, and the rotations."""
    r, t = random_poses(count, 35.0, SMALL, seed=4)
    ellipses = exact_ellipses(target, CAMERA, r, t).flatten(0, 1)
    polarity = 1.0 if target.background == "light" else -1.0
    ellipses[:, 0, 2:4] -= polarity * px
    ellipses[:, 1, 2:4] += polarity * px
    rings = rings_of(ellipses, torch.arange(count).repeat_interleave(len(target)), polarity=polarity)
    return replace(rings, clipped=torch.ones(len(rings), dtype=torch.bool)), r


def found(rings: Rings, target: Target, frames: int = 40) -> Identified:
    return identify(rings, MarkerTable.of([target]), CAMERA, frames, 1)


@pytest.mark.parametrize("name", ["quad40", "quad40_dark", "hexa50"])
@pytest.mark.parametrize("px", [0.0, 0.5, 1.0, 1.7])
def test_all_markers_under_one_displacement(name: str, px: float) -> None:
    target = Target.load(name)
    rings, r = moved(target, px)
    result = found(rings, target)
    assert torch.equal(result.ring, torch.arange(len(rings)).view(40, len(target)))
    assert rotations.angle_between(result.R, r).max() < 0.2


def test_rings_that_are_not_clipped_are_not_read_so() -> None:
    rings, _ = moved(Target.load("quad40"), 1.0)
    plain = replace(rings, clipped=torch.zeros(len(rings), dtype=torch.bool))
    right = found(plain, Target.load("quad40")).ring == torch.arange(160).view(40, 4)
    assert not right.all(1).any()


def test_three_rings_that_fit_the_target_turned_are_right_or_refused() -> None:
    """Without the largest code the others are those of the next three corners, read up to a code less."""
    target = Target.load("quad40")
    rings, _ = moved(target, 0.9)
    three = rings[target.radii[:, 1].argsort().argsort().repeat(40) < 3]
    result = found(three, target)
    code = target.radii[:, 1].argsort().argsort()
    right = torch.where(code < 3, torch.cumsum(code < 3, 0) - 1, -1) + 3 * torch.arange(40)[:, None] * (code < 3)
    refused = (result.ring == -1).all(1)
    assert (refused | (result.ring == right).all(1)).all()
    assert torch.equal(refused, result.R.isnan().flatten(1).any(1))
    assert refused.sum() < 10


def test_light_that_differs_from_ring_to_ring_gives_no_wrong_marker() -> None:
    target = Target.load("quad40")
    rings, _ = moved(target, 0.6)
    g = torch.Generator().manual_seed(0)
    own = 0.8 * torch.rand(len(rings), 1, dtype=F64, generator=g) - 0.4
    outer, inner = rings.outer.params.clone(), rings.inner.params.clone()
    outer[:, 2:4], inner[:, 2:4] = outer[:, 2:4] - own, inner[:, 2:4] + own
    uneven = replace(rings, outer=replace(rings.outer, params=outer), inner=replace(rings.inner, params=inner))
    ring = found(uneven, target).ring
    wrong = (ring >= 0) & (ring != torch.arange(160).view(40, 4))
    assert not (wrong & ((ring >= 0).sum(1, keepdim=True) >= 3)).any()


@pytest.mark.parametrize("name", ["quad40", "quad40_dark"])
def test_which_rings_are_clipped(name: str) -> None:
    target = Target.load(name)
    r, t = random_poses(2, 20.0, (300, 400), seed=1)
    polarity = 1.0 if target.background == "light" else -1.0
    pictures = render(CAMERA, target, r, t, psf_sigma=0.7, dark=30.0, light=220.0)
    for gain, clipped in ((1.0, False), (2.0, True)):
        frames = add_noise(gain * pictures, 2.0, seed=3)
        candidates = find_candidates(frames)
        rings = measure_rings(frames, candidates[candidates.polarity == polarity], CAMERA)
        assert len(rings) == 8
        assert (rings.clipped == clipped).all()


@pytest.mark.parametrize("gain", [2.0, 4.0])
@pytest.mark.parametrize("distance", [(150.0, 180.0), SMALL])
def test_over_exposed_frames(gain: float, distance: tuple[float, float]) -> None:
    """All found; errors as the covariances claim, also of a method that cannot know where the edges are."""
    target = Target.load("quad40")
    r, t = random_poses(3, 35.0, distance, seed=5)
    frames = add_noise(gain * render(CAMERA, target, r, t, psf_sigma=0.7, dark=30.0, light=220.0), 2.0, seed=6)
    for method in ("photometric", "centers"):
        poses = tp.PoseEstimator(CAMERA, target, method=method)(frames)
        assert poses.ok.all()
        assert (poses.markers == 4).all()
        error = torch.cat([poses.t - t, rotations.log(poses.R @ r.mT)], -1)
        assert (error.abs() < 6 * poses.std).all(), method
        if method == "photometric":
            assert (torch.linalg.vector_norm((poses.t - t)[:, :2], dim=-1) < 0.015).all()
