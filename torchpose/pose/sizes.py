"""Whether the rings are as large as their distances say: what no edge gain changes.

A gain moves the outer and the inner edge of a ring apart or together, so that the sum of its radii stays. Markers taken
for their neighbours in code have another sum. The distances between the markers, by the pose, tell the sum in mm.
"""

import torch
from torch import Tensor

from torchpose.geometry.constants import either
from torchpose.pose.evidence import Evidence
from torchpose.target import MIN_RATIO_GAP

# px, of a radius, and times the blur: measured ones of clutter_statistics.py --seed 54 err by less
_SIZE_ERROR = 0.1


def sizes_beyond(evidence: Evidence, predicted: Tensor) -> tuple[Tensor, Tensor]:
    """By how many codes (N,) at least the sums of the rings' radii differ from those of their markers, in the mean, and
    how far (N,) all edges of most rings, or discs, lie further from their centres, mm, where it is certain.

    Args:
        evidence: N rows.
        predicted: (N, M, 2, 5), circles of every marker under a pose that the centres tell, ideal px.
    """
    outer, inner = evidence.radii.unbind(-1)
    there = evidence.radii > 0  # of a disc the inner edge is nowhere
    excess = evidence.shape[..., 2:4] / predicted[..., 2:4] - 1
    further = either(there[..., None], evidence.radii[..., None] * excess, 0.0)
    difference, edge = further.sum(-2), further.sum((-2, -1)) / (2 * there.sum(-1))
    error = 2 * _SIZE_ERROR * evidence.blur.sqrt().clamp_min(1.0) / evidence.shape[..., 0, 3]
    each = torch.cat([difference / outer[..., None], torch.stack([error, 0.5 * error * outer], -1)], -1)
    seen = evidence.mask[..., None]
    one, two, error, error_mm = (either(seen, each, 0.0).sum(1) / seen.sum(1)).unbind(-1)
    # blur that bends the shapes draws one axis alone
    both = either(one * two > 0, torch.minimum(one.abs(), two.abs()), 0.0)
    # one ring of another size is not all of them
    larger = torch.where(evidence.mask, edge, torch.nan).nanmedian(1).values
    beyond = either(larger.abs() > error_mm, larger, 0.0)
    return (both - error).clamp_min(0) / _code_gap(inner / outer), beyond


def _code_gap(ratio: Tensor) -> Tensor:
    """Least difference (N,) between ratios (N, M) of radii; padded ones are 1."""
    apart = (ratio[:, :, None] - ratio[:, None]).abs()
    both = (ratio < 1)[:, :, None] & (ratio < 1)[:, None] & (apart > 0.5 * MIN_RATIO_GAP)
    return either(both, apart, torch.inf).flatten(1).amin(1)
