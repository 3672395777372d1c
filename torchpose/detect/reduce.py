"""Area reduction of a whole batch of frames: the only full-size pass of the detector, and it stays in integers."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

REDUCED_PIXELS = 1_300_000  # upper bound of the reduced frame's size when the factor is chosen automatically
_PART_PIXELS = 1_000_000  # of the frames that are reduced at a time


def reduction_factor(height: int, width: int) -> int:
    """Smallest integer factor that brings a frame to at most 1.3 megapixels (20 MP: 4, 5 MP: 2, 2 MP: 2, 1 MP: 1)."""
    factor = 1
    while (height // factor) * (width // factor) > REDUCED_PIXELS:
        factor += 1
    return factor


def area_reduce(frames: Tensor, factor: int, *, exact: bool = False) -> Tensor:
    """Means over factor x factor blocks: (B, H, W) -> (B, H // factor, W // factor), uint8 as it came, else float32.

    Reduced pixel (x, y) is centred at full-frame u = factor * x + (factor - 1) / 2, v likewise. Rows and columns beyond
    the last whole block are left out. uint8 and uint16 are rounded to whole levels, once for each factor of 2, unless
    ``exact`` asks for float32.

    On the CPU frames go through cv2.resize(INTER_AREA), the batch seen as one tall picture, a few rows at a time:
    reduction by 2 is the one that OpenCV has vector code for, three times as fast as by 4 at once, and what it leaves
    stays in the cache for the next (scripts/bench_pipeline.py).
    """
    whole = frames.dtype == torch.uint8 and not exact
    if factor == 1:
        return frames if whole else frames.float()
    batch, height, width = frames.shape
    h, w = height // factor, width // factor
    if 0 in (batch, h, w):
        return torch.zeros(batch, h, w, dtype=torch.uint8 if whole else torch.float32, device=frames.device)
    cropped = frames[:, : h * factor, : w * factor]
    if frames.device.type == "cpu" and frames.dtype in (torch.uint8, torch.uint16, torch.float32):
        tall = cropped.reshape(batch * h * factor, w * factor).numpy()  # a view unless rows were cropped
        reduced = np.empty((batch * h, w), np.float32 if exact else tall.dtype)
        rows = max(1, _PART_PIXELS // (w * factor * factor))
        for start in range(0, batch * h, rows):
            part, left = tall[start * factor : (start + rows) * factor].astype(reduced.dtype, copy=False), factor
            while left > 1:
                by = 2 if left % 2 == 0 else left
                left //= by
                size = (part.shape[1] // by, part.shape[0] // by)
                target = reduced[start : start + rows] if left == 1 else None
                part = cv2.resize(part, size, target, interpolation=cv2.INTER_AREA)
        out = torch.from_numpy(reduced).view(batch, h, w)
        return out if whole else out.float()
    means = torch.nn.functional.avg_pool2d(cropped[:, None].float(), factor)[:, 0]
    return means.round().to(torch.uint8) if whole else means
