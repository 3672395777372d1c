"""The methods of `PoseEstimator`: how each locates centres, and the steps that it takes once there are solutions."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose.pose import CENTER_RMS, Evidence, Solutions, center_rms, common_center, compensate
from torchpose.refine.centers import refine_centers
from torchpose.refine.decide import decide, decide_on_grey
from torchpose.refine.edges.fit import refine_edges
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.sight import LEAST_KEPT, Refined, Sight

# of the pixels, where the pose stays near: of wires over half of every ring 0.27 (measured: `wires 3` of
# `scripts/corruption_statistics.py`)
_LEAST_KEPT_NEAR = 0.2

Step = Callable[[Solutions, Evidence, Sight], Solutions]
"""From solutions of N rows, what was measured of them, and the rows in their frames, to better solutions."""


@dataclass(frozen=True)
class Recipe:
    """What a method does.

    Attributes:
        correct: free the edges from what blur and curvature do to them.
        locate: centre of a ring from its two ellipses, as `pose.common_center`.
        steps: after the solution from the centres, one after the other.
        on_rims: the poses are fitted to the edges of the rings in the end, not to their centres.
    """

    correct: bool = True
    locate: Callable[..., tuple[Tensor, Tensor]] = common_center
    steps: tuple[Step, ...] = ()
    on_rims: bool = False


def on_frames(refine: Callable[[Sight, Tensor, Tensor], Refined]) -> Step:
    """The step that refines every pose on the frames themselves, where that holds."""

    def step(solutions: Solutions, evidence: Evidence, sight: Sight) -> Solutions:
        index = solutions.solved.nonzero()[:, 0]
        rows = solutions[index]
        refined = refine(replace(sight[index], mask=rows.mask), rows.R, rows.t)
        rms = center_rms(replace(evidence[index], mask=rows.mask), refined.R, refined.t)
        better = replace(rows, R=refined.R, t=refined.t, covariance=refined.covariance, rms=rms)
        near = rms < torch.maximum(rows.rms, torch.full_like(rows.rms, CENTER_RMS))
        good = refined.good & ((refined.kept > LEAST_KEPT) | (near & (refined.kept > _LEAST_KEPT_NEAR)))
        return solutions.replaced(index[good], better[good])

    return step


def on_centers(solutions: Solutions, evidence: Evidence, sight: Sight) -> Solutions:
    """Refines every pose on the ellipses' own centres, where that holds."""
    seen = replace(evidence, mask=solutions.mask)
    refined = refine_centers(seen, solutions.R, solutions.t)
    rms = center_rms(seen, refined.R, refined.t)
    better = replace(solutions, R=refined.R, t=refined.t, covariance=refined.covariance, rms=rms)
    return better.where(refined.good & solutions.solved, solutions)


METHODS = {
    "photometric": Recipe(steps=(decide, decide_on_grey, on_frames(refine_photometric)), on_rims=True),
    "edges": Recipe(steps=(decide, on_frames(refine_edges)), on_rims=True),
    "centers": Recipe(steps=(decide, on_centers)),
    "paper": Recipe(correct=False, locate=compensate),
}
"""By name, as `PoseEstimator` and the command line take it."""
