"""Nodes and weights of Gauss rules: averages over a line, and over a disc by its chords."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def gauss_legendre(order: int, like: Tensor) -> tuple[Float[Tensor, " order"], Float[Tensor, " order"]]:
    """Nodes and weights (order,) on [0, 1] (Golub and Welsch 1969)."""
    k = torch.arange(1, order, dtype=like.dtype, device=like.device)
    off = k / (4 * k * k - 1).sqrt()
    node, vector = torch.linalg.eigh(off.diag(1) + off.diag(-1))
    return (node + 1) / 2, vector[0].square()


def disc_chords(order: int, like: Tensor) -> tuple[Float[Tensor, " order"], Float[Tensor, " order"]]:
    """Places on [-1, 1] and weights of the chords of a unit disc: Gauss-Chebyshev of the second kind.

    Its weight is the chord's length: exact for polynomials up to degree 2 order - 1 in the place.
    """
    angle = torch.arange(1, order + 1, dtype=like.dtype, device=like.device) * (math.pi / (order + 1))
    return angle.cos(), angle.sin().square() * (2 / (order + 1))
