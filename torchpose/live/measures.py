"""What someone who aims, focuses and lights a rig has to turn: blur, levels, clipping, size and tilt of what was found.

The blur of a ring is read from the profile of grey values across its outer edge. Of a step that goes from 0 to 1 as F,
the area under min(F, 1 - F) is sigma sqrt(2 / pi) for a Gaussian of the standard deviation sigma: an integral, so noise
averages out of it, and the place of the edge cancels. Where a blur is wide for its ring the profile ends before it is
flat; a table of the same area under cut-off Gaussian steps undoes that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from numpy.typing import NDArray
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked
from torchpose.geometry.grey import full_scale
from torchpose.geometry.least_squares import solve_scaled
from torchpose.results import Detections, Poses

_STEPS = 49  # of the profile across an edge
_EIGHTHS, _OF_EIGHTH = 8, 12  # directions: parts of the perimeter with a blur of their own, and samples in each
_SHARE_OF_RING = 0.45  # of its width, that the profile reaches on either side: the inner edge stays outside
_REACH = (2.0, 20.0)  # px, least and most of it
_OF_BLUR = 5.0  # standard deviations that it needs: at either end an eighth of it is flat then
_END = 6  # steps at either end of the profile that tell the levels: an eighth of it
_BILINEAR = 1 / 6  # px^2, mean variance that interpolation between two pixels adds: of f (1 - f) over f (derived)
_PIXEL = 1 / 12  # px^2, of the pixel's own width
_LEAST_STEP = 0.5  # of the usual one, below which a direction is covered
_AROUND = 1.25  # of the outer ellipse: the part of the picture whose clipping concerns the pose
_RADII, _ANGLES = 24, 64  # samples there
_NOISE_SIDE = 512  # px, of the patch in which the noise is measured
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # Immerkaer 1996: blind to planes
_MEDIAN_OF_NORMAL = 0.6745  # of |x|, standard deviations
CLIPPED_SOME = 0.002  # share of the pixels around a ring (convention), beyond single hot ones
_LOOKED_AT = 640  # px, longer side of the reduced picture in which the sharpest edges are sought
_NEIGHBOURHOOD = 9  # px there: steps are taken across it
_STRONG = 0.5  # of the largest step: those that count


@dataclass(frozen=True)
class RingMeasures:
    """Of one marker: blur (standard deviation without the pixel's own, px) as a round one and along its two axes, grey
    levels of both sides as shares of full scale, share of clipped pixels, diameters in px."""

    marker: int
    blur: float | None
    blur_axes: tuple[float, float] | None
    dark: float | None
    light: float | None
    clipped: float
    outer_px: float
    inner_px: float | None


@dataclass(frozen=True)
class PictureMeasures:
    """Of the whole frame: shares of pixels at full scale and at zero, grey levels below which 1 and 99 of 100 pixels
    lie and noise as shares of full scale, and the blur of its sharpest edges, px, coarse: from a picture that was
    reduced ``scale`` times."""

    clipped: float
    black: float
    low: float
    high: float
    noise: float
    blur: float | None
    scale: int


@dataclass(frozen=True)
class EdgeProfiles:
    """Of K rings: blurs (K, 3) px^2 without the pixel's own, levels inside and outside the outer edge."""

    blur: Float[Tensor, "K 3"]
    inside: Float[Tensor, " K"]
    outside: Float[Tensor, " K"]


def white_of(image: NDArray[np.integer]) -> float:
    """Grey value at which a frame is clipped, by its brightest pixel, or that of its type."""
    if image.dtype == np.uint8:
        return 255.0
    limit = float(full_scale(torch.tensor(float(image.max()))))
    return limit if math.isfinite(limit) else 65535.0


@checked
def edge_profiles(
    frame: Shaped[Tensor, "H W"], outer: Float[Tensor, "K 5"], inner: Float[Tensor, "K 5"]
) -> EdgeProfiles:
    """Blur and levels of K rings from the grey values across their outer edges.

    Args:
        frame: uint8, uint16 or floating point.
        outer: ellipses, see `torchpose.ellipse.fit`.
        inner: the same, NaN for discs.
    """
    width = torch.where(inner[:, 3].isfinite(), outer[:, 3] - inner[:, 3], outer[:, 3])
    widest = (_SHARE_OF_RING * width).clamp(*_REACH)
    first = _profiles_within(frame, outer, widest)
    # again with steps that suit the blur: wide ones cut the corner of the profile off
    about = _OF_BLUR * (blurs.size(first.blur).square() + _BILINEAR + _PIXEL).sqrt()
    return _profiles_within(frame, outer, torch.where(about.isfinite(), about.clamp_min(_REACH[0]), widest).min(widest))


def _profiles_within(frame: Tensor, outer: Tensor, reach: Tensor) -> EdgeProfiles:
    """The same from profiles that reach (K,) px on either side of the edge."""
    count = _EIGHTHS * _OF_EIGHTH
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (2 * math.pi / count)
    circle = torch.stack([angle.cos(), angle.sin()])
    shape = conics.shape_matrix(outer)
    normal = torch.linalg.inv(shape).mT @ circle  # (K, 2, A)
    normal = normal / torch.linalg.vector_norm(normal, dim=1, keepdim=True)
    offset = torch.linspace(-1, 1, _STEPS, dtype=torch.float64) * reach[:, None]  # (K, S)
    at = (outer[:, :2, None] + shape @ circle)[..., None] + normal[..., None] * offset[:, None, None]
    profile = _bilinear(frame, at[:, 0], at[:, 1])  # (K, A, S)
    low, high = profile[..., :_END].mean(-1), profile[..., -_END:].mean(-1)
    step = high - low
    usual = step.nanmedian(-1, keepdim=True).values
    seen = step * usual.sign() > _LEAST_STEP * usual.abs()
    variance = _variance(profile, seen, reach)  # (K, 8)
    middle = angle.view(_EIGHTHS, _OF_EIGHTH).mean(1)
    across = torch.linalg.inv(shape).mT @ torch.stack([middle.cos(), middle.sin()])
    across = across / torch.linalg.vector_norm(across, dim=1, keepdim=True)
    known = variance.isfinite()
    rows = blurs.columns(*across.unbind(1)).mT * known[:, None]  # (K, 3, 8)
    found = solve_scaled(rows @ rows.mT, (rows @ torch.where(known, variance, 0.0)[..., None])[..., 0])
    found = torch.where((known.sum(1) >= 3)[:, None], found, torch.nan)
    levels = [torch.where(seen, side, torch.nan).nanmean(-1) for side in (low, high)]
    return EdgeProfiles(found, *levels)


def _bilinear(frame: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Grey values at points, float64; NaN outside of the frame."""
    height, width = frame.shape
    left, top = u.floor(), v.floor()
    inside = (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
    x, y = (u - left), (v - top)
    cell = (torch.where(inside, top, 0) * width + torch.where(inside, left, 0)).long()
    flat = frame.reshape(-1)
    four = [flat[cell + step].double() for step in (0, 1, width, width + 1)]
    upper, lower = four[0] + x * (four[1] - four[0]), four[2] + x * (four[3] - four[2])
    return torch.where(inside, upper + y * (lower - upper), torch.nan)


def _variance(profile: Tensor, seen: Tensor, reach: Tensor) -> Tensor:
    """Variances (K, 8) across the edge, px^2, of profiles (K, A, S); NaN where an eighth is not seen."""
    weight = seen & profile.isfinite().all(-1)
    parts = torch.where(weight[..., None], profile, 0.0).unflatten(1, (_EIGHTHS, _OF_EIGHTH)).sum(2)
    mean = parts / weight.unflatten(1, (_EIGHTHS, _OF_EIGHTH)).sum(2)[..., None]  # 0 / 0 is NaN
    return (_widths(mean) * reach[:, None]).square() - _BILINEAR - _PIXEL


def _widths(profile: Tensor) -> Tensor:
    """Standard deviations (...) of blurred steps (..., S), in reaches of their profiles."""
    area = _areas(profile)
    table, deviations = _truncated()
    place = torch.searchsorted(table, area.contiguous()).clamp(1, len(table) - 1)
    share = ((area - table[place - 1]) / (table[place] - table[place - 1])).clamp(0, 1)
    return deviations[place - 1] + share * (deviations[place] - deviations[place - 1])


def _areas(profile: Tensor) -> Tensor:
    """Areas under min(F, 1 - F), in reaches, the levels taken from both ends."""
    low, high = (side.mean(-1, keepdim=True) for side in (profile[..., :_END], profile[..., -_END:]))
    rise = ((profile - low) / (high - low)).clamp(0, 1)
    return torch.minimum(rise, 1 - rise).sum(-1) * (2 / (_STEPS - 1))


@cache
def _truncated() -> tuple[Tensor, Tensor]:
    """Areas of Gaussian steps by deviation: less than sqrt(2 / pi) sigma where the ends are not flat."""
    deviations = torch.linspace(0.01, 1.5, 300, dtype=torch.float64)
    offset = torch.linspace(-1, 1, _STEPS, dtype=torch.float64)
    return _areas(0.5 * torch.erf(offset / (math.sqrt(2) * deviations[:, None]))), deviations


@checked
def ring_measures(frame: Shaped[Tensor, "H W"], found: Detections, white: float) -> list[RingMeasures]:
    """Of each marker found in a frame, by its id.

    Args:
        frame: (H, W).
        found: those of this frame.
        white: full scale of the grey values.
    """
    if len(found) == 0:
        return []
    edges = edge_profiles(frame, found.outer, found.inner)
    least, most = (axis.clamp_min(0).sqrt() for axis in blurs.axes(edges.blur))
    round_ = (0.5 * (edges.blur[:, 0] + edges.blur[:, 2])).clamp_min(0).sqrt()
    levels = torch.stack([edges.inside, edges.outside], 1) / white
    clipped = _clipped_around(frame, found.outer, white)
    columns = (found.marker, round_, least, most, levels.amin(1), levels.amax(1), clipped)
    numbers = zip(*(column.tolist() for column in columns), strict=True)
    sizes = zip((2 * found.outer[:, 2]).tolist(), (2 * found.inner[:, 2]).tolist(), strict=True)
    rings = [
        RingMeasures(
            *(marker, _known(blur), None if math.isnan(blur) else (low, high), _known(dark), _known(light), clip),
            *(size[0], _known(size[1])),
        )
        for (marker, blur, low, high, dark, light, clip), size in zip(numbers, sizes, strict=True)
    ]
    return sorted(rings, key=lambda ring: ring.marker)


def usable_blurs(rings: Sequence[RingMeasures]) -> list[float]:
    """Blurs of rings whose light side is not clipped, which makes edges look steeper than they are."""
    return [ring.blur for ring in rings if ring.blur is not None and ring.clipped <= CLIPPED_SOME]


def _clipped_around(frame: Tensor, outer: Tensor, white: float) -> Tensor:
    """Shares (K,) of pixels in and around rings that are at full scale."""
    radius = torch.linspace(0, 1, _RADII + 1, dtype=torch.float64)[1:].sqrt() * _AROUND  # equal areas
    angle = torch.arange(_ANGLES, dtype=torch.float64) * (2 * math.pi / _ANGLES)
    disc = (radius[:, None] * torch.stack([angle.cos(), angle.sin()])[:, None]).flatten(1)
    at = (outer[:, :2, None] + conics.shape_matrix(outer) @ disc).round().long()
    height, width = frame.shape
    u, v = at[:, 0].clamp(0, width - 1), at[:, 1].clamp(0, height - 1)
    return (frame[v, u].double() >= white).double().mean(1)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def picture_measures(image: NDArray[np.integer], white: float) -> PictureMeasures:
    """Of a frame (H, W), uint8 or uint16."""
    clipped = np.count_nonzero(image >= int(white)) / image.size
    black = 1 - cv2.countNonZero(image) / image.size
    scale = max(1, max(image.shape) // _LOOKED_AT)
    small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(small, (1, 99)) / white
    levels, noise = (float(low), float(high)), _noise(image) / white
    return PictureMeasures(clipped, black, *levels, noise, _sharpest(small, scale), scale)


def _noise(image: NDArray[np.integer]) -> float:
    """Standard deviation of the noise, grey levels, in the middle of a frame; edges are the fewer pixels there."""
    height, width = image.shape
    top, left = max(0, (height - _NOISE_SIDE) // 2), max(0, (width - _NOISE_SIDE) // 2)
    patch = image[top : top + _NOISE_SIDE, left : left + _NOISE_SIDE].astype(np.float32)
    # the kernel's sum of squares is 36
    return float(np.median(np.abs(cv2.filter2D(patch, -1, _NOISE_KERNEL)))) / (6 * _MEDIAN_OF_NORMAL)


def _sharpest(small: NDArray[np.float32], scale: int) -> float | None:
    """Blur of the strongest steps of a picture that was reduced ``scale`` times, px of the full one.

    A blurred step h has the slope h / (sqrt(2 pi) sigma). Where a blur is wider than the neighbourhood, only part of
    the step is in it, and the result is too small, though wide.
    """
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    box = np.ones((_NEIGHBOURHOOD, _NEIGHBOURHOOD), np.uint8)
    step = cv2.dilate(smooth, box) - cv2.erode(smooth, box)
    slope = np.hypot(cv2.Sobel(smooth, -1, 1, 0, scale=1 / 8), cv2.Sobel(smooth, -1, 0, 1, scale=1 / 8))
    steepest = cv2.dilate(slope, box)
    strong = step > _STRONG * float(step.max())
    if float(step.max()) <= 0 or not strong.any():
        return None
    sigma = np.median(step[strong] / np.maximum(steepest[strong], 1e-6)) / math.sqrt(2 * math.pi)
    return scale * math.sqrt(max(float(sigma) ** 2 - 1.0, 0.0))


def tilt_deg(poses: Poses) -> float | None:
    """Angle between the target's normal and the line of sight to it, of one row; None where there is no pose."""
    R, t = poses.R[0], poses.t[0]
    if not bool(t.isfinite().all()):
        return None
    cosine = float((R[:, 2] @ t).abs() / t.norm())
    return math.degrees(math.acos(min(1.0, cosine)))
