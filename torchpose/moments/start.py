"""Where the joint fit of a moment begins: the pose that most markers of most cameras agree on, by their centres.

Every camera that has a pose proposes it; one that sees two rings proposes the rough pose that they have. Where no
camera proposes anything, rays alone do (`torchpose.pnp.several`). Each proposal is fitted to the markers near it.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.rows import Rows
from torchpose.identify import MIN_MARKERS
from torchpose.identify.hypotheses import PLACE_TOLERANCE
from torchpose.moments.views import Moments, View
from torchpose.pnp import PnPCode
from torchpose.pnp.several import Rays, solve_rays
from torchpose.pnp.several.starts import APART_DEG, starts
from torchpose.pose import AMBIGUOUS_CHI2, Evidence, shape_chi2
from torchpose.pose.evidence import visible
from torchpose.results import Status

_STEPS = 30  # of the fit to the centres, at most


@dataclass(frozen=True, eq=False)
class Start(Rows):
    """J rows with a pose in the first camera.

    Attributes:
        R, t: the best pose by the centres; NaN where there is none.
        R_alt, t_alt: another one that explains as many markers.
        chi2, chi2_alt: of centres and shapes.
        mask: markers of the views that agree with it.
        against: views whose own pose it contradicts.
    """

    R: Float[Tensor, "J 3 3"]
    t: Float[Tensor, "J 3"]
    R_alt: Float[Tensor, "J 3 3"]
    t_alt: Float[Tensor, "J 3"]
    chi2: Float[Tensor, " J"]
    chi2_alt: Float[Tensor, " J"]
    mask: Bool[Tensor, "J V M"]
    against: Bool[Tensor, "J V"]

    @property
    def known(self) -> Tensor:
        """(J,) bool, rows with a pose."""
        return self.R.isfinite().flatten(1).all(1)


def begin(moments: Moments, rows: Tensor, more: tuple[Tensor, Tensor] | None = None) -> Start:
    """Poses of some rows (J,).

    Args:
        moments: what all cameras have.
        rows: of these.
        more: R (J, 3, 3), t (J, 3), one more proposal each.
    """
    views = moments.views
    evidence = [view.evidence(rows) for view in views]
    R, t = (torch.cat(parts, 1) for parts in zip(*(_proposals(moments, view, rows) for view in views), strict=True))
    if more is not None:
        R, t = torch.cat([more[0][:, None], R], 1), torch.cat([more[1][:, None], t], 1)
    rays = _rays(moments, evidence)
    alone = (~R.isfinite().flatten(2).all(2).any(1)).nonzero()[:, 0]
    if alone.numel():
        R, t = (_with_more(x, alone, y) for x, y in zip((R, t), starts(rays[alone]), strict=True))
    some = R.isfinite().flatten(2).all(2).any(0)
    R, t = R[:, some], t[:, some]
    near = _near(moments, evidence, R, t, 1.0)
    R, t, centers = _fitted(rays, R, t, near)
    near = _near(moments, evidence, R, t, 0.5)  # half of it: a pose is known, not guessed
    return _best(moments, evidence, (R, t), near, centers, _sure(moments, rows))


def _with_more(poses: Tensor, rows: Tensor, more: Tensor) -> Tensor:
    """Poses (J, S, ...) with those (K, S', ...) of some rows (K,) behind them."""
    added = poses.new_full((len(poses), *more.shape[1:]), torch.nan).index_copy(0, rows, more)
    return torch.cat([poses, added], 1)


def _proposals(moments: Moments, view: View, rows: Tensor) -> tuple[Tensor, Tensor]:
    """R (J, 2, 3, 3), t (J, 2, 3) in the first camera, of which a view proposes: its solutions, or its rough pose."""
    own, place = view.row[rows], view.place(rows)
    solutions, identified = view.found.solutions, view.found.identified
    R = identified.R[own.clamp_min(0)]
    t = identified.t[own.clamp_min(0)]
    R, t = (torch.stack([x, torch.full_like(x, torch.nan)], 1) for x in (R, t))
    if len(solutions):
        at = place.clamp_min(0)
        solved = (place >= 0) & solutions.solved[at]
        R = torch.where(solved[:, None, None, None], torch.stack([solutions.R, solutions.R_alt], 1)[at], R)
        t = torch.where(solved[:, None, None], torch.stack([solutions.t, solutions.t_alt], 1)[at], t)
    missing = own < 0
    R, t = R.masked_fill(missing[:, None, None, None], torch.nan), t.masked_fill(missing[:, None, None], torch.nan)
    return moments.rig.from_camera(view.camera, R, t)


def _sure(moments: Moments, rows: Tensor) -> Tensor:
    """(J, V) bool, views that have a pose of their own which nothing speaks against."""
    each = []
    for view in moments.views:
        place = view.place(rows)
        status = view.found.solutions.status
        each.append((place >= 0) & (status[place.clamp_min(0)] == Status.OK) if len(status) else place >= 0)
    return torch.stack(each, 1)


def _rays(moments: Moments, evidence: list[Evidence]) -> Rays:
    """The compensated centres of all views (J, V M)."""
    rig, parts = moments.rig, []
    factor = rig.factor()
    for view, some in zip(moments.views, evidence, strict=True):
        focal, principal = some.matrix.diagonal()[:2], some.matrix[:2, 2]
        root = torch.linalg.cholesky(torch.linalg.inv(visible(some.covariance + some.placed, some.mask))).mT
        seen = some.mask[..., None]
        each = (rig.R[view.camera], rig.t[view.camera], factor[view.camera])
        turn, shift, place = (x.to(some.points).expand(*some.mask.shape, *x.shape) for x in each)
        xy = torch.where(seen, (some.center - principal) / focal, 0.0)
        none = some.points.new_zeros(*some.mask.shape, 2, 0)
        parts.append(Rays(some.points, xy, root * focal * seen[..., None], turn, shift, place, none, some.mask))
    joined = {name: torch.cat([getattr(part, name) for part in parts], 1) for name in vars(parts[0])}
    return replace(parts[0], **joined)


def _near(moments: Moments, evidence: list[Evidence], R: Tensor, t: Tensor, share: float) -> Tensor:
    """(J, S, V, M) bool, markers that lie within a share of the tolerance of where S poses put them."""
    px, of_size, _ = PLACE_TOLERANCE
    each = []
    for view, some in zip(moments.views, evidence, strict=True):
        turn, shift = moments.in_view(view, R, t)
        x = (turn[:, :, None] @ some.points[:, None, ..., None])[..., 0] + shift[:, :, None]
        at = (x @ some.matrix.T)[..., :2] / x[..., 2:]
        miss = torch.linalg.vector_norm(at - some.center[:, None], dim=-1)
        reach = share * (px + of_size * some.shape[:, None, :, 0, 2])
        each.append((miss < reach) & (x[..., 2] > 0) & some.mask[:, None])
    return torch.stack(each, 2)


def _enough(near: Tensor) -> Tensor:
    """Poses (...,) bool that explain enough different markers, of views and markers (..., V, M)."""
    return near.any(-2).sum(-1) >= MIN_MARKERS


def _fitted(rays: Rays, R: Tensor, t: Tensor, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """S poses fitted to the markers near each, or to all where there are too few of them, and their chi-squared."""
    rows, several = t.shape[:2]
    every = rays[torch.arange(rows, device=t.device).repeat_interleave(several)]
    seen = torch.where(_enough(near)[..., None], near.flatten(2), rays.seen[:, None]).flatten(0, 1)
    some = replace(every, seen=seen, root=every.root * seen[..., None, None])
    there = R.isfinite().flatten(2).all(2).flatten()
    R, t = (torch.where(there.view(-1, *[1] * (x.ndim - 1)), x, torch.nan) for x in (R.flatten(0, 1), t.flatten(0, 1)))
    found = solve_rays(some, (R[:, None], t[:, None]), _STEPS)
    good = (found.code <= PnPCode.AMBIGUOUS) & there
    R, t, chi2 = (torch.where(good.view(-1, *[1] * (x.ndim - 1)), x, torch.nan) for x in (found.R, found.t, found.chi2))
    return R.unflatten(0, (rows, several)), t.unflatten(0, (rows, several)), chi2.unflatten(0, (rows, several))


def _best(
    moments: Moments,
    evidence: list[Evidence],
    poses: tuple[Tensor, Tensor],
    near: Tensor,
    chi2: Tensor,
    sure: Tensor,
) -> Start:
    """Of S poses (J, S, ...) that which explains most markers, by centres and shapes best."""
    R, t = poses
    support = near.flatten(2).sum(-1)
    good = R.isfinite().flatten(2).all(2) & _enough(near) & chi2.isfinite()
    row = torch.arange(len(good), device=good.device)
    best, other = _ranked(R, chi2, support, good)
    if bool(other.any()):
        chi2 = chi2 + _of_shapes(moments, evidence, R, t, near)
        good &= chi2.isfinite()
        best, other = _ranked(R, chi2, support, good)
    known = good.any(1)
    second = torch.where(other, chi2, torch.inf).argmin(1)
    has = other.any(1)

    def taken(values: Tensor, index: Tensor, kept: Tensor) -> Tensor:
        return torch.where(kept.view(-1, *[1] * (values.ndim - 2)), values[row, index], torch.nan)

    mask = near[row, best] & known[:, None, None]
    against = sure & (mask.sum(-1) < MIN_MARKERS) & known[:, None]
    return Start(
        taken(R, best, known),
        taken(t, best, known),
        taken(R, second, has),
        taken(t, second, has),
        taken(chi2, best, known),
        taken(chi2, second, has),
        mask,
        against,
    )


def _ranked(R: Tensor, chi2: Tensor, support: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
    """The best of S poses (J,), and which others (J, S) bool are of as many markers."""
    # of as many markers the one with less chi-squared
    score = torch.where(good, support + 1 / (2 + chi2.nan_to_num(nan=torch.inf)), -1.0)
    best = score.argmax(1, keepdim=True)
    turn = rotations.angle_between(R, R.gather(1, best[..., None, None].expand(-1, -1, 3, 3)))
    return best[:, 0], good & (support == support.gather(1, best)) & (turn > math.radians(APART_DEG))


def _of_shapes(moments: Moments, evidence: list[Evidence], R: Tensor, t: Tensor, near: Tensor) -> Tensor:
    """Chi-squared (J, S) of the shapes of the rings in the cameras that poses explain anything of."""
    chi2 = torch.zeros_like(t[..., 0])
    for k, (view, some) in enumerate(zip(moments.views, evidence, strict=True)):
        turn, shift = moments.in_view(view, R, t)
        there = torch.where(turn.isfinite(), turn, 0.0), torch.where(shift.isfinite(), shift, 1.0)
        chi2 = chi2 + torch.where(near[:, :, k].any(-1), shape_chi2(some, *there), 0.0)
    return chi2


def ambiguous(start: Start) -> Tensor:
    """Rows (J,) bool of which another pose explains centres and shapes about as well."""
    return start.chi2_alt - start.chi2 < AMBIGUOUS_CHI2
