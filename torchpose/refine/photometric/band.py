"""The pixels near the two circles of a ring, enumerated row by row without touching the others."""

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import Spread
from torchpose.geometry.segments import ragged_arange

BAND = 4.0  # px on either side of an edge, at least
_PER_BLUR = 4.6  # band of a wide blur, in its standard deviations
_WIDEST = 12.0  # px, of all bands


def band_width(spread: Spread) -> Tensor:
    """Band (N,) px that holds edges of these blurs and the levels on both sides."""
    most = blurs.axes(spread.covariance)[1]
    return (_PER_BLUR * most.sqrt()).clamp(BAND, _WIDEST)


def band_pixels(outer: Tensor, inner: Tensor, band: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels within about ``band`` px of either ellipse of K rings, each once.

    A row of pixels cuts the two ellipses, each grown and shrunk by the band, in nested spans; the pixels between the
    ends of a grown and a shrunk span belong to the band. Where the ring is thinner than two bands, theirs merge.

    Args:
        outer: (K, 5) ellipses in pixels.
        inner: (K, 5), inside of them.
        band: (K,) px.
        height: of the frame.
        width: of the frame.

    Returns:
        ring (P,), u (P,), v (P,) int64, sorted by ring and row.
    """
    reach = _half_height(outer, band)
    first = (outer[:, 1] - reach).ceil().clamp(0, height).long()
    last = (outer[:, 1] + reach).floor().clamp(-1, height - 1).long()
    ring, offset = ragged_arange((last - first + 1).clamp_min(0))
    v = first[ring] + offset
    # each ellipse grown, then shrunk: nested, from outside inwards
    grow = torch.stack([band, -band, band, -band], -1)
    four = torch.stack([outer, outer, inner, inner], 1)
    low, high = (x.unbind(-1) for x in _spans(four[ring], grow[ring], v.double(), width))
    # a span that the row misses is empty in the middle of the one around it
    (low0, high0), (low1, high1) = (low[0], high[0]), _within(low[1], high[1], low[0], high[0])
    low2, high2 = _within(low[2], high[2], low1, high1)
    low3, high3 = _within(low[3], high[3], low2, high2)
    start = torch.stack([low0, low2, high3, high1], -1)
    length = torch.stack([low1 - low0, low3 - low2, high2 - high3, high0 - high1], -1)
    segment, position = ragged_arange(length.flatten())
    row = segment // 4
    return ring[row], start.flatten()[segment] + position, v[row]


def _half_height(ellipse: Tensor, band: Tensor) -> Tensor:
    a, b, theta = ellipse[:, 2] + band, ellipse[:, 3] + band, ellipse[:, 4]
    return torch.hypot(a * theta.sin(), b * theta.cos())


def _spans(ellipse: Tensor, grow: Tensor, v: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """First pixel inside and first one beyond it (S, E), int64, where rows ``v`` (S,) of pixels cut grown ellipses
    (S, E, 5); equal where they miss.
    """
    cx, cy, *axes, theta = ellipse.unbind(-1)
    a, b = ((axis + grow).clamp_min(1e-3) for axis in axes)
    cos, sin, y = theta.cos(), theta.sin(), v[:, None] - cy
    # (x cos + y sin)^2 / a^2 + (y cos - x sin)^2 / b^2 = 1, a quadratic in x
    p = (cos / a).square() + (sin / b).square()
    half = cos * sin * (1 / b.square() - 1 / a.square()) * y
    root = half.square() - p * (((sin / a).square() + (cos / b).square()) * y.square() - 1)
    middle, reach = cx + half / p, root.clamp_min(0).sqrt() / p
    low, high = (middle - reach).ceil().clamp(0, width).long(), (middle + reach).floor().clamp(-1, width - 1).long() + 1
    return low, torch.where(root > 0, high, low).maximum(low)


def _within(low: Tensor, high: Tensor, outer_low: Tensor, outer_high: Tensor) -> tuple[Tensor, Tensor]:
    low = low.clamp(outer_low, outer_high)
    high = high.clamp(outer_low, outer_high)
    return low, torch.maximum(low, high)
