"""Area reduction of a whole batch of frames: the only full-size pass of the detector, and it stays in integers."""

from __future__ import annotations

import cv2
import torch
from torch import Tensor

REDUCED_PIXELS = 1_300_000  # upper bound of the reduced frame's size when the factor is chosen automatically


def reduction_factor(height: int, width: int) -> int:
    """Smallest integer factor that brings a frame to at most 1.3 megapixels (20 MP: 4, 5 MP: 2, 2 MP: 2, 1 MP: 1)."""
    factor = 1
    while (height // factor) * (width // factor) > REDUCED_PIXELS:
        factor += 1
    return factor


def area_reduce(frames: Tensor, factor: int) -> Tensor:
    """Means over factor x factor blocks: (B, H, W) -> (B, H // factor, W // factor) float32.

    Reduced pixel (x, y) is centred at full-frame u = factor * x + (factor - 1) / 2, v likewise. Rows and columns beyond
    the last whole block are left out.

    On the CPU frames go through cv2.resize(INTER_AREA), the batch seen as one tall picture: one pass over the bytes
    without a float copy, measured several times faster than avg_pool2d (scripts/bench_pipeline.py).
    """
    if factor == 1:
        return frames.float()
    batch, height, width = frames.shape
    h, w = height // factor, width // factor
    if 0 in (batch, h, w):
        return torch.zeros(batch, h, w, device=frames.device)
    cropped = frames[:, : h * factor, : w * factor]
    if frames.device.type == "cpu" and frames.dtype in (torch.uint8, torch.uint16, torch.float32):
        tall = cropped.reshape(batch * h * factor, w * factor).numpy()  # a view unless rows were cropped
        reduced = cv2.resize(tall, (w, batch * h), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(reduced).view(batch, h, w).float()
    return torch.nn.functional.avg_pool2d(cropped[:, None].float(), factor)[:, 0]
