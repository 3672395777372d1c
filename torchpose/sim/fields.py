"""Random numbers and smooth random fields of frames: functions of a key and of the place, the same in any batch."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.sim.sensor import frame_keys, normal_deviates


def keys_of(count: int, seed: int, purpose: str, index: Int[Tensor, " B"] | None = None) -> Int[Tensor, " B"]:
    """Keys of ``count`` frames for one purpose, so that no two purposes share their chance; ``index`` numbers them."""
    return frame_keys(count, seed + int.from_bytes(purpose.encode()[:6], "little"), index)


def uniform(key: Int[Tensor, " B"], count: int) -> Float[Tensor, "B count"]:
    """Numbers of 0..1, float64."""
    return torch.special.ndtr(normal_deviates(key, count).double())


def smooth_field(key: Int[Tensor, " B"], size: tuple[int, int], length: float) -> Float[Tensor, "B H W"]:
    """Gaussian fields of mean 0 and variance 1 whose autocorrelation at the distance d is exp(-(d / length)^2).

    White noise through the square root of that spectrum. The fields are periodic in their own size.

    Args:
        key: of every field.
        size: rows and columns, H and W.
        length: in rows and columns, 1.5 or more: a shorter one is not resolved.
    """
    height, width = size
    white = normal_deviates(key, height * width).view(-1, height, width)
    v = torch.fft.fftfreq(height, device=key.device)[:, None]
    u = torch.fft.rfftfreq(width, device=key.device)
    amplitude = (-0.5 * (math.pi * length) ** 2 * (u.square() + v.square())).exp()
    every = (-((math.pi * length) ** 2) * (torch.fft.fftfreq(width, device=key.device).square() + v.square())).exp()
    scale = (every.sum() / (height * width)).rsqrt()
    field: Tensor = torch.fft.irfft2(torch.fft.rfft2(white) * (scale * amplitude), s=size)
    return field
