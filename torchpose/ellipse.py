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
from torchpose.geometry.constants import constant, either
from torchpose.geometry.least_squares import geman_mcclure
from torchpose.geometry.rows import Rows
from torchpose.geometry.segments import Tiles

_SOLVABLE_POINTS = 6  # five parameters and one point to spare (derived)
_CHUNK = 1 << 15  # points summed at a time: blocks that stay in the processor's cache
_MOST_PADDING = 4  # places a point: beyond, points are summed one by one (convention: cost alone depends on it)
_LEAST_SLOPE = 1e-9  # 1/px, of a conic (convention: far below that of any ellipse)
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


@checked
def fit_near(points: Points, index: Index, count: int, weights: Weights, reach: float) -> Ellipses:
    """As `fit`, then once more with weights that fall smoothly to 0 at ``reach`` px from that ellipse."""
    _expect(index, count, weights)
    tiles, xy, w = _tiled(points, index, count, weights)
    first = _Conics.of(*_tile_moments(tiles, xy, w))
    far = (first.distances(tiles, xy).nan_to_num(nan=reach) / reach).square()[:, None]
    return _Conics.of(*_tile_moments(tiles, xy, w * (1 - far).clamp_min(0).square())).ellipses()


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
    """Centroids (M, 2), mean central moments (M, 3, 6), and whether there are enough points (M,).

    The moments are means of the products of x^2, xy, y^2 and x^2, xy, y^2, x, y, 1.
    """
    xy = points.double().mT.contiguous()  # (M, 2, P): the fastest layout by far for all that follows
    if weights is None:
        w: Tensor | None = None
        total: Tensor | int = xy.shape[2]
        enough = torch.full((xy.shape[0],), xy.shape[2] >= _SOLVABLE_POINTS, device=xy.device)
        center = xy.mean(-1, keepdim=True)
    else:
        w = weights.double()[:, None]
        there = w > 0
        xy = either(there, xy, 0.0)
        total, enough = w.sum(-1, keepdim=True), there.sum((1, 2)) >= _SOLVABLE_POINTS
        center = torch.bmm(xy, w.mT) / total
    sums = _fused_sums if torch.compiler.is_compiling() else _gram_sums
    return center.squeeze(-1), sums(xy, center, w) / total, enough


def _tiled(points: Tensor, index: Tensor, count: int, weights: Tensor | None = None) -> tuple[Tiles, Tensor, Tensor]:
    """Points (K, 2, T), 0 where their weight is, and their weights (K, 1, T), laid out in tiles."""
    tiles = Tiles.of(index, count)
    weights = torch.ones_like(index, dtype=torch.float64) if weights is None else weights.double()
    xy, w = tiles.planes(*points.double().unbind(-1), weights).split_with_sizes([2, 1], 1)
    return tiles, either(w > 0, xy, 0.0), w


def _tile_moments(tiles: Tiles, xy: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `_moments`, for ellipses whose numbers of points differ too much for one block; points as of `_tiled`."""
    sums = tiles.sums(torch.cat([weights, (weights > 0).double(), xy * weights], 1).sum(-1))
    total, used, center = sums.split_with_sizes([1, 1, 2], 1)
    center = center / total
    moments = tiles.sums(_gram_sums(xy, center.index_select(0, tiles.group)[..., None], weights))
    return center, moments / total[..., None], used.squeeze(-1) >= _SOLVABLE_POINTS


def _gram_sums(xy: Tensor, center: Tensor, weights: Tensor | None) -> Tensor:
    """Sums (M, 3, 6) of `_moments` of points (M, 2, P) about centres (M, 2, 1): one matrix product."""
    xy = xy - center
    x, y = xy.split_with_sizes([1, 1], 1)
    square = torch.cat([xy * x, y * y], 1)
    left = square if weights is None else square * weights
    return torch.bmm(left, torch.cat([square, xy, torch.ones_like(x)], 1).mT)


def _fused_sums(xy: Tensor, center: Tensor, weights: Tensor | None) -> Tensor:
    """The same as plain sums, which a compiler makes one pass over the points of."""
    x, y = (xy - center).unbind(1)
    square = (x * x, x * y, y * y)
    terms = [one * other for one in square for other in (*square, x, y, torch.ones_like(x))]
    return torch.stack([(z if weights is None else z * weights[:, 0]).sum(-1) for z in terms], -1).unflatten(-1, (3, 6))


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
        planes = moments.permute(1, 2, 0).contiguous()
        square = (planes[0, 5] + planes[2, 5]).reciprocal()
        orders = constant(((2.0,), (2.0,), (2.0,), (1.5,), (1.5,), (1.0,)), square)
        planes = planes * square**orders
        m20, m11, m02 = planes[:, 5].unbind()  # m20 + m02 = 1, so their determinant is the squared ratio of the extents
        det = torch.addcmul(m20 * m02, m11, m11, value=-1)
        conic = _taubin(planes) if method == "taubin" else _halir_flusser(planes, det)
        return cls(conic, center, square.rsqrt(), enough & (det > _FLAT))

    def ellipses(self) -> Tensor:
        """(M, 5)."""
        ellipse, scale = conics.ellipse_from_conic(self.conic), self.scale[:, None]
        center, axes, theta = ellipse.split_with_sizes([2, 2, 1], -1)
        ellipse = torch.cat([torch.addcmul(self.center, center, scale), axes * scale, theta], -1)
        return either(self.sound[:, None], ellipse, torch.nan)

    def distances(self, tiles: Tiles, xy: Tensor) -> Tensor:
        """As `distance`, of points (K, 2, T) in tiles, from the ellipses; NaN where there is none."""
        a, b, c, d, e, f = self.conic.unbind(-1)
        half, square = 2 * a, 2 * c
        disc = torch.addcmul(half * square, b, b, value=-1)
        x, y = torch.addcmul(b * e, square, d, value=-1) / disc, torch.addcmul(b * d, half, e, value=-1) / disc
        # the conic is rho^2 - 1 where it is -1 at the centre
        level = f + 0.5 * torch.addcmul(d * x, e, y)
        conic = either(self.sound[:, None], self.conic / -level[:, None], torch.nan)
        rows = _rows(conic).index_select(0, tiles.group)
        unit = (xy - self.center.index_select(0, tiles.group)[..., None]) / self.scale[tiles.group, None, None]
        square, u, v = torch.bmm(rows, _terms(unit)).unbind(1)
        rho = (square + 1).sqrt()
        return 2 * rho * (rho - 1) / _length(u, v) * self.scale[tiles.group, None]


def _terms(xy: Tensor) -> Tensor:
    """x^2, xy, y^2, x, y and 1 (K, 6, T) of (K, 2, T)."""
    x, y = xy.split_with_sizes([1, 1], 1)
    return torch.cat([xy * x, y * y, xy, torch.ones_like(x)], 1)


def _rows(conic: Tensor) -> Tensor:
    """Conics (M, 6) as sums of `_terms`, and their derivatives by x and y: (M, 3, 6)."""
    return (conic @ constant(_BY_TERMS, conic)).unflatten(1, (3, 6))


# each coefficient's part in the sums of `_rows`, (6, 18)
_BY_TERMS = (
    (1.0, *[0.0] * 5, *[0.0] * 3, 2.0, 0.0, 0.0, *[0.0] * 6),
    (0.0, 1.0, *[0.0] * 4, *[0.0] * 4, 1.0, 0.0, *[0.0] * 3, 1.0, 0.0, 0.0),
    (*[0.0] * 2, 1.0, *[0.0] * 3, *[0.0] * 6, *[0.0] * 4, 2.0, 0.0),
    (*[0.0] * 3, 1.0, *[0.0] * 2, *[0.0] * 5, 1.0, *[0.0] * 6),
    (*[0.0] * 4, 1.0, 0.0, *[0.0] * 6, *[0.0] * 5, 1.0),
    (*[0.0] * 5, 1.0, *[0.0] * 12),
)


def _halir_flusser(moments: Tensor, det: Tensor) -> Tensor:
    """Conics (M, 6) of central moments (3, 6, M), as of `_moments`, with m20 + m02 = 1 and m20 m02 - m11^2 = det.

    The 3x3 eigenproblem in closed form. Matrices are (rows, columns, M): planes of numbers, few calls and fast ones.
    """
    quartic, mixed, mean = moments.split_with_sizes([3, 2, 1], 1)
    # scatter matrix of (x^2, xy, y^2) after eliminating the linear part (x, y, 1)
    signs = constant(((1.0,), (-1.0,), (-1.0,), (1.0,)), det)
    inverse = (mean[:, 0].index_select(0, constant((2, 1, 1, 0), det, torch.int64)) * signs / det).unflatten(0, (2, 2))
    rest = torch.cat([(mixed[:, :, None] * inverse).sum(1), mean], 1)
    scatter = quartic - (rest[:, None] * moments[:, 3:]).sum(2)
    # rows of M = C^-1 S with the constraint matrix C of 4AC - B^2
    quadratic = _positive_eigenvector(scatter.flip(0) * constant((((0.5,),), ((-1.0,),), ((0.5,),)), det))
    # back-substitute the linear part
    return torch.cat([quadratic, -(quadratic[:, None] * rest).sum(0)]).mT


def _taubin(moments: Tensor) -> Tensor:
    """Conics (M, 6) of central moments (3, 6, M): smallest eigenvector of the scatter against the mean squared
    gradient."""
    (m40, m31, m22, m30, m21, m20), (*_, m11), (_, m13, m04, m12, m03, m02) = moments
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
    return either(sound[:, 0], conic, torch.nan)


def _positive_eigenvector(matrix: Tensor) -> Tensor:
    """Eigenvectors (3, M) of the one non-negative eigenvalue of C^-1 S (3, 3, M), the largest of three real ones."""
    eye = constant(tuple(tuple((float(i == k),) for k in range(3)) for i in range(3)), matrix)
    centered = matrix - matrix.diagonal().mean(-1) * eye
    # Viete's solution of the cubic: the largest root is twice the radius times a cosine
    twice = ((centered * centered.transpose(0, 1)).sum((0, 1)) * (2 / 3)).clamp_min(0).sqrt()
    one, two, three = centered
    det = (torch.linalg.cross(one, two, dim=0) * three).sum(0)
    largest = twice * ((4 * det / twice.pow(3)).clamp(-1, 1).acos() / 3).cos()
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
    kept = near.tiles.flat(near.robust(near.circle, scales, cut)[1])
    return fit(points, index, count, kept), kept > 0


class Near(NamedTuple):
    """Points near M ellipses, in coordinates in which each of these is the unit circle.

    There a conic a . (x^2, xy, y^2, x, y) = 1 near the circle is found by one linear solution, of small residuals about
    as well as by the direct fit, and the distances from it are two products of matrices. Points that are not finite
    count nothing.

    Attributes:
        tiles: the points'.
        there: (K, T), 1 where there is one, else 0.
        terms: (K, 6, T), x^2, xy, y^2, x, y and 1.
        center: (M, 2), of the ellipses.
        inverse: (M, 2, 2), from px about them to these coordinates.
        rows: (M, 6, 18), as `_rows` for each coefficient of a conic, derivatives per px.
    """

    tiles: Tiles
    there: Tensor
    terms: Tensor
    center: Tensor
    inverse: Tensor
    rows: Tensor

    @classmethod
    def of(cls, points: Tensor, index: Tensor, ellipses: Tensor) -> Self:
        """Of points (E, 2) near the ellipses (M, 5) of their index (E,)."""
        ellipses = ellipses.double()
        tiles, inverse = Tiles.of(index, len(ellipses)), conics.inverse_shape(ellipses)
        each = constant(_BY_TERMS, inverse).view(6, 3, 6)
        slopes = (inverse @ each[:, 1:].transpose(0, 1).flatten(1)).unflatten(2, (6, 6)).transpose(1, 2)
        rows = torch.cat([each[None, :, :1].expand(len(inverse), -1, -1, -1), slopes], 2).flatten(2)
        return cls._at(tiles, points, ellipses[:, :2], inverse, rows)

    @classmethod
    def _at(cls, tiles: Tiles, points: Tensor, center: Tensor, inverse: Tensor, rows: Tensor) -> Self:
        u, v = points.double().unbind(-1)
        planes = tiles.planes(u, v, torch.ones_like(u))
        finite = 0 * planes.sum(1, keepdim=True) == 0
        xy, there = either(finite, planes, 0.0).split_with_sizes([2, 1], 1)
        group = tiles.group
        unit = torch.bmm(inverse.index_select(0, group), xy - center.index_select(0, group)[..., None])
        return cls(tiles, there[:, 0], _terms(unit), center, inverse, rows)

    def moved(self, points: Tensor) -> Self:
        """The same points at other places (E, 2)."""
        return self._at(self.tiles, points, self.center, self.inverse, self.rows)

    @property
    def circle(self) -> Tensor:
        """Conics (M, 5) of the ellipses themselves."""
        return constant((1.0, 0.0, 1.0, 0.0, 0.0), self.terms).expand(len(self.center), 5)

    def _rows(self, conic: Tensor) -> Tensor:
        """`_rows` (M, 3, 6) of conics (M, 5), derivatives per px."""
        return torch.bmm(torch.nn.functional.pad(conic, (0, 1), value=-1.0)[:, None], self.rows).view(-1, 3, 6)

    def distances(self, conic: Tensor) -> Tensor:
        """First-order distances (K, T) in px of the points from conics (M, 5), positive outside (Sampson)."""
        value, u, v = torch.bmm(self._rows(conic).index_select(0, self.tiles.group), self.terms).unbind(1)
        return value / _length(u, v).clamp_min_(_LEAST_SLOPE)

    def curvatures(self, conic: Tensor) -> Tensor:
        """Curvatures (K, T) in 1/px of the level curves of conics (M, 5) at the points."""
        rows = self._rows(conic)[:, 1:]
        second = torch.bmm(rows[..., 3:5], self.inverse).index_select(0, self.tiles.group)
        u, v = torch.bmm(rows.index_select(0, self.tiles.group), self.terms).unbind(1)
        along = torch.stack([v, -u], 1)
        return (torch.bmm(second, along) * along).sum(1) / _length(u, v) ** 3

    def robust(self, conic: Tensor, scales: tuple[float, ...], cut: float = 4.0) -> tuple[Tensor, Tensor]:
        """Conics (M, 5) from ``conic`` on, see `fit_robust`, and which points were kept (K, T), 1 or 0."""

        def trust(off: Tensor, scale: float) -> Tensor:
            return self.there * geman_mcclure(off / scale)

        for scale in scales:
            conic = self.refit(trust(self.distances(conic), scale), conic)
        keep = before = self.there
        for number in range(3):
            r = self.distances(conic).abs()
            # the weighted RMS under Geman-McClure weights is a scale that outliers hardly move
            w = trust(r, scales[-1])
            sums = self.tiles.sums(torch.stack([w * r * r, w], 1).sum(-1))
            limit = cut * (sums[:, :1] / sums[:, 1:]).sqrt() + 0.02
            before, keep = keep, self.there * (r <= limit.index_select(0, self.tiles.group))
            if number and torch.equal(before, keep):  # the same points again
                break
            conic = self.refit(keep, conic)
        return conic, keep

    def refit(self, weights: Tensor, old: Tensor) -> Tensor:
        """Conics (M, 5) of the points by their weights (K, T); the ``old`` ones where they define none."""
        gram = self.tiles.sums(torch.bmm(self.terms[:, :5] * weights[:, None], self.terms.mT))
        conic = torch.linalg.solve_ex(*gram.split_with_sizes([5, 1], -1)).result.squeeze(-1)
        return torch.where((0 * conic).sum(-1, keepdim=True) == 0, conic, old)


def _length(x: Tensor, y: Tensor) -> Tensor:
    """Lengths (K, T) of vectors, in a tenth of the time of a norm along an axis that is not the last."""
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
    planes, of = tiles.planes(*points.double().unbind(-1), w), ellipses.index_select(0, tiles.group)
    cos, sin = of[:, 4].cos(), of[:, 4].sin()
    turn = torch.stack([cos, sin, -sin, cos], -1).view(-1, 2, 2)  # from the frame's axes to the ellipse's own
    axes, w = of[:, 2:4, None], planes[:, 2:]
    unit = torch.bmm(turn, planes[:, :2] - of[:, :2, None]) / axes
    rho = _length(*unit.unbind(1))[:, None]
    slope = unit / (axes * rho)
    norm = _length(*slope.unbind(1))[:, None]
    r, normal = ((rho - 1) / norm).nan_to_num(nan=0.0), slope / norm
    # unit circle coordinates s of the point with that normal: the boundary moves by n . (dc + E s)
    s = axes * normal
    s = s / _length(*s.unbind(1))[:, None]
    own, mixed = normal * s, (normal * s.flip(1)).sum(1, keepdim=True)
    jac = torch.cat([torch.bmm(turn.mT, normal), own[:, :1], mixed, own[:, 1:]], 1).nan_to_num(nan=0.0)
    # times b, so that it is 1 where the ellipse is steepest
    algebraic = (w * (axes[:, 1:] * norm).square()).nan_to_num(nan=0.0)
    weighted = jac * algebraic
    both = torch.bmm(torch.cat([weighted, weighted * algebraic], 1), jac.mT)
    normal_matrix, scatter = tiles.sums(both).split_with_sizes([5, 5], 1)
    chi2, n = tiles.sums(torch.cat([w * r.square(), w], 1).sum(-1)).unbind(-1)
    sigma = (chi2 / (n - 5).clamp_min(1)).sqrt()
    solvable = (n >= _SOLVABLE_POINTS) & (0 * ellipses.sum(-1) == 0)
    eye = torch.eye(5, dtype=torch.float64, device=points.device)
    inverse, info = torch.linalg.inv_ex(torch.where(solvable[:, None, None], normal_matrix, eye))
    solvable = solvable & (info == 0)
    variance = either(solvable, correlation * sigma.square(), torch.nan)
    covariance = torch.bmm(torch.bmm(inverse, scatter), inverse) * variance[:, None, None]
    return EllipseFit(ellipses, covariance, sigma, n)
