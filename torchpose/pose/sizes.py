"""Whether the rings are as large as their distances say: what no edge gain changes.

A gain moves the outer and the inner edge of a ring apart or together, so that the sum of its radii stays. Markers taken
for their neighbours in code have another sum. The distances between the markers, by the pose, tell the sum in mm.
"""

import torch
from torch import Tensor

from torchpose.pose.evidence import Evidence, predicted_circles
from torchpose.target import MIN_RATIO_GAP

# px, of a radius, and times the blur: measured ones of clutter_statistics.py --seed 54 err by less
_SIZE_ERROR = 0.1


def code_shift(evidence: Evidence, predicted: Tensor) -> Tensor:
    """By how many codes (N,) at least the sums of the rings' radii differ from those of their markers, in the mean.

    Args:
        evidence: N rows.
        predicted: (N, M, 2, 5), circles of every marker under a pose that the centres tell, ideal px.
    """
    outer, inner = evidence.radii.unbind(-1)
    difference = _grown(evidence, predicted) / outer[..., None]
    error = 2 * _SIZE_ERROR * evidence.blur.sqrt().clamp_min(1.0) / evidence.shape[..., 0, 3]
    seen, each = evidence.mask[..., None], torch.cat([difference, error[..., None]], -1)
    one, two, error = (torch.where(seen, each, 0.0).sum(1) / seen.sum(1)).unbind(-1)
    # blur that bends the shapes draws one axis alone
    both = torch.where(one * two > 0, torch.minimum(one.abs(), two.abs()), 0.0)
    return (both - error).clamp_min(0) / _code_gap(inner / outer)


def size_beyond(evidence: Evidence, R: Tensor, t: Tensor) -> Tensor:
    """How far both edges of the rings (N,) lie further from their centres than their radii, mm, where it is certain."""
    grown = _grown(evidence, predicted_circles(evidence, R[:, None], t[:, None])[:, 0]).mean(-1)
    px = R.new_tensor(_SIZE_ERROR) * evidence.blur.sqrt().clamp_min(1.0)
    error = 2 * px * evidence.radii[..., 0] / evidence.shape[..., 0, 3]
    seen = evidence.mask
    grown, error = (torch.where(seen, each, 0.0).sum(1) / seen.sum(1) for each in (grown, error))
    return torch.where(grown.abs() > error, 0.5 * grown, 0.0)


def _grown(evidence: Evidence, predicted: Tensor) -> Tensor:
    """How much larger the sum of the radii of rings (N, M, 2) is along both axes than ``predicted``, mm."""
    return (evidence.radii[..., None] * (evidence.shape[..., 2:4] / predicted[..., 2:4] - 1)).sum(-2)


def _code_gap(ratio: Tensor) -> Tensor:
    """Least difference (N,) between ratios (N, M) of radii; padded ones are 1."""
    apart = (ratio[:, :, None] - ratio[:, None]).abs()
    both = (ratio < 1)[:, :, None] & (ratio < 1)[:, None] & (apart > 0.5 * MIN_RATIO_GAP)
    return torch.where(both, apart, torch.inf).flatten(1).amin(1)
