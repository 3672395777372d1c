"""A second, finer look at small places where something round may be, each cut out as a small frame of its own."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.detect.reduce import area_reduce
from torchpose.detect.regions import BESIDE, MOST_A_FRAME
from torchpose.geometry.segments import marked, near_pairs, positions, rank_in_group

SIDE = 64  # px of a cut-out (convention: docs/decisions/0051)
MIN_SEMI_MINOR = 2.0  # px of any scale: the least that the gradient's two pixels leave a hole in (convention)
MIN_ASPECT = 0.12  # of an ellipse: a tilt of 83 degrees (convention)
_LARGEST = SIDE / 8  # reduced px of semi-major axis: what a cut-out holds wherever in it (derived)


def promising_places(
    frame: Int[Tensor, " M"], ellipses: Float[Tensor, "M 5"], whole: Bool[Tensor, " M"]
) -> Int[Tensor, " P"]:
    """Indices of the small ellipses, of whatever verdict, worth a finer look; ellipses are sorted by frame.

    Those within one that was seen whole are not, nor those beside a larger one of the same place.
    """
    a, b = ellipses[:, 2], ellipses[:, 3]
    place = positions((a < _LARGEST) & (b > 0.5 * MIN_SEMI_MINOR) & (b > MIN_ASPECT * a) & ~whole)
    place = place[torch.argsort(a[place], descending=True, stable=True)]
    place = place[torch.argsort(frame[place], stable=True)]
    known = positions(whole)
    center = ellipses[:, :2]
    j, i = near_pairs(center[known], center[place], 0.5 * b[known], (frame[known], frame[place]))
    apart = torch.linalg.vector_norm(ellipses[place[i], :2] - ellipses[known[j], :2], dim=-1)
    place = place[~marked(i[apart < 0.5 * b[known[j]]], len(place))]
    near = torch.full_like(b[place], BESIDE)
    i, j = near_pairs(center[place], center[place], near, (frame[place], frame[place]))
    apart = torch.linalg.vector_norm(center[place[i]] - center[place[j]], dim=-1)
    place = place[~marked(i[(j < i) & (apart < BESIDE)], len(place))]
    return place[rank_in_group(frame[place]) < MOST_A_FRAME]


def cut_outs(frames: Tensor, frame: Tensor, center: Tensor, factor: int) -> tuple[Tensor, Tensor]:
    """Square cut-outs about centres (P, 2), in full px, of frames of at least 64 ``factor`` px on each side.

    Returns:
        (P, 64, 64), reduced by ``factor``, and their corners (P, 2) int64 in full px.
    """
    height, width = frames.shape[-2:]
    side = SIDE * factor
    limit = torch.tensor([width - side, height - side], device=frames.device)
    corner = (center - side / 2).round().long().clamp_min(0).minimum(limit)
    along = torch.arange(side, device=frames.device)
    first = (frame * height + corner[:, 1]) * width + corner[:, 0]
    cell = first[:, None, None] + along[:, None] * width + along
    return area_reduce(frames.reshape(-1)[cell], factor), corner
