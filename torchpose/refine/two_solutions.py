"""Which of two solutions: by the centres of the ellipses, where compensated centres leave it open.

A compensated centre extrapolates from both circles, so it is several times less certain than the ellipses' own centres.
Two poses that compensated centres cannot tell apart may differ by many deviations of these.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchpose.pose import AMBIGUOUS_CHI2, Evidence, Solutions, center_rms, shape_chi2
from torchpose.refine.centers import refine_centers
from torchpose.results import Reason, Status

_FLOOR = 0.03  # px, of a centre: what blur, covers and clutter do to it beyond its covariance
_MOST_CHI2 = 5.0  # per degree of freedom, above which the better pose does not explain the centres itself


def decide(s: Solutions, e: Evidence) -> Solutions:
    """Solutions whose ambiguous rows are `Status.OK` where the ellipses' centres and shapes tell which pose is right.

    Args:
        s: N rows. e: their evidence.
    """
    row = (s.status == Status.AMBIGUOUS).nonzero()[:, 0]
    if row.numel() == 0:
        return s
    some = replace(e[row], mask=s.mask[row])
    floor = torch.diag(torch.tensor([_FLOOR**2] * 2 + [0.0] * 3, dtype=s.t.dtype, device=s.t.device))
    wide = replace(some, shape_covariance=some.shape_covariance + floor)
    both = [refine_centers(wide, r[row], t[row]) for r, t in ((s.R, s.t), (s.R_alt, s.t_alt))]
    r, t, covariance = (torch.stack([getattr(v, n) for v in both], 1) for n in ("R", "t", "covariance"))
    of_centers = torch.stack([v.chi2 for v in both], 1).nan_to_num(nan=torch.inf)
    chi2, best = (of_centers + shape_chi2(some, r, t)).nan_to_num(nan=torch.inf).sort(1)
    good, freedom = torch.stack([v.good for v in both], 1), 4 * some.mask.sum(-1) - 6
    first = best[:, :1]
    explained = (good & (of_centers < _MOST_CHI2 * freedom[:, None])).gather(1, first)[:, 0]
    sure = (explained & (chi2[:, 1] - chi2[:, 0] > AMBIGUOUS_CHI2)).nonzero()[:, 0]
    one, two = best[sure].unbind(1)
    values = {
        "R": r[sure, one],
        "t": t[sure, one],
        "covariance": covariance[sure, one],
        "rms": center_rms(some[sure], r[sure, one], t[sure, one]),
        "chi2": chi2[sure, 0],
        "R_alt": r[sure, two],
        "t_alt": t[sure, two],
        "rms_alt": center_rms(some[sure], r[sure, two], t[sure, two]),
        "chi2_alt": chi2[sure, 1],
        "status": torch.full_like(sure, int(Status.OK)),
        "reason": torch.full_like(sure, int(Reason.NONE)),
    }
    every = {name: getattr(s, name).index_copy(0, row[sure], value) for name, value in values.items()}
    return replace(s, **every)
