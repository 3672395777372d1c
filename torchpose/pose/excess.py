"""What residuals show that noise and the stated uncertainties do not explain, and what may be behind it.

Of every row three explanations are weighed by their evidence (the likelihood, averaged over how large each may be):

- the print: places of markers along it, across it (paper bends), and an edge gain, off by amounts of their own;
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
_GRID = 16  # values, logarithmic: the closest are a factor of 1.5 apart, which a few residuals do not tell
_COARSE = 10  # of each of three: 2.3
_AT_ONCE = 10_000_000  # numbers: 80 MB


@dataclass(frozen=True, eq=False)
class Excess(Rows):
    """What N rows show beyond noise and stated uncertainties.

    Attributes:
        deviation: standard deviations of the further unknowns: places (by marker two along the print and one across,
            mm), gain (mm), camera (px); 0 where they need not be off.
        printed: the same if the print is behind it; 0 where nothing is.
        factor: of the variance of all noise, 1 where it suffices.
        misfit: `Misfit`, what is behind it.
        explained: whether the residuals then agree with all that.
    """

    deviation: Float[Tensor, "N E"]
    printed: Float[Tensor, "N E"]
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
    most, explained = _of_noise(modes)
    none = _none(right, explained)
    row = (~explained).nonzero()[:, 0]
    if row.numel() == 0:
        return none
    some = _Modes(*(x[row] for x in modes))
    families = (_print(some), _camera(some), _scatter(some))  # in the order of `Misfit`
    best = torch.stack([f.evidence for f in families], -1).argmax(-1)
    at = torch.arange(len(row), device=row.device)
    deviation, factor, chi2 = (torch.stack([f[k] for f in families], 1)[at, best] for k in (1, 2, 3))
    return none.replaced(row, Excess(deviation, families[0].deviation, factor, best + 1, chi2 < most[row]))


def no_excess(information: Float[Tensor, "N E E"], right: Float[Tensor, "N E"]) -> Excess:
    """The same where noise explains the residuals; elsewhere `Excess.explained` is False and nothing else is said."""
    return _none(right, _of_noise(_modes(information, right))[1])


def _none(right: Tensor, explained: Tensor) -> Excess:
    zero, nothing = torch.zeros_like(right), torch.zeros_like(explained, dtype=torch.int64)
    return Excess(zero, zero, right.new_ones(len(right)), nothing, explained)


def _of_noise(modes: _Modes) -> tuple[Tensor, Tensor]:
    """The most that chi-squared may be by chance (N,), and whether it is less (N,) bool."""
    chi2, freedom = modes.residual.square().sum(-1), modes.there.sum(-1).clamp_min(1)
    most = freedom * of_chance(freedom)
    return most, chi2 < most


def _modes(information: Tensor, right: Tensor) -> _Modes:
    finite = (information.isfinite().all(-1) & right.isfinite()).all(-1, keepdim=True)
    right = torch.where(finite, right, 0.0)
    values, vectors = torch.linalg.eigh(torch.where(finite[..., None], information, 0.0))
    there = values > LEAST_DIRECTION * values[:, -1:].clamp_min(torch.finfo(values.dtype).tiny)
    root = torch.where(there, values, 0.0).sqrt()
    residual = torch.where(there, (vectors.mT @ right[..., None])[..., 0] / root.clamp_min(1e-300), 0.0)
    return _Modes(residual, root[..., None] * vectors.mT, there)


def _print(modes: _Modes) -> _Family:
    """A print bends by no less than it stretches: across it the variance of the places along it counts, and more."""
    places, gain = modes.by[..., : -CAMERA - 1], modes.by[..., -CAMERA - 1 : -CAMERA]
    values = _values(_PRINT, modes, _COARSE).square()
    of_places = torch.cartesian_prod(values, values).unbind(-1)
    parts = tuple(zip((places, places[..., 2::3]), of_places, strict=True))
    evidence, weight, chi2 = _weighed(modes, parts, (gain, values))
    variances = torch.cartesian_prod(values, values, values).unbind(-1)
    every, bent, of_gain = ((weight * v).sum(-1, keepdim=True) for v in variances)
    none, place = torch.zeros_like(modes.by[:, 0, -CAMERA:]), torch.cat([every, every, every + bent], -1)
    deviation = torch.cat([place.repeat(1, places.shape[-1] // 3), of_gain, none], -1).sqrt()
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


_Part = tuple[Tensor, Tensor]
"""Derivatives (N, r, e) by some of the further unknowns, and variances that each of these may have."""


def _weighed(modes: _Modes, parts: tuple[_Part, ...], one: _Part | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Log evidence (N,) of unknowns with G variances each, their weights (N, G), and the mean chi-squared (N,).

    With ``one`` more unknown (e = 1) of V variances, each of the G is combined with each of these, which then count
    faster: its part is of rank one, and costs next to nothing (Sherman and Morrison 1950).
    """
    rows, r = modes.residual.shape
    some = max(1, _AT_ONCE // (len(parts[0][1]) * r * r))
    likelihood, square = (
        torch.cat(x)
        for x in zip(*(_likelihood(modes, parts, one, slice(k, k + some)) for k in range(0, rows, some)), strict=True)
    )
    weight = torch.softmax(likelihood, -1)
    return _mean(likelihood), weight, (weight * square).sum(-1)


def _likelihood(modes: _Modes, parts: tuple[_Part, ...], one: _Part | None, rows: slice) -> tuple[Tensor, Tensor]:
    """Logarithm (n, G) under each of the variances, and chi-squared (n, G), of some rows."""
    residual = modes.residual[rows, None, :, None]
    spread = torch.eye(residual.shape[-2], dtype=modes.by.dtype, device=modes.by.device)
    for by, variance in parts:
        spread = spread + variance[:, None, None] * (by[rows] @ by[rows].mT)[:, None]
    factor = torch.linalg.cholesky(spread)
    logarithm = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    columns = residual if one is None else torch.cat([residual, one[0][rows, None]], -1)
    whitened = torch.linalg.solve_triangular(factor, columns.expand(*factor.shape[:-1], -1), upper=False)
    square = whitened[..., 0].square().sum(-1)
    if one is not None:
        held = 1 + one[1] * whitened[..., 1].square().sum(-1, keepdim=True)
        pull = whitened.prod(-1).sum(-1, keepdim=True)
        square = (square[..., None] - one[1] * pull.square() / held).flatten(-2)
        logarithm = (logarithm[..., None] + 0.5 * held.log()).flatten(-2)
    return -0.5 * square - logarithm, square


def _values(ends: tuple[float, float], modes: _Modes, count: int = _GRID) -> Tensor:
    like = modes.residual
    least, most = (math.log10(value) for value in ends)
    return torch.logspace(least, most, count, dtype=like.dtype, device=like.device)


def _mean(likelihood: Tensor) -> Tensor:
    """Logarithm of the mean likelihood (N,) over the last dimension."""
    return torch.logsumexp(likelihood, -1) - math.log(likelihood.shape[-1])
