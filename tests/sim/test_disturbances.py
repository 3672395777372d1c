"""Lens, air, lamp and sensor against the renderer itself, moments, statistics in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.sim.test_effects import shifted
from tests.sim.test_renderer import camera, pose, target
from torchpose.sim import render, shapes
from torchpose.sim.disturbances import (
    Disturbances,
    SensorPattern,
    coma,
    displaced,
    disturbed,
    flicker,
    lines_moved,
    read_out,
    speckle,
    window,
)
from torchpose.sim.fields import keys_of

F64 = torch.float64
POSE = pose(35, 20, (2.0, -3.0, 200.0))
SOFT = 1.0  # px of blur: 2e-4 of an edge's contrast lies beyond the Nyquist frequency; 5e-3 of one with 0.7 px


def middle(frames: Tensor) -> Tensor:
    return frames[..., 8:-8, 8:-8]


@pytest.mark.parametrize(("du", "dv"), [(0.1, 0.0), (0.0, -0.15), (0.25, 0.3)])
def test_displaced_is_a_camera_that_is_shifted(du: float, dv: float) -> None:
    frame = render(camera(), target(), *POSE, psf_sigma=SOFT)
    found = displaced(frame, frame.new_tensor([du, dv]).expand(1, 120, 128, 2))
    expected = render(shifted(camera(), du, dv), target(), *POSE, psf_sigma=SOFT)
    # of 190 grey levels
    assert (middle(found - expected)).abs().max() < 0.12
    assert float((middle(found - expected)).square().mean().sqrt()) < 0.01 * float(
        middle(frame - expected).square().mean().sqrt()
    )


def test_displacement_changes_from_pixel_to_pixel() -> None:
    # away from the principal point by 0.5 % of the distance: a longer lens
    cam, stretch = camera(), 0.005
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(128.0), indexing="ij")
    away = torch.stack([u, v], -1) - cam.matrix[:2, 2].float()
    frame = render(cam, target(), *POSE, psf_sigma=SOFT)
    matrix = cam.matrix.clone()
    matrix[:2, :2] /= 1 - stretch
    longer = render(replace(cam, matrix=matrix), target(), *POSE, psf_sigma=SOFT / (1 - stretch))
    found = displaced(frame, stretch * away[None])
    assert float(middle(found - longer).square().mean().sqrt()) < 0.03 * float(
        middle(frame - longer).square().mean().sqrt()
    )


def test_lines_move_on_their_own() -> None:
    frame = render(camera(), target(), *POSE, psf_sigma=SOFT)
    shift = torch.where(torch.arange(120) % 2 == 0, 0.4, -1.3)[None]
    found = lines_moved(frame, shift)
    for parity, du in ((0, 0.4), (1, -1.3)):
        expected = render(shifted(camera(), du, 0.0), target(), *POSE, psf_sigma=SOFT)
        assert middle(found - expected)[:, parity::2].abs().max() < 0.12


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_coma_keeps_the_centroid_and_has_its_moments(angle: float) -> None:
    dot = shapes.ring((0, 0), 3.0, level=0.0)
    pose_ = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
    frame = render(camera(), dot, *pose_, light=1.0, psf_sigma=SOFT)
    found = coma(frame, torch.tensor([4.0], dtype=F64), torch.tensor([angle], dtype=F64))
    v, u = torch.meshgrid(torch.arange(120, dtype=F64), torch.arange(128, dtype=F64), indexing="ij")
    along = (u - 63.3) * math.cos(angle) + (v - 60.8) * math.sin(angle)

    def moments(picture: Tensor) -> list[float]:
        mass = torch.where(torch.hypot(u - 63.3, v - 60.8) < 30, 1 - picture[0].double(), 0.0)
        mean = float((mass * along).sum() / mass.sum())
        return [float(mass.sum()), mean, *[float((mass * (along - mean) ** k).sum() / mass.sum()) for k in (2, 3)]]

    before, after = moments(frame), moments(found)
    share, place, width = np.array([0.6, 0.28, 0.12]), np.array([0.0, 2.0, 4.0]), np.array([0.0, 0.8, 1.4])
    place = place - share @ place
    assert after[0] == pytest.approx(before[0], rel=1e-5)
    assert after[1] == pytest.approx(before[1], abs=1e-3)
    assert after[2] - before[2] == pytest.approx(share @ (place**2 + width**2), rel=2e-3)
    assert after[3] - before[3] == pytest.approx(share @ (place**3 + 3 * place * width**2), rel=2e-2)


def test_lamp_modulates_the_lines_as_a_sine() -> None:
    gain = flicker(torch.tensor([0.03, 0.1], dtype=F64), 40.0, 400, keys_of(2, 1, "lamp"))[..., 0].double()
    spectrum = torch.fft.rfft(gain)
    expected = torch.zeros(2, 201, dtype=F64)
    expected[:, 0], expected[:, 10] = 400, torch.tensor([0.03, 0.1]) * 200
    torch.testing.assert_close(spectrum.abs(), expected, rtol=0, atol=1e-3)
    assert (spectrum[0, 10].angle() - spectrum[1, 10].angle()).abs() > 0.01  # frames meet the lamp at any time


def test_speckle_is_exponential_and_has_its_grain() -> None:
    gain = speckle(torch.ones(8, dtype=F64), 3.0, (200, 240), keys_of(8, 2, "laser"))
    assert float(gain.mean()) == pytest.approx(1, abs=0.01)
    assert float(gain.std()) == pytest.approx(1, abs=0.02)
    assert float((gain > 2).double().mean()) == pytest.approx(math.exp(-2), abs=0.005)
    for shift in (1, 3):
        found = float(((gain - 1) * (gain.roll(shift, 2) - 1)).mean())
        assert found == pytest.approx(math.exp(-2 * (shift / 3) ** 2), abs=0.02)
    weak = speckle(torch.full((8,), 0.1, dtype=F64), 3.0, (200, 240), keys_of(8, 2, "laser"))
    torch.testing.assert_close(weak - 1, 0.1 * (gain - 1))


def test_ghost_is_four_panes() -> None:
    panes = window(torch.zeros(6, 480, 640), keys_of(6, 4, "ghost"))
    assert panes.min() >= 0
    assert panes.max() <= 1
    area = panes.flatten(1).mean(1) * 480 * 640
    # 0.35 to 0.6 of the height wide, 6 % of it bars
    assert (area < (0.60 * 480 * 0.94) ** 2).all()
    assert (area > (0.35 * 480 * 0.94) ** 2 * 0.95).all()
    assert len(area.unique()) == 6


def test_disturbances_are_of_the_frame_alone() -> None:
    frames = render(camera(), target(), *POSE, psf_sigma=SOFT).expand(3, 120, 128)
    what = Disturbances.of(
        3, seed=5, coma_px=1.0, haze_px=0.1, ghost=10.0, speckle=0.02, flicker=0.02, haze_length=20.0
    )
    together = disturbed(frames, what)
    alone = disturbed(frames[:1], what[2:], torch.tensor([2]))
    torch.testing.assert_close(together[2:], alone, rtol=0, atol=1e-3)
    assert (together[0] - together[1]).abs().max() > 1
    assert torch.equal(disturbed(frames, Disturbances.of(3)), frames)


def test_haze_displaces_by_its_rms() -> None:
    # a picture whose grey value is its place, as far as a period goes: phases say by how much it moved
    u = torch.arange(256.0).expand(256, 256)
    wave = torch.stack([(2 * math.pi / 16 * u).cos(), (2 * math.pi / 16 * u).sin()]).repeat(8, 1, 1)
    what = Disturbances.of(16, seed=2, haze_px=0.1, haze_length=25.0)
    hazy = disturbed(wave, what, torch.arange(8).repeat_interleave(2))  # both phases through the same air
    phase = torch.atan2(hazy[1::2], hazy[0::2]) - torch.atan2(wave[1::2], wave[0::2])
    shift = -(torch.remainder(phase + math.pi, 2 * math.pi) - math.pi)[:, 20:-20, 20:-20] * 16 / (2 * math.pi)
    # 8 fields of some 30 independent places
    assert float(shift.square().mean().sqrt()) == pytest.approx(0.1, rel=0.2)
    near = float((shift[..., 25:] * shift[..., :-25]).mean() / shift.square().mean())
    assert near == pytest.approx(math.exp(-1), abs=0.2)


def test_sensor_patterns_stay_from_frame_to_frame() -> None:
    grey = torch.full((2, 300, 400), 100.0)
    uneven = read_out(grey, SensorPattern(prnu=0.01, seed=3), 0)
    assert torch.equal(uneven[0], uneven[1])
    assert float(uneven.std()) == pytest.approx(1.0, rel=0.02)
    flat = (uneven[0] - 100).flatten()
    assert float((flat[1:] * flat[:-1]).mean().abs()) < 5 / math.sqrt(300 * 400)  # white
    lined = read_out(grey, SensorPattern(column_noise=2.0, seed=3), 0)
    assert torch.equal(lined[0, :1].expand(300, 400), lined[1])
    assert float(lined.std()) == pytest.approx(2.0, rel=5 / math.sqrt(2 * 400))
    assert not torch.equal(lined, read_out(grey, SensorPattern(column_noise=2.0, seed=4), 0))
    frames = render(camera(), target(), *POSE, psf_sigma=SOFT).expand(2, 120, 128)
    jitter = read_out(frames, SensorPattern(line_jitter=0.2), 7)
    assert (jitter[0] - jitter[1]).abs().max() > 2
    again = read_out(frames[:1], SensorPattern(line_jitter=0.2), 7, torch.tensor([1]))
    torch.testing.assert_close(again, jitter[1:], rtol=0, atol=1e-3)
