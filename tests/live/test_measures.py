"""Blur, levels, clipping, size and tilt against the truth of rendered frames; what is said of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.live.cell import CAMERA, F64, LOOK, POSE, TARGET, picture
from torchpose.geometry import rotations
from torchpose.live.advice import advise, status_of
from torchpose.live.engine import Observer
from torchpose.live.measures import picture_measures, white_of
from torchpose.live.sources import Shot
from torchpose.sim import add_noise, render

OBSERVER = Observer(CAMERA, TARGET)


def sight(image: np.ndarray):  # type: ignore[no-untyped-def]
    return OBSERVER.look(Shot("a.png", 1.0, image))


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0, 1.6, 2.5])
def test_blur_of_every_ring_is_that_of_the_lens(sigma: float) -> None:
    seen = sight(picture(psf_sigma=sigma))
    assert [ring.marker for ring in seen.rings] == [0, 1, 2, 3]
    for ring in seen.rings:
        assert ring.blur == pytest.approx(sigma, rel=0.05, abs=0.03)
        assert ring.blur_axes is not None
        assert ring.blur_axes[0] <= ring.blur <= ring.blur_axes[1]


def test_blur_has_a_direction_where_the_camera_moves() -> None:
    image = picture(psf_sigma=0.7).astype(np.float32)
    moved = np.mean([np.roll(image, shift, axis=1) for shift in range(-3, 4)], axis=0)  # 7 px along u
    seen = sight(np.asarray(np.round(moved), np.uint8))
    least, most = seen.rings[0].blur_axes or (0.0, 0.0)
    assert least == pytest.approx(0.7, abs=0.2)
    assert most == pytest.approx(math.hypot(0.7, 2.0), rel=0.15)  # a box of 7 px has a deviation of 2


def test_levels_clipping_noise_and_size() -> None:
    seen = sight(picture(dark=40.0, light=200.0))
    ring = seen.rings[0]
    assert (ring.dark, ring.light) == (pytest.approx(40 / 255, abs=0.01), pytest.approx(200 / 255, abs=0.01))
    assert ring.clipped == 0.0
    assert ring.outer_px == pytest.approx(2 * 5.0 * 700 / 150, rel=0.01)  # diameter of 10 mm
    assert seen.picture is not None
    assert seen.picture.noise * 255 == pytest.approx(1.0, rel=0.2)
    bright = sight(picture(light=300.0))
    assert bright.rings[0].clipped > 0.2
    assert bright.picture is not None
    assert bright.picture.clipped == pytest.approx(np.mean(picture(light=300.0) == 255))


@pytest.mark.parametrize("bits", [10, 12])
def test_levels_of_deep_frames_are_shares_of_their_own_range(bits: int) -> None:
    ideal = render(CAMERA, TARGET, *POSE, **LOOK)
    image = np.asarray(add_noise(ideal, 1.0, bits=bits)[0])
    seen = OBSERVER.look(Shot("a", 1.0, image, white=float((1 << bits) - 1)))
    assert seen.rings[0].light == pytest.approx(220 / 255, abs=0.01)
    image[0, 0] = (1 << bits) - 1
    assert white_of(image) == (1 << bits) - 1


def test_tilt_is_that_of_the_target() -> None:
    lean = rotations.exp(torch.tensor([[math.radians(30.0), 0.0, 0.0]], dtype=F64))
    ideal = render(CAMERA, TARGET, lean, POSE[1], **LOOK)
    seen = sight(np.asarray(add_noise(ideal, 1.0)[0]))
    assert seen.tilt_deg == pytest.approx(30.0, abs=0.05)


def test_prediction_for_a_sharp_picture_is_below_what_a_soft_one_has() -> None:
    soft, sharp = sight(picture(psf_sigma=2.5)).accuracy, sight(picture(psf_sigma=0.7)).accuracy
    assert soft is not None
    assert sharp is not None
    assert soft.axis == sharp.axis == "z"
    assert soft.reachable_um is not None
    assert sharp.reachable_um is not None
    assert soft.reachable_um < soft.stated_um
    # of the same pose, so the same promise; the sharp picture nearly keeps it (its contrast is less)
    assert soft.reachable_um == pytest.approx(sharp.reachable_um, rel=0.2)
    assert sharp.stated_um == pytest.approx(sharp.reachable_um, rel=0.4)


CASES: dict[str, tuple[dict[str, Any], str, str, str]] = {
    "good": ({}, "ok", "good", ""),
    "covered": ({"cover": 1}, "ok", "fair", "Marker 1 is not found"),
    "mostly covered": ({"cover": 2}, "too_few_markers", "bad", "Markers 1, 2 are not found"),
    "gone": ({"t": (300.0, 0.0, 150.0)}, "no_target", "bad", "into view"),
    "over-exposed": ({"light": 2000.0, "surround": 900.0, "dark": 400.0}, "no_target", "bad", "shorten the exposure"),
    "dark": ({"light": 4.0, "surround": 3.0, "dark": 2.0}, "no_target", "bad", "The picture is dark"),
    "blurred": ({"psf_sigma": 14.0}, "no_target", "bad", "turn the focus"),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_said_of_a_frame(name: str) -> None:
    look, status, level, hint = CASES[name]
    cover = look.get("cover")
    image = picture(**{key: value for key, value in look.items() if key != "cover"})
    if cover is not None:
        image[60 : 130 if cover == 1 else 360, 290:380] = 110
    seen = sight(image)
    assert seen.row["status"] == status
    said = status_of(seen.row, seen.picture, seen.missing)
    assert said[0] == level
    assert hint in said[2]
    lines = {line.key: line for line in advise(seen.rings, seen.picture, seen.tilt_deg, 0.7)}
    assert set(lines) == {"focus", "exposure", "contrast", "size", "tilt"}
    if name == "good":
        assert {line.level for line in lines.values()} == {"good"}
        assert all(line.zone[0] <= (line.at or 0) <= line.zone[1] for line in lines.values())
    if name == "over-exposed":
        assert lines["exposure"].level == "bad"


def test_frames_without_anything_are_measured() -> None:
    for value in (0, 128, 255):
        image = np.full((360, 480), value, np.uint8)
        measured = picture_measures(image, 255.0)
        assert measured.blur is None
        assert measured.clipped == (value == 255)
        assert measured.black == (value == 0)
        assert sight(image).row["status"] == "no_target"
