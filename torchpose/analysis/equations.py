"""Equations (1) to (6) of the paper, section II-B: one distance seen face on by a pinhole camera.

Lengths in mm, image lengths in px, the pixel pitch mu in mm. Numbers or tensors that broadcast. What leaves this
model (tilt, perspective, distortion, every marker at once) is `torchpose.analysis.propagate`.
"""

from typing import Any

from torch import Tensor

Number = float | Tensor


def distance(l0: Number, f: Number, n: Number, mu: Number) -> Any:
    """Eq. (1): d = l0 f / (n mu), the working distance at which the length ``l0`` is ``n`` px long, mm."""
    return l0 * f / (n * mu)


def depth_per_pixel(l0: Number, f: Number, d: Number, mu: Number) -> Any:
    """Eq. (2): dd/dn = -l0 f / (mu n^2) = -mu d^2 / (l0 f), mm per px: the depth falls as the image grows."""
    return -mu * d * d / (l0 * f)


def lateral_per_pixel(f: Number, d: Number, mu: Number) -> Any:
    """Eq. (3): dl0/dn = d mu / f, mm per px: the footprint of one pixel, across the optical axis."""
    return d * mu / f


def true_distance(l0: Number, f_true: Number, n: Number, mu: Number) -> Any:
    """Eq. (4): d_true = l0 f_true / (n mu), eq. (1) with the focal length that the lens has, mm."""
    return distance(l0, f_true, n, mu)


def depth_focal_error(d_true: Number, f: Number, f_true: Number) -> Any:
    """Eq. (5): d_true - d = d_true (f_true - f) / f_true, mm, where d is what eq. (1) gives with ``f``."""
    return d_true * (f_true - f) / f_true


def lateral_focal_error(d_true: Number, dn: Number, f: Number, f_true: Number, mu: Number) -> Any:
    """Eq. (6), its middle: (d_true / f_true - d_true / f) mu dn = -d_true mu dn (f_true - f) / (f f_true), mm.

    By how much the wrong focal length changes the length that ``dn`` px stand for, the distance d_true being known.
    The paper's right side lacks the minus sign; docs/sensitivity.md has when the term can be neglected.
    """
    return (d_true / f_true - d_true / f) * mu * dn
