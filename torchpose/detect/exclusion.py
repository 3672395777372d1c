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
from torchpose.geometry.segments import marked, members, pairs_in_group, positions

_NEAR = 1.5  # cells between an edge and the ellipse that explains it
_COS = 0.8  # of the edge's gradient with the normal of that ellipse: 37 degrees
_ROUNDS = 4


def explain_once(grad: Gradient, found: Candidates, known: Candidates | None = None) -> Candidates:
    """The same candidates; those of which too little remains without the edges of better ones become `EXPLAINED`.

    Ellipses that are seen whole stay as they are. All are in cells; ``known`` are accepted ellipses of a finer scale.
    """
    part = positions((found.verdict == Verdict.ACCEPTED) & (found.cover <= WHOLE))
    if part.numel() == 0:
        return found
    weak, every = found[part], found if known is None else Candidates.cat([found, known])
    samples = sample_edges(grad, weak.frame, weak.ellipse, weak.polarity)
    sample, other = _explained(samples, weak, every)
    # who explains must be kept itself: the rounds close in, from below and above, on the choice made one by one in the
    # order of false alarms
    kept = torch.ones(len(every), dtype=torch.bool, device=part.device)
    for _ in range(_ROUNDS):
        free = ~marked(sample[kept[other]], len(samples))
        nfa, cover = false_alarms(grad, samples.error[free], samples.of[free], part.numel())
        kept[part] = (nfa < 0) & (cover >= LEAST_COVER)
    return replace(found, verdict=torch.where(kept[: len(found)], found.verdict, int(Verdict.EXPLAINED)))


def _explained(samples: Samples, weak: Candidates, every: Candidates) -> tuple[Tensor, Tensor]:
    """Which of the samples of ``weak`` (Q,) lie on the edges of which better ones of ``every`` (Q,)."""
    best = positions(every.verdict == Verdict.ACCEPTED)
    best = best[torch.argsort(every.frame[best], stable=True)]
    i, j = pairs_in_group(weak.frame, every.frame[best])
    j = best[j]
    apart = torch.linalg.vector_norm(weak.ellipse[i, :2] - every.ellipse[j, :2], dim=-1)
    meet = (every.log10_nfa[j] < weak.log10_nfa[i]) & (apart < weak.ellipse[i, 2] + every.ellipse[j, 2] + _NEAR)
    i, j = i[meet], j[meet]
    pair, sample = members(torch.bincount(samples.of, minlength=len(weak)), i)
    other = j[pair]
    off, normal = conics.signed_distance(every.ellipse[other], samples.xy[sample])
    gradient = samples.gradient[sample]
    rise = (gradient * normal).sum(-1) * every.polarity[other]
    on = (off.abs() < _NEAR) & (rise > _COS * torch.linalg.vector_norm(gradient, dim=-1))
    return sample[on], other[on]
