"""Tone curves against the numbers of their standard, finite differences and files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import torchpose as tp
from torchpose.camera import LINEAR, Tone

F64 = torch.float64


def test_srgb_is_that_of_the_standard() -> None:
    # IEC 61966-2-1: mid grey, and the end of the line at its toe
    assert float(Tone("srgb").light(torch.tensor(0.5, dtype=F64))) == pytest.approx(0.21404114, abs=1e-8)
    assert float(Tone("srgb").light(torch.tensor(0.04045, dtype=F64))) == pytest.approx(0.0031308, abs=1e-7)


@pytest.mark.parametrize("tone", [LINEAR, Tone("srgb"), Tone("gamma", 2.2), Tone("gamma", 0.5)])
def test_slope_is_the_derivative(tone: Tone) -> None:
    stored, step = torch.linspace(0.06, 0.99, 50, dtype=F64), 1e-6
    difference = (tone.light(stored + step) - tone.light(stored - step)) / (2 * step)
    torch.testing.assert_close(tone.slope(tone.light(stored)), difference, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16])
def test_integers_and_floats_agree(dtype: torch.dtype) -> None:
    white = 255 if dtype == torch.uint8 else 65535
    stored = torch.arange(0, white + 1, max(1, white // 255)).to(torch.int32).to(dtype).view(1, 1, -1)
    tone = Tone("gamma", 2.2)
    assert tone.linear(stored).dtype == torch.uint16
    share = tone.linear(stored).int().double() / 65535
    floats = tone.linear(stored.int().float() / white, 1.0)
    torch.testing.assert_close(share.float(), floats / 255, rtol=0, atol=1e-5)
    assert LINEAR.linear(stored) is stored


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("tone", [None, LINEAR, Tone("srgb"), Tone("gamma", 1.85)])
def test_camera_files_hold_it(tmp_path: Path, suffix: str, tone: Tone | None) -> None:
    camera = tp.Camera(64, 48, [[50.0, 0, 31], [0, 50, 23], [0, 0, 1]], [], tone=tone)
    file = tmp_path / f"camera{suffix}"
    camera.save(file)
    assert tp.Camera.load(file).tone == tone
    for format in ("ros", "kalibr"):
        camera.save(file.with_suffix(".yaml"), format)
        assert tp.Camera.load(file.with_suffix(".yaml")).tone == tone


def test_a_mapping_is_read_too(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    tp.Camera(64, 48, [[50.0, 0, 31], [0, 50, 23], [0, 0, 1]], []).save(file)
    file.write_text(file.read_text() + "tone:\n  gamma: 2.2\n")
    assert tp.Camera.load(file).tone == Tone("gamma", 2.2)


@pytest.mark.parametrize("text", ["", "rec709", "gamma", "gamma: -1", "gamma: 9", {"gamma": "x"}, {"srgb": 1}])
def test_others_are_refused(text: object) -> None:
    with pytest.raises(tp.ConfigError, match="write linear, srgb or gamma"):
        Tone.parse(text)
