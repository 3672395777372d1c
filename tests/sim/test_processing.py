"""A camera's processing against OpenCV, SciPy and values in closed form."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage

from tests.sim.test_renderer import camera, pose, target
from torchpose.errors import ConfigError
from torchpose.sim import add_noise, render
from torchpose.sim.processing import Processing, bilateral, demosaiced, processed, smoothed
from torchpose.sim.sensor import toned

FRAME = render(camera(), target(), *pose(35, 20, (2.0, -3.0, 200.0)))
NOISY = add_noise(FRAME, 3.0, 1, bits=16).float() / 257


def test_mosaic_is_that_of_opencv() -> None:
    raw = (NOISY[0].numpy() * 257).round().astype(np.uint16)
    colour = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB).astype(np.float64)
    luma = colour @ np.array([0.299, 0.587, 0.114]) / 257
    found = demosaiced(NOISY)[0].numpy()
    # OpenCV rounds each mean to 1 / 257 grey level
    np.testing.assert_allclose(found[2:-2, 2:-2], luma[2:-2, 2:-2], rtol=0, atol=0.01)
    torch.testing.assert_close(demosaiced(torch.full((1, 20, 30), 77.0)), torch.full((1, 20, 30), 77.0))


def test_denoising_is_that_of_opencv() -> None:
    found = bilateral(NOISY, 12.0)[0].numpy()
    expected = cv2.bilateralFilter(NOISY[0].numpy(), 5, 12.0, 1.5)
    # OpenCV reads its weights from a table
    np.testing.assert_allclose(found[3:-3, 3:-3], expected[3:-3, 3:-3], rtol=0, atol=0.05)


def test_sharpening_is_an_unsharp_mask() -> None:
    blurred = ndimage.gaussian_filter(FRAME[0].double().numpy(), 1.5, mode="mirror", truncate=4.0)
    np.testing.assert_allclose(smoothed(FRAME, 1.5)[0].numpy(), blurred, rtol=0, atol=1e-3)
    expected = FRAME[0].numpy() + 0.8 * (FRAME[0].numpy() - blurred)
    found = processed(FRAME, Processing(sharpen=0.8))[0].numpy()
    np.testing.assert_allclose(found, expected.round().clip(0, 255), rtol=0, atol=1)
    assert found.max() > 235  # a halo beside the ring: the paper has 220


@pytest.mark.parametrize(("gamma", "pairs"), [
    ("srgb", {0.0: 0.0, 255.0: 255.0, 0.0031308 * 255: 0.040449936 * 255, 0.21404114 * 255: 127.5}),
    (2.0, {0.0: 0.0, 63.75: 127.5, 255.0: 255.0}),
    (1.0, {10.0: 10.0}),
])  # fmt: skip
def test_tone_has_known_values(gamma: float, pairs: dict[float, float]) -> None:
    found = toned(torch.tensor([list(pairs)]), gamma)
    torch.testing.assert_close(found, torch.tensor([list(pairs.values())]), rtol=0, atol=2e-3)
    noisy = add_noise(torch.tensor([[list(pairs)]]), 0.0, gamma=gamma, bits=16)
    torch.testing.assert_close(noisy.float()[0] / 257, found, rtol=0, atol=3e-3)


def test_jpeg_loses_with_its_quality() -> None:
    lossless, *lossy = (processed(NOISY, Processing(jpeg=q)).float() for q in (None, 100, 90, 50, 20))
    loss = [float((frame - lossless).square().mean().sqrt()) for frame in lossy]
    assert loss[0] < 0.8
    assert sorted(loss) == loss
    assert loss[-1] > 2.0
    with pytest.raises(ConfigError, match="jpeg: holds 8 bits"):
        processed(NOISY, Processing(jpeg=90), 12)


def test_nothing_is_rounding() -> None:
    assert not Processing().wanted
    assert torch.equal(processed(NOISY, Processing()), NOISY.round().clamp(0, 255).to(torch.uint8))
    assert processed(NOISY, Processing(), 12).dtype == torch.uint16
