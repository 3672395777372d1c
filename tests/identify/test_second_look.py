"""Markers that the first search lost, measured where the others put them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import pinhole, random_poses
from torchpose import pipeline
from torchpose.detect import Candidates, find_candidates
from torchpose.identify import second_look
from torchpose.sim import add_noise, render
from torchpose.target import Target

Scene = tuple[tp.Camera, Target, Tensor, Tensor, Tensor]


@pytest.fixture(scope="module")
def scene() -> Scene:
    camera = replace(pinhole(1111.11, 912, 608), distortion=torch.tensor([-0.1, 0.02, 0, 0], dtype=torch.float64))
    target = Target.load("quad40")
    r, t = random_poses(6, 40.0, (150, 200), seed=3)
    t[:, :2] = 0
    return camera, target, r, t, add_noise(render(camera, target, r, t, psf_sigma=0.8), 1.0, seed=2)


def estimate(monkeypatch: pytest.MonkeyPatch, scene: Scene, lost: int, frames: Tensor | None = None) -> tp.Poses:
    """Poses where the first search loses ``lost`` markers of every frame, those with the highest ids."""
    camera, target, r, t, pictures = scene
    pictures = pictures if frames is None else frames

    def lossy(frames: Tensor, *, coarse: Candidates | None = None, **options: Any) -> tp.detect.Candidates:
        found = find_candidates(frames, coarse=coarse, **options)
        for marker in range(len(target) - lost, len(target)):
            at = camera.project((r @ target.centers[marker]) + t)
            found = found[torch.linalg.vector_norm(found.ellipse[:, :2] - at[found.frame], dim=-1) > 20]
        return found

    for search in ("find_coarse", "find_candidates"):
        monkeypatch.setattr(pipeline, search, lossy)
    return tp.PoseEstimator(camera, target)(pictures)


@pytest.mark.parametrize("lost", [1, 2])
def test_lost_markers_are_found(monkeypatch: pytest.MonkeyPatch, scene: Scene, lost: int) -> None:
    camera, target, _, _, frames = scene
    whole = tp.PoseEstimator(camera, target)(frames)
    found = estimate(monkeypatch, scene, lost)
    assert found.ok.all()
    assert (found.markers == 4).all()
    assert ((found.t - whole.t).abs() < 0.2 * whole.std[:, :3]).all()


def test_what_is_not_there_is_not_found(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    camera, target, r, t, frames = scene
    frames = frames.clone()
    for k, (u, v) in enumerate(camera.project((r @ target.centers[3]) + t).round().long().tolist()):
        frames[k, v - 50 : v + 51, u - 50 : u + 51] = 220
    found = estimate(monkeypatch, scene, 1, frames)
    assert (found.markers == 3).all()


def test_another_code_is_no_marker(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    """A ring in the right place whose inner circle is that of no marker."""
    camera, target, r, t, _ = scene
    radii = target.radii.clone()
    radii[3, 1] = 4.0
    frames = add_noise(render(camera, replace(target, radii=radii), r, t, psf_sigma=0.8), 1.0, seed=2)
    found = estimate(monkeypatch, scene, 1, frames)
    assert (found.markers == 3).all()


def test_what_is_blurred_is_not_looked_at_again(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    """A ring of another code where a marker is missing: under such a blur no other look shows more."""
    camera, target, r, t, _ = scene
    radii = target.radii.clone()
    radii[3, 1] = 4.0
    frames = add_noise(render(camera, replace(target, radii=radii), r, t, psf_sigma=3.0), 1.0, seed=2)
    calls = []
    for module, name in ((pipeline, "find_candidates"), (second_look, "measure_predicted")):
        monkeypatch.setattr(module, name, lambda *_, **__: calls.append("again"))
    poses = tp.PoseEstimator(camera, target)(frames)
    assert poses.ok.all()
    assert (poses.markers == 3).all()
    assert not calls


def test_a_covered_small_ring_completes_the_target() -> None:
    """A grey patch over a fifth of a ring of 10 px, of which the search makes an ellipse around ring and patch."""
    camera, target = pinhole(1111.11, 912, 608), Target.load("quad40")
    r, t = random_poses(8, 25.0, (520, 560), seed=5)
    t[:, :2] = 0
    frames = render(camera, target, r, t, psf_sigma=1.6)
    for k, (u, v) in enumerate(camera.project((r @ target.centers[2]) + t).tolist()):
        angle = 2 * math.pi * k / 8
        y, x = torch.meshgrid(torch.arange(608.0), torch.arange(912.0), indexing="ij")
        along = (x - u) * math.cos(angle) + (y - v) * math.sin(angle)
        across = (y - v) * math.cos(angle) - (x - u) * math.sin(angle)
        patch = (
            torch.sigmoid((along - 7) * 1.5)
            * torch.sigmoid((22 - along) * 1.5)
            * torch.sigmoid((12 - across.abs()) * 1.5)
        )
        frames[k] = (frames[k] * (1 - patch) + 110 * patch).to(frames.dtype)
    poses = tp.PoseEstimator(camera, target)(add_noise(frames, 1.5, seed=3))
    assert poses.ok.all()
    assert (poses.markers == 4).sum() >= 7
