"""Where the edge in each window of pixels lies about a predicted curve: the matched filter of a blurred step.

Zernike moments need to know nothing of an edge; once its pose and blur are nearly known, the derivative of the blurred
step is the filter of least noise. Both grey levels are free in every window, so light may be as uneven as it likes: the
filter is made orthogonal to them.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry.blurred_edge import blurred_step, square_cumulant

WINDOW = 9  # px; a wider one tells the levels better, but small circles are no longer simple curves in it
# px along an edge: where the fourth order of an ellipse's end is 0.02 px, and at least (derived)
_BEND_REACH = (0.63, 1.2)


class StepOffsets(NamedTuple):
    """Fields (E,): error, px, of the edge outside the curve; widening, px^2, of the blur's variance across the edge
    beyond the one assumed; the information about both, px^-2 and px^-4, at a noise of one step; step, grey outside less
    inside."""

    error: Tensor
    widening: Tensor
    information: Tensor
    blur_information: Tensor
    step: Tensor


def step_offsets(
    frames: Tensor,
    frame: Tensor,
    pixel: Tensor,
    curve: tuple[Tensor, Tensor, Tensor],
    blur: Tensor,
    room: Tensor | None = None,
) -> StepOffsets:
    """Offsets of edges from curves that pass within about a pixel of a window's middle, to first order.

    Args:
        frames: (B, H, W) grey. frame: (E,) int64. pixel: (E, 2) int64 u, v of the window's middle; what of the window
            is beyond the border does not count.
        curve: normal, distance and bend as in `step_filters`. blur: as there.
        room: (E,) px, of the window's pixels to use to either side of the curve; all by default.
    """
    height, width = frames.shape[-2:]
    du, dv = _window(frames.device)
    u, v = pixel[:, :1] + du, pixel[:, 1:] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at = (frame[:, None] * height + v.clamp(0, height - 1)) * width + u.clamp(0, width - 1)
    if room is not None:
        across = curve[1][:, None] + curve[0][:, :1] * du + curve[0][:, 1:] * dv
        inside &= across.abs() < room[:, None]
    grey = frames.reshape(-1)[at].float()
    grey = grey - grey[:, WINDOW * WINDOW // 2, None]  # keeps float32 exact to rounding
    fraction, slope, widen = step_filters(*curve, blur, inside)
    step = (fraction * grey).sum(-1) / fraction.square().sum(-1)
    information, blur_information = slope.square().sum(-1), widen.square().sum(-1)
    error = -(slope * grey).sum(-1) / (step * information)
    widening = (widen * grey).sum(-1) / (step * blur_information)
    return StepOffsets(*(x.double() for x in (error, widening, information, blur_information, step)))


def step_filters(
    normal: Tensor, distance: Tensor, bend: Tensor, blur: Tensor, inside: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Fraction of the outside in the pixels of windows, row by row, and what tells an edge's position and blur from it.

    Args:
        normal: (E, 2) unit, of the curve. distance: (E,) px, of the middle pixel's centre from it, along the normal.
        bend: (E,) 1/px, its curvature, positive where it bends away from the normal. blur: (E, 3)
            px^2, see `geometry.blur`. inside: (E, P) bool, pixels to use.

    Returns:
        fraction (E, P) float32 less its mean; its derivatives (E, P) by the pixel's distance and by the blur's variance
        across the edge, made orthogonal to a constant and to the fraction.
    """
    du, dv = _window(normal.device)
    nu, nv, k = (x[:, None].float() for x in (*normal.unbind(-1), bend))
    variance = blurs.across(blur, *normal.unbind(-1))[:, None].float()
    beside = (blur[:, 0] + blur[:, 2])[:, None].float() - variance  # along the edge
    q = variance.sqrt()
    across = distance[:, None].float() + nu * du + nv * dv
    along2 = (nu * dv - nv * du).square()
    # from the circle of curvature
    off = (2 * across + k * (across.square() + along2)) / (1 + ((1 + k * across).square() + k.square() * along2).sqrt())
    z = (off + 0.5 * k * beside) / q
    fraction, density = blurred_step(z, square_cumulant(nu * nv, variance))
    reach, least = _BEND_REACH
    use = along2 < (reach * k.abs().clamp_min(1e-6).pow(-0.75)).clamp_min(least).square()
    weight = (use if inside is None else use & inside).float()
    count = weight.sum(-1, keepdim=True)

    def centred(plane: Tensor) -> Tensor:
        return weight * (plane - (weight * plane).sum(-1, keepdim=True) / count)

    fraction = centred(fraction)
    scale = fraction.square().sum(-1, keepdim=True)
    slope, widen = (centred(x) for x in (density / q, density * z * (-0.5 / variance)))
    slope, widen = (x - fraction * ((fraction * x).sum(-1, keepdim=True) / scale) for x in (slope, widen))
    return fraction, slope, widen


@lru_cache(maxsize=1)
def window_correlation() -> float:
    """How many windows along an edge tell as much as one alone, for they share their pixels.

    Chains of edge pixels on long straight edges at all angles, blur 0.75 px: the sum over pixels of the squared sum of
    the filters there, over the sum of their squares.
    """
    length, size = 400, 420
    du, dv = _window(torch.device("cpu"))
    factors = []
    for angle in torch.linspace(0, math.pi / 4, 19, dtype=torch.float64):
        u = torch.arange(length, dtype=torch.float64)
        v = u * angle.tan() + 10
        pixel = torch.stack([u + 10, v.round()], -1)
        normal = torch.stack([-angle.sin(), angle.cos()]).expand(length, 2)
        distance = (v.round() - v) * angle.cos()
        slope = step_filters(normal, distance, torch.zeros_like(u), blurs.isotropic(torch.full_like(u, 0.75)))[
            1
        ].double()
        at = (pixel[:, 1:].long() + dv) * size + pixel[:, :1].long() + du
        total = torch.zeros(size * size, dtype=torch.float64).index_add_(0, at.flatten(), slope.flatten())
        factors.append(total.square().sum() / slope.square().sum())
    return float(torch.stack(factors).mean())


def _window(device: torch.device) -> tuple[Tensor, Tensor]:
    """Offsets (P,) int64 of the pixels of a window, row by row."""
    d = torch.arange(-(WINDOW // 2), WINDOW // 2 + 1, device=device)
    return d.repeat(WINDOW), d.repeat_interleave(WINDOW)
