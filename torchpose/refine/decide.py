"""Which of two solutions, where compensated centres leave it open: by the centres of the ellipses, then by grey values.

A compensated centre extrapolates from both circles, so it is several times less certain than the ellipses' own centres.
Two poses that compensated centres cannot tell apart may differ by many deviations of these. Small rings leave even them
open, but not the grey values around their edges.
"""

import torch
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.arguments import checked
from torchpose.geometry.robust import of_chance
from torchpose.geometry.rows import replace
from torchpose.pose import AMBIGUOUS_CHI2, SHAPE_FLOOR, Evidence, Solutions, center_rms, pose_covariance, shape_chi2
from torchpose.refine.centers import refine_centers
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.photometric.grey_chi2 import grey_chi2
from torchpose.refine.sight import LEAST_KEPT, Refined, Sight
from torchpose.results import Reason, Status


@checked
def decide(solutions: Solutions, evidence: Evidence, sight: Sight | None = None) -> Solutions:
    """Solutions whose ambiguous rows are `Status.OK` where the ellipses' centres and shapes tell which pose is right.

    Args:
        solutions: N rows.
        evidence: of these.
        sight: the same rows in their frames; not needed for this.
    """
    row = (solutions.status == Status.AMBIGUOUS).nonzero()[:, 0]
    if row.numel() == 0:
        return solutions
    open_ones = solutions[row]
    some = replace(evidence[row], mask=open_ones.mask)
    floor = torch.diag(torch.tensor([SHAPE_FLOOR[0] ** 2] * 2 + [0.0] * 3, dtype=some.shape.dtype, device=row.device))
    placed = torch.nn.functional.pad(some.placed, (0, 3, 0, 3))[:, :, None]
    wide = replace(some, shape_covariance=some.shape_covariance + placed + floor)
    both = [refine_centers(wide, R, t) for R, t in _both(open_ones)]
    R, t, covariance, of_centers, good = (
        torch.stack([getattr(one, name) for one in both], 1) for name in ("R", "t", "covariance", "chi2", "good")
    )
    of_centers = of_centers.nan_to_num(nan=torch.inf)
    chi2, best = (of_centers + shape_chi2(some, R, t)).nan_to_num(nan=torch.inf).sort(1)
    at = torch.arange(len(row), device=row.device)[:, None]
    R, t, covariance, of_centers, good = (x[at, best] for x in (R, t, covariance, of_centers, good))
    freedom = 4 * some.mask.sum(-1) - 6
    explained = good[:, 0] & (of_centers[:, 0] < freedom * of_chance(freedom))
    sure = explained & (chi2[:, 1] - chi2[:, 0] > AMBIGUOUS_CHI2)
    rms = [center_rms(some, R[:, k], t[:, k]) for k in range(2)]
    first = {
        "R": R[:, 0],
        "t": t[:, 0],
        "rms": rms[0],
        "chi2": chi2[:, 0],
        "covariance": covariance[:, 0],
        "noise": covariance[:, 0],
    }
    second = {"R_alt": R[:, 1], "t_alt": t[:, 1], "rms_alt": rms[1], "chi2_alt": chi2[:, 1]}
    decided = replace(open_ones, **first, **second).marked(sure, Status.OK, Reason.NONE)
    return solutions.replaced(row[sure], decided[sure])


@checked
def decide_on_grey(solutions: Solutions, evidence: Evidence, sight: Sight) -> Solutions:
    """Solutions whose ambiguous rows are `Status.OK` where the grey values tell which pose is right.

    Both are refined. If they meet, there was one minimum; else the one that explains the grey values better wins. Rows
    that were rejected for the shapes of their rings, which blur, glare and covers bend, are `Status.OK` if beyond that
    the grey values of most of the edges of every marker agree with the pose. Rows whose centres and shapes leave the
    other pose close behind are turned where the grey values say so.

    Args:
        solutions: N rows.
        evidence: of these.
        sight: the same rows in their frames.
    """
    shape = (solutions.status == Status.REJECTED) & (solutions.reason == Reason.RING_SHAPE)
    # ten times what leaves it open: small blurred rings were seen to be wrong by 37
    close = (solutions.status == Status.OK) & (solutions.chi2_alt - solutions.chi2 < 10 * AMBIGUOUS_CHI2)
    row = ((solutions.status == Status.AMBIGUOUS) | shape | close).nonzero()[:, 0]
    if row.numel() == 0:
        return solutions
    open_ones, shape, close = solutions[row], shape[row], close[row]
    sight = replace(sight[row], mask=open_ones.mask)
    one, two = (refine_photometric(sight, R, t) for R, t in _both(open_ones))
    chi2, there, explained = grey_chi2(sight, one, two)
    swap = chi2 < 0
    better = two.where(swap, one)
    # whatever becomes of the other's fit, this one must show every ring
    shows = torch.where(shape[:, None], explained, there)
    shows = torch.where(swap, shows[:, 1], shows[:, 0])
    told = shape | (one.good & two.good & _meet(one, two)) | (chi2.abs() > AMBIGUOUS_CHI2)
    sure = better.good & (better.kept > LEAST_KEPT) & shows & told & (swap | ~close)
    decided = open_ones.swapped(swap).marked(sure, Status.OK, Reason.NONE)
    # the covariance is that of the pose which it stands beside
    own = pose_covariance(replace(evidence[row], mask=open_ones.mask), decided.R, decided.t)[0]
    own = torch.where(swap[:, None, None], own, decided.covariance)
    decided = replace(decided, covariance=own, noise=own)
    return solutions.replaced(row[sure], decided[sure])


def _both(solutions: Solutions) -> list[tuple[Tensor, Tensor]]:
    """Both minima; where there is no second, the first again."""
    alone = solutions.R_alt.isnan().any(-1).any(-1)
    R_alt = torch.where(alone[:, None, None], solutions.R, solutions.R_alt)
    return [(solutions.R, solutions.t), (R_alt, torch.where(alone[:, None], solutions.t, solutions.t_alt))]


def _meet(one: Refined, two: Refined) -> Tensor:
    """Rows (N,) bool whose refined poses differ by no more than their covariances allow."""
    apart = torch.cat([two.t - one.t, rotations.log(two.R @ one.R.mT)], -1)[..., None]
    known = (one.good & two.good)[:, None, None]
    unit = torch.eye(6, dtype=apart.dtype, device=apart.device)
    covariance = torch.where(known, one.covariance + two.covariance, unit)
    return (apart.mT @ torch.linalg.solve(covariance, apart))[:, 0, 0] < AMBIGUOUS_CHI2
