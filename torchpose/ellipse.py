"""Stage: batched direct least-squares ellipses over flat points.

Every function takes points as flat (E, 2) with the ellipse index (E,), so thousands of rings of all frames of a batch
are fitted by one sequence of tensor operations. Ellipses are (cx, cy, a >= b, theta in [0, pi) from +u towards +v).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from torchpose.errors import ArgumentError
from torchpose.geometry import conics
from torchpose.geometry.arguments import checked, expect_index, expect_not_negative, expect_positive
from torchpose.geometry.least_squares import geman_mcclure
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import Tiles

_SOLVABLE_POINTS = 6  # five parameters and one point to spare (derived)
_CHUNK = 1 << 15  # points summed at a time: blocks that stay in the processor's cache
_MOST_PADDING = 4  # places a point: beyond, points are summed one by one (convention: cost alone depends on it)
_FLAT = 1e-12  # squared ratio of the extents of a point set across and along, below which it is a line (convention)

Method = Literal["halir-flusser", "taubin"]
Points = Real[Tensor, "E 2"]
Index = Int[Tensor, " E"]
Weights = Real[Tensor, " E"] | None
Ellipses = Float[Tensor, "M 5"]
Vector = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class EllipseFit(Rows):
    """Fitted ellipses with their uncertainty.

    Attributes:
        params: cx, cy, a, b (px), theta (rad); NaN where the points define no ellipse.
        covariance: of (cx, cy, e11, e12, e22): the centre, and the symmetric change E of the shape matrix diag(a, b) in
            the ellipse's own axes. var(a) = var(e11), var(b) = var(e22), var(theta) = var(e12) / (a - b)^2. Unlike
            theta, e12 stays defined for a circle.
        sigma: RMS distance of the points (weighted), px.
        points: sum of the weights: number of points that count.
    """

    params: Float[Tensor, "M 5"]
    covariance: Float[Tensor, "M 5 5"]
    sigma: Float[Tensor, " M"]
    points: Float[Tensor, " M"]

    @property
    def center_covariance(self) -> Float[Tensor, "M 2 2"]:
        """Covariance of the centre, px^2."""
        return self.covariance[:, :2, :2]


@checked
def fit(
    points: Points, index: Index, count: int, weights: Weights = None, *, method: Method = "halir-flusser"
) -> Ellipses:
    """Direct least-squares ellipses in float64.

    "halir-flusser" minimises the weighted sum of squared algebraic distances subject to 4AC - B^2 = 1 (Fitzgibbon 1999
    in the stable form of Halir and Flusser 1998): always an ellipse, but too small on short noisy arcs. "taubin" takes
    the mean squared gradient for the constraint (Taubin 1991): nearly the fit of least distances, dearer, and NaN where
    the best conic is no ellipse. What arcs cost: `scripts/arc_statistics.py`, its table in docs/precision.md. On whole
    ellipses both agree within a fraction of the noise. Points of one ellipse need not follow each other, but are fitted
    faster where the index is sorted.

    Args:
        points: px; those of weight 0 may be NaN.
        index: ellipse of each point.
        count: number of ellipses.
        weights: not negative; 1 by default.
        method: see above.

    Returns:
        NaN for ellipses with fewer than 6 points of weight above 0, whose points lie on a line, or with a NaN among
        them.

    Raises:
        ArgumentError: shapes or dtypes that do not fit, an index outside of 0 to count - 1, a negative weight, an
            unknown method; so do all functions of this module.
    """
    _expect(index, count, weights)
    if count == 0:
        return torch.zeros(0, 5, dtype=torch.float64, device=points.device)
    if weights is None and _is_blocked(index, count):
        blocks = points.view(count, -1, 2).split(max(1, _CHUNK * count // index.numel()))
        parts = [_moments(block) for block in blocks]
    elif count * int(torch.bincount(index).max() if index.numel() else 0) > _MOST_PADDING * index.numel():
        parts = [_tile_moments(*_tiled(points, index, count, weights))]
    else:
        parts = [_moments(block, weight) for block, weight in _padded(points, index, count, weights)]
    return _from_moments(*(torch.cat(part) for part in zip(*parts, strict=True)), method=method)


def _expect(index: Tensor, count: int, weights: Tensor | None = None) -> None:
    expect_not_negative(count=count)
    expect_index("index", index, count)
    if weights is not None:
        expect_not_negative(weights=weights)


def _is_blocked(index: Tensor, count: int) -> bool:
    """Whether all ellipses have the same number of points, one after the other."""
    if index.numel() == 0 or index.numel() % count:
        return False
    return bool((index.view(count, -1) == torch.arange(count, device=index.device)[:, None]).all())


def _padded(points: Tensor, index: Tensor, count: int, weights: Tensor | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Blocks (m, P, 2) of the points of successive ellipses and their weights (m, P), 0 where there is no point."""
    if bool((index[1:] < index[:-1]).any()):
        index, order = index.sort(stable=True)
        points, weights = points[order], None if weights is None else weights[order]
    sizes = torch.bincount(index, minlength=count)
    ends = sizes.cumsum(0)
    slot = torch.arange(index.numel(), device=index.device) - (ends - sizes)[index]
    for low in range(0, count, step := max(1, _CHUNK * count // max(1, index.numel()))):
        some = sizes[low : low + step]
        first, last = int(ends[low] - sizes[low]), int(ends[low : low + step][-1])
        at = (index[first:last] - low, slot[first:last])
        weight = torch.zeros(len(some), int(some.max()), dtype=torch.float64, device=points.device)
        block = weight.new_zeros(*weight.shape, 2)
        block[at] = points[first:last].double()
        weight[at] = 1.0 if weights is None else weights[first:last].double()
        yield block, weight


@checked
def fit_blocks(
    points: Float[Tensor, "M P 2"], weights: Real[Tensor, "M P"] | None = None, *, method: Method = "halir-flusser"
) -> Ellipses:
    """As `fit`, of ellipses with the same number of points.

    Free of data-dependent control flow: ``torch.compile(fit_blocks)`` fuses it, at half the cost or less.
    """
    if weights is not None:
        expect_not_negative(weights=weights)
    return _from_moments(*_moments(points, weights), method=method)


def _moments(points: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Centroids (M, 2), mean central moments (M, 12), and whether there are enough points (M,).

    The moments are m20 m11 m02, m30 m21 m12 m03, m40 m31 m22 m13 m04.
    """
    xy = points.double().mT.contiguous()  # (M, 2, P): the fastest layout by far for all that follows
    if weights is None:
        w: Tensor | None = None
        total: Tensor | int = xy.shape[2]
        enough = torch.full((xy.shape[0],), xy.shape[2] >= _SOLVABLE_POINTS, device=xy.device)
        center = xy.mean(-1)
    else:
        w = weights.double()[:, None]
        xy = torch.where(w > 0, xy, 0.0)
        total, enough = w.sum(-1), (w > 0).sum(-1).squeeze(-1) >= _SOLVABLE_POINTS
        center = (xy @ w.mT).squeeze(-1) / total
    # writing in place saves a copy, and leaves no gradient
    sums = _fused_sums if torch.compiler.is_compiling() or xy.requires_grad else _gram_sums
    return center, sums(xy, center[..., None], w) / total, enough


def _tiled(points: Tensor, index: Tensor, count: int, weights: Tensor | None = None) -> tuple[Tiles, Tensor, Tensor]:
    """Points (K, 2, T) and their weights (K, 1, T) laid out in tiles."""
    tiles = Tiles.of(index, count)
    weights = torch.ones_like(index, dtype=torch.float64) if weights is None else weights.double()
    xy, w = tiles.planes(*points.double().unbind(-1), weights).split([2, 1], 1)
    return tiles, xy, w


def _tile_moments(tiles: Tiles, xy: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `_moments`, for ellipses whose numbers of points differ too much for one block."""
    counts = weights > 0
    xy = torch.where(counts, xy, 0.0)
    total, used = tiles.sums(weights.sum(-1)), tiles.sums(counts.sum(-1))
    center = tiles.sums((xy * weights).sum(-1)) / total
    sums = _fused_sums if xy.requires_grad else _gram_sums
    moments = tiles.sums(sums(xy, center[tiles.group][..., None], weights)) / total
    return center, moments, used.squeeze(-1) >= _SOLVABLE_POINTS


def _gram_sums(xy: Tensor, center: Tensor, weights: Tensor | None) -> Tensor:
    """Sums (M, 12) of the monomials of `_moments` of points (M, 2, P) about centres (M, 2, 1): one matrix product."""
    planes = xy.new_empty(xy.shape[0], 5, xy.shape[2])  # x, y, x^2, xy, y^2
    torch.sub(xy, center, out=planes[:, :2])
    torch.mul(planes[:, :2], planes[:, :1], out=planes[:, 2:4])
    torch.mul(planes[:, 1], planes[:, 1], out=planes[:, 4])
    left = planes[:, 2:] if weights is None else planes[:, 2:] * weights
    gram = left @ planes.mT
    return torch.cat([left.sum(-1), gram[:, 0, :2], gram[:, 2, :2], gram[:, 0, 2:], gram[:, 1:, 4]], -1)


def _fused_sums(xy: Tensor, center: Tensor, weights: Tensor | None) -> Tensor:
    """The same as plain sums, which a compiler makes one pass over the points of."""
    x, y = (xy - center).unbind(1)
    xx, xy_, yy = x * x, x * y, y * y
    terms = (xx, xy_, yy, xx * x, xx * y, yy * x, yy * y, xx * xx, xx * xy_, xx * yy, xy_ * yy, yy * yy)
    return torch.stack([(z if weights is None else z * weights[:, 0]).sum(-1) for z in terms], -1)


def _from_moments(center: Tensor, moments: Tensor, enough: Tensor, *, method: Method) -> Tensor:
    """Ellipses (M, 5) from the results of `_moments`."""
    return _Conics.of(center, moments, enough, method).ellipses()


class _Conics(NamedTuple):
    """Fitted conics (M, 6) of points about ``center`` (M, 2), in units of ``scale`` (M,); not all sound (M,)."""

    conic: Tensor
    center: Tensor
    scale: Tensor
    sound: Tensor

    @classmethod
    def of(cls, center: Tensor, moments: Tensor, enough: Tensor, method: Method = "halir-flusser") -> Self:
        """From the results of `_moments`."""
        rows = moments.mT.contiguous()
        square = (rows[0] + rows[2]).reciprocal()
        scale = square.rsqrt()
        scaled = torch.cat([rows[:3] * square, rows[3:7] * (square / scale), rows[7:] * square.square()])
        conic = _taubin(scaled.unbind(0)) if method == "taubin" else _halir_flusser(scaled)
        m20, m11, m02 = scaled[:3].unbind()  # m20 + m02 = 1, so their determinant is the squared ratio of the extents
        return cls(conic, center, scale, enough & (m20 * m02 - m11 * m11 > _FLAT))

    def ellipses(self) -> Tensor:
        """(M, 5)."""
        ellipse, scale = conics.ellipse_from_conic(self.conic), self.scale[:, None]
        ellipse = torch.cat([ellipse[:, :2] * scale + self.center, ellipse[:, 2:4] * scale, ellipse[:, 4:]], -1)
        return torch.where(self.sound[:, None], ellipse, torch.nan)


def _halir_flusser(moments: Tensor) -> Tensor:
    """Conics (M, 6) of central moments (12, M), as `_moments` orders them, with m20 + m02 = 1.

    The 3x3 eigenproblem in closed form. Matrices are (rows, columns, M): planes of numbers, few calls and fast ones.
    """
    mean, third, fourth = moments[:3], moments[3:7], moments[7:]
    # the moments of one order make up a Hankel matrix
    square, mixed, quartic = mean.unfold(0, 2, 1).mT, third.unfold(0, 2, 1).mT, fourth.unfold(0, 3, 1).mT
    eye = torch.eye(3, dtype=moments.dtype, device=moments.device)[..., None]
    # scatter matrix of (x^2, xy, y^2) after eliminating the linear part (x, y, 1); the trace of the square is 1
    det = mean[0] * mean[2] - mean[1].square()
    linear = (mixed[:, :, None] * ((eye[:2, :2] - square) / det)).sum(1)
    scatter = quartic - (linear[:, None] * mixed).sum(2) - mean[:, None] * mean
    # rows of M = C^-1 S with the constraint matrix C of 4AC - B^2
    quadratic = _positive_eigenvector(torch.stack([0.5 * scatter[2], -scatter[1], 0.5 * scatter[0]]), eye)
    # back-substitute the linear part
    rest = torch.cat([linear, mean[:, None]], 1)
    return torch.cat([quadratic, -(quadratic[:, None] * rest).sum(0)]).mT


def _taubin(moments: tuple[Tensor, ...]) -> Tensor:
    """Conics (M, 6) of central moments: smallest eigenvector of the scatter against the mean squared gradient."""
    m20, m11, m02, m30, m21, m12, m03, m40, m31, m22, m13, m04 = moments
    zero, one = torch.zeros_like(m20), torch.ones_like(m20)
    # (A, B, C, D, E) after eliminating F = -(A m20 + B m11 + C m02)
    mean = torch.stack([m20, m11, m02, zero, zero], -1)
    products = [
        [m40, m31, m22, m30, m21],
        [m31, m22, m13, m21, m12],
        [m22, m13, m04, m12, m03],
        [m30, m21, m12, m20, m11],
        [m21, m12, m03, m11, m02],
    ]
    scatter = torch.stack([torch.stack(row, -1) for row in products], -2) - mean[:, :, None] * mean[:, None]
    # mean of (2 A x + B y + D)^2 + (B x + 2 C y + E)^2, m20 + m02 = 1
    squares = [
        [4 * m20, 2 * m11, zero, zero, zero],
        [2 * m11, m20 + m02, 2 * m11, zero, zero],
        [zero, 2 * m11, 4 * m02, zero, zero],
        [zero, zero, zero, one, zero],
        [zero, zero, zero, zero, one],
    ]
    factor, failed = torch.linalg.cholesky_ex(torch.stack([torch.stack(row, -1) for row in squares], -2))
    sound = ((failed == 0) & scatter.isfinite().all(-1).all(-1))[:, None, None]
    eye = torch.eye(5, dtype=scatter.dtype, device=scatter.device)
    factor, scatter = torch.where(sound, factor, eye), torch.where(sound, scatter, eye)
    half = torch.linalg.solve_triangular(factor, scatter, upper=False)
    white = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    _, vectors = torch.linalg.eigh(white)
    best = torch.linalg.solve_triangular(factor.mT, vectors[:, :, :1], upper=True).squeeze(-1)
    conic = torch.cat([best, -(best * mean).sum(-1, keepdim=True)], -1)
    return torch.where(sound[:, 0], conic, torch.nan)


def _positive_eigenvector(matrix: Tensor, eye: Tensor) -> Tensor:
    """Eigenvectors (3, M) of the one non-negative eigenvalue of C^-1 S (3, 3, M), the largest of three real ones."""
    centered = matrix - matrix.diagonal().mean(-1) * eye
    p = ((centered * centered.transpose(0, 1)).sum((0, 1)) / 6).clamp_min(0)
    det = (torch.linalg.cross(centered[0], centered[1], dim=0) * centered[2]).sum(0)
    root = p.sqrt()
    largest = 2 * root * ((det / (2 * p * root)).clamp(-1, 1).acos() / 3).cos()
    rows = centered - largest * eye
    # the null vector is the cross product of any two independent rows: take the longest of the three
    crosses = torch.linalg.cross(rows, rows.roll(-1, 0), dim=1)
    longest = crosses.square().sum(1, keepdim=True).argmax(0, keepdim=True)
    return crosses.gather(0, longest.expand(1, 3, -1)).squeeze(0)


@checked
def distance(points: Points, index: Index, ellipses: Ellipses) -> Float[Tensor, " E"]:
    """Signed first-order distances in px of points to their ellipses, positive outside (Sampson)."""
    _expect(index, len(ellipses))
    value, gx, gy = _radial(points, index, ellipses)
    return value / torch.sqrt(gx * gx + gy * gy)


@checked
def curvature(points: Points, index: Index, ellipses: Ellipses) -> Float[Tensor, " E"]:
    """Curvature in 1/px of the ellipses where the rays from their centres through the points meet them."""
    _expect(index, len(ellipses))
    _, gx, gy = _radial(points, index, ellipses)
    steep = gx * gx + gy * gy
    # p^3 / (a b)^2 with p = 1 / |grad rho| the distance of the tangent from the centre
    return 1 / (steep * steep.sqrt() * (ellipses[:, 2] * ellipses[:, 3]).square().index_select(0, index))


def _radial(points: Tensor, index: Tensor, ellipses: Tensor) -> Vector:
    """rho - 1 (E,) and its gradient, two of (E,); rho = |S^-1 (x - c)| the elliptic radius."""
    of = (v.contiguous().index_select(0, index) for v in _inverse_shape(ellipses).unbind(-1))
    return _radius(*points.double().unbind(-1), *of)


def _inverse_shape(ellipses: Tensor) -> Tensor:
    """(M, 5): what `_radius` needs of ellipses (M, 5)."""
    shape = conics.shape_matrix(ellipses)
    s11, s12, s22 = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    det = s11 * s22 - s12.square()
    return torch.stack([ellipses[:, 0], ellipses[:, 1], s22 / det, -s12 / det, s11 / det], -1)


def _radius(x: Tensor, y: Tensor, cx: Tensor, cy: Tensor, i11: Tensor, i12: Tensor, i22: Tensor) -> Vector:
    dx, dy = x - cx, y - cy
    u, v = i11 * dx + i12 * dy, i12 * dx + i22 * dy
    rho = torch.sqrt(u * u + v * v)
    return rho - 1, (i11 * u + i12 * v) / rho, (i12 * u + i22 * v) / rho


@checked
def fit_robust(
    points: Points,
    index: Index,
    count: int,
    *,
    start: Ellipses,
    scales: tuple[float, ...] = (2.0, 1.0, 0.5),
    cut: float = 4.0,
) -> tuple[Ellipses, Bool[Tensor, " E"]]:
    """Ellipses from points of which some lie elsewhere (cover, glare, neighbouring edges), and which were kept.

    Iteratively reweighted direct fits from ``start``: first with Geman-McClure weights of falling scale, then with the
    points within ``cut`` robust standard deviations only, unweighted, so that the result is a plain least-squares fit.

    Points, their index and the count are given as in `fit`.

    Args:
        start: rough ellipses to start from.
        scales: px, scales of the weights, from the error of ``start`` down to a few times the edge noise.
        cut: in standard deviations.
    """
    _expect(index, count)
    expect_positive(cut=cut, **{f"scales[{i}]": scale for i, scale in enumerate(scales)})
    if len(start) != count:
        raise ArgumentError(f"start: has {len(start)} ellipses; give one for each of the {count} of count")
    near = Near.of(points, index, start)
    _, keep = near.robust(near.circle, scales, cut)
    ellipses = _Conics.of(*_tile_moments(near.tiles, near.xy, keep[:, None])).ellipses()
    return ellipses, near.tiles.flat(keep) > 0


class Near(NamedTuple):
    """Points near M ellipses, in coordinates in which each of these is the unit circle.

    There a conic a . (x^2, xy, y^2, x, y) = 1 near the circle is found by one linear solution, of small residuals about
    as well as by the direct fit, and the distances from it are two products of matrices. Points that are not finite
    count nothing.

    Attributes:
        tiles: the points'.
        xy: (K, 2, T), px, 0 where there is none.
        there: (K, T), 1 where there is one, else 0.
        terms: (K, 6, T), x^2, xy, y^2, x, y and 1.
        center: (M, 2), of the ellipses.
        inverse: (M, 2, 2), from px about them to these coordinates.
    """

    tiles: Tiles
    xy: Tensor
    there: Tensor
    terms: Tensor
    center: Tensor
    inverse: Tensor

    @classmethod
    def of(cls, points: Tensor, index: Tensor, ellipses: Tensor) -> Self:
        """Of points (E, 2) near the ellipses (M, 5) of their index (E,)."""
        ellipses = ellipses.double()
        tiles, inverse = Tiles.of(index, len(ellipses)), torch.linalg.inv_ex(conics.shape_matrix(ellipses)).inverse
        return cls._at(tiles, points, ellipses[:, :2], inverse)

    @classmethod
    def _at(cls, tiles: Tiles, points: Tensor, center: Tensor, inverse: Tensor) -> Self:
        u, v = points.double().unbind(-1)
        planes = tiles.planes(u, v, torch.ones_like(u))
        finite = planes.isfinite().all(1, keepdim=True)
        xy, there = torch.where(finite, planes, 0.0).split([2, 1], 1)
        unit = torch.bmm(inverse[tiles.group], xy - center[tiles.group][..., None])
        terms = xy.new_ones(xy.shape[0], 6, xy.shape[2])
        torch.mul(unit, unit[:, :1], out=terms[:, :2])
        torch.mul(unit[:, 1], unit[:, 1], out=terms[:, 2])
        terms[:, 3:5] = unit
        return cls(tiles, xy, there[:, 0], terms, center, inverse)

    def moved(self, points: Tensor) -> Self:
        """The same points at other places (E, 2)."""
        return self._at(self.tiles, points, self.center, self.inverse)

    @property
    def circle(self) -> Tensor:
        """Conics (M, 5) of the ellipses themselves."""
        return self.terms.new_tensor([1.0, 0.0, 1.0, 0.0, 0.0]).expand(len(self.center), 5)

    def slopes(self, conic: Tensor) -> Tensor:
        """Gradients (K, 2, T) of conics (M, 5) at the points, per px."""
        a, b, c, d, e = conic.unbind(-1)
        slope = torch.stack([2 * a, b, d, b, 2 * c, e], -1).unflatten(-1, (2, 3))
        return torch.bmm(torch.bmm(self.inverse, slope)[self.tiles.group], self.terms[:, 3:])

    def distances(self, conic: Tensor, slopes: Tensor | None = None) -> Tensor:
        """First-order distances (K, T) in px of the points from conics (M, 5), positive outside (Sampson)."""
        slopes = self.slopes(conic) if slopes is None else slopes
        both = torch.nn.functional.pad(conic, (0, 1), value=-1.0)[:, None]
        value = torch.bmm(both[self.tiles.group], self.terms).squeeze(1)
        return value / _length(slopes)

    def curvatures(self, conic: Tensor, slopes: Tensor) -> Tensor:
        """Curvatures (K, T) in 1/px of the level curves of conics (M, 5) at the points."""
        second = conic[:, (0, 1, 1, 2)].unflatten(-1, (2, 2)) * conic.new_tensor([[2.0, 1.0], [1.0, 2.0]])
        second = torch.bmm(torch.bmm(self.inverse, second), self.inverse)[self.tiles.group]
        steep = _length(slopes)
        along = torch.stack([slopes[:, 1], -slopes[:, 0]], 1)
        return (torch.bmm(second, along) * along).sum(1) / steep**3

    def robust(self, conic: Tensor, scales: tuple[float, ...], cut: float = 4.0) -> tuple[Tensor, Tensor]:
        """Conics (M, 5) from ``conic`` on, see `fit_robust`, and which points were kept (K, T), 1 or 0."""

        def trust(off: Tensor, scale: float) -> Tensor:
            return self.there * geman_mcclure(off / scale).nan_to_num(nan=0.0)

        for scale in scales:
            conic = self.refit(trust(self.distances(conic), scale), conic)
        keep = before = self.there
        for number in range(3):
            r = self.distances(conic)
            # the weighted RMS under Geman-McClure weights is a scale that outliers hardly move
            w = trust(r, scales[-1])
            sums = self.tiles.sums(torch.stack([w * r.square().nan_to_num(nan=0.0), w], 1).sum(-1))
            sigma = (sums[:, 0] / sums[:, 1]).sqrt()
            before, keep = keep, self.there * (r.abs() <= (cut * sigma + 0.02)[self.tiles.group, None])
            if number and torch.equal(before, keep):  # the same points again
                break
            conic = self.refit(keep, conic)
        return conic, keep

    def refit(self, weights: Tensor, old: Tensor) -> Tensor:
        """Conics (M, 5) of the points by their weights (K, T); the ``old`` ones where they define none."""
        gram = self.tiles.sums(torch.bmm(self.terms * weights[:, None], self.terms.mT))
        conic = torch.linalg.solve_ex(gram[:, :5, :5], gram[:, :5, 5]).result
        return torch.where(conic.isfinite().all(-1, keepdim=True), conic, old)


def _length(planes: Tensor) -> Tensor:
    """Lengths (K, T) of vectors (K, 2, T), in a tenth of the time of a norm along an axis that is not the last."""
    x, y = planes.unbind(1)
    return torch.addcmul(x * x, y, y).sqrt_()


@checked
def with_covariance(
    points: Points, index: Index, ellipses: Ellipses, weights: Weights = None, *, correlation: float = 1.0
) -> EllipseFit:
    """First-order covariance of fitted ellipses from the scatter of their own points.

    To first order the direct fit is least squares of the normal distances with weights W = w |grad rho|^2, rho the
    elliptic radius: algebraic distances count points near the ends of the major axis less. So the covariance is
    sigma^2 (J^T W J)^-1 J^T W^2 J (J^T W J)^-1, sigma from the distances with E - 5 degrees of freedom.

    Points, their index and their weights are given as in `fit`.

    Args:
        ellipses: as fitted.
        correlation: variance inflation where errors are correlated along the edge (`zernike.edge_correlation`).
    """
    count = ellipses.shape[0]
    _expect(index, count, weights)
    expect_positive(correlation=correlation)
    w = torch.ones_like(points[:, 0], dtype=torch.float64) if weights is None else weights.double()
    tiles = Tiles.of(index, count)
    planes, of = tiles.planes(*points.double().unbind(-1), w), ellipses[tiles.group]
    cos, sin = of[:, 4].cos(), of[:, 4].sin()
    turn = torch.stack([cos, sin, -sin, cos], -1).view(-1, 2, 2)  # from the frame's axes to the ellipse's own
    axes, w = of[:, 2:4, None], planes[:, 2:]
    unit = torch.bmm(turn, planes[:, :2] - of[:, :2, None]) / axes
    rho = _length(unit)[:, None]
    slope = unit / (axes * rho)
    norm = _length(slope)[:, None]
    r, normal = ((rho - 1) / norm).nan_to_num(nan=0.0), slope / norm
    # unit circle coordinates s of the point with that normal: the boundary moves by n . (dc + E s)
    s = axes * normal
    s = s / _length(s)[:, None]
    own, mixed = normal * s, (normal * s.flip(1)).sum(1, keepdim=True)
    jac = torch.cat([torch.bmm(turn.mT, normal), own[:, :1], mixed, own[:, 1:]], 1).nan_to_num(nan=0.0)
    # times b, so that it is 1 where the ellipse is steepest
    algebraic = (w * (axes[:, 1:] * norm).square()).nan_to_num(nan=0.0)
    weighted = jac * algebraic
    normal_matrix = tiles.sums(weighted @ jac.mT)
    scatter = tiles.sums((weighted * algebraic) @ jac.mT)
    chi2, n = tiles.sums(torch.cat([w * r.square(), w], 1).sum(-1)).unbind(-1)
    sigma = (chi2 / (n - 5).clamp_min(1)).sqrt()
    solvable = (n >= _SOLVABLE_POINTS) & ellipses.isfinite().all(-1)
    eye = torch.eye(5, dtype=torch.float64, device=points.device)
    inverse, info = torch.linalg.inv_ex(torch.where(solvable[:, None, None], normal_matrix, eye))
    solvable = solvable & (info == 0)
    covariance = (inverse @ scatter @ inverse) * (correlation * sigma.square())[:, None, None]
    covariance = torch.where(solvable[:, None, None], covariance, torch.nan)
    return EllipseFit(ellipses, covariance, sigma, n)
