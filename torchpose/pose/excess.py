"""What residuals show that noise and the stated uncertainties do not explain, and what may be behind it.

Of every row three explanations are weighed by their evidence (the likelihood, averaged over how large each may be):

- the print: places of markers, and an edge gain, that are off by amounts of their own;
- the camera: its focal length, principal point and radial distortion are off;
- all else: whatever it is, it makes the scatter larger by one factor (Birge 1932).

The likeliest becomes part of the row's problem with the variance that it has on average over what remains possible: a
few residuals tell a variance to a factor only, and the mean counts that, as Student's t does.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.least_squares import LEAST_DIRECTION
from torchpose.geometry.robust import of_chance
from torchpose.geometry.rows import Rows

CAMERA = 4  # numbers of a camera that may be off: focal length, principal point (2), radial distortion
# how large each may be, from below any noise: mm, places and edges of an office print (50 to 100 um);
# px at the corner of the frame, of a camera file that is a mistake beyond; of variances, as a factor
_PRINT, _CAMERA, _SCALE = (1e-4, 0.15), (1e-3, 3.0), (1.0, 1e3)
_GRID = 16  # values of each, logarithmic: the closest are a factor of 1.5 apart, which a few residuals do not tell


@dataclass(frozen=True, eq=False)
class Excess(Rows):
    """What N rows show beyond noise and stated uncertainties.

    Attributes:
        deviation: standard deviations of the further unknowns: places (3 by marker, mm), gain (mm), camera (px); 0
            where they need not be off.
        factor: of the variance of all noise, 1 where it suffices.
        misfit: `Misfit`, what is behind it.
        explained: whether the residuals then agree with all that.
    """

    deviation: Float[Tensor, "N E"]
    factor: Float[Tensor, " N"]
    misfit: Int[Tensor, " N"]
    explained: Bool[Tensor, " N"]


class _Modes(NamedTuple):
    """Residuals (N, r) as independent numbers of unit variance, of which ``there`` (N, r) exist.

    by: (N, r, E), by the further unknowns.
    """

    residual: Tensor
    by: Tensor
    there: Tensor


class _Family(NamedTuple):
    """One explanation: its log evidence (N,), deviations (N, E), factor (N,), and chi-squared (N,) under it."""

    evidence: Tensor
    deviation: Tensor
    factor: Tensor
    chi2: Tensor


def excess_of(information: Float[Tensor, "N E E"], right: Float[Tensor, "N E"]) -> Excess:
    """What speaks from the information about the further unknowns, and their right side, all else being unknown."""
    modes = _modes(information, right)
    chi2, freedom = modes.residual.square().sum(-1), modes.there.sum(-1).clamp_min(1)
    most = freedom * of_chance(freedom)
    explained = chi2 < most
    none = Excess(torch.zeros_like(right), torch.ones_like(chi2), torch.zeros_like(freedom), explained)
    row = (~explained).nonzero()[:, 0]
    if row.numel() == 0:
        return none
    some = _Modes(*(x[row] for x in modes))
    families = (_print(some), _camera(some), _scatter(some))  # in the order of `Misfit`
    best = torch.stack([f.evidence for f in families], -1).argmax(-1)
    at = torch.arange(len(row), device=row.device)
    deviation, factor, chi2 = (torch.stack([f[k] for f in families], 1)[at, best] for k in (1, 2, 3))
    return none.replaced(row, Excess(deviation, factor, best + 1, chi2 < most[row]))


def _modes(information: Tensor, right: Tensor) -> _Modes:
    finite = (information.isfinite().all(-1) & right.isfinite()).all(-1, keepdim=True)
    right = torch.where(finite, right, 0.0)
    values, vectors = torch.linalg.eigh(torch.where(finite[..., None], information, 0.0))
    there = values > LEAST_DIRECTION * values[:, -1:].clamp_min(torch.finfo(values.dtype).tiny)
    root = torch.where(there, values, 0.0).sqrt()
    residual = torch.where(there, (vectors.mT @ right[..., None])[..., 0] / root.clamp_min(1e-300), 0.0)
    return _Modes(residual, root[..., None] * vectors.mT, there)


def _print(modes: _Modes) -> _Family:
    places, gain = modes.by[..., : -CAMERA - 1], modes.by[..., -CAMERA - 1 : -CAMERA]
    one, two = (v.flatten() for v in torch.meshgrid(*[_values(_PRINT, modes).square()] * 2, indexing="ij"))
    evidence, weight, chi2 = _weighed(modes, ((places, one), (gain, two)))
    of_places, of_gain = ((weight * v).sum(-1, keepdim=True).sqrt() for v in (one, two))
    none = torch.zeros_like(modes.by[:, 0, -CAMERA:])
    deviation = torch.cat([of_places.expand(-1, places.shape[-1]), of_gain, none], -1)
    return _Family(evidence, deviation, torch.ones_like(evidence), chi2)


def _camera(modes: _Modes) -> _Family:
    variance = _values(_CAMERA, modes).square()
    evidence, weight, chi2 = _weighed(modes, ((modes.by[..., -CAMERA:], variance),))
    deviation = torch.zeros_like(modes.by[:, 0])
    deviation[:, -CAMERA:] = (weight * variance).sum(-1, keepdim=True).sqrt()
    return _Family(evidence, deviation, torch.ones_like(evidence), chi2)


def _scatter(modes: _Modes) -> _Family:
    factor, freedom = _values(_SCALE, modes), modes.there.sum(-1, keepdim=True)
    square = modes.residual.square().sum(-1, keepdim=True)
    likelihood = -0.5 * (square / factor + freedom * factor.log())
    mean = (torch.softmax(likelihood, -1) * factor).sum(-1)
    return _Family(_mean(likelihood), torch.zeros_like(modes.by[:, 0]), mean, square[:, 0] / mean)


def _weighed(modes: _Modes, parts: tuple[tuple[Tensor, Tensor], ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Log evidence (N,) of unknowns with derivatives (N, r, e) and G variances each, their weights (N, G), and the mean
    chi-squared (N,).
    """
    spread = torch.eye(modes.residual.shape[-1], dtype=modes.by.dtype, device=modes.by.device)
    for by, variance in parts:
        spread = spread + variance[:, None, None] * (by @ by.mT)[:, None]
    factor = torch.linalg.cholesky(spread)
    whitened = torch.linalg.solve_triangular(factor, modes.residual[:, None, :, None], upper=False)
    square = whitened.square().sum((-1, -2))
    likelihood = -0.5 * square - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = torch.softmax(likelihood, -1)
    return _mean(likelihood), weight, (weight * square).sum(-1)


def _values(ends: tuple[float, float], modes: _Modes) -> Tensor:
    like = modes.residual
    least, most = (math.log10(value) for value in ends)
    return torch.logspace(least, most, _GRID, dtype=like.dtype, device=like.device)


def _mean(likelihood: Tensor) -> Tensor:
    """Logarithm of the mean likelihood (N,) over the last dimension."""
    return torch.logsumexp(likelihood, -1) - math.log(likelihood.shape[-1])
