"""What a blur makes of an edge: a Gaussian of any covariance, a line (motion), a disc (defocus).

With p displaced by the blur's (X, Y) along and across the normal n of an edge of curvature k, the share of the blur
that falls outside is, to second order in k,

    F = P(d + T > 0),   T = X + k Y^2 / 2 - k^2 X Y^2 / 2,

d the distance of the pixel outside the edge, k the curvature of the edge's level curve through the pixel. For a
Gaussian of the variances s = n'Sn, t = t'St and the covariance m, T has the mean k t / 2, the variance
s + k^2 (t^2 / 2 - s t - 2 m^2), and the cumulants 3 k m^2 and 12 k^2 m^2 (t - s) (derived), of which F is the Edgeworth
series. A line or a disc is averaged over nodes along the normal, each of them a narrow Gaussian. What T has in third
order, k^3 (X^2 Y^2 / 2 - Y^4 / 8), is counted there by its mean: of 12 px beside a radius of 18 px it is 0.006 px.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, Self, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry.quadrature import disc_chords, gauss_legendre
from torchpose.geometry.rows import Rows, replace, shared

Kind = Literal["gauss", "line", "disc"]
KINDS: tuple[Kind, ...] = get_args(Kind)
BLUR = 3  # numbers of a blur
# of a radius of curvature: blurs up to there, and pixels no nearer to the centre, see one edge and not all sides of it
# (convention; what the second order leaves: tests/geometry/test_blur.py)
HOLDS = 0.4
LEAST, MOST = 0.3, 12.0  # px, standard deviations: a pixel alone has 0.289; beyond the widest band nothing is left
LONG = 1.7  # of the variances of a blur's axes: a motion of 2 px, from which on it may be a line (derived)
_NODES_A_SIGMA = 1.1  # Gauss-Legendre nodes a half length in narrow Gaussians: an edge to 1e-3
_MOST_NODES = 40
_ON_CPU = torch.zeros(0, dtype=torch.float64)  # nodes are numbers
_CORE = 0.6  # px, of what is not the line or the disc, to begin with: a pixel, and a sharp lens
_FAR = 8.0  # standard deviations: beyond, a Gaussian is 0 to single precision, and denormal numbers cost tenfold
_SQUARE = 1 / (24 * 120)  # fourth cumulant of a pixel along its side, over -24
_LEAST_SHARE = 0.25  # of a variance that terms of second order may leave: beyond, the expansion has failed
_MOST_STEP = 0.6  # of the size of a blur that it may change by in a step: the derivatives hold no farther


@dataclass(frozen=True, eq=False)
class Spread(Rows):
    """Blurs of N rows as a block of unknowns (`geometry.least_squares`).

    Attributes:
        values: gauss: the covariance s11, s12, s22, px^2; line: variance of the Gaussian core, and the line's vector,
            px; disc: variance of the core, radius of the disc, px, and nothing.
        kind: of all rows.
    """

    values: Float[Tensor, "N 3"]
    kind: Kind = shared("gauss")

    @classmethod
    def of(cls, blur: Float[Tensor, "N 3"], kind: Kind = "gauss") -> Self:
        """The blur of a kind that has about this covariance."""
        if kind == "gauss":
            return cls(blur, kind)
        least, most = blurs.axes(blur)
        if kind == "disc":
            core = torch.full_like(least, _CORE**2).minimum(0.5 * least)
            radius = 2 * (0.5 * (least + most) - core).clamp_min(0).sqrt()
            return cls(torch.stack([core, radius, torch.zeros_like(core)], -1), kind)
        length = (12 * (most - least)).clamp_min(0).sqrt()
        s11, s12, s22 = blur.unbind(-1)
        turn = 0.5 * torch.atan2(2 * s12, s11 - s22)
        return cls(torch.stack([least, length * turn.cos(), length * turn.sin()], -1), kind)

    @property
    def size(self) -> int:
        return BLUR

    @property
    def covariance(self) -> Float[Tensor, "N 3"]:
        """s11, s12, s22, px^2."""
        if self.kind == "gauss":
            return self.values
        core, one, two = self.values.unbind(-1)
        if self.kind == "disc":
            return blurs.isotropic((core + one.square() / 4).sqrt())
        return torch.stack([core + one * one / 12, one * two / 12, core + two * two / 12], -1)

    def moved(self, step: Tensor) -> Self:
        if self.kind == "gauss":
            limit = _MOST_STEP * (self.values[:, 0] + self.values[:, 2])[:, None]
            long = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
            step = step * (limit / long.clamp_min(1e-12)).clamp_max(1.0)
            return replace(self, values=blurs.limited(self.values + step, LEAST**2, MOST**2))
        place = self._moved_disc(step) if self.kind == "disc" else self._moved_line(step)
        return replace(self, values=place)

    def _moved_line(self, step: Tensor) -> Tensor:
        core, line = self.values[:, 0], self.values[:, 1:]
        limit = _MOST_STEP * (line.square().sum(-1) + 12 * core).sqrt()
        share = (limit / torch.linalg.vector_norm(step[:, 1:], dim=-1).clamp_min(1e-12)).clamp_max(1.0)
        return torch.cat([self._core(core + step[:, 0])[:, None], line + share[:, None] * step[:, 1:]], -1)

    def _moved_disc(self, step: Tensor) -> Tensor:
        """What the image of a small disc tells is its mean square together with the core's, not its radius: so the sum
        moves as the step says, in which the square of the radius is linear, and the disc has what the core leaves."""
        core, radius, _ = self.values.unbind(-1)
        square = radius.square() / 4
        change = step[:, 0] + 0.5 * radius * step[:, 1]
        limit = _MOST_STEP * (core + square)
        total = core + square + change.clamp(-limit, limit)
        disc = (total - self._core(core + step[:, 0])).maximum(square / 4)
        core = self._core(total - disc)
        return torch.stack([core, 2 * disc.sqrt(), torch.zeros_like(core)], -1)

    def _core(self, wanted: Tensor) -> Tensor:
        """Variances (N,) of the core, within what a step may change them by."""
        core = self.values[:, 0]
        return wanted.maximum(core / 4).minimum(4 * core).clamp(LEAST**2, MOST**2)

    def at(self, row: Tensor, nu: Tensor, nv: Tensor, dims: int = 1) -> Edges:
        """Edges, of distances and curvatures (..., K, P), under the blurs of rows (K,) where the normals are nu, nv.

        ``dims``: of P.
        """
        values = self.values.index_select(0, row).float().view(-1, *[1] * (dims - 1), BLUR)
        if self.kind == "gauss":
            return _Gauss(values, nu, nv)
        return _Line(values, nu, nv) if self.kind == "line" else _Disc(values)


class Edge(NamedTuple):
    """Share of the outside in pixels, and its derivatives by the distance and by the three numbers of the blur."""

    fraction: Tensor
    by_distance: Tensor
    by_blur: tuple[Tensor, Tensor, Tensor]


class _Gauss:
    """Planes (K, P) of what the blur is across and along edges of the normals nu, nv."""

    def __init__(self, values: Tensor, nu: Tensor, nv: Tensor) -> None:
        s11, s12, s22 = values[..., None].unbind(-2)
        self.uu, self.vv, uv = nu * nu, nv * nv, nu * nv
        self.uv2 = 2 * uv
        self.across = s11 * self.uu + s12 * self.uv2 + s22 * self.vv
        self.along = s11 + s22 - self.across
        mixed2 = ((s22 - s11) * uv + s12 * (self.uu - self.vv)).square()
        # the cumulants of X + k Y^2 / 2 - k^2 X Y^2 / 2: what follows is times k or its square
        self.more = (0.5 * self.along - self.across) * self.along - 2 * mixed2
        self.third, self.fourth = 0.5 * mixed2, 0.5 * mixed2 * (self.along - self.across)
        self.square = (1 - 2 * uv.square()) * _SQUARE

    def __call__(self, distance: Tensor, bend: Tensor) -> Edge:
        half, bend2 = 0.5 * bend, bend * bend
        variance = torch.addcmul(self.across, bend2, self.more).maximum(_LEAST_SHARE * self.across)
        over2 = variance.reciprocal()
        over = over2.sqrt()
        z = (torch.addcmul(distance, half, self.along) * over).clamp_(-_FAR, _FAR)
        z2 = z * z
        density = torch.exp(z2 * -0.5) * (1 / math.sqrt(2 * math.pi))
        third = self.third * bend * over2 * over
        fourth = torch.addcmul(self.square, self.fourth, bend2, value=-1) * over2 * over2  # times -1
        # Edgeworth's series by Hermite's polynomials; He5 = z He4 - 4 He3, He6 = z He5 - 5 He4
        he3, he4 = z * (z2 - 3), z2 * (z2 - 6) + 3
        he5 = torch.sub(z * he4, he3, alpha=4)
        sixth = third * third * 0.5
        correction = torch.addcmul(torch.addcmul(third * (z2 - 1), fourth, he3), sixth, he5, value=-1)
        change = torch.addcmul(
            torch.addcmul(fourth * he4, third, he3), sixth, torch.sub(z * he5, he4, alpha=5), value=-1
        )  # times -1
        step = torch.addcmul(0.5 * torch.erfc(z * -math.sqrt(0.5)), density, correction)
        slope = torch.addcmul(density, density, change, value=-1) * over
        by_across = slope * z * over * -0.5
        by_along = half * slope
        # the variance along is the trace less that across
        change = by_across - by_along
        by_blur = (
            torch.addcmul(by_along, change, self.uu),
            change * self.uv2,
            torch.addcmul(by_along, change, self.vv),
        )
        return Edge(step, slope, by_blur)


class Edges(Protocol):
    """Edges, of distances and curvatures; ``across`` is the blur's variance across them, None where it is not kept."""

    @property
    def across(self) -> Tensor | None: ...

    def __call__(self, distance: Tensor, bend: Tensor, /) -> Edge: ...


class _Nodes(NamedTuple):
    """Means over nodes: of the step, of the slope, of its derivative by the core, and of the slope times the share of
    each node and its square."""

    step: Tensor
    slope: Tensor
    by_core: Tensor
    by_place: Tensor
    by_square: Tensor


class _Averaged:
    """Narrow edges averaged over nodes: those at a share x lie x times ``reach`` along the normal, and their mean
    square along the edge is (a + b x^2) times ``square``; planes (K, P), or columns of one number a row. ``third``: the
    mean of X^2 Y^2 / 2 - Y^4 / 8, as c0 + c2 x^2 + c4 x^4. ``uneven``: mean variance of Y^2 / 2 at a node."""

    def __init__(
        self,
        nodes: tuple[Tensor, Tensor],
        core: Tensor,
        reach: Tensor,
        square: Tensor,
        profile: tuple[float, float],
        third: tuple[float | Tensor, float | Tensor, Tensor],
        uneven: Tensor | None = None,
    ) -> None:
        self.nodes = tuple(zip(*(v.tolist() for v in nodes), strict=True))
        self.core, self.reach, self.square, self.profile, self.third = core, reach, square, profile, third
        self.uneven = uneven
        self.scale = (2 * core).rsqrt()

    def __call__(self, distance: Tensor, bend: Tensor) -> _Nodes:
        # y = (d + x n + k / 2 (s + q (1 - k x n)) + k^3 c) / sqrt(2 s) is a quartic in the share, by Horner's rule and
        # in place: a dozen nodes of some ten thousand pixels each are most of what a motion or a defocus costs
        a, b = self.profile
        scale = self.scale if self.uneven is None else (2 * (self.core + bend.square() * self.uneven)).rsqrt()
        half = 0.5 * bend * scale
        one, lean = self.reach * scale, half * bend * self.reach
        y0 = (distance * scale).addcmul(half, self.core + a * self.square)
        y1, y2, y3 = one - a * self.square * lean, b * self.square * half, -b * self.square * lean
        cubed = bend.square() * bend * scale
        c0, c2, c4 = self.third
        y0, y2, y4 = y0 + cubed * c0, y2 + cubed * c2, cubed * c4
        step, slope, by_y, by_place, by_square = distance.new_zeros(5, *distance.shape).unbind(0)
        step += 0.5
        moved, y, density = torch.empty_like(y3), torch.empty_like(y0), torch.empty_like(y0)
        for share, weight in self.nodes:
            torch.add(y3, y4, alpha=share, out=moved).mul_(share).add_(y2).mul_(share).add_(y1).mul_(share)
            torch.add(moved, y0, out=y).clamp_(-_FAR / math.sqrt(2), _FAR / math.sqrt(2))
            torch.mul(y, y, out=density).neg_().exp_()
            slope.add_(density, alpha=weight)
            by_place.add_(density, alpha=weight * share)
            by_square.add_(density, alpha=weight * share * share)
            by_y.addcmul_(density, y, value=weight)
            step.add_(y.erf_(), alpha=0.5 * weight)
        norm = scale / math.sqrt(math.pi)
        # the core both widens the edge and, where it is curved, moves it: dy / ds = k / 2 / sqrt(2 s) - y / (2 s)
        by_core = (half * slope).addcmul_(by_y, scale.square(), value=-1) * (1 / math.sqrt(math.pi))
        return _Nodes(step, slope * norm, by_core, by_place * norm, by_square * norm)


class _Line:
    """A line of the vector m: displaced evenly from -m / 2 to m / 2."""

    across: Tensor | None = None

    def __init__(self, values: Tensor, nu: Tensor, nv: Tensor) -> None:
        core, mu, mv = values.split(1, -1)
        self.nu, self.nv, self.along = nu, nv, nu * mv - nv * mu
        place, weight = gauss_legendre(_nodes(0.5 * torch.hypot(mu, mv), core), _ON_CPU)
        reach, square = nu * mu + nv * mv, self.along.square()
        third = (0.0, 0.0, (0.5 * reach.square() - 0.125 * square) * square)
        self.mean = _Averaged((place - 0.5, weight), core, reach, square, (0.0, 1.0), third)

    def __call__(self, distance: Tensor, bend: Tensor) -> Edge:
        mean = self.mean(distance, bend)
        lean = bend * self.along * mean.by_square
        by_blur = (mean.by_core, mean.by_place * self.nu - lean * self.nv, mean.by_place * self.nv + lean * self.nu)
        return Edge(mean.step, mean.slope, by_blur)


class _Disc:
    """A disc of a radius r: chords across the normal, of mean square (r^2 - x^2) / 3 along it."""

    across: Tensor | None = None

    def __init__(self, values: Tensor) -> None:
        core, self.radius, _ = values.split(1, -1)
        nodes = disc_chords(_nodes(self.radius, core), _ON_CPU)
        square, fourth = self.radius.square(), self.radius.square().square()
        # of a chord the mean of Y^4 is a fifth of the fourth power of its half length
        third = (-1 / 40 * fourth, 13 / 60 * fourth, -23 / 120 * fourth)
        self.mean = _Averaged(nodes, core, self.radius, square, (1 / 3, -1 / 3), third, fourth / 72)

    def __call__(self, distance: Tensor, bend: Tensor) -> Edge:
        mean = self.mean(distance, bend)
        by_radius = mean.by_place + bend * self.radius / 3 * (mean.slope - mean.by_square)
        return Edge(mean.step, mean.slope, (mean.by_core, by_radius, torch.zeros_like(by_radius)))


def _nodes(half: Tensor, core: Tensor) -> int:
    """Nodes for the longest of half lengths (K, 1) beside cores (K, 1)."""
    ratio = float((half / core.sqrt()).max()) if half.numel() else 0.0
    return min(_MOST_NODES, 2 + math.ceil(_NODES_A_SIGMA * ratio))


def square_cumulant(product: Tensor, variance: Tensor) -> Tensor:
    """What a pixel, a square and no Gaussian, adds to an edge whose normal has that ``product`` nu nv.

    Its fourth cumulant along the normal, -(nu^4 + nv^4) / 120 px^4, over -24 variance^2.
    """
    return (1 - 2 * product.square()) * _SQUARE / variance.square()


def blurred_step(z: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    """Step and its slope at ``z`` standard deviations: the normal law and its fourth-order term."""
    z2 = z.square()
    density = torch.exp(-0.5 * z2) * (1 / math.sqrt(2 * math.pi))
    step = 0.5 * torch.erfc(-z * math.sqrt(0.5)) + square * density * z * (z2 - 3)
    return step, density * (1 - square * (z2 * (z2 - 6) + 3))
