"""Joint refinement of moments: every camera's pictures around the common pose, then one pose from all.

Each camera's grey values are fitted with a blur and levels of their own from where the common pose puts the markers;
what the fit tells of pose, blur and dot gain is summed up by its normal equations, and the pose is the one of all of
these together. Near the minimum that is the joint fit: the normal equations are those of all grey values, and the last
step is made by all cameras at once (docs/decisions/0101-several-cameras.md).

A camera that sees two markers or one fixes no pose by itself. There what all centres tell holds the fit, and is taken
out again: it is no part of what the camera tells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.robust import LEAST_KEPT
from torchpose.geometry.rows import Rows
from torchpose.identify import MIN_MARKERS
from torchpose.moments.joint import JointPose, Seen, joint_pose
from torchpose.moments.places import widened
from torchpose.moments.start import Start, ambiguous
from torchpose.moments.views import Moments, motion_in_view
from torchpose.pose import (
    AMBIGUOUS_CHI2,
    CENTER_RMS,
    PLACE,
    Evidence,
    MarkerNormals,
    Setting,
    center_normals,
    center_rms,
)
from torchpose.pose.systematic import POSE
from torchpose.refine import Refined, Sight, refine_centers
from torchpose.refine.methods import BESIDE, LEAST_KEPT_NEAR, ROUNDS, beyond
from torchpose.refine.photometric.grey_chi2 import grey_chi2
from torchpose.refine.sight import Look
from torchpose.results import Misfit, Reason, Status

Refine = Callable[..., Refined]


@dataclass(frozen=True, eq=False)
class Fused(Rows):
    """J rows with a pose from several cameras.

    Attributes:
        pose: of all cameras.
        status, reason: as in `results.Poses`.
        rms: of the compensated centres in all cameras, px.
        R_alt, t_alt: another pose that explains as many markers; NaN where there is none.
        chi2, chi2_alt: of centres and shapes.
        mask: markers of each view that count.
    """

    pose: JointPose
    status: Int[Tensor, " J"]
    reason: Int[Tensor, " J"]
    rms: Float[Tensor, " J"]
    R_alt: Float[Tensor, "J 3 3"]
    t_alt: Float[Tensor, "J 3"]
    chi2: Float[Tensor, " J"]
    chi2_alt: Float[Tensor, " J"]
    mask: Bool[Tensor, "J V M"]


class _Rows(NamedTuple):
    """J rows of a view: what was measured, and where, with the markers that count."""

    camera: int
    evidence: Evidence
    sight: Sight

    def of(self, index: Tensor) -> _Rows:
        return self._replace(evidence=self.evidence[index], sight=self.sight[index])


def refine_moments(moments: Moments, rows: Tensor, start: Start, refine: Refine | None) -> Fused:
    """Rows (J,) refined from a start; without ``refine`` on the centres of the ellipses alone."""
    views = [
        _Rows(view.camera, replace(view.evidence(rows), mask=start.mask[:, k]), view.sight(rows, start.mask[:, k]))
        for k, view in enumerate(moments.views)
    ]
    if refine is not None:
        start = _decided(moments, views, start, refine)
    begun, place = _begun(moments, views, start, _larger(moments, rows))
    pose = (
        _on_centers(moments, views, begun.R, begun.t)
        if refine is None
        else _on_frames(moments, views, begun, place, refine)
    )
    pose = widened(pose, pose.known & pose.explained & ~pose.torn & ~start.against.any(1))
    rms = _rms(moments, views, pose.R, pose.t)
    return _judged(moments, views, start, pose, rms)


def _larger(moments: Moments, rows: Tensor) -> Tensor:
    """How far both edges of the rings lie further out, mm, (J,), in the mean over the cameras that tell."""
    total, count = rows.new_zeros(len(rows), dtype=torch.float64), rows.new_zeros(len(rows))
    for view in moments.views:
        place, larger = view.place(rows), view.found.solutions.larger
        if len(larger):
            total = total + torch.where(place >= 0, larger[place.clamp_min(0)], 0.0)
            count = count + (place >= 0)
    return total / count.clamp_min(1)


class _Begun(NamedTuple):
    R: Tensor
    t: Tensor


def _begun(moments: Moments, views: list[_Rows], start: Start, larger: Tensor) -> tuple[_Begun, Tensor]:
    """Poses, and places (J, M, 5) of markers beside those of the file, by the ellipses."""
    nowhere = start.t.new_zeros(*start.mask.shape[::2], PLACE)
    there = torch.stack([view.evidence.mask.any(-1) for view in views])
    gains = torch.stack([-beyond(nowhere, view.evidence)[..., 3] for view in views])
    gain = (gains * there[..., None]).sum(0) / there.sum(0).clamp_min(1)[:, None]
    place = torch.cat([nowhere[..., :3], gain[..., None], larger[:, None, None].expand_as(nowhere[..., 4:])], -1)
    begun = _Begun(start.R, start.t)
    off = (_rms(moments, views, *begun) > BESIDE).nonzero()[:, 0]
    if off.numel() == 0:
        return begun, place
    found = _on_centers(moments, [view.of(off) for view in views], start.R[off], start.t[off])
    beside = torch.cat([found.look[..., :3], place[off][..., 3:]], -1)  # centres tell of no gain
    begun = _Begun(start.R.index_copy(0, off, found.R), start.t.index_copy(0, off, found.t))
    return begun, place.index_copy(0, off, beside)


def _on_centers(moments: Moments, views: list[_Rows], R: Tensor, t: Tensor) -> JointPose:
    """The joint pose of the centres of the ellipses."""
    seen = [_by_centers(moments, view, *moments.rig.seen_by(view.camera, R, t)) for view in views]
    nowhere = t.new_zeros(len(t), views[0].evidence.mask.shape[1], PLACE)
    return joint_pose(moments.rig, seen, R, t, nowhere)


def _by_centers(moments: Moments, view: _Rows, R: Tensor, t: Tensor) -> Seen:
    """What a camera's centres tell, at its own poses where they have any."""
    refined = refine_centers(view.evidence, R, t)
    return Seen(
        view.camera, Setting(view.evidence, R, t, view.sight.camera, False), refined.normals, refined.R, refined.t
    )


def _on_frames(moments: Moments, views: list[_Rows], begun: _Begun, place: Tensor, refine: Refine) -> JointPose:
    """The joint pose of the pictures, as `refine.methods.on_frames` has that of one camera's."""
    R, t = begun
    active = torch.arange(len(t), device=t.device)
    good = torch.zeros_like(active, dtype=torch.bool)
    for number in range(ROUNDS):
        some = [view.of(active) for view in views]
        held = _held(moments, some, R[active], t[active])
        fitted = [
            _fitted(moments, view, known, (R[active], t[active]), place[active], refine, number > 0)
            for view, known in zip(some, held, strict=True)
        ]
        now = joint_pose(moments.rig, [one.seen for one in fitted], R[active], t[active], place[active])
        holds = now.known & torch.stack([one.on_frames for one in fitted]).any(0)
        if number == 0:
            found = now
            views = [
                _Rows(v.camera, v.evidence, replace(v.sight, look=f.look)) for v, f in zip(views, fitted, strict=True)
            ]
        else:
            # markers looked for where they are leave less to noise: if not, they are elsewhere
            holds &= torch.logdet(now.noise) < torch.logdet(found.noise[active])
        better = holds.nonzero()[:, 0]
        found, good = found.replaced(active[better], now[better]), good.index_fill(0, active[better], True)
        mm = [view.evidence.matrix[0, 0] / one.seen.setting.t[:, 2] for view, one in zip(views, fitted, strict=True)]
        beside = (now.look - place[active]).abs().amax((-1, -2)) * torch.stack(mm).amax(0)
        R, t = R.index_copy(0, active, now.R), t.index_copy(0, active, now.t)
        place = place.index_copy(0, active, now.look)
        doubt = torch.stack([one.doubt for one in fitted]).any(0)
        amiss = (doubt | (holds & (now.misfit != Misfit.NONE))) & (number == 0)
        active = active[((holds & (beside > BESIDE)) | amiss) & ~now.torn]
        if active.numel() == 0:
            break
    bad = (~good).nonzero()[:, 0]
    if bad.numel() == 0:
        return found
    return found.replaced(bad, _on_centers(moments, [view.of(bad) for view in views], begun.R[bad], begun.t[bad]))


class _Fitted(NamedTuple):
    """A camera's pictures fitted: what they tell, rows that the fit holds of, rows in doubt, and how it saw them."""

    seen: Seen
    on_frames: Tensor
    doubt: Tensor
    look: Look | None


def _held(moments: Moments, views: list[_Rows], R: Tensor, t: Tensor) -> list[Tensor]:
    """Information (J, 6, 6) about the poses, in the axes of each camera, that holds those that see too few markers."""
    if all(bool((view.evidence.mask.sum(-1) >= MIN_MARKERS).all()) for view in views):
        return [t.new_zeros(len(t), POSE, POSE)] * len(views)
    whole = torch.zeros(len(t), POSE, POSE, dtype=t.dtype, device=t.device)
    turns = [motion_in_view(moments.rig, view.camera).to(t) for view in views]
    for view, turn in zip(views, turns, strict=True):
        own = center_normals(view.evidence, *moments.rig.seen_by(view.camera, R, t))
        whole = whole + turn.mT @ own.information[..., :POSE, :POSE].sum(1) @ turn
    few = [(view.evidence.mask.sum(-1) < MIN_MARKERS)[:, None, None] for view in views]
    return [torch.where(alone, turn @ whole @ turn.mT, 0.0) for turn, alone in zip(turns, few, strict=True)]


def _fitted(
    moments: Moments,
    view: _Rows,
    held: Tensor,
    poses: tuple[Tensor, Tensor],
    place: Tensor,
    refine: Refine,
    thorough: bool,
) -> _Fitted:
    """One camera's pictures, around the common poses."""
    R, t = moments.rig.seen_by(view.camera, *poses)
    evidence, rows = view.evidence, len(t)
    setting = Setting(evidence, R, t, view.sight.camera, True)
    some = evidence.mask.any(-1).nonzero()[:, 0]
    sight = view.sight.displaced(beyond(place, evidence))[some]
    prior = held[some] if bool(held[some].any()) else None
    refined = refine(sight, R[some], t[some], prior=prior, thorough=thorough)
    kept, start_rms = refined.kept, center_rms(evidence[some], R[some], t[some])
    near = center_rms(evidence[some], refined.R, refined.t) < torch.maximum(
        start_rms, torch.full_like(start_rms, CENTER_RMS)
    )
    good = refined.good & ((kept > LEAST_KEPT) | (near & (kept > LEAST_KEPT_NEAR)))
    normals, own_R, own_t = _elsewhere(moments, view, (R, t), refined.normals, bool(good.all()))
    better = some[good]
    normals = normals.replaced(better, refined.normals[good])
    own_R, own_t = own_R.index_copy(0, better, refined.R[good]), own_t.index_copy(0, better, refined.t[good])
    empty = torch.zeros(rows, dtype=torch.bool, device=t.device)
    on_frames, doubt = empty.index_fill(0, better, True), empty.index_copy(0, some, refined.doubt)
    look = None if refined.look is None else _laid_out(refined.look, some, rows)
    return _Fitted(Seen(view.camera, setting, normals, own_R, own_t), on_frames, doubt, look)


def _elsewhere(
    moments: Moments, view: _Rows, poses: tuple[Tensor, Tensor], like: MarkerNormals, nowhere: bool
) -> tuple[MarkerNormals, Tensor, Tensor]:
    """What a camera tells of rows where its grey values do not: what its centres do; nothing if there are no such."""
    n = like.right.shape[-1]
    if nowhere:
        right = like.right.new_zeros(*view.evidence.mask.shape, n)
        return MarkerNormals(right[..., None].expand(*right.shape, n), right), *poses
    centers = _by_centers(moments, view, *poses)
    return _padded(centers.normals, n), centers.R, centers.t


def _padded(normals: MarkerNormals, n: int) -> MarkerNormals:
    """What centres tell, which is nothing of the blur; whatever that may be then (J, M, n)."""
    more = n - normals.right.shape[-1]
    if more == 0:
        return normals
    right = torch.cat(
        [normals.right[..., :POSE], normals.right.new_zeros(*normals.right.shape[:2], more), normals.right[..., POSE:]],
        -1,
    )
    information = right.new_zeros(*right.shape, n)
    kept = [*range(POSE), n - 1]
    wide = information.new_zeros(*right.shape[:2], POSE + 1, n)
    wide[..., kept] = normals.information
    information[:, :, kept] = wide
    information[:, :, POSE:-1, POSE:-1] = torch.eye(more).to(right)
    return MarkerNormals(information, right)


def _laid_out(look: Look, some: Tensor, rows: int) -> Look:
    """Of all rows; those that are not looked at have an empty look."""

    def spread(values: Tensor, fill: float) -> Tensor:
        return torch.full((rows, *values.shape[1:]), fill, dtype=values.dtype, device=values.device).index_copy(
            0, some, values
        )

    return Look(
        spread(look.kind, 0),
        spread(look.blur, 1.0),
        spread(look.levels, 0.0),
        spread(look.band, 1.0),
        spread(look.reduction, 1),
        spread(look.doubt, False),
    )


def _rms(moments: Moments, views: list[_Rows], R: Tensor, t: Tensor) -> Tensor:
    """RMS distance (J,) of the centres in all cameras, px."""
    square, count = torch.zeros_like(t[:, 0]), torch.zeros_like(t[:, 0])
    for view in views:
        seen = view.evidence.mask.sum(-1)
        own = center_rms(view.evidence, *moments.rig.seen_by(view.camera, R, t)).nan_to_num(nan=0.0)
        square, count = square + own.square() * seen, count + seen
    return (square / count).sqrt()


def _decided(moments: Moments, views: list[_Rows], start: Start, refine: Refine) -> Start:
    """The better of two poses first, where centres leave it open and the grey values of all cameras tell."""
    row = ambiguous(start).nonzero()[:, 0]
    if row.numel() == 0:
        return start
    some = start[row]
    difference = torch.zeros_like(some.chi2)
    for view in (view.of(row) for view in views):
        seen = view.evidence.mask.any(-1).nonzero()[:, 0]
        if seen.numel() == 0:
            continue
        fits = []
        for pose in ((some.R, some.t), (some.R_alt, some.t_alt)):
            R, t = (x[seen] for x in moments.rig.seen_by(view.camera, *pose))
            held = 1e3 * center_normals(view.evidence[seen], R, t).information[..., :POSE, :POSE].sum(1)
            held = held + torch.eye(POSE).to(held) * 1e6
            fits.append(refine(view.sight[seen], R, t, prior=held))
        chi2, _, _ = grey_chi2(view.sight[seen], *fits)
        difference = difference.index_add(0, seen, chi2)
    swap = difference < 0
    chi2, other = some.chi2, some.chi2 + difference.abs()
    other = torch.where(difference.abs() > AMBIGUOUS_CHI2, torch.maximum(other, some.chi2_alt), some.chi2_alt)
    first = replace(
        some,
        R=torch.where(swap[:, None, None], some.R_alt, some.R),
        t=torch.where(swap[:, None], some.t_alt, some.t),
        R_alt=torch.where(swap[:, None, None], some.R, some.R_alt),
        t_alt=torch.where(swap[:, None], some.t, some.t_alt),
        chi2=chi2,
        chi2_alt=other,
    )
    return start.replaced(row, first)


def _judged(moments: Moments, views: list[_Rows], start: Start, pose: JointPose, rms: Tensor) -> Fused:
    """The rows with their status; of several reasons the last one counts."""
    behind = torch.stack([_from_behind(moments, view, pose) for view in views]).any(0)
    disagree = pose.torn | start.against.any(1)
    against = torch.where(start.against.sum(1) == 1, start.against.int().argmax(1), -1)
    several = (start.mask.any(-1) | start.against).sum(1) > 2
    odd = torch.where(start.against.any(1), against, pose.odd)
    status, reason = torch.full_like(pose.misfit, int(Status.OK)), torch.full_like(pose.misfit, int(Reason.NONE))
    for condition, is_now, why in (
        (ambiguous(start), Status.AMBIGUOUS, Reason.TWO_SOLUTIONS),
        (~pose.explained, Status.REJECTED, Reason.RESIDUAL),
        (disagree, Status.REJECTED, Reason.CAMERAS_DISAGREE),
        (behind, Status.REJECTED, Reason.MIRRORED),
        (~pose.known, Status.REJECTED, Reason.DEGENERATE),
    ):
        status, reason = torch.where(condition, int(is_now), status), torch.where(condition, int(why), reason)
    named = torch.where(disagree & several, odd, -1)
    return Fused(
        replace(pose, odd=named),
        status,
        reason,
        rms,
        start.R_alt,
        start.t_alt,
        start.chi2,
        start.chi2_alt,
        start.mask,
    )


def _from_behind(moments: Moments, view: _Rows, pose: JointPose) -> Tensor:
    """Poses (J,) bool that show a camera all of its rings from behind their printed side."""
    R, t = moments.rig.seen_by(view.camera, pose.R, pose.t)
    evidence = view.evidence
    x = (R[:, None] @ evidence.points[..., None]).squeeze(-1) + t[:, None]
    normal = (R[:, None] @ evidence.normals[..., None]).squeeze(-1)
    return (((normal * x).sum(-1) < 0) | ~evidence.mask).all(-1) & evidence.mask.any(-1)
