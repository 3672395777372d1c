"""The pose of J rows from what every marker tells in every camera (`pose.systematic`, over the cameras of a rig).

A marker in a camera is a part of normal equations about a motion of its own. The pose moves them all, in the axes of
each camera; the blur is one of each camera's pictures; places on the print, dot gain, lenses and the places of the
cameras are numbers of unit variance, which are unknowns with that prior. So a camera whose place is known badly counts
for no more than it tells, and the covariance of the pose holds what all of them leave open.

What residuals show beyond that (`pose.excess`) is looked for within each camera, with a pose of its own: cameras that
contradict each other are no misfit of the print. Whether they do is asked then: chi-squared of poses of their own.
What that leaves possible widens the covariance (`moments.places`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import CameraRig
from torchpose.geometry import rotations
from torchpose.geometry.least_squares import LEAST_DIRECTION, scaled_inverse, solve_scaled
from torchpose.geometry.robust import CUT, quantile
from torchpose.geometry.rows import Rows
from torchpose.moments.views import motion_in_view, motion_of_place
from torchpose.pose import MarkerNormals, Setting
from torchpose.pose.excess import OF_CAMERA, SURE, Excess, beyond_chance, excess_of, no_excess
from torchpose.pose.systematic import (
    POSE,
    JointSolution,
    among,
    assembled,
    motions_by_camera,
    motions_by_size,
    motions_by_target,
    places_of,
    print_shifts,
    remaining_of,
)
from torchpose.results import Misfit


class Seen(NamedTuple):
    """What one camera tells of J rows: at the poses of the setting, in its axes, the parts of its markers.

    Attributes:
        camera: its number in the rig.
        setting: with a mask of the markers that count; none where the camera has nothing of a row.
        normals: what they tell.
        R, t: the poses, in its axes, where these were formed.
    """

    camera: int
    setting: Setting
    normals: MarkerNormals
    R: Tensor
    t: Tensor

    @property
    def there(self) -> Tensor:
        """(J,) bool, rows of which it has anything."""
        return self.setting.evidence.mask.any(-1)


@dataclass(frozen=True, eq=False)
class JointPose(Rows):
    """Poses in the first camera; fields as in `pose.OnPrint`, and what the cameras say against each other.

    Attributes:
        share: of the information about the pose, by camera; they sum up to 1.
        between: chi-squared between the cameras.
        between_freedom: its degrees of freedom.
        odd: the camera alone against which all others agree; -1 where none is.
        torn: whether they contradict each other beyond their covariance.
        told: information about the numbers that all rows share, and about how far cameras are beside their places
            (of each three turns, rad, and three shifts, mm), pose and blurs being unknown.
        pull: its right side.
        by_place: error of the pose with each of the latter.
    """

    R: Float[Tensor, "J 3 3"]
    t: Float[Tensor, "J 3"]
    covariance: Float[Tensor, "J 6 6"]
    noise: Float[Tensor, "J 6 6"]
    systematic: Float[Tensor, "J 6 L"]
    place: Float[Tensor, "J M 5"]
    look: Float[Tensor, "J M 5"]
    misfit: Int[Tensor, " J"]
    explained: Bool[Tensor, " J"]
    chi2: Float[Tensor, " J"]
    freedom: Int[Tensor, " J"]
    known: Bool[Tensor, " J"]
    share: Float[Tensor, "J V"]
    between: Float[Tensor, " J"]
    between_freedom: Int[Tensor, " J"]
    odd: Int[Tensor, " J"]
    torn: Bool[Tensor, " J"]
    told: Float[Tensor, "J E E"]
    pull: Float[Tensor, "J E"]
    by_place: Float[Tensor, "J 6 P"]


class _Parts(NamedTuple):
    """The markers of all cameras one after the other: (J, V M, ...).

    normals: at the joint pose. own: columns of pose and blurs. apart: the same with a pose for every camera. numbers:
    columns of lenses, places and print, L of them, of which the last ``printed`` are the print's.
    """

    normals: MarkerNormals
    own: Tensor
    apart: Tensor
    numbers: Tensor
    printed: int


def joint_pose(rig: CameraRig, views: list[Seen], R: Tensor, t: Tensor, moved: Tensor) -> JointPose:
    """The joint problem of J rows.

    Args:
        rig: the cameras.
        views: what each of them tells.
        R: (J, 3, 3) in the first camera, near which the pose is.
        t: (J, 3), the same.
        moved: (J, M, 5), where the markers were looked for beside their places.
    """
    parts = _parts(rig, views, R, t, moved)
    excess, further = _excess(parts, views)
    n = parts.normals.right.shape[-1]
    odd_ones = parts.numbers[..., :0]
    if further is not None:
        odd_ones = among(further * excess.deviation[:, None, None], n)
    beside = torch.cat([parts.numbers, odd_ones], -1)
    normals = parts.normals.over(excess.factor)
    between, freedom, odd, torn = _between(normals, parts, beside, len(views))
    off = _off(rig, views, R, t, n)
    own = torch.cat([parts.own, odd_ones], -1)
    told, pull = remaining_of(normals, own, torch.cat([parts.numbers, off], -1), odd_ones.shape[-1])
    # counted, not estimated: the pose is the one of a rig that is as its file says
    joint = JointSolution.of(normals, parts.own, beside, off, True)
    covariance = joint.noise + joint.by_print @ joint.by_print.mT
    place = look = _print_places(parts, views, joint, excess.deviation, further)
    other = ((excess.misfit == Misfit.CAMERA) | (excess.misfit == Misfit.SCATTER)).nonzero()[:, 0]
    if other.numel() and further is not None:
        look = place.index_copy(0, other, _if_printed(parts, views, excess, further, other))
    known = joint.known & (torch.linalg.cholesky_ex(covariance.nan_to_num(nan=-1.0))[1] == 0)
    step = joint.step.nan_to_num(nan=0.0)
    return JointPose(
        R=rotations.exp(step[:, 3:]) @ R,
        t=t + step[:, :3],
        covariance=covariance,
        noise=joint.noise,
        systematic=joint.by_print[..., : parts.numbers.shape[-1]],
        place=place,
        look=look,
        misfit=excess.misfit,
        explained=excess.explained,
        chi2=excess.chi2,
        freedom=excess.freedom,
        known=known,
        share=_share(normals, parts.own, len(views)),
        between=between,
        between_freedom=freedom,
        odd=odd,
        torn=torn,
        told=told,
        pull=pull,
        by_place=joint.by_camera - _in_axes_of_first(views, off),
    )


def _parts(rig: CameraRig, views: list[Seen], R: Tensor, t: Tensor, moved: Tensor) -> _Parts:
    """Of all cameras, about a pose in the first one."""
    count = len(views)
    n = views[0].normals.right.shape[-1]
    parts: list[tuple[MarkerNormals, Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    for k, view in enumerate(views):
        own_R, own_t = rig.seen_by(view.camera, R, t)
        setting = view.setting._replace(R=own_R, t=own_t)
        normals = _about(view, setting, moved)
        rows, markers = normals.right.shape[:2]
        eye = torch.eye(n).to(t)
        pose, blur = eye[:, :POSE], eye[:, POSE:-1]
        in_view = pose @ motion_in_view(rig, view.camera).to(t)
        own = torch.cat([in_view, *(blur * float(j == k) for j in range(count))], -1)
        apart = torch.cat([*(pose * float(j == k) for j in range(count)), own[:, POSE:]], -1)
        placed = pose @ motion_of_place(rig, view.camera, own_t)
        own, apart = (x.expand(rows, markers, *x.shape) for x in (own, apart))
        placed = placed[:, None].expand(-1, markers, -1, -1)
        lens, printed = among(motions_by_camera(setting), n), among(motions_by_target(setting), n)
        parts.append((normals, own, apart, lens, placed, printed))
    lenses = [part[3].shape[-1] for part in parts]
    spread = [torch.nn.functional.pad(part[3], (sum(lenses[:k]), sum(lenses[k + 1 :]))) for k, part in enumerate(parts)]
    numbers = torch.cat([torch.cat([a, p[4], p[5]], -1) for a, p in zip(spread, parts, strict=True)], 1)
    information, right = (torch.cat([getattr(p[0], name) for p in parts], 1) for name in ("information", "right"))
    own, apart = torch.cat([p[1] for p in parts], 1), torch.cat([p[2] for p in parts], 1)
    return _Parts(MarkerNormals(information, right), own, apart, numbers, parts[0][5].shape[-1])


def _about(view: Seen, setting: Setting, moved: Tensor) -> MarkerNormals:
    """A camera's normal equations about the pose of the setting, of markers in their places."""
    information, right = view.normals.information, view.normals.right
    n = right.shape[-1]
    aside = (view.R[:, None] @ moved[..., :3, None])[..., 0]
    formed = setting._replace(R=view.R, t=view.t)
    back = torch.cat([aside, torch.zeros_like(aside), moved[..., 3:4]], -1) + moved[..., 4:] * motions_by_size(formed)
    off = torch.cat([setting.t - view.t, rotations.log(setting.R @ view.R.mT), torch.zeros_like(view.t[:, :1])], -1)
    change = among((back - off[:, None])[..., None], n)
    right = right + (information @ change)[..., 0]
    # of a camera without a picture no blur is known, nor is it asked for
    nothing = torch.zeros(n, dtype=right.dtype, device=right.device)
    nothing[POSE:-1] = 1
    alone = torch.zeros_like(information)
    alone[:, 0] = torch.diag(nothing) * (~view.there).to(right)[:, None, None]
    seen = setting.evidence.mask
    information = torch.where(seen[..., None, None], information, 0.0) + alone
    return MarkerNormals(information, torch.where(seen[..., None], right, 0.0))


def _excess(parts: _Parts, views: list[Seen]) -> tuple[Excess, Tensor | None]:
    """What residuals show within the cameras, and the motions (J, V M, 7, E) of what may be behind it."""
    normals, n = parts.normals, parts.normals.right.shape[-1]
    rows, items = normals.right.shape[:2]
    # poses of their own take up what the places of the cameras do
    known = torch.cat([parts.apart, parts.numbers], -1)
    count = parts.numbers.shape[-1]
    alone = torch.eye(items * (POSE + 1)).to(known).unflatten(0, (items, -1)).expand(rows, -1, -1, -1)
    excess = no_excess(*remaining_of(normals, known, among(alone, n), count))
    odd = (~excess.explained).nonzero()[:, 0]
    if odd.numel() == 0:
        return excess, None
    # what one camera's lens does is scatter here: of which one it is would be one more question
    shifts = torch.cat([print_shifts(view.setting.of_rows(odd)) for view in views], 1)
    shifts = torch.nn.functional.pad(shifts, (0, OF_CAMERA))
    refuted = beyond_chance(excess)[odd]
    again = excess_of(*remaining_of(normals[odd], known[odd], among(shifts, n), count), refuted=refuted)
    every = shifts.new_zeros(rows, *shifts.shape[1:]).index_copy(0, odd, shifts)
    nothing = shifts.new_zeros(rows, shifts.shape[-1])
    excess = replace(excess, deviation=nothing, printed=nothing)
    return excess.replaced(odd, replace(again, chi2=excess.chi2[odd], freedom=excess.freedom[odd])), every


def _print_places(
    parts: _Parts, views: list[Seen], joint: JointSolution, deviation: Tensor, further: Tensor | None
) -> Tensor:
    """Places (J, M, 5) of the markers on the print, by the motions that they are in the first of the cameras."""
    setting, markers = views[0].setting, views[0].setting.evidence.mask.shape[1]
    first = parts.numbers.shape[-1] - parts.printed
    by = parts.numbers[:, :markers, :, first:]
    by = torch.cat([by[:, :, :POSE], by[:, :, -1:]], 2)
    if further is not None:
        by = torch.cat([by, further[:, :markers] * deviation[:, None, None]], -1)
    numbers = joint.numbers[:, first : first + by.shape[-1]]
    return places_of(by, joint._replace(numbers=numbers), setting, deviation)


def _if_printed(parts: _Parts, views: list[Seen], excess: Excess, further: Tensor, rows: Tensor) -> Tensor:
    """The same of some rows (K,) if the print is behind their misfit: where to look for the markers next."""
    some = _Parts(parts.normals[rows], parts.own[rows], parts.apart[rows], parts.numbers[rows], parts.printed)
    n, deviation = some.normals.right.shape[-1], excess.printed[rows]
    beside = torch.cat([some.numbers, among(further[rows] * deviation[:, None, None], n)], -1)
    joint = JointSolution.of(some.normals, some.own, beside, some.numbers[..., :0], True)
    seen = [view._replace(setting=view.setting.of_rows(rows)) for view in views]
    return _print_places(some, seen, joint, deviation, further[rows])


def _between(
    normals: MarkerNormals, parts: _Parts, numbers: Tensor, views: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Chi-squared (J,) that poses of their own would take off, its freedom (J,), the odd camera (J,) or -1, and whether
    all that is beyond chance (J,).

    A camera that was knocked sees everything shifted: two numbers, which twelve of other kinds would hide. So each
    camera's shift is judged by itself, too.
    """
    known = torch.cat([parts.own, numbers], -1)
    information, right = remaining_of(normals, known, parts.apart[..., : POSE * views], numbers.shape[-1])
    chi2, freedom = _taken(information, right)
    each = torch.arange(views, device=right.device)
    own = right.unflatten(-1, (views, POSE))
    blocks = information.unflatten(-1, (views, POSE)).unflatten(-3, (views, POSE))[:, each, :, each].movedim(0, 1)
    alone, of_one = _of_each(blocks, own)
    shifted, of_shift = _of_each(blocks[..., :2, :2], own[..., :2])
    rest, left = chi2[:, None] - alone, freedom[:, None] - of_one
    agrees = (rest < quantile(left.clamp_min(1), SURE)) & (left > 0)
    odd = torch.where(agrees.sum(1) == 1, agrees.int().argmax(1), -1)
    torn = (freedom > 0) & (chi2 > quantile(freedom.clamp_min(1), CUT))
    torn |= ((of_shift > 0) & (shifted > quantile(of_shift.clamp_min(1), CUT))).any(1)
    return chi2, freedom, odd, torn


def _of_each(blocks: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
    """`_taken` (J, V) of each camera alone."""
    found = _taken(blocks.flatten(0, 1), own.flatten(0, 1))
    return found[0].unflatten(0, own.shape[:2]), found[1].unflatten(0, own.shape[:2])


def _off(rig: CameraRig, views: list[Seen], R: Tensor, t: Tensor, n: int) -> Tensor:
    """How markers move (J, V M, n, 6 V) if a camera is not where the rig has it: turned by 1 rad, or moved by 1 mm."""
    parts = []
    for k, view in enumerate(views):
        at = rig.seen_by(view.camera, R, t)[1]
        turn = torch.zeros(len(t), n, POSE, dtype=t.dtype, device=t.device)
        eye = torch.eye(3).to(t)
        turn[:, :3, :3] = -rotations.skew(at)
        turn[:, 3:POSE, :3] = eye
        turn[:, :3, 3:] = eye
        turn = torch.nn.functional.pad(turn, (POSE * k, POSE * (len(views) - 1 - k)))
        parts.append(turn[:, None].expand(-1, view.setting.evidence.mask.shape[1], -1, -1))
    return torch.cat(parts, 1)


def _in_axes_of_first(views: list[Seen], off: Tensor) -> Tensor:
    """By how much poses (J, 6, 6 V) in the axes of the rig's first camera differ from those of its place if that one
    is off."""
    moved = torch.zeros_like(off[:, 0, :POSE])
    if views[0].camera == 0:
        moved[..., :POSE] = off[:, 0, :POSE, :POSE]
    return moved


def _taken(information: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Chi-squared (J,) that unknowns of this information and right side take off, and how many of them there are."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    scale = torch.where(scale > 0, scale.rsqrt(), 0.0).nan_to_num(posinf=0.0)
    scaled = (information * scale[..., :, None] * scale[..., None, :]).nan_to_num(nan=0.0)
    values, vectors = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
    # what is left of sums that were taken off each other has half of their digits
    least = LEAST_DIRECTION**0.5
    there = values > least * values[..., -1:].clamp_min(least)
    along = (vectors.mT @ (right * scale)[..., None])[..., 0]
    return torch.where(there, along.square() / values.clamp_min(LEAST_DIRECTION), 0.0).sum(-1), there.sum(-1)


def _share(normals: MarkerNormals, own: Tensor, views: int) -> Tensor:
    """(J, V): how much of the information about the pose each camera has, by the mean over its six directions."""
    blocks = []
    for k in range(views):
        items = slice(k * own.shape[1] // views, (k + 1) * own.shape[1] // views)
        matrix = assembled(_items(normals, items), own[:, items])[0]
        taken = matrix[:, :POSE, POSE:] @ solve_scaled(matrix[:, POSE:, POSE:], matrix[:, POSE:, :POSE])
        blocks.append(matrix[:, :POSE, :POSE] - taken)
    each = torch.stack(blocks, 1)
    whole = scaled_inverse(each.sum(1))[0]
    return (whole[:, None] * each).sum((-1, -2)) / POSE


def _items(normals: MarkerNormals, items: slice) -> MarkerNormals:
    return MarkerNormals(normals.information[:, items], normals.right[:, items])
