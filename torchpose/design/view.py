"""Which rings of a target a camera has in its frame, and which of them count."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.analysis.sensitivity import around, marker_axes
from torchpose.camera import Camera
from torchpose.design.layout import Limits
from torchpose.geometry.projection import image_by_point
from torchpose.target import Target

FRAME_MARGIN_PX = 10.0  # between rings and the border of the frame
RIM_POINTS = 48  # of a circle
_OUTLINE = 12  # of them


def rims(target: Target) -> Float[Tensor, "circles samples 3"]:
    """Points on the outer and inner circle of every marker, in turn, mm."""
    circle = target.printed_radii[..., None, None] * around(target, RIM_POINTS)[0][:, None]
    return (target.centers[:, None, None] + circle).flatten(0, 1)


def outlines(target: Target) -> Float[Tensor, "points 3"]:
    """Points on the outer circles of a target, 12 each, mm."""
    return rims(target)[::2, :: RIM_POINTS // _OUTLINE].flatten(0, 1)


def points_in_view(camera: Camera, points: Tensor, R: Tensor, t: Tensor, margin: float) -> Bool[Tensor, "B P"]:
    """Which of some points (P, 3) of the target lie ``margin`` px inside the frame at poses (B, 3, 3), (B, 3)."""
    seen = points @ R.mT + t[:, None]
    pixel = camera.project(seen)
    last = t.new_tensor([camera.width - 1, camera.height - 1]) - margin
    inside = ((pixel >= margin) & (pixel <= last)).all(-1)
    return inside & ((seen[..., :2] / seen[..., 2:]).norm(dim=-1) < camera.fold_radius) & (seen[..., 2] > 0)


def in_view(camera: Camera, points: Tensor, R: Tensor, t: Tensor, margin: float) -> bool:
    """Whether all points (P, 3) of the target lie ``margin`` px inside the frame at all poses (B, 3, 3), (B, 3)."""
    return bool(points_in_view(camera, points, R, t, margin).all())


def rings_that_count(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Bool[Tensor, "B M"]:
    """Rings that a further camera has at poses (B, 3, 3), (B, 3): whole in its frame, from their printed side, and as
    large as the stages ask for (`Limits.outer`)."""
    whole = points_in_view(camera, outlines(target), R, t, FRAME_MARGIN_PX).unflatten(-1, (len(target), -1)).all(-1)
    at = target.centers @ R.mT + t[:, None]
    axes = R[:, None] @ marker_axes(target).mT  # two directions in the plane of each ring, and its normal
    xy = at[..., :2] / at[..., 2:]
    by_place = camera.J_distort(xy) @ image_by_point(xy, at[..., 2]) @ axes[..., :2]
    semi_minor = torch.linalg.svdvals(torch.where(whole[..., None, None], by_place, 0.0))[..., -1] * target.radii[:, 0]
    return whole & ((axes[..., 2] * at).sum(-1) > 0) & (semi_minor >= Limits.of(camera, 1.0).outer)
