"""Which tone of the frames the sizes of circles tell.

Taken for linear, frames that are not move every edge towards its dark side by about the same number of pixels, near or
far. The printer's dot gain moves it by so many mm, and more px the larger a mark is seen. So sizes of marks in px,

    outer = (r_outer + gain) m + s,    inner = (r_inner - gain) m - s,

m the px of a mm at the mark by the pose, tell the displacement s apart from the gain where marks are seen in different
sizes: by tilt and by distance. The right tone leaves none. Centres, and poses with them, hardly depend on the tone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import LINEAR, Camera, Tone
from torchpose.geometry.least_squares import geman_mcclure
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.rows import Rows
from torchpose.pipeline import Method, PoseEstimator
from torchpose.results import Status
from torchpose.target import Target

TONES = (LINEAR, Tone("srgb"), *(Tone("gamma", g) for g in (1.4, 1.8, 2.2, 2.6)))
_SURE = 4.0  # standard deviations of the displacement: once in 16,000
_MATTERS = 0.02  # px: less than this blur and curvature leave in the sizes of small rings
_LIKE_SRGB = (2.0, 2.4)  # of a gamma
_LEAST_MARKS = 24
_SCALES = (0.3, 0.1, 0.05)  # px, of the weights: covers and strays differ by more
_LEAST_SPREAD = 1e-3  # relative, of the sizes seen: below it nothing tells gain and displacement apart


@dataclass(frozen=True, eq=False)
class Sizes(Rows):
    """Sizes of K marks, root of the product of the semi-axes.

    Attributes:
        scale: px of a mm there.
        outer: px.
        inner: px, NaN of a disc.
        radii: mm as the file has them, without the gain.
    """

    scale: Float[Tensor, " K"]
    outer: Float[Tensor, " K"]
    inner: Float[Tensor, " K"]
    radii: Float[Tensor, "K 2"]


@dataclass(frozen=True)
class Shift:
    """Displacement of edges outwards, the same in px for all marks."""

    px: float
    sigma: float

    @property
    def none(self) -> bool:
        return abs(self.px) < max(_SURE * self.sigma, _MATTERS)


def judge_tone(measure: Callable[[Tone], Sizes]) -> tuple[Tone | None, Shift | None]:
    """The tone that leaves no displacement of edges, and the displacement that linear frames would have.

    Linear where that is none. None where too few marks are seen, or all in the same size.

    Args:
        measure: sizes of the marks in frames taken to be of a tone.
    """
    linear = edge_shift(measure(LINEAR))
    if linear is None or linear.none:
        return (None if linear is None else LINEAR), linear
    found = [(tone, shift) for tone in TONES[1:] if (shift := edge_shift(measure(tone))) is not None]
    powers = [(1.0, linear.px), *((tone.gamma, shift.px) for tone, shift in found if tone.kind == "gamma")]
    for (low, before), (high, after) in pairwise(powers):
        gamma = low + (high - low) * before / (before - after) if before * after <= 0 and before != after else 0.0
        # what sRGB and 2.2 differ by is little: one of these two where it is either
        if gamma and not _LIKE_SRGB[0] < gamma < _LIKE_SRGB[1]:
            return Tone("gamma", round(gamma, 2)), linear
    best = min(found, key=lambda one: abs(one[1].px), default=None)
    return (LINEAR if best is None or abs(best[1].px) > abs(linear.px) else best[0]), linear


def edge_shift(sizes: Sizes) -> Shift | None:
    """Robust least squares of displacement and gain; None where too few sizes tell."""
    row = torch.cat([torch.stack([s * sizes.scale, torch.full_like(sizes.scale, s)], -1) for s in (1.0, -1.0)])
    right = torch.cat([sizes.outer, sizes.inner]) - (sizes.scale[:, None] * sizes.radii).mT.flatten()
    known = right.isfinite() & row.isfinite().all(-1)
    row, right = row[known], right[known]
    spread = float(sizes.scale.std() / sizes.scale.mean()) if len(sizes) > 1 else 0.0
    if len(right) < _LEAST_MARKS or not spread > _LEAST_SPREAD:
        return None
    weight = torch.ones_like(right)
    # the first fit by medians: gain and displacement of half the marks may be strays'
    residual = right - right.median() * row[:, 1]
    for scale in (*_SCALES, *_SCALES[-1:]):
        weighted = row * weight[:, None]
        inverse = torch.linalg.inv(weighted.mT @ row)
        found = inverse @ (weighted.mT @ right)
        residual = right - row @ found
        weight = geman_mcclure(residual / (scale + 2 * float(residual.abs().median())))
    noise = float((weight * residual.square()).sum() / weight.sum())
    return Shift(float(found[1]), (noise * float(inverse[1, 1])) ** 0.5)


def scale_at(camera: Camera, R: Tensor, points: Tensor) -> Tensor:
    """px of a mm (K,), over all directions in planes z = 0 turned by R (K, 3, 3), at points (K, 3) in the camera."""
    xy = points[:, :2] / points[:, 2:]
    return (camera.J_distort(xy) @ image_by_point(xy, points[:, 2]) @ R[..., :2]).det().abs().sqrt()


def sizes_of_target(frames: Tensor, camera: Camera, target: Target) -> Sizes:
    """Sizes of the rings of a target in frames of a tone that the camera does not say any more."""
    method: Method = "centers" if target.discs else "edges"
    poses = PoseEstimator(camera, target.upright(), method=method)(frames)
    found = poses.detections
    found = found[(poses.status == Status.OK)[found.frame]]
    marker = (found.marker[:, None] == target.ids).long().argmax(1)
    R, t = poses.R[found.frame], poses.t[found.frame]
    at = (R @ target.centers[marker][..., None])[..., 0] + t
    outer, inner = (e[:, 2:4].prod(-1).sqrt() for e in (found.outer, found.inner))
    return Sizes(scale_at(camera, R, at), outer, inner, target.radii[marker])
