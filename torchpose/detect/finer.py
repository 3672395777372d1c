"""A second, finer look at small places where something round may be, each cut out as a small frame of its own."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpose.detect.reduce import area_reduce
from torchpose.geometry.segments import pairs_in_group, rank_in_group

SIDE = 64  # px of a cut-out
_LARGEST = 10.0  # reduced px of semi-major axis: whatever is larger needs no finer look
_SMALLEST = 1.2  # reduced px of semi-minor axis
_LEAST_ASPECT = 0.15
_SAME_PLACE = 3.0  # reduced px
_MOST_PLACES = 160  # in a frame, the largest


def promising_places(frame: Tensor, ellipses: Tensor, whole: Tensor) -> Tensor:
    """Indices (P,) int64 of the small ellipses worth a finer look.

    Those within a whole ellipse that is known already are not, nor those beside a larger one of the same place.

    Args:
        frame: (M,) int64. ellipses: (M, 5), reduced px, of whatever verdict, NaN allowed. whole: (M,) bool, accepted
            with nearly all of its perimeter.
    """
    a, b = ellipses[:, 2], ellipses[:, 3]
    small = (a < _LARGEST) & (b > _SMALLEST) & (b > _LEAST_ASPECT * a) & ~whole
    place = small.nonzero()[:, 0]
    place = place[torch.argsort(a[place], descending=True, stable=True)]
    place = place[torch.argsort(frame[place], stable=True)]
    frames = int(frame.max()) + 1 if frame.numel() else 0
    known = whole.nonzero()[:, 0]
    known = known[torch.argsort(frame[known], stable=True)]
    i, j = pairs_in_group(frame[place], frame[known])
    apart = torch.linalg.vector_norm(ellipses[place[i], :2] - ellipses[known[j], :2], dim=-1)
    inside = torch.zeros_like(place, dtype=torch.bool)
    inside[i[apart < 0.5 * b[known[j]]]] = True
    place = place[~inside]
    i, j = pairs_in_group(frame[place], frame[place])
    apart = torch.linalg.vector_norm(ellipses[place[i], :2] - ellipses[place[j], :2], dim=-1)
    again = torch.zeros_like(place, dtype=torch.bool)
    again[i[(apart < _SAME_PLACE) & (j < i)]] = True
    place = place[~again]
    return place[rank_in_group(frame[place], frames) < _MOST_PLACES]


def cut_outs(frames: Tensor, frame: Tensor, center: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Square cut-outs of frames reduced by ``factor``: (P, 64, 64) float32, and their corners (P, 2) int64 in full px.

    Args:
        frames: (B, H, W), at least 64 ``factor`` px on each side. frame: (P,) int64. center: (P, 2), full px.
    """
    height, width = frames.shape[-2:]
    side = SIDE * factor
    limit = torch.tensor([width - side, height - side], device=frames.device)
    corner = (center - side / 2).round().long().clamp_min(0).minimum(limit)
    along = torch.arange(side, device=frames.device)
    first = (frame * height + corner[:, 1]) * width + corner[:, 0]
    cell = first[:, None, None] + along[:, None] * width + along
    return area_reduce(frames.reshape(-1)[cell], factor), corner
