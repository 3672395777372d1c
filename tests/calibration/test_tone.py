"""The tone that sizes of marks tell: rendered frames of known tone, with dot gain."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.calibration import board_scenes as boards
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration.grids import Grid, sizes_of_marks
from torchpose.calibration.tone import Sizes, edge_shift, judge_tone, sizes_of_target
from torchpose.camera import Tone
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
CAMERA = scenes.camera([-0.1, 0.02, 1e-4, -1e-4], scale=0.5)


def views(count: int) -> tuple[Tensor, Tensor]:
    """Tilted by 30 degrees, 140 to 220 mm away."""
    azimuth = 2 * torch.pi * torch.arange(count, dtype=F64) / count
    R = rotations.exp(0.52 * torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], -1))
    depth = torch.linspace(140, 220, count, dtype=F64)
    return R, torch.stack([0 * depth, 0 * depth, depth], -1)


@pytest.mark.parametrize(("gamma", "least", "most"), [(1.0, 1.0, 1.0), (1.6, 1.5, 1.7), (2.2, 2.2, 2.2)])
@pytest.mark.parametrize(("text", "outer", "inner"), [("rings:7x5:8:3:1.5", 3.05, 1.45), ("circles:7x5:8", 2.5, 0.0)])
def test_grids(text: str, outer: float, inner: float, gamma: float, least: float, most: float) -> None:
    grid = Grid.parse(text)
    assert grid is not None
    R, t = views(4)
    drawn = boards.shapes(grid, outer, inner)
    frames = torch.cat([render(CAMERA, drawn, R[k : k + 1], t[k : k + 1]) for k in range(4)])
    frames, names = add_noise(frames, 1.0, gamma=gamma), ["a", "b", "c", "d"]
    tone, shift = judge_tone(lambda one: sizes_of_marks(one.linear(frames), names, grid, CAMERA))
    assert shift is not None
    assert tone is not None
    found = {"linear": 1.0, "srgb": 2.2}.get(tone.kind, tone.gamma)  # sRGB is 2.2 but for its toe
    assert least <= found <= most
    assert (abs(shift.px) < 0.03) == (gamma == 1.0)


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_target(gamma: float) -> None:
    target = tp.Target.load("hexa50")
    R, t = views(8)
    frames = add_noise(render(CAMERA, target, R, t), 1.0, gamma=gamma)
    tone, _ = judge_tone(lambda one: sizes_of_target(one.linear(frames), CAMERA, target))
    assert tone is not None
    assert tone.kind == "linear" if gamma == 1 else tone.kind == "srgb" or 2 <= tone.gamma <= 2.4


def test_shift_and_gain_are_told_apart() -> None:
    scale = torch.linspace(4, 6, 60, dtype=F64)
    noise = 0.01 * torch.randn(2, 60, dtype=F64, generator=torch.Generator().manual_seed(2))
    radii = torch.tensor([3.0, 1.5], dtype=F64).expand(60, 2)
    sizes = Sizes(scale, 3.02 * scale + 0.2 + noise[0], 1.48 * scale - 0.2 + noise[1], radii)
    found = edge_shift(sizes)
    assert found is not None
    assert abs(found.px - 0.2) < 5 * found.sigma < 0.1
    # a fifth of strays does not matter, one size alone tells nothing
    wild = sizes.outer.clone()
    wild[::5] += 3
    strays = edge_shift(replace(sizes, outer=wild))
    assert strays is not None
    assert abs(strays.px - 0.2) < 0.05
    assert edge_shift(replace(sizes, scale=torch.full_like(scale, 5))) is None


def test_few_marks_tell_nothing() -> None:
    none = torch.zeros(0, dtype=F64)
    assert judge_tone(lambda tone: Sizes(none, none, none, torch.zeros(0, 2, dtype=F64))) == (None, None)


def test_the_estimator_takes_the_tone_from_its_camera() -> None:
    target, (R, t) = tp.Target.load("quad40"), views(1)
    stored = add_noise(render(CAMERA, target, R, t), 0.5, gamma=2.2)

    def off(camera: tp.Camera) -> float:
        """Of the measured codes from those of the target, the largest."""
        found = tp.PoseEstimator(camera, target, method="edges")(stored).detections
        ratio = (found.inner[:, 2:4].prod(-1) / found.outer[:, 2:4].prod(-1)).sqrt()
        radii = target.radii[(found.marker[:, None] == target.ids).long().argmax(1)]
        return float((ratio - radii[:, 1] / radii[:, 0]).abs().max())

    assert off(replace(CAMERA, tone=Tone("gamma", 2.2))) < 0.002 < 0.01 < off(CAMERA)
