"""What a camera does to the grey values between its sensor and the file: mosaic, denoising, tone, sharpening, JPEG."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn.functional import conv2d, pad

from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.sim.sensor import GREY_MAX, toned

_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, of red, green and blue
_RADIUS, _REACH = 2, 1.5  # px, of the bilateral filter: its neighbourhood and the deviation of its Gaussian


@dataclass(frozen=True)
class Processing:
    """Steps in the order of a camera; the defaults do nothing.

    Attributes:
        bayer: mosaic of red, green and blue over a grey scene, bilinear demosaicing, luma.
        denoise: grey levels, range of a bilateral filter (Tomasi and Manduchi 1998) of 5 x 5 px; 0 for none.
        sharpen: amount of an unsharp mask, which adds so many times the difference from the blurred frame; 0 for none.
        sharpen_px: standard deviation of that blur.
        jpeg: quality of JPEG, 1 to 100; None for lossless files.
    """

    bayer: bool = False
    denoise: float = 0.0
    sharpen: float = 0.0
    sharpen_px: float = 1.5
    jpeg: int | None = None

    @property
    def wanted(self) -> bool:
        """Whether anything is done."""
        return self.bayer or self.denoise > 0 or self.sharpen > 0 or self.jpeg is not None


@checked
def processed(
    raw: Float[Tensor, "B H W"], steps: Processing, bits: int = 8, gamma: float | Literal["srgb"] = 1.0
) -> Shaped[Tensor, "B H W"]:
    """Frames as the file has them, of raw grey levels 0..255 with their noise: uint8 up to 8 bits, else uint16.

    Raises:
        ConfigError: JPEG of more than 8 bits.
    """
    if steps.jpeg is not None and bits != 8:
        raise ConfigError("jpeg: holds 8 bits; write bits: 8")
    if steps.bayer:
        raw = demosaiced(raw)
    if steps.denoise > 0:
        raw = bilateral(raw, steps.denoise)
    grey = toned(raw, gamma)
    if steps.sharpen > 0:
        grey = grey + steps.sharpen * (grey - smoothed(grey, steps.sharpen_px))
    top = 2**bits - 1
    stored = (grey * (top / GREY_MAX)).round().clamp(0, top).to(torch.uint8 if bits <= 8 else torch.uint16)
    return stored if steps.jpeg is None else _through_jpeg(stored, steps.jpeg)


def demosaiced(raw: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Luma of an RGGB mosaic whose colours are interpolated bilinearly."""
    height, width = raw.shape[1:]
    odd_row, odd_column = (torch.arange(size, device=raw.device) % 2 == 1 for size in (height, width))
    red = ~odd_row[:, None] & ~odd_column
    blue = odd_row[:, None] & odd_column
    cross = raw.new_tensor([[0.0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
    square = raw.new_tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
    parts = zip(_LUMA, (red, ~(red | blue), blue), (square, cross, square), strict=True)
    return torch.stack([share * _filtered(raw * of, kernel) for share, of, kernel in parts]).sum(0)


def bilateral(frames: Float[Tensor, "B H W"], grey: float) -> Float[Tensor, "B H W"]:
    """Mean of the neighbours within 2 px, weighted by Gaussians of their distance and of their difference in grey."""
    height, width = frames.shape[1:]
    wide = pad(frames[:, None], (_RADIUS,) * 4, mode="reflect")[:, 0]
    total, weights = torch.zeros_like(frames), torch.zeros_like(frames)
    steps = range(-_RADIUS, _RADIUS + 1)
    for dv, du in ((a, b) for a in steps for b in steps if a * a + b * b <= _RADIUS**2):
        near = wide[:, _RADIUS + dv : _RADIUS + dv + height, _RADIUS + du : _RADIUS + du + width]
        distance = (du * du + dv * dv) / (2 * _REACH**2)
        weight = (-(near - frames).square() / (2 * grey**2) - distance).exp()
        total, weights = total + weight * near, weights + weight
    return total / weights


def smoothed(frames: Float[Tensor, "B H W"], sigma: float) -> Float[Tensor, "B H W"]:
    """Frames through a sampled Gaussian."""
    reach = max(1, round(4 * sigma))
    kernel = (-0.5 * (torch.arange(-reach, reach + 1, device=frames.device).to(frames) / sigma).square()).softmax(0)
    return _filtered(_filtered(frames, kernel[None]), kernel[:, None])


def _filtered(frames: Tensor, kernel: Tensor) -> Tensor:
    """Frames (B, H, W) through a kernel (h, w) of odd sides, mirrored at the border."""
    down, across = kernel.shape[0] // 2, kernel.shape[1] // 2
    wide = pad(frames[:, None], (across, across, down, down), mode="reflect")
    return conv2d(wide, kernel[None, None])[:, 0]


def _through_jpeg(frames: Tensor, quality: int) -> Tensor:
    """Frames uint8 as they come back from JPEG."""

    def coded(frame: np.ndarray) -> np.ndarray:
        code = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE))

    return torch.from_numpy(np.stack([coded(frame) for frame in frames.cpu().numpy()])).to(frames.device)
