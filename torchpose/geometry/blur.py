"""Blur as a covariance: what it makes of an edge depends on the edge's direction.

Blurs are (..., 3): s11, s12, s22 of a symmetric 2 x 2 covariance S in px^2, point-spread function and pixel together.
Across an edge of the unit normal n the blur has the variance n' S n, along it t' S t.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.geometry.constants import constant

Blur = Float[Tensor, "*batch 3"]


def isotropic(sigma: Float[Tensor, "*batch"]) -> Blur:
    """The same in all directions: standard deviation, px."""
    variance = sigma.square()
    return torch.stack([variance, torch.zeros_like(variance), variance], -1)


def across(blur: Blur, nu: Tensor, nv: Tensor) -> Tensor:
    """Variance along the normal (nu, nv)."""
    s11, s12, s22 = blur.unbind(-1)
    return torch.addcmul(s11 * nu, s12, nv, value=2) * nu + s22 * nv * nv


def columns(nu: Tensor, nv: Tensor) -> Tensor:
    """Derivatives (..., 3) of `across` by the blur."""
    return torch.stack([nu * nu, 2 * nu * nv, nv * nv], -1)


def axes(blur: Blur) -> tuple[Tensor, Tensor]:
    """Variances along the minor and the major axis."""
    s11, s12, s22 = blur.unbind(-1)
    middle = torch.lerp(s11, s22, 0.5)
    reach = torch.hypot(s11 - middle, s12)
    return middle - reach, middle + reach


def limited(blur: Blur, low: float, high: float) -> Blur:
    """The nearest blur of the same axes whose variances along both lie within the limits."""
    s11, s12, s22 = blur.unbind(-1)
    middle = torch.lerp(s11, s22, 0.5)
    lean = s11 - middle
    reach = torch.hypot(lean, s12)
    least, most = (middle - reach).clamp(low, high), (middle + reach).clamp(low, high)
    share = 0.5 * (most - least) / reach.clamp_min(1e-12)
    middle, lean, s12 = torch.lerp(least, most, 0.5), lean * share, s12 * share
    return torch.stack([middle + lean, s12, middle - lean], -1)


def size(blur: Blur) -> Tensor:
    """Standard deviation of the round blur of the same area, px."""
    s11, s12, s22 = blur.unbind(-1)
    return (s11 * s22 - s12 * s12).clamp_min(0).pow(0.25)


def reduced(blur: Blur, factor: int) -> Blur:
    """The same in pixels of frames reduced by block means, whose pixel is wider."""
    return blur / factor**2 + pixel(blur, 1 - 1 / factor**2)


def enlarged(blur: Blur, factor: int) -> Blur:
    """The inverse of `reduced`."""
    return (blur - pixel(blur, 1 - 1 / factor**2)) * factor**2


def pixel(like: Tensor, share: float = 1.0) -> Float[Tensor, "3"]:
    """Covariance of the square pixel, or of a share of it: 1/12 along either axis."""
    return constant((share / 12, 0.0, share / 12), like)
