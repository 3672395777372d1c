"""Whether cameras are where the rig has them: what the rows of a call leave possible, together.

Contradictions that are no more than chance allows may yet be a camera that was knocked; a pose that averages over it is
wrong by more than the contradiction shows. A camera that is off is so at all moments: what their pictures say of its
place adds up, with lenses and target as numbers that all rows share. The camera may be turned, or off in all six
numbers (by as much as shifts its picture alike), or every camera may be, by an amount that nobody knows: all that is
averaged over by its likelihood, with the rig as its file says being as likely beforehand as all of that. What remains
possible is counted in the covariance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchpose.geometry.least_squares import LEAST_DIRECTION, solve_scaled
from torchpose.moments.joint import JointPose
from torchpose.pose.systematic import POSE

# deviations of what the pictures tell best, by which a camera may be off: from none that would show to what nobody
# would call a calibration (convention)
_OFF, _GRID = (-1.0, 3.0), 24


def widened(pose: JointPose, counted: Bool[Tensor, " J"]) -> JointPose:
    """The poses with the covariance that cameras beside their places leave possible.

    Args:
        pose: of all rows.
        counted: rows that tell of the cameras' places.
    """
    counted = counted & (pose.told.isfinite().all(-1) & pose.pull.isfinite()).all(-1)
    if not bool(counted.any()):
        return pose
    information, right = _of_places(pose, counted)
    alike = torch.linalg.vector_norm(pose.t[counted], dim=-1).mean()
    unit = torch.cat([alike.new_ones(3), alike.expand(3)]).repeat(len(right) // POSE)  # as a turn by 1 rad
    by_place = pose.by_place * unit
    moment = _second_moment(information * unit[:, None] * unit, right * unit)
    return replace(pose, covariance=pose.covariance + by_place @ moment @ by_place.mT)


def _of_places(pose: JointPose, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Information (P, P) about the places, and its right side (P,), of all rows that count."""
    information, right = pose.told[counted].sum(0), pose.pull[counted].sum(0)
    k = len(right) - pose.by_place.shape[-1]
    shared = information[:k, :k] + torch.eye(k, dtype=right.dtype, device=right.device)
    both = torch.cat([information[:k, k:], right[:k, None]], -1)
    taken = information[k:, :k] @ solve_scaled(shared[None], both[None])[0]
    return information[k:, k:] - taken[:, :-1], right[k:] - taken[:, -1]


def _second_moment(information: Tensor, right: Tensor) -> Tensor:
    """Mean square (P, P) of how far the cameras are off, over all that may be."""
    size = len(right)
    cameras = torch.eye(size // POSE, dtype=right.dtype, device=right.device)
    turned = torch.nn.functional.pad(right.new_ones(2), (0, POSE - 2))  # about the axes across the line of sight
    which = torch.cat([torch.kron(cameras, turned[None]), cameras.repeat_interleave(POSE, 1), right.new_ones(1, size)])
    likelihood, moment = zip(*(_if_off(information, right, some > 0) for some in which), strict=True)
    every = torch.stack(likelihood)
    # as likely beforehand as none of it
    none = every.new_full((1,), math.log(every.numel()))
    weight = torch.softmax(torch.cat([none, every.flatten()]), 0)[1:].view_as(every)
    return (weight[..., None, None] * torch.stack(moment)).sum((0, 1))


def _if_off(information: Tensor, right: Tensor, some: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithm (G,) of how much likelier some (P,) of the numbers are off with G variances than not at all, and
    their mean squares (G, P, P) then."""
    index = some.nonzero()[:, 0]
    information, right = information[index][:, index], right[index]
    values, vectors = torch.linalg.eigh(0.5 * (information + information.mT))
    # what is left of sums that were taken off each other has half of their digits
    there = values > LEAST_DIRECTION**0.5 * values[-1].clamp_min(torch.finfo(values.dtype).tiny)
    known, values = values[-1], torch.where(there, values, 0.0)
    every = torch.zeros(_GRID, len(some), len(some), dtype=right.dtype, device=right.device)
    if not bool(known > 0):
        return right.new_full((_GRID,), -torch.inf), every
    variance = torch.logspace(*_OFF, _GRID, dtype=right.dtype, device=right.device)[:, None].square() / known
    along = torch.where(there, vectors.mT @ right, 0.0)
    # the right side along a direction has the variance l + v l^2
    spread = 1 + variance * values
    left = variance / spread
    likelihood = 0.5 * (along.square() * left - spread.log()).sum(-1)
    mean = left * along
    every[:, index[:, None], index] = vectors @ (torch.diag_embed(left) + mean[:, :, None] * mean[:, None]) @ vectors.mT
    return likelihood, every
