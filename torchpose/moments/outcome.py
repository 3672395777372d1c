"""The rows of moments: those that several cameras share, and those of which one camera alone has anything."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import marked
from torchpose.moments.refined import Fused
from torchpose.moments.views import Moments, View, motion_in_view, motion_of_place
from torchpose.pose.outcome import award, detections_of
from torchpose.pose.systematic import POSE
from torchpose.results import Detections, Poses, Reason, Status


class Alone(NamedTuple):
    """Rows (A,) that one view has alone, its index among the views, and its own poses of all of its pictures."""

    rows: Tensor
    view: int
    poses: Poses


def joined(moments: Moments, rows: Tensor, fused: Fused | None, alone: list[Alone]) -> Poses:
    """A row for every moment and target, in the axes of the first camera.

    Args:
        moments: what the cameras have.
        rows: (J,) that several cameras share.
        fused: of these; None for none.
        alone: the others.
    """
    lenses = [view.found.evidence.of_camera for view in moments.views]
    places = moments.rig.factor().shape[-1]
    common = _Common(moments, _detections(moments, rows, fused, alone), lenses, sum(lenses) + places)
    parts = [] if fused is None else [_shared(common, rows, fused)]
    parts += [_of_one(common, part) for part in alone if part.rows.numel()]
    order = [] if fused is None else [rows]
    order += [part.rows for part in alone if part.rows.numel()]
    every: Poses = Rows.cat.__func__(Poses, parts)  # type: ignore[attr-defined]
    return every[torch.argsort(torch.cat(order))]


class _Common(NamedTuple):
    """What all rows share: the markers found, the uncertain numbers of each view's lens, and of the whole rig."""

    moments: Moments
    detections: Detections
    lenses: list[int]
    of_camera: int

    def lens(self, view: int) -> slice:
        """Where the numbers of a view's lens stand."""
        first = sum(self.lenses[:view])
        return slice(first, first + self.lenses[view])

    def frame_and_target(self, rows: Tensor) -> dict[str, Tensor]:
        targets = self.moments.targets
        return {"frame": rows // targets, "target": rows % targets}


def _detections(moments: Moments, rows: Tensor, fused: Fused | None, alone: list[Alone]) -> Detections:
    """The markers that the rows have, of all cameras; frames are moments."""
    parts = []
    for k, view in enumerate(moments.views):
        mask = torch.zeros_like(view.found.evidence.mask)
        if fused is not None:
            own = view.row[rows]
            there = (own >= 0).nonzero()[:, 0]
            mask = mask.index_copy(0, own[there], fused.mask[there, k])
        found = [detections_of(view.scene, view.found, mask)]
        for part in alone:
            if part.view == k:
                own = marked(view.row[part.rows].clamp_min(0), len(view.found.evidence))
                seen = part.poses.detections
                found.append(seen[own[seen.frame * moments.targets + seen.target]])
        both = Detections.cat(found)
        number = torch.full_like(both.frame, view.camera)
        parts.append(replace(both, frame=view.moment[both.frame], camera=number))
    every = Detections.cat(parts)
    order = torch.argsort(every.frame * moments.targets + every.target, stable=True)
    return every[order]


def _shared(common: _Common, rows: Tensor, fused: Fused) -> Poses:
    """Rows of several cameras."""
    moments, pose = common.moments, fused.pose
    status, reason = fused.status, fused.reason
    support = torch.where(status == Status.REJECTED, 0, fused.mask.flatten(1).sum(-1))
    awarded = (support > 0) & _positive(pose.covariance)
    if moments.targets > 1:
        awarded &= _owners(moments, rows, fused, support)
    lost = (status != Status.REJECTED) & ~awarded
    status = torch.where(lost, int(Status.REJECTED), status)
    reason = torch.where(lost, int(Reason.RESIDUAL), reason)

    def kept(values: Tensor) -> Tensor:
        return torch.where(awarded.view(-1, *[1] * (values.ndim - 1)), values, torch.nan)

    every = fused.mask.any(1)
    share = torch.zeros(len(rows), len(moments.rig), dtype=pose.t.dtype, device=pose.t.device)
    share[:, [view.camera for view in moments.views]] = torch.where(fused.mask.any(-1), pose.share, 0.0)
    numbers = torch.tensor([view.camera for view in moments.views], device=rows.device)
    return Poses(
        **common.frame_and_target(rows),
        instance=torch.zeros_like(rows),
        copies=torch.stack([_copies(view, rows) for view in moments.views]).amax(0).maximum(awarded.long()),
        R=kept(pose.R),
        t=kept(pose.t),
        covariance=kept(pose.covariance),
        noise=kept(pose.noise),
        systematic=kept(pose.systematic),
        place=kept(torch.where(every[..., None], pose.place, torch.nan)),
        misfit=pose.misfit * awarded,
        residual_chi2=kept(pose.chi2),
        freedom=pose.freedom * awarded,
        rms=kept(fused.rms),
        status=status,
        reason=reason,
        markers=every.sum(-1),
        chi2=kept(fused.chi2),
        R_alt=kept(fused.R_alt),
        t_alt=kept(fused.t_alt),
        rms_alt=torch.full_like(fused.rms, torch.nan),
        chi2_alt=kept(fused.chi2_alt),
        detections=common.detections,
        of_camera=common.of_camera,
        share=share,
        consistency=torch.stack([pose.between, pose.between_freedom.to(pose.between)], -1),
        odd=torch.where(pose.odd >= 0, numbers[pose.odd.clamp_min(0)], -1),
    )


def _copies(view: View, rows: Tensor) -> Tensor:
    own = view.row[rows]
    return torch.where(own >= 0, view.found.identified.copies[own.clamp_min(0)], 0)


def _owners(moments: Moments, rows: Tensor, fused: Fused, support: Tensor) -> Tensor:
    """Rows (J,) bool that keep their pose where others claim the same rings."""
    first, rings = 0, []
    for view in moments.views:
        own = view.found.identified.ring[view.row[rows].clamp_min(0)]
        rings.append(own.clamp_min(0) + first)
        first += len(view.found.rings)
    ring = torch.cat(rings, 1)
    return award((rows % moments.targets, moments.targets), support, fused.mask.flatten(1), ring, first)[0]


def _of_one(common: _Common, part: Alone) -> Poses:
    """Rows of one camera alone, in the axes of the first camera."""
    moments, view = common.moments, common.moments.views[part.view]
    own = view.row[part.rows]
    poses = part.poses[own]
    back = motion_in_view(moments.rig, view.camera).to(poses.t).mT
    R, t = moments.rig.from_camera(view.camera, poses.R, poses.t)
    R_alt, t_alt = moments.rig.from_camera(view.camera, poses.R_alt, poses.t_alt)
    by_place = -back @ motion_of_place(moments.rig, view.camera, poses.t)
    systematic = back @ poses.systematic
    lens, count = common.lens(part.view), common.lenses[part.view]
    numbers = systematic.new_zeros(len(own), POSE, common.of_camera)
    numbers[..., lens] = systematic[..., :count]
    numbers[..., common.of_camera - by_place.shape[-1] :] = by_place
    share = poses.t.new_zeros(len(own), len(moments.rig))
    share[:, view.camera] = poses.t.isfinite().all(1).to(share)
    return replace(
        poses,
        **common.frame_and_target(part.rows),
        R=R,
        t=t,
        covariance=back @ poses.covariance @ back.mT + by_place @ by_place.mT,
        noise=back @ poses.noise @ back.mT,
        systematic=torch.cat([numbers, systematic[..., count:]], -1),
        R_alt=R_alt,
        t_alt=t_alt,
        detections=common.detections,
        of_camera=common.of_camera,
        share=share,
        consistency=poses.t.new_zeros(len(own), 2),
        odd=torch.full_like(part.rows, -1),
    )


def _positive(covariance: Tensor) -> Tensor:
    return torch.linalg.cholesky_ex(covariance.nan_to_num(nan=-1.0))[1] == 0
