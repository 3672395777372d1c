"""What residuals show that noise and the stated uncertainties do not explain, and what may be behind it.

Of every row three explanations are weighed by their evidence (the likelihood, averaged over how large each may be):

- the print: places of markers along it, across it (paper bends, and turns the rings), and the edges of all rings,
  off by amounts of their own;
- the camera: its focal lengths, axes, principal point and distortion are off;
- all else: whatever it is, it makes the scatter larger by one factor (Birge 1932).

The likeliest becomes part of the row's problem with the variance that it has on average over what remains possible: a
few residuals tell a variance to a factor only, and the mean counts that, as Student's t does. A camera, which the pose
does not follow, counts by the mean square of its numbers, which residuals tell better than what they may be. Where it
is scatter, it may yet be a print whose residuals are small by chance, and the pose's covariance is the mean of both.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.arguments import checked
from torchpose.geometry.constants import either, finite
from torchpose.geometry.least_squares import LEAST_DIRECTION
from torchpose.geometry.robust import of_chance, quantile
from torchpose.geometry.rows import Rows, replace
from torchpose.results import Misfit

OF_MARKER = 5  # two along the print, one across, and two turns of a ring that goes with the plate's bend
# edge gain of the print; the same in the picture (wrong tone, light that floods), by as many px all round; and how far
# both edges of a ring lie further out
OF_EDGES = 3
OF_CAMERA = 8  # numbers of a camera that may be off: linear (focal length, aspect, skew), principal point, k1, p1, p2
SKEW = 2  # which of them
_EDGES_OFF = ((1, 0, 0), (0, 1, 0), (1, 0, 1))  # what may be off of the edges, in that order
_OFF = (  # what may be off of a camera's numbers, in the order of `OF_CAMERA`: one thing, or all
    (1, 0, 0, 0, 0, 0, 0, 0),
    (1, 1, 1, 0, 0, 0, 0, 0),
    (0, 0, 0, 1, 1, 0, 0, 0),
    (0, 0, 0, 0, 0, 1, 0, 0),
    (0, 0, 0, 0, 0, 0, 1, 1),
    (1, 1, 1, 1, 1, 1, 1, 1),
)
# how large each may be, from below any noise: mm, places and edges of an office print (50 to 100 um);
# px at the corner of the frame, where a file without distortion may be off by a hundred; of variances, as a factor
_PRINT, _CAMERA, _SCALE = (1e-4, 0.15), (1e-3, 300.0), (1.0, 1e3)
_FIELD = (1e-3, 1.0)  # px, of displacements of the picture: more would be no ring's shape
SURE = 2.33  # deviations: one row in 100 that is as its files say is looked at as closely as can be (derived)
_GRID = 16  # values, logarithmic, apart by a factor of 1.5, of a camera 2.3, which few residuals do not tell
_COARSE = 10  # of each of three: 2.3
# of what a wrong camera displaces, that derivatives by its numbers leave: of 10 px 0.03 (measured: decisions/0077)
_BENT = 0.05
_FEW_FACTORS = 4  # of ten, of the scatter beside a print or a camera (convention)
_LENS, _SCATTER = int(Misfit.CAMERA) - 1, int(Misfit.SCATTER) - 1  # among the explanations
_AS_NOTHING = _SCATTER + 1  # how many explanations are together as likely beforehand as that there is nothing
_AT_ONCE = 10_000_000  # numbers: 80 MB


class Picture(NamedTuple):
    """What residuals say when every marker may move by itself, and how it moves if the picture is displaced at random.

    information (N, 7 M, 7 M) and right (N, 7 M). fields (N, F, M, 7, 7): factors of the covariance of the motions by
    displacements of 1 px, correlated over each of F lengths.
    """

    information: Tensor
    right: Tensor
    fields: Tensor


@dataclass(frozen=True, eq=False)
class Excess(Rows):
    """What N rows show beyond noise and stated uncertainties.

    Attributes:
        deviation: standard deviations of the further unknowns: places (by marker `OF_MARKER`, mm), edges
            (`OF_EDGES`, mm), camera (px); 0 where they need not be off.
        lens: factor of the mean square of the camera's numbers, px, by all that residuals say; 0 where it is as filed.
        printed: the same if the print is behind it; 0 where nothing is.
        factor: of the variance of all noise, 1 where it suffices, or where ``field`` stands for it.
        printed_factor: the same if the print is behind it.
        field: variance of displacements of the picture, px^2, by the lengths of `Picture`, where it scatters.
        maybe: how likely it is the print where scatter is likelier, of these two; 0 elsewhere.
        misfit: `Misfit`, what is behind it.
        explained: whether the residuals then agree with all that.
        chi2: of the residuals, under noise and stated uncertainties alone.
        freedom: its degrees of freedom.
    """

    deviation: Float[Tensor, "N E"]
    lens: Float[Tensor, "N C C"]
    printed: Float[Tensor, "N E"]
    factor: Float[Tensor, " N"]
    printed_factor: Float[Tensor, " N"]
    field: Float[Tensor, "N F"]
    maybe: Float[Tensor, " N"]
    misfit: Int[Tensor, " N"]
    explained: Bool[Tensor, " N"]
    chi2: Float[Tensor, " N"]
    freedom: Int[Tensor, " N"]


class _Modes(NamedTuple):
    """Residuals (N, r) as independent numbers of unit variance, of which ``there`` (N, r) exist.

    by: (N, r, E), by the further unknowns.
    """

    residual: Tensor
    by: Tensor
    there: Tensor

    def existing(self) -> Self:
        """Those that exist in any row; they come last."""
        most = max(1, int(self.there.sum(-1).amax())) if len(self.there) else self.there.shape[1]
        return type(self)(*(x[:, x.shape[1] - most :] for x in self))


class _Family(NamedTuple):
    """One explanation: its log evidence (N,), deviations (N, E), factor (N,), and chi-squared (N,) under it."""

    evidence: Tensor
    deviation: Tensor
    factor: Tensor
    chi2: Tensor


def excess_of(
    information: Float[Tensor, "N E E"],
    right: Float[Tensor, "N E"],
    even: Float[Tensor, " N"] | None = None,
    picture: Callable[[Tensor], Picture] | None = None,
    refuted: Bool[Tensor, " N"] | None = None,
) -> Excess:
    """What speaks from the information about the further unknowns, and their right side, all else being unknown.

    Args:
        even: degrees of freedom of other residuals that are those of noise: what makes all noise larger would have made
            them larger, too.
        picture: of some rows (K,), to tell displacements of the picture by; without, scatter is one factor.
        refuted: rows in which residuals that the further unknowns do not reach are beyond chance; something is amiss.
    """
    modes = _modes(information, right)
    none = _none(right, modes)
    none = replace(none, explained=(none.chi2 < _most(none.freedom)) & (True if refuted is None else ~refuted))
    row, families, said = _explanations(modes, none, even)
    if row.numel() == 0:
        return none
    evidence = torch.stack([f.evidence for f in families], -1)
    best = evidence.argmax(-1)
    at = torch.arange(len(row), device=row.device)
    deviation, factor, chi2 = (torch.stack([f[k] for f in families], 1)[at, best] for k in (1, 2, 3))
    explained = chi2 < _most(none.freedom[row])
    field, scatters = factor.new_zeros(len(row), 1), (best == _SCATTER).nonzero()[:, 0]
    if picture is not None and scatters.numel():
        found = _displaced(picture(row[scatters]))
        field = field.new_zeros(len(row), found.shape[1]).index_copy(0, scatters, found)
        factor = factor.index_fill(0, scatters, 1.0)
    values, vectors = torch.linalg.eigh(said * (best == _LENS)[:, None, None])
    lens = vectors * values.clamp_min(0.0).sqrt()[:, None]
    misfit = torch.where((best == 0) & _is_tone(deviation), int(Misfit.TONE), best + 1)
    every = replace(none, field=field.new_zeros(len(none.chi2), field.shape[1]))
    return every.replaced(
        row,
        replace(
            every[row],
            deviation=deviation,
            lens=lens,
            printed=families[0].deviation,
            factor=factor,
            printed_factor=families[0].factor,
            field=field,
            maybe=torch.where(best == _SCATTER, torch.sigmoid(evidence[:, 0] - evidence[:, _SCATTER]), 0.0),
            misfit=misfit,
            explained=explained,
        ),
    )


def _explanations(modes: _Modes, none: Excess, even: Tensor | None) -> tuple[Tensor, list[_Family], Tensor]:
    """Rows (K,) of which an explanation is likelier than that there is nothing to explain, or which chance does not
    reach, and the three of them, in the order of `Misfit`.

    One thing that is off, as k1, may stand in one direction of the residuals, where their sum says little. So a camera,
    which costs little to try, is held against rows whose sum is no surprise, too.
    """
    row = ((none.chi2 > _usual(none.freedom)) | ~none.explained).nonzero()[:, 0]
    some, silent = _Modes(*(x[row] for x in modes)).existing(), torch.zeros_like(none.chi2)
    # beforehand as likely as all three; where noise is known to be more than that of independent pixels, as each
    expected = torch.ones_like(none.explained) if even is None else even > 0
    nothing = math.log(_AS_NOTHING) * expected[row].to(some.residual) - 0.5 * some.residual.square().sum(-1)
    camera, said = _camera(some)
    kept = (none.chi2[row] > quantile(none.freedom[row].clamp_min(1), SURE)) | (camera.evidence > nothing)
    kept |= ~none.explained[row]
    row, some, nothing, said = row[kept], _Modes(*(x[kept] for x in some)), nothing[kept], said[kept]
    scatter = _scatter(some, (silent if even is None else even)[row])
    families = [_beside_scatter(_print, some), _Family(*(x[kept] for x in camera)), scatter]
    likelier = (torch.stack([f.evidence for f in families]).amax(0) > nothing) | ~none.explained[row]
    return row[likelier], [_Family(*(x[likelier] for x in f)) for f in families], said[likelier]


def _is_tone(deviation: Tensor) -> Tensor:
    """Prints (N,) bool by whose deviations (N, E) it is edges in the picture that are off, more than all else."""
    markers, edges, _ = by_kind(deviation)
    return edges[:, 1] > torch.maximum(edges[:, 0], markers.amax(-1))


def by_kind(unknowns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Further unknowns (..., E) as those of markers, edges and camera."""
    markers, edges, camera = unknowns.tensor_split([-OF_CAMERA - OF_EDGES, -OF_CAMERA], -1)
    return markers, edges, camera


def beyond_chance(excess: Excess) -> Bool[Tensor, " N"]:
    """Rows (N,) whose residuals noise does not reach."""
    return improbable(excess.chi2, excess.freedom)


def no_excess(information: Float[Tensor, "N E E"], right: Float[Tensor, "N E"]) -> Excess:
    """The same where noise explains the residuals; elsewhere `Excess.explained` is False and nothing else is said."""
    return _none(right, _modes(information, right))


def _none(right: Tensor, modes: _Modes) -> Excess:
    chi2, freedom = modes.residual.square().sum(-1), modes.there.sum(-1)
    zero, one = torch.zeros_like(right), torch.ones_like(chi2)
    by_chance = chi2 < _usual(freedom)
    nothing = torch.zeros_like(freedom)
    lens = zero[:, :1, None].expand(-1, OF_CAMERA, OF_CAMERA)
    return Excess(zero, lens, zero, one, one, zero[:, :1], zero[:, 0], nothing, by_chance, chi2, freedom)


def _usual(freedom: Tensor) -> Tensor:
    """What chi-squared (N,) of noise stays below by one of its deviations: five times in six."""
    freedom = freedom.double()  # torch takes roots of integers in its default type
    return freedom + (2 * freedom).sqrt()


def improbable(chi2: Tensor, freedom: Tensor) -> Tensor:
    """Whether chi-squared (N,) is more than chance makes of what should explain it."""
    return chi2 > _most(freedom)


def _most(freedom: Tensor) -> Tensor:
    """What chi-squared (N,) stays below where what explains it does."""
    freedom = freedom.clamp_min(1)
    return freedom * of_chance(freedom)


def _modes(information: Tensor, right: Tensor) -> _Modes:
    known = finite(torch.cat([information, right[..., None]], -1), (1, 2))[:, None]
    right = either(known, right, 0.0)
    values, vectors = torch.linalg.eigh(either(known[..., None], information, 0.0))
    there = values > LEAST_DIRECTION * values[:, -1:].clamp_min(torch.finfo(values.dtype).tiny)
    root = either(there, values, 0.0).sqrt()
    residual = either(there, torch.bmm(vectors.mT, right[..., None])[..., 0] / root.clamp_min(1e-300), 0.0)
    return _Modes(residual, root[..., None] * vectors.mT, there)


def _beside_scatter(explain: Callable[[_Modes], _Family], modes: _Modes) -> _Family:
    """An explanation with scatter besides: what large errors bend beyond the numbers that explain them.

    The more of it, the less likely beforehand: nothing tells small errors and scatter from scatter alone.
    """
    factors = _values(_SCALE, modes.residual, _FEW_FACTORS)
    root, rows = factors.sqrt().repeat(len(modes.residual))[:, None], modes.residual.repeat_interleave(_FEW_FACTORS, 0)
    by, there = (x.repeat_interleave(_FEW_FACTORS, 0) for x in (modes.by, modes.there))
    found = explain(_Modes(rows / root, by / root[..., None], there))
    evidence, deviation, _, chi2 = (part.unflatten(0, (-1, _FEW_FACTORS)) for part in found)
    evidence = evidence - (0.5 * modes.there.sum(-1, keepdim=True) + 1) * factors.log()
    weight = torch.softmax(evidence, -1)
    deviation = (weight[..., None] * deviation.square()).sum(1).sqrt()
    return _Family(_mean(evidence), deviation, (weight * factors).sum(-1), (weight * chi2).sum(-1))


def _print(modes: _Modes) -> _Family:
    """A print bends by no less than it stretches: across it the variance of the places along it counts, and more."""
    markers, edges, camera = by_kind(modes.by)
    markers = markers.unflatten(-1, (-1, OF_MARKER))
    values = _values(_PRINT, modes.residual, _COARSE).square()
    places = torch.cartesian_prod(values, values)  # along, across
    parts = tuple(zip((markers[..., :3].flatten(-2), markers[..., 2:].flatten(-2)), places.T, strict=True))
    off = values.new_tensor(_EDGES_OFF)
    of_edges = (off[:, None] * values[:, None]).flatten(0, 1)
    evidence, weight, chi2 = _weighed(modes, edges, off, values, parts)
    every, bent = (weight.sum(-1) @ places).split(1, -1)
    of_marker = torch.cat([every, every, every + bent, bent, bent], -1).repeat(1, markers.shape[-2])
    none = torch.zeros_like(camera[:, 0])
    deviation = torch.cat([of_marker, weight.sum(1) @ of_edges, none], -1)
    more = _between(chi2, modes.there.sum(-1), values)
    return _Family(evidence, (more[:, None] * deviation).sqrt(), torch.ones_like(evidence), chi2 / more)


def _between(chi2: Tensor, freedom: Tensor, values: Tensor) -> Tensor:
    """Factors (N,) of variances that were tried at ``values`` alone, and may lie half a step above the best of them.

    A hundred residuals of a board tell a variance to a tenth. Where what they leave is beyond chance, it is that share.
    """
    most = (values[1] / values[0]).sqrt()
    freedom = freedom.clamp_min(1)
    return torch.where(chi2 > quantile(freedom, SURE), (chi2 / freedom).minimum(most), 1.0)


def _camera(modes: _Modes) -> tuple[_Family, Tensor]:
    """One thing may be off, or all: of another focal length alone the mean over all tells too little. With scatter
    besides, as `_beside_scatter` has it.

    Also the mean square (N, C, C) of what the numbers of the camera are. Few residuals tell the variance that they may
    have to a factor only, but the numbers themselves to a deviation: the mean over all that remains possible is that of
    what residuals say of them and of what they leave open.
    """
    variance, factor = _values(_CAMERA, modes.residual).square(), _values(_SCALE, modes.residual, _FEW_FACTORS)
    off, by = variance.new_tensor(_OFF), by_kind(modes.by)[2]
    told = off[:, :, None] * (by.mT @ by)[:, None] * off[:, None]
    values, vectors = torch.linalg.eigh(told)  # (N, S, C), of the things that may be off
    pull = (vectors.mT @ (off * (modes.residual[:, None] @ by))[..., None])[..., 0]
    values, pull = values.clamp_min(0.0)[:, None, :, None], pull[:, None, :, None]
    square, freedom = (x.sum(-1)[:, None, None, None] for x in (modes.residual.square(), modes.there))
    # noise (N, F, S, V): scatter, and what derivatives leave of what is displaced by so much
    displaced = (values * (variance[:, None] * pull / (1 + variance[:, None] * values)).square()).sum(-1)
    factor = factor[:, None, None]
    noise = (factor * (1 + _BENT**2 * displaced / freedom.clamp_min(1))).clamp_max(_SCALE[1])
    gain = 1 + variance[:, None] * values / noise[..., None]  # (N, F, S, V, C)
    number = variance[:, None] * pull / noise[..., None] / gain
    chi2 = (square - (number * pull).sum(-1)) / noise
    likelihood = -0.5 * (chi2 + gain.log().sum(-1) + freedom * noise.log()) - factor.log()
    weight = torch.softmax(likelihood.flatten(1), -1).view_as(likelihood)
    open_ = (weight[..., None] * variance[:, None] / gain).sum((1, 3))
    said = torch.einsum("nfsv,nfsvc,nfsvd->nscd", weight, number, number) + torch.diag_embed(open_)
    said = (off[:, :, None] * (vectors @ said @ vectors.mT) * off[:, None]).sum(1)
    markers, edges, _ = by_kind(torch.zeros_like(modes.by[:, 0]))
    size = torch.einsum("nfsv,v,sc->nc", weight, variance, off).sqrt()
    mean, left = ((weight * x).sum((1, 2, 3)) for x in (noise, chi2))
    return _Family(_mean(likelihood.flatten(1)), torch.cat([markers, edges, size], -1), mean, left), said


@checked
def may_be_off(told: Float[Tensor, " N"], pull: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Mean square (N,) of what residuals say of one number of a camera, where nothing is likelier to be amiss.

    Two or three deviations of it are no evidence: most often they are noise. But a number that is off by so little may
    move the pose by many of its deviations. So it counts by how likely it is to be off, next to nothing. What residuals
    do not tell of it is not in here: that a file states, or it counts as known.

    Args:
        told: information about it, all else being unknown.
        pull: its right side.
    """
    variance = _values(_CAMERA, told).square()
    more = 1 + told[:, None] * variance
    found = variance * pull[:, None] / more
    likelihood = 0.5 * (found * pull[:, None] - more.log())
    nothing = torch.full_like(likelihood[:, :1], math.log(_AS_NOTHING * len(_OFF) * _GRID))
    share = torch.softmax(torch.cat([likelihood, nothing], -1), -1)[:, :-1]
    return (share * found.square()).sum(-1)


def _scatter(modes: _Modes, even: Tensor) -> _Family:
    """Of ``even`` (N,) other residuals the mean square is 1: they speak against it, and not of how large it is."""
    factor, freedom = _values(_SCALE, modes.residual), modes.there.sum(-1, keepdim=True)
    square = modes.residual.square().sum(-1, keepdim=True)
    likelihood = -0.5 * (square / factor + freedom * factor.log())
    mean = (torch.softmax(likelihood, -1) * factor).sum(-1)
    against = 0.5 * even[:, None] * (1 / factor + factor.log() - 1)
    return _Family(_mean(likelihood - against), torch.zeros_like(modes.by[:, 0]), mean, square[:, 0] / mean)


def _displaced(picture: Picture) -> Tensor:
    """Variances (N, F) in px^2 of displacements of the picture that are alike over each of the lengths.

    What scatters displaces a ring as a whole more than it changes its size or turns it: air, and lines that shake. The
    pose stands on these shifts, of which few residuals remain. How much larger they are than sizes and turns is told by
    the length over which displacements are alike, and sizes and turns tell how large they are. One factor for all noise
    would be that of the shortest length.
    """
    modes, fields = _modes(picture.information, picture.right), picture.fields
    by = modes.by.unflatten(-1, fields.shape[2:4])
    by = torch.einsum("nrma,nfmab->nfrmb", by, fields).flatten(-2)
    values, vectors = torch.linalg.eigh(by @ by.mT)
    square = (vectors.mT @ modes.residual[:, None, :, None]).square()  # (N, F, r, 1)
    sizes = _values(_FIELD, modes.residual).square()
    held = 1 + values.clamp_min(0.0)[..., None] * sizes
    likelihood = -0.5 * (square / held + held.log()).sum(2)
    weight = torch.softmax(likelihood.flatten(1), -1).view_as(likelihood)
    return weight @ sizes


_Part = tuple[Tensor, Tensor]
"""Derivatives (N, r, e) by some of the further unknowns, and G variances that each of these may have."""


def _weighed(
    modes: _Modes, few: Tensor, off: Tensor, values: Tensor, parts: tuple[_Part, ...] = ()
) -> tuple[Tensor, Tensor, Tensor]:
    """Log evidence (N,) of unknowns, weights (N, G, S V) of their variances, and the mean chi-squared (N,).

    Args:
        modes: the residuals.
        few: derivatives (N, r, e) by some unknowns.
        off: (S, e) 1 or 0, which of these may be off together, by each of the variances ``values`` (V,), which cost
            little to try (Woodbury 1950).
        parts: further unknowns; each of the G is combined with each of the S V.
    """
    rows, r = modes.residual.shape
    grid = len(parts[0][1]) if parts else 1
    some = max(1, _AT_ONCE // (grid * max(r * r, off.numel() * len(values))))
    found = [_likelihood(modes, few, off, values, parts, slice(k, k + some)) for k in range(0, max(rows, 1), some)]
    likelihood, square = (torch.cat(x) for x in zip(*found, strict=True))
    weight = torch.softmax(likelihood.flatten(1), -1).view_as(likelihood)
    return _mean(likelihood.flatten(1)), weight, (weight * square).sum((1, 2))


def _likelihood(
    modes: _Modes, few: Tensor, off: Tensor, values: Tensor, parts: tuple[_Part, ...], rows: slice
) -> tuple[Tensor, Tensor]:
    """Logarithm (n, G, S V) under each of the variances, and chi-squared (n, G, S V), of some rows."""
    columns = torch.cat([modes.residual[..., None], few], -1)[rows, None]
    spread = torch.eye(columns.shape[-2], dtype=modes.by.dtype, device=modes.by.device)
    for by, variance in parts:
        spread = spread + variance[:, None, None] * (by[rows] @ by[rows].mT)[:, None]
    factor = torch.linalg.cholesky(spread).expand(len(columns), -1, -1, -1) if parts else None
    whitened = columns if factor is None else torch.linalg.solve_triangular(factor, columns, upper=False)
    alone = 0.0 if factor is None else factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[..., None]
    products = (whitened.mT @ whitened)[:, :, None]  # (n, G, 1, 1 + e, 1 + e)
    # one variance for all that is off together: along the axes of what is told of them a sum of single ones
    told, vectors = torch.linalg.eigh(off[:, :, None] * products[..., 1:, 1:] * off[:, None])
    pull = (vectors.mT @ (off * products[..., 1:, 0])[..., None]).mT  # (n, G, S, 1, e)
    gain = 1 + values[:, None] * told[..., None, :].clamp_min(0.0)  # (n, G, S, V, e)
    taken = (values[:, None] * pull.square() / gain).sum(-1).flatten(2)
    square = products[..., 0, 0] - taken
    return -0.5 * (square + gain.log().sum(-1).flatten(2)) - alone, square


def _values(ends: tuple[float, float], like: Tensor, count: int = _GRID) -> Tensor:
    least, most = (math.log10(value) for value in ends)
    return torch.logspace(least, most, count, dtype=like.dtype, device=like.device)


def _mean(likelihood: Tensor) -> Tensor:
    """Logarithm of the mean likelihood (N,) over the last dimension."""
    return torch.logsumexp(likelihood, -1) - math.log(likelihood.shape[-1])
