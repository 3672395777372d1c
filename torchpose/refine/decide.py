"""Which of two solutions, where compensated centres leave it open: by the centres of the ellipses, then by grey values.

A compensated centre extrapolates from both circles, so it is several times less certain than the ellipses' own centres.
Two poses that compensated centres cannot tell apart may differ by many deviations of these. Small rings leave even them
open, but not the grey values around their edges.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.pose import AMBIGUOUS_CHI2, Evidence, Solutions, center_rms, shape_chi2
from torchpose.refine.centers import refine_centers
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.photometric.grey_chi2 import grey_chi2
from torchpose.refine.photometric.ring_model import Sight
from torchpose.results import Reason, Status

_FLOOR = 0.03  # px, of a centre: what blur, covers and clutter do to it beyond its covariance
_LEAST_KEPT = 0.5  # of the pixels around the edges that must follow the model for grey values to decide
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


def decide_on_grey(
    s: Solutions, e: Evidence, frames: Tensor, camera: Camera, frame: Tensor, rings: Tensor
) -> Solutions:
    """Solutions whose ambiguous rows are `Status.OK` where the grey values tell which pose is right.

    Both are refined. If they meet, there was one minimum; else the one that explains the grey values better wins. Rows
    that were rejected for the shapes of their rings, which blur, glare and covers bend, are `Status.OK` if beyond that
    the grey values of most of the edges of every marker agree with the pose.

    Args:
        s: N rows. e: their evidence. frames: (B, H, W) grey. frame: (N,) int64. rings: (N, M, 2, 5) ellipses, raw px.
    """
    shape = (s.status == Status.REJECTED) & (s.reason == Reason.RING_SHAPE)
    row = ((s.status == Status.AMBIGUOUS) | shape).nonzero()[:, 0]
    if row.numel() == 0:
        return s
    mask = s.mask[row]
    alone = s.R_alt[row].isnan().any(-1).any(-1)  # no second minimum
    r_alt = torch.where(alone[:, None, None], s.R[row], s.R_alt[row])
    t_alt = torch.where(alone[:, None], s.t[row], s.t_alt[row])
    start, model = (frames, camera, frame[row]), (mask, rings[row], e.points[row], e.normals[row], e.radii[row])
    one, two = (refine_photometric(*start, r, t, *model) for r, t in ((s.R[row], s.t[row]), (r_alt, t_alt)))
    chi2, explained = grey_chi2(Sight(*start, *model), one, two)
    swap = (chi2 < 0)[:, None]
    turn = rotations.log(two.R @ one.R.mT)
    apart = torch.cat([two.t - one.t, turn], -1)[..., None]
    covariance = torch.where(
        (one.good & two.good)[:, None, None], one.covariance + two.covariance, torch.eye(6).to(apart)
    )
    meet = (apart.mT @ torch.linalg.solve(covariance, apart))[:, 0, 0] < AMBIGUOUS_CHI2
    sound = one.good & two.good & (torch.where(swap[:, 0], two.kept, one.kept) > _LEAST_KEPT)
    sure = sound & (meet | (chi2.abs() > AMBIGUOUS_CHI2))
    sure &= ~shape[row] | torch.where(swap[:, 0], explained[:, 1], explained[:, 0])
    values = {
        "R": torch.where(swap[..., None], s.R_alt[row], s.R[row]),
        "t": torch.where(swap, s.t_alt[row], s.t[row]),
        "R_alt": torch.where(swap[..., None], s.R[row], s.R_alt[row]),
        "t_alt": torch.where(swap, s.t[row], s.t_alt[row]),
        "status": torch.full_like(row, int(Status.OK)),
        "reason": torch.full_like(row, int(Reason.NONE)),
    }
    for name in ("rms", "chi2"):
        both = getattr(s, name)[row], getattr(s, name + "_alt")[row]
        values[name], values[name + "_alt"] = torch.where(swap[:, 0], both[1], both[0]), torch.where(swap[:, 0], *both)
    some = row[sure]
    return replace(s, **{name: getattr(s, name).index_copy(0, some, value[sure]) for name, value in values.items()})
