"""Area reduction of a whole batch of frames: the only full-size pass of the detector, and it stays in integers."""

from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Real, Shaped
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either

# upper bound of the reduced frame's size when the factor is chosen automatically: 2 MP are halved (convention)
REDUCED_PIXELS = 1_300_000
_MOST_REDUCTION = 4  # of frames that are looked at from farther away: of wider blurs rings are not read
_PART_PIXELS = 1_000_000  # of the frames that are reduced at a time
# of larger blocks OpenCV forms means in float32, which is too short to round sums of 16 bits right (derived)
_OPENCV_MOST = 9
_OPENCV_LANES = 16  # columns that its widest vectors take at a time
_Grid = TypeVar("_Grid", np.ndarray, Tensor)


@checked
def reduction_factor(height: int, width: int) -> int:
    """Smallest integer factor that brings a frame to at most 1.3 megapixels (20 MP: 4, 5 MP: 2, 2 MP: 2, 1 MP: 1)."""
    factor = 1
    while (height // factor) * (width // factor) > REDUCED_PIXELS:
        factor += 1
    return factor


def area_reduce(frames: Shaped[Tensor, "B H W"], factor: int, *, exact: bool = False) -> Real[Tensor, "B h w"]:
    """Means over factor x factor blocks, H // factor by W // factor; uint8 as it came, else float32.

    Reduced pixel (x, y) is centred at full-frame u = factor * x + (factor - 1) / 2, v likewise. Rows and columns beyond
    the last whole block are left out. uint8 and uint16 are rounded to whole levels as in `block_means`, once for each
    factor of 2, unless ``exact`` asks for float32. The result is the same on every device to the last bit.
    """
    whole = frames.dtype == torch.uint8 and not exact
    if factor == 1:
        return frames if whole else frames.float()
    batch, height, width = frames.shape
    h, w = height // factor, width // factor
    if 0 in (batch, h, w):
        return torch.zeros(batch, h, w, dtype=torch.uint8 if whole else torch.float32, device=frames.device)
    exact |= frames.dtype not in (torch.uint8, torch.uint16)
    reduced = _in_parts if frames.device.type == "cpu" else _at_once
    means = reduced(frames[:, : h * factor, : w * factor], factor, exact)
    return means.to(torch.uint8 if whole else torch.float32)


def reduction_for(width: Float[Tensor, " N"], widest: float) -> Int[Tensor, " N"]:
    """The power of two, at most 4, by which frames are reduced so that what is ``width`` px wide is not wider."""
    factor = torch.ones_like(width, dtype=torch.int64)
    for power in range(1, _MOST_REDUCTION.bit_length()):
        factor = either(width > widest * 2 ** (power - 1), 2**power, factor)
    return factor


def only_reduced(
    frames: Shaped[Tensor, "B H W"], frame: Int[Tensor, " N"], factor: int
) -> tuple[Real[Tensor, "F h w"], Int[Tensor, " N"], Int[Tensor, " F"]]:
    """The frames that N items are of, reduced; the number of each item's among them; and which of all they are."""
    which, own = frame.unique(return_inverse=True)
    some = frames if len(which) == len(frames) else frames[which]
    return some if factor == 1 else area_reduce(some, factor, exact=True), own, which


def _steps(factor: int) -> list[int]:
    """The factors by which frames are reduced one after the other: every 2, then what is left."""
    if factor % 2:
        return [factor] if factor > 1 else []
    return [2, *_steps(factor // 2)]


def _at_once(frames: Tensor, factor: int, exact: bool) -> Tensor:
    """What `_in_parts` does, on any device."""
    levels = frames.float() if exact else frames.int()
    for by in _steps(factor):
        levels = block_means(levels, by)
    return levels


def _in_parts(frames: Tensor, factor: int, exact: bool) -> Tensor:
    """The batch seen as one tall picture, a few rows at a time, which stay in the processor's cache."""
    batch, height, width = frames.shape
    if exact and frames.dtype not in (torch.uint8, torch.float32):
        frames = frames.float()
    tall = frames.reshape(batch * height, width).numpy()  # a view unless rows were cropped
    reduced = np.empty((batch * height // factor, width // factor), np.float32 if exact else tall.dtype)
    rows = max(1, _PART_PIXELS // (width * factor))
    *steps, last = _steps(factor)
    for start in range(0, len(reduced), rows):
        part = tall[start * factor : (start + rows) * factor].astype(reduced.dtype, copy=False)
        for by in steps:
            part = _by_opencv(part, by, np.empty((len(part) // by, part.shape[1] // by), part.dtype))
        _by_opencv(part, last, reduced[start : start + rows])
    return torch.from_numpy(reduced).view(batch, height // factor, -1)


def _by_opencv(levels: np.ndarray, by: int, means: np.ndarray) -> np.ndarray:
    """`block_means`, put into ``means``, through cv2.resize(INTER_AREA) where it gives the same.

    Reduction by 2 is the one that OpenCV has vector code for, three times as fast as by 4 at once
    (scripts/bench_pipeline.py). It adds floats in the order of `block_means`, but for the columns left over.
    """
    whole = levels.dtype.kind == "u"
    if by > (_OPENCV_MOST if whole else 2):
        means[:] = block_means(levels.astype(np.int64) if whole else levels, by)
        return means
    cv2.resize(levels, means.shape[::-1], means, interpolation=cv2.INTER_AREA)
    rest = 0 if whole else means.shape[1] % _OPENCV_LANES
    if rest:
        means[:, -rest:] = block_means(levels[:, -by * rest :], by)
    return means


def block_means(levels: _Grid, by: int) -> _Grid:
    """Means over by x by blocks of (..., h, w): of integers to the nearest, halves up; of floats by columns, then rows.

    Args:
        levels: integers wide enough for the sum of a block, or floats.
        by: a divisor of h and w.
    """
    columns = sum((levels[..., k::by] for k in range(1, by)), start=levels[..., ::by])
    total = sum((columns[..., k::by, :] for k in range(1, by)), start=columns[..., ::by, :])
    area = by * by
    return total * (1 / area) if "float" in str(levels.dtype) else (total + area // 2) // area
