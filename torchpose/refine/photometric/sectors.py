"""Whether the grey values around a ring follow the model, by sectors of its two circles.

A sum over all pixels of a marker tells little: noise hides what is wrong with a tenth of them, and a pixel alone tells
less. What harms a pose is a misfit that pulls at an edge over many pixels: a cover, a neighbour's blurred edge, light
that is no plane. Each of 48 sectors of a circle measures how far its own pixels would move the edge,

    e = sum(w j r) / sum(w j^2),   j = d(grey) / d(edge),   variance sigma^2 / sum(w j^2),

and these displacements are independent and of zero mean where the model holds (a score test; Rao 1948).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry import conics
from torchpose.geometry.constants import either
from torchpose.geometry.least_squares import scaled_inverse, solve_scaled
from torchpose.geometry.robust import CUT, of_chance
from torchpose.geometry.rows import Rows, replace
from torchpose.geometry.sectors import MOST, SECTORS, middles
from torchpose.geometry.segments import segment_mean, segment_sum
from torchpose.refine.photometric.grey_levels import MOST_SPREAD
from torchpose.refine.photometric.light import POSE
from torchpose.refine.photometric.ring_model import PixelBlocks, RingModel

_KEPT = 0.9  # of a sector's pixels that must follow the model for it to count (convention; decisions/0064)
_CELL = 4  # sectors over which a misfit is taken for one
_BAND = 2  # sectors of the outer circle that a band of lines is high: half as much apart, most of them share it
_UNCLEAR = 3  # sectors of an outer circle: more are no chance (measured: decisions/0064)
# harmonics that neither pose nor gain nor blur can have, and that a box of 12 cells resolves (derived)
_ODD = (3, 5, 7)
# of the spectrum of what displaces a rim, as reciprocals of the harmonic of the outer circle at which it has fallen to
# 1/e: white, and down to a correlation over half of the radius (convention: none is told better)
_WIDTHS = (0.0, 0.03, 0.06, 0.12, 0.24)
_DISPLACED = 0.005  # px, displacement that a camera or print slightly off may cause: no reason for doubt
_TINY = 1e-12  # least divisor (convention: below any sum that counts)


@dataclass(frozen=True, eq=False)
class Sectors(Rows):
    """Sums over the pixels of the 2 x 48 sectors of K markers, inner circle first.

    Attributes:
        total: usable pixels.
        used: sum of weights.
        square: of weighted squared residuals.
        pull: sum(w j r).
        hold: sum(w j^2).
        cell: flat sector of every pixel.
    """

    total: Float[Tensor, "K 96"]
    used: Float[Tensor, "K 96"]
    square: Float[Tensor, "K 96"]
    pull: Float[Tensor, "K 96"]
    hold: Float[Tensor, "K 96"]
    cell: Int[Tensor, "K P"]

    def of_pixels(self, values: Tensor) -> Tensor:
        """Values (K, 96) of the sectors as those of their pixels (K, P)."""
        return values.flatten()[self.cell.flatten()].view(self.cell.shape)

    def scaled(self, factor: Tensor) -> Sectors:
        """With the weights of every sector multiplied by ``factor`` (K, 96), as far as its displacement tells."""
        return replace(self, pull=self.pull * factor, hold=self.hold * factor)


def sum_sectors(
    residual: Tensor, slope: Tensor, usable: Tensor, weight: Tensor, blocks: PixelBlocks, model: RingModel
) -> Sectors:
    """Sums of residuals (K, P) with derivatives by the edge ``slope``, and weights, of which ``usable`` is the most."""
    middle = 0.5 * (1 + blocks.radii[:, 1] / blocks.radii[:, 0])
    outer = torch.addcmul(model.x * model.x, model.y, model.y).flatten(1) > middle.square()[:, None].float()
    count = len(blocks.row)
    block = torch.arange(count, device=blocks.row.device)[:, None]
    cell = (2 * block + outer) * SECTORS + blocks.sector
    flat = cell.flatten()
    weighted = weight * residual
    slope = slope.masked_fill(weight == 0, 0.0)  # padded pixels have none
    pull = weight * slope
    planes = (usable, weight, weighted * residual, pull * residual, pull * slope)
    sums = torch.zeros(len(planes), 2 * SECTORS * count, dtype=weight.dtype, device=weight.device).unbind(0)
    for of_sectors, plane in zip(sums, planes, strict=True):
        of_sectors.scatter_add_(0, flat, plane.flatten())
    total, used, square, pulls, hold = (of_sectors.view(count, 2 * SECTORS) for of_sectors in sums)
    return Sectors(total, used, square, pulls, hold, cell)


def clear_sectors(sectors: Sectors, spread: Tensor, misfit: Tensor, rough: Tensor | None = None) -> Tensor:
    """(K, 96) bool, False for sectors where many usable pixels do not follow the model.

    What covers an edge agrees with it by chance wherever the edge passes through the cover's own grey, and where both
    are blurred no single pixel may betray it: a sector's mean square must be that of noise, too.

    Args:
        spread: (K,) standard deviation of noise. misfit: (K,) what the model itself may be off by; grey levels.
        rough: (K,), as `roughness`.
    """
    limit = spread[:, None].square() * of_chance(sectors.used.clamp_min(1)) + misfit[:, None].square()
    allowed = sectors.used * limit
    if rough is not None:
        allowed = allowed + (CUT * rough[:, None]).square().to(allowed) * sectors.hold
    clear = (sectors.used > _KEPT * sectors.total) & (sectors.square < allowed)
    # where half of a ring is gone, the rest of the marker is not to be trusted either
    seen = (sectors.total > 0).sum(-1, keepdim=True)
    return clear & (clear.sum(-1, keepdim=True) > MOST * seen)


def roughness(sectors: Sectors, spread: Tensor, row: Tensor) -> Tensor:
    """Deviation (K,) in px of displacements that most of the sectors of all rings of a row have beyond noise, 0 where
    they have none.

    Air and coarse prints displace all edges, a cover some. Medians tell the one from the other: where most of every
    ring scatters, a pixel or a sector that does is no outlier. That it does is told by what differs over 30 degrees: a
    circle beside its place, or of another size, does not scatter.

    Args:
        sectors: with the weights of all usable pixels. spread: (K,) deviation of noise. row: (K,).
    """
    hold = sectors.hold.clamp_min(_TINY).masked_fill(sectors.hold <= 0, torch.nan).unflatten(1, (2, SECTORS))
    error, noise = sectors.pull.view_as(hold) / hold, spread[:, None, None].square() / hold
    apart = error - 0.5 * (error.roll(_CELL, -1) + error.roll(-_CELL, -1))
    usual = noise + 0.25 * (noise.roll(_CELL, -1) + noise.roll(-_CELL, -1))
    factor = (1.4826 * (apart.abs() / usual.sqrt()).flatten(1).nanmedian(-1).values).square()
    more = of_more(factor, (sectors.hold > 0).sum(-1))
    own = (1.4826 * error.abs().flatten(1).nanmedian(-1).values).square() - noise.flatten(1).nanmedian(-1).values
    own = (own * more).nan_to_num(nan=0.0).clamp_min(0.0)
    least = own.new_full((int(row.max()) + 1 if len(own) else 0,), torch.inf).scatter_reduce(0, row, own, "amin")
    return torch.minimum(own, MOST_SPREAD**2 * least[row]).sqrt()


def away_from_unclear(sectors: Sectors, clear: Tensor) -> Tensor:
    """Clear sectors (K, 96) that touch no run of two unclear ones: what lies over these ends in a blurred edge."""
    unclear = (~clear & (sectors.total > 0)).unflatten(1, (2, SECTORS))
    run = unclear & (unclear.roll(1, -1) | unclear.roll(-1, -1))
    return clear & ~(run.roll(1, -1) | run.roll(-1, -1)).flatten(1)


def trust(sectors: Sectors, clear: Tensor, variance: Tensor, rough: Tensor | None = None) -> Tensor:
    """Weights (K, 96) of the sectors beside those of their pixels: 0 where they are not clear or pull too hard.

    What is left of a circle may still pull more than noise does. The excess of the chi-squared of cells of four sectors
    is the variance tau^2 of a displacement of their own (random effects; DerSimonian and Laird 1986), and weights are
    1 / (v + tau^2) instead of 1 / v. Where all rims scatter, what moves a circle as a whole or draws it out is not part
    of that: it shows in what the rings say against each other.

    Args:
        variance: (K,) of noise.
        rough: (K,), as `roughness`.
    """
    noise = variance[:, None].to(sectors.pull.dtype)
    # in deviations of noise; where all sectors scatter by more (paper, compression), more is no reason to drop one
    deviation = sectors.pull / (noise * sectors.hold.clamp_min(_TINY)).sqrt()
    usual = 1.4826 * deviation.abs().masked_fill(~clear, torch.nan).nanmedian(-1, keepdim=True).values
    good = clear & (deviation.abs() < CUT * usual.nan_to_num(nan=1.0).clamp_min(1.0))
    error, hold = _cell_displacements(sectors.scaled(good.to(sectors.pull.dtype)), variance)
    cells = (hold > 0).sum((1, 2)).double()
    chi2, free = (hold * error.square()).sum((1, 2)), cells
    if rough is not None:
        beyond = _beyond_harmonics(error, hold)
        chi2, free = (x.where(rough > 0, y) for x, y in zip(beyond, (chi2, free), strict=True))
    tau2 = (chi2 - free).clamp_min(0) * cells / (free * hold.sum((1, 2))).clamp_min(_TINY)
    spread = (tau2[:, None, None] * hold).flatten(1)  # tau^2 over the variance of each cell
    return good / (1 + spread.repeat_interleave(_CELL, 1))


def _cells(sectors: Sectors, noise: Tensor, allowed: float = 0.0) -> tuple[Tensor, Tensor]:
    """Chi-squared of the displacement of every cell, given ``allowed`` px besides noise, and its hold: (K, 24)."""
    pull, hold = (v.unflatten(1, (-1, _CELL)).sum(-1) for v in (sectors.pull, sectors.hold))
    variance = noise * hold + (allowed * hold).square()
    return either(hold > 0, pull.square() / variance.clamp_min(_TINY), 0.0), hold


def misfit(sectors: Sectors, clear: Tensor, variance: Tensor, row: Tensor, rows: int) -> Tensor:
    """Chi-squared of the displacements of a row's cells per cell (N,): 1 where the model holds."""
    chi2, hold = _cells(sectors.scaled(clear.to(sectors.pull.dtype)), variance[:, None].to(sectors.pull.dtype))
    count = segment_sum((hold > 0).double().sum(-1), row, rows).clamp_min(1)
    return segment_sum(chi2.double().sum(-1), row, rows) / count


def overdispersion(sectors: Sectors, variance: Tensor, row: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """By how much the scatter of edges along the rims exceeds that of independent noise (N,), as a factor of variance,
    and the degrees of freedom (N,) in which it is that of noise, 0 where it is more.

    Noise that is correlated between pixels (paper, compression, filters of the camera) pulls at an edge in step over
    many of them. Every cell's displacement shows how much. What moves a circle as a whole, makes it larger, or draws it
    out is no noise and taken off: a mean and two harmonics of each. The second is a tilt, or a blur with a direction,
    that is held or of which the last step is still to come; it moves no centre.

    Args:
        sectors: weighted as in the fit. variance: (K,) of noise. row: (K,) of ``rows``.
    """
    error, hold = _cell_displacements(sectors, variance)
    each, free = _beyond_harmonics(error, hold)
    chi2, freedom = segment_sum(each, row, rows), segment_sum(free, row, rows).clamp_min(1)
    factor = chi2 / freedom
    more = of_more(factor, freedom)
    return either(more, factor, 1.0), either(more, 0.0, freedom)


def _cell_displacements(sectors: Sectors, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements (K, 2, C) in px of the rims over cells, inner circle first, and their information."""
    pull, hold = (v.double().unflatten(1, (2, -1, _CELL)).sum(-1) for v in (sectors.pull, sectors.hold))
    hold = hold / variance[:, None, None]
    return either(hold > 0, pull / variance[:, None, None] / hold.clamp_min(_TINY), 0.0), hold


def of_more(factor: Tensor, freedom: Tensor) -> Tensor:
    """Mean squares that are those of more than noise: by half of the deviations that make a value none.

    A wrong factor costs little, and comes once in forty frames.
    """
    return factor > 1 + 0.5 * CUT * (2 / freedom.clamp_min(1)).sqrt()


def _beyond_harmonics(error: Tensor, hold: Tensor) -> tuple[Tensor, Tensor]:
    """Chi-squared (K,) of errors (K, 2, C) around two circles, of variance 1 / hold, with a mean and two harmonics of
    each taken off, and its degrees of freedom (K,).
    """
    basis = _harmonics(hold)
    weighted = hold[..., None] * basis
    right = (weighted * error[..., None]).sum(-2)
    held = (weighted.flatten(0, 1).mT @ basis).view(-1, *basis.shape[-1:] * 2)
    taken = (solve_scaled(held, right.flatten(0, 1)).view_as(right) * right).sum(-1)
    free = ((hold > 0).sum(-1) - basis.shape[-1]).clamp_min(0).sum(-1).double()
    return ((hold * error.square()).sum(-1) - taken).sum(-1), free


def _displacements(sectors: Sectors, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements (K, 2, 48) in px of the rims in single sectors, inner circle first, and their information."""
    pull, hold = (v.double().unflatten(1, (2, SECTORS)) / variance[:, None, None] for v in (sectors.pull, sectors.hold))
    return either(hold > 0, pull / hold.clamp_min(_TINY), 0.0), hold


def _harmonics(around: Tensor) -> Tensor:
    """A mean and two harmonics (S, 5) of what goes around a circle in S parts, the last dimension."""
    return _made_harmonics(around.shape[-1], around.dtype, around.device)


@cache
def _made_harmonics(parts: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        angle = (torch.arange(parts, dtype=dtype, device=device) + 0.5) * (2 * math.pi / parts)
        harmonics = [of(k * angle) for k in (1, 2) for of in (torch.cos, torch.sin)]
        return torch.stack([torch.ones_like(angle), *harmonics], -1)


def in_step(
    sectors: Sectors, variance: Tensor, rings: Tensor, row: Tensor, rows: int
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2"], Float[Tensor, "K 2"]]:
    """By how much the shifts of rings along u and along v scatter more than independent edges would let them, as a
    factor of variance, the degrees of freedom that tell it, and the variance (px^2) that these edges would give.

    What displaces the lines of a frame displaces all edges on a line alike: those left and right in a ring, of both its
    circles, and of the rings beside it. These pulls add up in a shift, which no scatter along a rim shows. So pulls
    along u are summed over bands of lines, and the mean square of the sums is compared with that of independent edges
    (variance by clusters; Liang and Zeger 1986); along v over bands of columns. Taken off is what `overdispersion`
    takes off.

    Args:
        sectors: weighted as in the fit. variance: (K,) of noise. rings: (K, 2, 5) ellipses, outer one first.
            row: (K,) of ``rows``.
    """
    error, hold = _displacements(sectors, variance)
    basis = _harmonics(hold)
    inverse = scaled_inverse(((hold[..., None] * basis).mT @ basis).flatten(0, 1))[0].unflatten(0, (-1, 2))
    taken = basis @ inverse @ ((hold * error)[..., None, :] @ basis).mT
    place, normal = _edges(rings.flip(1))  # inner circle first
    pulls = hold[..., None] * normal
    step = rings[:, 0, 2:4].prod(-1).sqrt() * (2 * math.pi / SECTORS)  # px along the outer rim
    height = _BAND * segment_mean(step, row, rows)[row, None, None, None]
    band = (place.flip(-1) / height).floor().long().movedim(-1, 0)  # (2, K, 2, 48)
    same = (band[..., :, None] == band[..., None, :]).to(hold)
    by_harmonic = pulls.movedim(-1, 0)[..., None] * basis
    taken_off = ((by_harmonic @ inverse) * (same @ by_harmonic)).sum(-1)
    alone = (pulls * normal).movedim(-1, 0)
    usual, sums = alone - taken_off, (pulls * (error[..., None] - taken)).movedim(-1, 0)
    low = band.amin()
    count = int(band.amax() - low) + 1
    of = (band - low + count * row[:, None, None]).flatten(1)
    bands = hold.new_zeros(2, 2, rows * count)
    bands[0].scatter_add_(1, of, sums.flatten(1))
    bands[1].scatter_add_(1, of, usual.flatten(1))
    found, expected = bands.unflatten(-1, (rows, count)).movedim(1, -1)  # (N, count, 2)
    total = expected.sum(1).clamp_min(_TINY)
    freedom = total.square() / expected.square().sum(1).clamp_min(_TINY)
    return found.square().sum(1) / total, freedom, 1 / alone.sum((-1, -2)).mT.clamp_min(_TINY)


def shift_scatter(sectors: Sectors, variance: Tensor, rings: Tensor, row: Tensor, rows: int) -> Float[Tensor, " N"]:
    """By how much the shifts of rings scatter more than independent edges would let them (N,), as a factor of variance.

    A shift is the first harmonic of what displaces a rim. It cannot be told from the pose, but the third, fifth and
    seventh can: what is white along the rim gives all of them the same power, what is correlated over some px gives the
    first one more, and what is symmetric (the cells of a printer) gives another to even ones, of which sizes and tilts
    are made. Their power is taken for a Gaussian of the frequency along the rim, A exp(-(q k / r)^2), and the first
    one's is its mean over the widths q that remain possible.

    Args:
        sectors, variance, rings, row, rows: as for `in_step`.
    """
    error, hold = _displacements(sectors, variance)
    basis = _harmonics(hold)
    weighted = hold[..., None] * basis
    taken = solve_scaled((weighted.mT @ basis).flatten(0, 1), (weighted.mT @ error[..., None]).flatten(0, 1))
    pull = hold * (error - (basis @ taken.unflatten(0, (-1, 2)))[..., 0])
    order = torch.tensor(_ODD, dtype=hold.dtype, device=hold.device)
    wave = torch.polar(torch.ones_like(order)[:, None], order[:, None] * middles(hold.device).to(hold))  # (3, 48)
    held = hold.sum(-1)  # (K, 2)
    power = (pull.to(wave) @ wave.mT).abs().square() / held.clamp_min(_TINY)[..., None]  # 1 of independent edges
    radius = rings.flip(1)[..., 2:4].prod(-1).sqrt()  # inner circle first, as the sectors
    about = (rings[:, 0, 2:4].prod(-1).sqrt()[:, None] / radius.clamp_min(_TINY))[..., None, None]
    width = torch.tensor(_WIDTHS, dtype=hold.dtype, device=hold.device)
    damping = (-(width * about * order[:, None]).square()).exp()  # (K, 2, 3, Q)
    seen = (held > 0).to(hold)[..., None, None]
    count = len(_ODD) * segment_sum(seen.sum((1, 2, 3)), row, rows)[:, None]
    height = segment_sum((seen * power[..., None] / damping).sum((1, 2)), row, rows) / count.clamp_min(1)
    fall = segment_sum((seen * damping.log()).sum((1, 2)), row, rows)
    share = torch.softmax(-count * height.clamp_min(_TINY).log() - fall, -1)  # powers are exponential about their means
    first = (-(width * about[..., 0]).square()).exp()  # (K, 2, Q)
    weight = segment_sum(held.sum(-1), row, rows).clamp_min(_TINY)
    first = segment_sum((held[..., None] * first).sum(1), row, rows) / weight[:, None]
    return (share * height * first).sum(-1)


def level_scatter(
    sectors: Sectors, weight: Tensor, residual: Tensor, variance: Tensor, row: Tensor, rows: int
) -> Tensor:
    """Mean square (N,) of the sums of residuals over cells, over that of independent pixels.

    Correlated noise pulls at the levels of ring and paper by more than at an edge, which it shifts only where it
    differs from one side to the other. What the levels themselves may take is taken off as in `overdispersion`.

    Args:
        weight: (K, P) of the pixels, by their share of the ring, or of the paper. residual: (K, P), grey levels.
            variance: (K,) of noise. row: (K,) of ``rows``.
    """
    planes = weight * residual, weight.square() * variance[:, None].to(weight)
    flat, empty = sectors.cell.flatten(), torch.zeros_like(sectors.used)
    sums, usual = (
        empty.flatten().scatter_add(0, flat, plane.flatten()).view(len(row), 2, -1, _CELL).sum(-1).double()
        for plane in planes
    )
    chi2, freedom = _beyond_harmonics(either(usual > 0, sums / usual.clamp_min(_TINY), 0.0), usual)
    return segment_sum(chi2, row, rows) / segment_sum(freedom, row, rows).clamp_min(1)


def _edges(rings: Tensor) -> tuple[Tensor, Tensor]:
    """Places (K, 2, 48, 2) in px of the sectors' middles on ellipses (K, 2, 5), and normals there."""
    angle = middles(rings.device)
    around = torch.stack([angle.cos(), angle.sin()], -1)
    shape = conics.shape_matrix(rings)
    normal = torch.nn.functional.normalize(around @ torch.linalg.inv(shape), dim=-1)
    return rings[..., None, :2] + around @ shape, normal


def of_noise(more: Tensor) -> Tensor:
    """Most (N,) that noise takes off chi-squared, by chance, in a step from some pixels to ``more`` (N,) times as many:
    alone it takes more - 1 times its usual.
    """
    return POSE * of_chance(float(POSE)) * (more - 1)


def doubtful(sectors: Sectors, clear: Tensor, variance: Tensor, row: Tensor, step_chi2: Tensor, more: Tensor) -> Tensor:
    """Rows (N,) bool whose grey values contradict the model, or that have not come to rest.

    Args:
        variance: (K,) of noise. row: (K,) int64. step_chi2: (N,) chi-squared by which the last step lowered the sum.
            more: (N,) how many times the pixels of the steps before it saw.
    """
    rows = step_chi2.numel()
    unclear = (~clear & (sectors.total > 0))[:, SECTORS:].sum(-1) > _UNCLEAR
    chi2, hold = _cells(
        sectors.scaled(clear.to(sectors.pull.dtype)), variance[:, None].to(sectors.pull.dtype), _DISPLACED
    )
    total = segment_sum(chi2.double().sum(-1), row, rows) - step_chi2
    freedom = segment_sum((hold > 0).double().sum(-1), row, rows).clamp_min(1)
    pulled = total > freedom * of_chance(freedom)
    return pulled | (step_chi2 > of_noise(more)) | (segment_sum(unclear.double(), row, rows) > 0)
