"""An edge is explained once: ellipses put together from the edges of better ones are none.

The exclusion principle of a-contrario detection (Desolneux, Moisan and Morel 2008): what is seen belongs to its best
interpretation, the one with the fewest false alarms, and the others are judged by what is left. Two circles side by
side have arcs that a third ellipse joins, too long to be an accident, and yet it is none.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.detect.regions import Gradient
from torchpose.detect.validation import LEAST_COVER, WHOLE, Candidates, Samples, Verdict, false_alarms, sample_edges
from torchpose.geometry import conics
from torchpose.geometry.segments import pairs_in_group, ragged_arange

_NEAR = 1.5  # cells between an edge and the ellipse that explains it
_COS = 0.8  # of the edge's gradient with the normal of that ellipse: 37 degrees
_ROUNDS = 4


def explain_once(grad: Gradient, found: Candidates, known: Candidates | None = None) -> Candidates:
    """The same candidates; those of which too little remains without the edges of better ones become `EXPLAINED`.

    Ellipses that are seen whole stay as they are.

    Args:
        found: in cells. known: accepted ellipses of a finer scale, in the same cells.
    """
    part = ((found.verdict == Verdict.ACCEPTED) & (found.cover <= WHOLE)).nonzero()[:, 0]
    if part.numel() == 0:
        return found
    weak, every = found[part], found if known is None else Candidates.cat([found, known])
    samples = sample_edges(grad, weak.frame, weak.ellipse, weak.polarity)
    sample, other = _explained(samples, weak, every)
    # who explains must be kept itself: the rounds close in, from below and above, on the choice made one by one in the
    # order of false alarms
    kept = torch.ones(len(every), dtype=torch.bool, device=part.device)
    for _ in range(_ROUNDS):
        free = torch.ones_like(samples.of, dtype=torch.bool)
        free[sample[kept[other]]] = False
        nfa, cover = false_alarms(grad, samples.error[free], samples.of[free], part.numel())
        kept[part] = (nfa < 0) & (cover >= LEAST_COVER)
    lost = ~kept[: len(found)]
    return replace(found, verdict=torch.where(lost, int(Verdict.EXPLAINED), found.verdict))


def _explained(samples: Samples, weak: Candidates, every: Candidates) -> tuple[Tensor, Tensor]:
    """Which of the samples of ``weak`` (Q,) lie on the edges of which better ones of ``every`` (Q,)."""
    best = (every.verdict == Verdict.ACCEPTED).nonzero()[:, 0]
    best = best[torch.argsort(every.frame[best], stable=True)]
    i, j = pairs_in_group(weak.frame, every.frame[best])
    j = best[j]
    apart = torch.linalg.vector_norm(weak.ellipse[i, :2] - every.ellipse[j, :2], dim=-1)
    meet = (every.log10_nfa[j] < weak.log10_nfa[i]) & (apart < weak.ellipse[i, 2] + every.ellipse[j, 2] + _NEAR)
    i, j = i[meet], j[meet]
    size = torch.bincount(samples.of, minlength=len(weak))
    start = size.cumsum(0) - size
    pair, offset = ragged_arange(size[i])
    sample, other = start[i[pair]] + offset, j[pair]
    off, normal = conics.signed_distance(every.ellipse[other], samples.xy[sample])
    gradient = samples.gradient[sample]
    rise = (gradient * normal).sum(-1) * every.polarity[other]
    on = (off.abs() < _NEAR) & (rise > _COS * torch.linalg.vector_norm(gradient, dim=-1))
    return sample[on], other[on]
