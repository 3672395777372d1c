"""What a print and a camera that are not as their files say do to poses.

Every marker of a row tells something of the pose by itself: its own part of the normal equations. That its centre sits
elsewhere on the print, or that the camera's parameters differ, is for that marker a motion of its own, and dot gain one
unknown more. So what is not known of the target and the camera is a list of numbers of unit variance that each move all
markers a little , common to all frames. They are unknowns of the row with this prior, and the pose is the one
of the joint problem (generalised least squares). Its covariance has three parts: the noise of the frame, what these
numbers leave open, and what the residuals show beyond both (`pose.excess`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.camera import Camera
from torchpose.camera.derivatives import by_intrinsics
from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import constant, either
from torchpose.geometry.least_squares import covariance_factor, scaled_inverse, solve_scaled
from torchpose.geometry.projection import by_pose
from torchpose.geometry.rotations import plane_axes, turned
from torchpose.geometry.rows import Rows, replace
from torchpose.pose.covariance import center_jacobian, derivative
from torchpose.pose.evidence import Evidence
from torchpose.pose.excess import (
    OF_CAMERA,
    OF_EDGES,
    OF_MARKER,
    SKEW,
    Excess,
    Picture,
    beyond_chance,
    by_kind,
    excess_of,
    may_be_off,
    no_excess,
)
from torchpose.pose.solutions import PLACE
from torchpose.results import Misfit

POSE = 6
# of outer radii: from what differs along a rim to what moves a ring as a whole (convention)
_LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)
_RIM_POINTS = 24  # of a circle: sums over it are exact up to the perspective's high orders


@dataclass(frozen=True, eq=False)
class MarkerNormals(Rows):
    """What each of M markers of N rows tells, as its part of normal equations at a pose; 0 for markers not seen.

    The n unknowns are the pose (6: translation, rotation from the left), what else the row has (blur), and last the
    edge gain, mm.

    Attributes:
        information: J^T W J.
        right: J^T W r, r measured less predicted.
    """

    information: Float[Tensor, "N M n n"]
    right: Float[Tensor, "N M n"]

    def over(self, variance: Float[Tensor, " N"]) -> Self:
        """Of noise with so many times the variance."""
        return type(self)(self.information / variance[:, None, None, None], self.right / variance[:, None, None])

    def scattered(self, more: Float[Tensor, "N M n n"]) -> Self:
        """Of noise by which right sides have the covariance ``more`` beside the information."""
        both = torch.cat([self.information, self.right[..., None]], -1)
        told = self.information @ solve_scaled(self.information + more, both)
        return type(self)(0.5 * (told[..., :-1] + told[..., :-1].mT), told[..., -1])

    def by_motions(self, by: Float[Tensor, "N M n e"]) -> Float[Tensor, "N M n n"]:
        """Covariance of the right sides of markers that numbers of unit variance, their own, move by these columns."""
        pull = self.information @ by
        return pull @ pull.mT

    @classmethod
    def laid_out(cls, information: Tensor, right: Tensor, mask: Tensor) -> Self:
        """Of the parts (K, n, n), (K, n) of the markers seen, in the order of the mask (N, M)."""
        row, marker = mask.nonzero().unbind(-1)
        n = right.shape[-1]
        every = information.new_zeros(*mask.shape, n, n).index_put((row, marker), information)
        return cls(every, right.new_zeros(*mask.shape, n).index_put((row, marker), right))


class Setting(NamedTuple):
    """N rows at poses: what was measured, R (N, 3, 3), t (N, 3) mm, the camera, and what the poses are fitted to.

    on_rims: to the edges of the rings, which tell their size and shape too, and not to their centres.
    """

    evidence: Evidence
    R: Tensor
    t: Tensor
    camera: Camera
    on_rims: bool

    @property
    def arms(self) -> Tensor:
        """The markers (N, M, 3) as seen from the target's origin, camera axes, mm."""
        return turned(self.R, self.evidence.points)

    def of_rows(self, index: Tensor) -> Self:
        return self._replace(evidence=self.evidence[index], R=self.R[index], t=self.t[index])


@dataclass(frozen=True, eq=False)
class OnPrint(Rows):
    """The poses of the joint problem, from where the normal equations were formed.

    Attributes:
        step: of the pose.
        covariance: of everything.
        noise: the part of it that is the frame's own.
        systematic: how the pose errs with each of the L numbers, one deviation of them; the same in all frames.
        place: where the markers sit beside their places, as `Poses.place`, as estimated.
        look: the same if the print is behind the misfit, whatever is likeliest: where to look for the markers next.
        misfit: `Misfit`, what the residuals show beyond noise and stated uncertainties; it is in the covariance.
        explained: whether the residuals agree with all that.
        chi2: of the residuals, as in `Excess`.
        freedom: its degrees of freedom.
        known: whether the pose is determined.
    """

    step: Float[Tensor, "N 6"]
    covariance: Float[Tensor, "N 6 6"]
    noise: Float[Tensor, "N 6 6"]
    systematic: Float[Tensor, "N 6 L"]
    place: Float[Tensor, "N M 5"]
    look: Float[Tensor, "N M 5"]
    misfit: Int[Tensor, " N"]
    explained: Bool[Tensor, " N"]
    chi2: Float[Tensor, " N"]
    freedom: Int[Tensor, " N"]
    known: Bool[Tensor, " N"]


@checked
def on_print(
    normals: MarkerNormals,
    setting: Setting,
    moved: Float[Tensor, "N M 5"],
    *,
    estimate: bool = True,
    even: Float[Tensor, " N"] | None = None,
) -> OnPrint:
    """The joint problem of N rows.

    Args:
        normals: at the poses of the setting.
        setting: the rows.
        moved: where the markers were looked for beside their places, when the normal equations were formed.
        estimate: find poses; without, those that noise alone weighs stay, and their covariance counts what the rest
            does to them.
        even: see `excess.excess_of`.
    """
    R, n = setting.R, normals.right.shape[-1]
    if bool(moved.any()):
        aside = turned(R, moved[..., :3])
        back = torch.cat([aside, torch.zeros_like(aside), moved[..., 3:4]], -1)
        back = back + moved[..., 4:] * motions_by_size(setting)
        normals = MarkerNormals(normals.information, normals.right + _told(normals, among(back[..., None], n))[..., 0])
    right = normals.right
    own = torch.eye(n, dtype=right.dtype, device=right.device)[:, :-1].expand(*right.shape[:2], n, n - 1)
    by_camera, by_target = motions_by_camera(setting), motions_by_target(setting)
    stated = torch.cat([by_camera, by_target], -1)
    known = torch.cat([own, among(stated, n)], -1)
    excess, further, bent = _excess(normals, known, stated.shape[-1], setting, even)
    printed, lens = by_target, by_camera
    if further is not None:
        beside = further * excess.deviation[:, None, None]
        printed = torch.cat([by_target, beside[..., :-OF_CAMERA]], -1)
        off = excess.lens[:, None]
        rolled = _turned(setting) * torch.linalg.vector_norm(off[..., SKEW, :], dim=-1)[..., None, None]
        lens = torch.cat([by_camera, further[..., -OF_CAMERA:] @ off, rolled], -1)
    lens = torch.cat([lens, bent], -1)
    noisy = normals if further is None else _scattered(normals, setting, excess)
    joint = JointSolution.of(noisy, own, among(printed, n), among(lens, n), estimate)
    place = look = places_of(printed, joint, setting, excess.deviation)
    if further is not None:  # of a camera that is off, they stay where they were looked for
        look = moved.where((excess.misfit == Misfit.CAMERA)[:, None, None], place)
    other = (excess.misfit == Misfit.SCATTER).nonzero()[:, 0]
    if other.numel() and further is not None:
        # a fit that looks for the markers where they are not may only seem to scatter
        if_printed = torch.cat([by_target, (further * excess.printed[:, None, None])[..., :-OF_CAMERA]], -1)[other]
        alone = JointSolution.of(normals[other], own[other], among(if_printed, n), among(lens[other], n), True)
        look = look.index_copy(0, other, places_of(if_printed, alone, setting.of_rows(other), excess.printed[other]))
        noisy = normals[other].over(excess.printed_factor[other])
        alone = JointSolution.of(noisy, own[other], among(if_printed, n), among(lens[other], n), estimate)
        joint = joint.perhaps(other, alone, excess.maybe[other])
    sure = joint.known & (torch.linalg.cholesky_ex(joint.covariance)[1] == 0)
    parts = (joint.by_camera[..., : by_camera.shape[-1]], joint.by_print[..., : by_target.shape[-1]])
    common = torch.cat(parts, -1)
    found = (joint.step, joint.covariance, joint.noise, common, place, look)
    return OnPrint(*found, excess.misfit, excess.explained, excess.chi2, excess.freedom, sure)


def _scattered(normals: MarkerNormals, setting: Setting, excess: Excess) -> MarkerNormals:
    """Normal equations of the noise that the residuals show, and of displacements of the picture."""
    noisy = normals.over(excess.factor)
    moving = (excess.field > 0).any(-1).nonzero()[:, 0]
    if moving.numel() == 0:
        return noisy
    fields = excess.field[moving].sqrt()[:, :, None, None, None] * _fields(setting.of_rows(moving))
    shifts = among(fields.movedim(1, -2).flatten(-2), normals.right.shape[-1])
    some = noisy[moving]
    return noisy.replaced(moving, some.scattered(some.by_motions(shifts)))


def places_of(printed: Tensor, joint: JointSolution, setting: Setting, deviation: Tensor) -> Tensor:
    """Places (N, M, 5) of markers moved by the numbers of a solution, by their motions (N, M, 7, L).

    Where these go beyond what is stated, the last ones are those of edges, see `excess.OF_EDGES`.
    """
    if printed.shape[-1] == 0:
        return printed.new_zeros(*printed.shape[:2], PLACE)
    # a motion turns about the target's origin: what it does to a centre is both of its parts
    arm = setting.arms[..., None].expand_as(printed[:, :, 3:POSE])
    aside = printed[:, :, :3] + torch.linalg.cross(printed[:, :, 3:POSE], arm, dim=-2)
    by = torch.cat([setting.R.mT[:, None] @ aside, printed[:, :, POSE:]], 2)
    by = torch.nn.functional.pad(by, (0, 0, 0, 1))
    if bool((deviation > 0).any()):
        gain, bloom, size = by_kind(deviation)[1].T
        edges = by[..., -OF_EDGES:].zero_()
        edges[:, :, 3, :2] = torch.stack([gain, bloom], -1)[:, None]
        edges[:, :, 4, 2] = size[:, None]
    return (by @ joint.numbers[:, None, :, None])[..., 0]


class JointSolution(NamedTuple):
    """Solution of N problems of own unknowns, and numbers of unit variance of the print and of the camera.

    The print's are unknowns, too. The camera's are not: a frame tells next to nothing of them, and poses that followed
    what it seems to tell would scatter. They are counted alone.

    step (N, 6). numbers (N, L), of the print. covariance, noise (N, 6, 6), as in `OnPrint`. by_print (N, 6, L) and
    by_camera (N, 6, C), error of the pose with each number. known (N,).
    """

    step: Tensor
    numbers: Tensor
    covariance: Tensor
    noise: Tensor
    by_print: Tensor
    by_camera: Tensor
    known: Tensor

    @classmethod
    def of(cls, normals: MarkerNormals, own: Tensor, by_print: Tensor, by_camera: Tensor, estimate: bool) -> Self:
        """With the columns of the markers' unknowns that belong to each.

        By what the data tell of the print's numbers when the own unknowns are free, S = V diag(l) V^T: then they have
        the covariance (I + S)^-1, and every part of the pose's covariance is a sum of squares, whatever is large.
        """
        columns = torch.cat([own, by_print], -1)
        matrix, right = assembled(normals, columns)
        by_lens = torch.bmm(columns.flatten(1, 2).mT, _told(normals, by_camera).flatten(1, 2))
        k = own.shape[-1]
        alone, known = scaled_inverse(matrix[:, :k, :k])
        both = torch.cat([right[..., None], by_lens], -1)
        step, noise = torch.bmm(alone, both[:, :k]), alone[:, :POSE, :POSE]
        if by_print.shape[-1] == 0:
            step, lens, none = step[:, :POSE, 0] * float(estimate), step[:, :POSE, 1:], right[:, k:]
            return cls(step, none, noise + torch.bmm(lens, lens.mT), noise, lens[..., :0], lens, known)
        shift = alone @ matrix[:, :k, k:]  # of the own unknowns, found without the numbers, by these
        told = matrix[:, k:, k:] - matrix[:, k:, :k] @ shift
        finite = told.isfinite().all(-1).all(-1)
        told = torch.where(finite[:, None, None], 0.5 * (told + told.mT), 0.0)
        values, vectors = torch.linalg.eigh(told)
        values = values.clamp_min(0.0)[:, None] if estimate else torch.zeros_like(values)[:, None]
        held = shift[:, :POSE] @ vectors / (1 + values)
        numbers = both[:, k:] - matrix[:, k:, :k] @ step
        numbers = vectors / (1 + values) @ (vectors.mT @ numbers) * float(estimate)
        step = (step - shift @ numbers)[:, :POSE]
        noise = noise + (held * values) @ held.mT
        lens = step[..., 1:]
        covariance = noise + held @ held.mT + lens @ lens.mT
        step = step[..., 0] * float(estimate)
        return cls(step, numbers[..., 0], covariance, noise, held @ vectors.mT, lens, known & finite)

    def perhaps(self, rows: Tensor, other: Self, share: Tensor) -> Self:
        """With the covariance about these poses of solutions of which some ``rows`` are the ``other`` by a share."""
        apart = (other.step - self.step[rows])[..., None]
        there = other.covariance + apart @ apart.mT
        mean = self.covariance[rows] + share[:, None, None] * (there - self.covariance[rows])
        return self._replace(covariance=self.covariance.index_copy(0, rows, mean))


def _excess(
    normals: MarkerNormals, known: Tensor, count: int, setting: Setting, even: Tensor | None
) -> tuple[Excess, Tensor | None, Tensor]:
    """What the residuals show beyond the ``known`` columns, and the motions (N, M, 7, E) of what may be behind it.

    Without them where the markers agree: then each of them alone, free to move, would not move far. And the motions
    (N, M, 7, 1 or 0) by what the lens may bend where nothing is behind it.
    """
    rows, markers, n = known.shape[:3]
    alone = torch.eye(markers * (POSE + 1), dtype=known.dtype, device=known.device).unflatten(0, (markers, -1))
    together = remaining_of(normals, known, among(alone.expand(rows, -1, -1, -1), n), count)
    excess = no_excess(*together)
    odd = (~excess.explained).nonzero()[:, 0]
    bent = _bent(setting, *together)
    if odd.numel() == 0:
        return excess, None, bent
    some = setting.of_rows(odd)
    shifts = torch.cat([print_shifts(some), _camera_shifts(some)], -1)
    remaining = remaining_of(normals[odd], known[odd], among(shifts, n), count)
    refuted = beyond_chance(excess)[odd]

    def picture(which: Tensor) -> Picture:
        information, right = (x[odd[which]] for x in together)
        return Picture(information, right, _fields(some.of_rows(which)))

    # centres alone do not tell how a displacement bends a ring: there its scatter is that of all noise
    seen = picture if setting.on_rims else None
    again = excess_of(*remaining, None if even is None else even[odd], seen, refuted)
    every = shifts.new_zeros(rows, *shifts.shape[1:]).index_copy(0, odd, shifts)
    nothing = shifts.new_zeros(rows, shifts.shape[-1])
    excess = replace(excess, deviation=nothing, printed=nothing, field=shifts.new_zeros(rows, again.field.shape[1]))
    excess = excess.replaced(odd, replace(again, chi2=excess.chi2[odd], freedom=excess.freedom[odd]))
    return excess, every, torch.where((excess.misfit == Misfit.NONE)[:, None, None, None], bent, 0.0)


def _bent(setting: Setting, information: Tensor, right: Tensor) -> Tensor:
    """Motions (N, M, 7, 1) of markers by what a lens may bend more than its file says, by what residuals tell of it.

    Of all that may be off of a camera one frame tells this best beside what it does to the pose; a focal length that is
    off by what the frame tells of it moves the pose by hundreds of its deviations, and only many frames show it. A file
    that states what it knows of its lens is taken at its word (0 numbers) until residuals contradict it.

    Args:
        setting: the rows.
        information: of the motions of all markers, each alone, (N, 7 M, 7 M).
        right: its right side (N, 7 M).
    """
    camera = setting.camera
    if camera.lens_stated:
        return setting.t.new_zeros(*setting.evidence.mask.shape, POSE + 1, 0)
    jacobian, xy, weight = (_rim_jacobian if setting.on_rims else _center_jacobian)(*setting[:3])
    at = xy / _reach(camera)
    by = _least_squares(setting, jacobian, weight, (at * at.square().sum(-1, keepdim=True))[..., None])
    column = by.flatten(1)
    told = ((information * column[:, None]).sum(-1) * column).sum(-1)
    return by * may_be_off(told, (column * right).sum(-1)).sqrt()[:, None, None, None]


def motions_by_target(setting: Setting) -> Tensor:
    """How markers seem moved (N, M, 7, L), each alone, by the numbers of unit variance of the target.

    A target that is larger as a whole looks like the same one that is nearer: all markers move towards the camera.
    """
    by, scale = setting.evidence.by_target, setting.evidence.scale_sigma
    if by.shape[-1] == 0:
        return by
    moved = displaced(setting.R, setting.arms, by)
    if not bool((scale > 0).any()):
        return moved
    nearer = moved.new_zeros(*moved.shape[:3])
    nearer[..., :3] = -(scale[:, None] * setting.t)[:, None]
    return torch.cat([moved[..., :-1], nearer[..., None]], -1)


@checked
def displaced(
    R: Float[Tensor, "N 3 3"], arms: Float[Tensor, "N M 3"], by: Float[Tensor, "*N M 7 L"]
) -> Float[Tensor, "N M 7 L"]:
    """How markers seem moved, each as a pose of its own, and their edge gain, by places and turns on the print.

    Args:
        R: target to camera.
        arms: the markers as seen from the target's origin, camera axes, mm.
        by: as `MarkerTable.by_print`.
    """
    R = R[:, None]
    aside, turn = R @ by[..., :3, :], R @ by[..., 3:6, :]
    # a pose turns about the target's origin, a ring about its own centre
    aside = aside + torch.linalg.cross(arms[..., None].expand_as(turn), turn, dim=-2)
    return torch.cat([aside, turn, by[..., 6:, :].expand(*turn.shape[:2], 1, -1)], -2)


def motions_by_camera(setting: Setting) -> Tensor:
    """The same (N, M, 7, C) by those of the camera.

    A camera's error moves the image of a ring; the motion of the marker that does the same, by its own information, is
    the least-squares solution over its rims, or over its centre.
    """
    camera, like = setting.camera, setting.evidence.by_target
    if camera.covariance is None:
        return like.new_zeros(*like.shape[:2], POSE + 1, 0)
    factor = covariance_factor(camera.covariance.to(like))
    moved = _as_motions(setting, lambda xy: by_intrinsics(camera, xy)[..., : len(factor)] @ factor)
    together = setting.evidence.by_camera  # of a target that was measured by this camera
    return moved + displaced(setting.R, setting.arms, together) if together.shape[-1] else moved


def _camera_shifts(setting: Setting) -> Tensor:
    """The same of what a camera may be off by (`excess.OF_CAMERA`), each by 1 px at the frame's corner."""
    reach = _reach(setting.camera)

    def by(xy: Tensor) -> Tensor:
        eye = torch.eye(2, dtype=xy.dtype, device=xy.device).expand(*xy.shape, 2)
        at = xy / reach
        x, y = at.unbind(-1)
        square = at.square().sum(-1)
        # axes that are not square, half of the way from those turned alike to those of which v alone is, see `_turned`
        skew = torch.stack([1.5 * y, 0.5 * x], -1)
        linear = torch.stack([at, torch.stack([x, -y], -1), skew], -1)
        tangential = square[..., None, None] * eye + 2 * at[..., :, None] * at[..., None, :]
        return torch.cat([linear, eye, (square[..., None] * at)[..., None], tangential / 3], -1)

    return _as_motions(setting, by)


def _turned(setting: Setting) -> Tensor:
    """The same (N, 1, 7, 1) by what is open of axes that are not square: which of them is as filed.

    Nothing in the frame tells, for the picture of one is that of the other, turned: where lines are read one after the
    other, those of u are.
    """
    turn = torch.zeros_like(setting.t)
    turn[:, 2] = 0.5 / (_reach(setting.camera) * setting.camera.matrix.diagonal()[:2].mean())
    both = torch.cat([torch.linalg.cross(turn, setting.t), turn, torch.zeros_like(turn[:, :1])], -1)
    return both[:, None, :, None].expand(-1, setting.evidence.mask.shape[1], -1, -1)


def _reach(camera: Camera) -> float:
    """Of the frame's corner on the plane z = 1."""
    return 0.5 * math.hypot(camera.width, camera.height) / float(camera.matrix.diagonal()[:2].mean())


def print_shifts(setting: Setting) -> Tensor:
    """The same (N, M, 7, E) of the numbers of a print in `excess`, by 1 mm each."""
    evidence, R = setting.evidence, setting.R
    rows, markers = evidence.mask.shape
    normal, seen = evidence.normals, evidence.mask[..., None].to(R)
    moved = R[:, None] @ torch.stack([*plane_axes(normal), normal], -1)
    away = (evidence.points - (seen * evidence.points).sum(1, keepdim=True) / seen.sum(1, keepdim=True)) * seen
    reach = torch.linalg.vector_norm(away, dim=-1).amax(-1)[:, None, None, None]
    turn = 2 * moved[..., :2] / reach  # of a plate that is bent by 1 mm at its rim
    arm = setting.arms[..., None].expand_as(turn)
    own = torch.cat([moved, torch.linalg.cross(arm, turn, dim=-2)], -1)
    own = torch.cat([own, torch.nn.functional.pad(turn, (3, 0))], -2)
    each = torch.eye(markers, dtype=R.dtype, device=R.device)
    own = (each[:, None, :, None] * own[:, :, :, None]).flatten(-2)
    columns = R.new_zeros(rows, markers, POSE + 1, OF_MARKER * markers + OF_EDGES)
    columns[:, :, :POSE, :-OF_EDGES] = own
    columns[:, :, -1, -3] = 1
    columns[..., -2] = _by_bloom(setting)
    columns[..., -1] = motions_by_size(setting)
    return columns


def _fields(setting: Setting) -> Tensor:
    """Factors (N, F, M, 7, 7) of the covariance of motions of single markers where the picture is displaced at random.

    By 1 px along u and along v, alike over each of F lengths. Rings are so far apart that each is displaced by itself.
    """
    evidence = setting.evidence
    jacobian, xy, weight = _rim_jacobian(evidence, setting.R, setting.t)
    markers = evidence.mask.shape[1]
    weighted = (jacobian.mT @ weight).unflatten(1, (markers, -1))  # (N, M, P, 7, 2)
    held = (weighted @ jacobian.unflatten(1, (markers, -1))).sum(2)
    moved = solve_scaled(held, weighted.movedim(2, -1).flatten(-2)).unflatten(-1, (2, -1))  # (N, M, 7, 2, P)
    moved = torch.where(evidence.mask[..., None, None, None], moved, 0.0)
    at = (xy * evidence.matrix.diagonal()[:2]).unflatten(1, (markers, -1))
    across = evidence.radii[..., 0] * evidence.matrix.diagonal()[:2].mean() / setting.t[:, 2:]
    length = across.new_tensor(_LENGTHS)[:, None, None, None] * across[:, None, :, None, None]
    apart = torch.cdist(at, at)[:, None]  # (N, 1, M, P, P)
    alike = (-(apart / length).square()).exp()
    both = torch.einsum("nmacp,nfmpq,nmbcq->nfmab", moved, alike, moved)
    values, vectors = torch.linalg.eigh(0.5 * (both + both.mT))
    return vectors * values.clamp_min(0.0).sqrt()[..., None, :]


def _by_bloom(setting: Setting) -> Tensor:
    """Motions (N, M, 7) that do to rings what dark edges do that lie further outwards by what 1 mm is at the target."""
    if not setting.on_rims:
        return setting.t.new_zeros(*setting.evidence.mask.shape, POSE + 1)
    jacobian, _, weight = _rim_jacobian(setting.evidence, setting.R, setting.t)
    across = torch.nn.functional.normalize(weight @ jacobian[..., -1:], dim=-2)
    mm = setting.evidence.matrix.diagonal()[:2].mean() / setting.t[:, 2]
    return _least_squares(setting, jacobian, weight, across)[..., 0] * mm[:, None, None]


def motions_by_size(setting: Setting) -> Tensor:
    """Motions (N, M, 7) that do to a ring what both its edges do 1 mm further out: it is nearer, with less gain.

    A disc has one edge, and nothing but gain.
    """
    evidence = setting.evidence
    outer, inner = evidence.radii.unbind(-1)
    x = setting.arms + setting.t[:, None]
    ring = inner > 0
    nearer = torch.where(ring, -2 / (outer + inner), 0.0)[..., None] * x
    less = -evidence.polarity[:, None] * torch.where(ring, (outer - inner) / (outer + inner), -1.0)
    return torch.cat([nearer, torch.zeros_like(x), less[..., None]], -1)


def _as_motions(setting: Setting, by: Callable[[Tensor], Tensor]) -> Tensor:
    """Motions (N, M, 7, n) of single markers by which pixels move as by the columns ``by`` (..., 2, n) of their images.

    Measured are the pixels of the frame: a changed camera moves the ideal pixels made of them.
    """
    camera = setting.camera
    jacobian, xy, weight = (_rim_jacobian if setting.on_rims else _center_jacobian)(*setting[:3])
    ideal = camera.matrix.diagonal()[:2, None] * torch.linalg.inv(camera.J_distort(xy))
    return _least_squares(setting, jacobian, weight, ideal @ by(xy))


def _least_squares(setting: Setting, jacobian: Tensor, weight: Tensor, pixels: Tensor) -> Tensor:
    """Motions (N, M, 7, n) of single markers that move points best as by the columns ``pixels`` (N, P, 2, n)."""
    mask, each = setting.evidence.mask, (setting.evidence.mask.numel(), -1)
    weighted = torch.bmm(weight.flatten(0, 1), jacobian.flatten(0, 1)).view(*each, jacobian.shape[-1])
    columns = torch.cat([jacobian, pixels], -1).view(*each, jacobian.shape[-1] + pixels.shape[-1])
    sums = torch.bmm(weighted.mT, columns).unflatten(0, mask.shape)
    held, pulled = sums.split_with_sizes([jacobian.shape[-1], pixels.shape[-1]], -1)
    return either(mask[..., None, None], solve_scaled(held, pulled), 0.0)


def remaining_of(normals: MarkerNormals, known: Tensor, excess: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Information (N, E, E) about the ``excess`` columns and their right side (N, E), with the ``known`` unknowns.

    The last ``count`` of these are numbers with a prior of unit variance about 0.
    """
    matrix, right = assembled(normals, torch.cat([known, excess], -1))
    k = known.shape[-1]
    if count:
        matrix.diagonal(dim1=-2, dim2=-1)[:, k - count : k] += 1
    both = torch.cat([matrix[:, :k, k:], right[:, :k, None]], -1)
    taken = torch.bmm(matrix[:, k:, :k], solve_scaled(matrix[:, :k, :k], both))
    return matrix[:, k:, k:] - taken[..., :-1], right[:, k:] - taken[..., -1]


def assembled(normals: MarkerNormals, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations (N, k, k), (N, k) of unknowns with these columns (N, M, n, k)."""
    # all markers in one product: with many of them single ones are large together
    every = columns.flatten(1, 2).mT
    both = torch.cat([_told(normals, columns), normals.right[..., None]], -1).flatten(1, 2)
    matrix, right = torch.bmm(every, both).split_with_sizes([columns.shape[-1], 1], -1)
    return matrix.contiguous(), right[..., 0]


def _told(normals: MarkerNormals, columns: Tensor) -> Tensor:
    """What the markers tell of columns (N, M, n, k), each of its own: (N, M, n, k)."""
    return torch.bmm(normals.information.flatten(0, 1), columns.flatten(0, 1)).view_as(columns)


def among(by: Tensor, n: int) -> Tensor:
    """Columns (N, M, n, L) of pose and gain (N, M, 7, L), with 0 for what stands between."""
    if by.shape[-1] == 0:
        return by.new_zeros(*by.shape[:2], n, 0)
    between = by.new_zeros(*by.shape[:2], n - POSE - 1, by.shape[-1])
    return torch.cat([by[:, :, :POSE], between, by[:, :, POSE:]], 2)


def _rim_jacobian(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives (N, P, 2, 7) of points all along both rims by pose and gain, their normalised images, weights.

    A point counts across the edge, by its share of the rim's length.
    """
    angle = torch.arange(_RIM_POINTS, dtype=t.dtype, device=t.device) * (2 * torch.pi / _RIM_POINTS)
    one, two = (x[..., None, None, :] for x in plane_axes(evidence.normals))
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    radii = evidence.radii[..., None, None]
    outward = cos * one + sin * two
    points = evidence.points[:, :, None, None] + radii * outward
    along = radii * (cos * two - sin * one)
    side = evidence.polarity[:, None, None, None, None] * constant((((1.0,),), ((-1.0,),)), t)
    seen_from = torch.stack([points, along, side * outward], -1).flatten(1, 3)
    arm, *moved = (R[:, None] @ seen_from).unbind(-1)
    by_point, xy = derivative(arm + t[:, None], evidence.matrix)
    tangent, by_gain = (by_point @ torch.stack(moved, -1)).unbind(-1)  # px per rad, px per mm
    length = torch.linalg.vector_norm(tangent, dim=-1)
    normal = torch.stack([-tangent[..., 1], tangent[..., 0]], -1) / length[..., None]
    # of a disc the inner edge is nowhere
    seen = (evidence.mask[..., None] & (evidence.radii > 0)).flatten(1).repeat_interleave(_RIM_POINTS, 1)
    weight = normal[..., :, None] * normal[..., None, :] * (length * seen)[..., None, None]
    return torch.cat([by_pose(by_point, arm), by_gain[..., None]], -1), xy, weight


def _center_jacobian(evidence: Evidence, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same of the markers' centres, (N, M, 2, 7), which gain does not move."""
    jacobian, xy, weight = center_jacobian(evidence, R, t)
    return torch.nn.functional.pad(jacobian, (0, 1)), xy, weight


@checked
def center_normals(evidence: Evidence, R: Tensor, t: Tensor) -> MarkerNormals:
    """What the compensated centres tell; gain moves none."""
    jacobian, xy, weight = _center_jacobian(evidence, R, t)
    at = xy * evidence.matrix.diagonal()[:2] + evidence.matrix[:2, 2]
    error = torch.where(evidence.mask[..., None], evidence.center - at, 0.0)
    weighted = jacobian.mT @ weight
    return MarkerNormals(weighted @ jacobian, (weighted @ error[..., None])[..., 0])
