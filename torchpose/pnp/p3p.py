"""Perspective-three-point: all poses of three points, by the degenerate conic of Persson and Nordberg (ECCV 2018).

The unknowns are the distances of the points from the camera. Two homogeneous quadratic equations in them span a pencil
of conics; one of its members is a pair of lines, found from a cubic, and each line meets the pencil in two points. The
lines are split off by adjugates (Richter-Gebert, Perspectives on Projective Geometry, section 11.1), so that nothing
but elementwise arithmetic is needed. Newton steps on the cosine law remove what rounding left.
"""

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import cofactors3, cross, det, inverse3, matmul3
from torchpose.pnp.candidates import Candidates, batch_last, rank

_PAIRS = ((0, 1), (0, 2), (1, 2))
_POLISHING = 4


def p3p(object_points: Tensor, image_points: Tensor, mask: Tensor | None = None) -> Candidates:
    """All poses of three points; with more of them the widest three are used and the others choose.

    Args:
        object_points: (N, 3) or (B, N, 3), N >= 3.
        image_points: (B, N, 2), undistorted normalised coordinates.
        mask: (B, N) bool, True where a point was seen; at least three of them, not on a line.

    Returns:
        `Candidates` with S = 4, sorted by the reprojection error of all points (about zero where there are three only);
        NaN where there are fewer solutions.

    Raises:
        ArgumentError: the shapes do not fit.
    """
    points, xy, weight = batch_last(object_points, image_points, mask)
    return rank(*of_three(points, xy, weight), points, xy, weight)


def of_three(points: Tensor, xy: Tensor, weight: Tensor | None, *, nearly: bool = False) -> tuple[Tensor, Tensor]:
    """R (3, 3, 4, B), t (3, 4, B) from the widest three of points (3, N, B) and their images (2, N, B), unsorted.

    Two solutions that noise makes complex are NaN, or with ``nearly`` the pose where they would meet.
    """
    index = widest_triple(points, weight).expand(3, xy.shape[2])
    corners = points.expand(-1, -1, xy.shape[2]).gather(1, index.expand(3, 3, -1))  # (3, 3 points, B)
    image = xy.gather(1, index.expand(2, 3, -1))
    rays = torch.cat([image, torch.ones_like(image[:1])])
    rays = rays / rays.square().sum(0).sqrt()
    distances = _distances(corners, rays, nearly)  # (3 points, 4, B)
    seen = rays[:, :, None] * distances  # (3, 3 points, 4, B)
    r = matmul3(_triad(seen), _triad(corners).transpose(0, 1)[:, :, None])
    t = seen.mean(1) - (r * corners.mean(1)[:, None]).sum(1)
    return r, t


def widest_triple(points: Tensor, weight: Tensor | None) -> Tensor:
    """Indices (3, B) of three points far from each other and from one line."""

    def far(measure: Tensor) -> Tensor:
        return (measure if weight is None else torch.where(weight > 0, measure, -1.0)).argmax(0)

    def at(index: Tensor) -> Tensor:
        spread = points.expand(-1, -1, index.shape[-1])
        return spread.gather(1, index.expand(3, 1, -1))

    count = points.shape[1] if weight is None else weight.sum(0)
    first = far((points - points.sum(1, keepdim=True) / count).square().sum(0))
    second = far((points - at(first)).square().sum(0))
    third = far(cross(points - at(first), points - at(second)).square().sum(0))
    return torch.stack([first, second, third])


def _distances(corners: Tensor, rays: Tensor, nearly: bool) -> Tensor:
    """Distances (3, 4, B) of the corners (3, 3, B) along the unit rays (3, 3, B); NaN where there is no solution.

    With ``nearly`` a line of the pencil's degenerate conic that just misses the other conics counts as touching them.
    """
    squares = torch.stack([(corners[:, i] - corners[:, j]).square().sum(0) for i, j in _PAIRS])
    unit = squares.sum(0)
    squares = squares / unit  # (3, B)
    cosines = torch.stack([(rays[:, i] * rays[:, j]).sum(0) for i, j in _PAIRS])
    one, zero = torch.ones_like(unit), torch.zeros_like(unit)
    b12, b13, b23 = cosines
    m12 = torch.stack([one, -b12, zero, -b12, one, zero, zero, zero, zero]).unflatten(0, (3, 3))
    m13 = torch.stack([one, zero, -b13, zero, zero, zero, -b13, zero, one]).unflatten(0, (3, 3))
    m23 = torch.stack([zero, zero, zero, zero, one, -b23, zero, -b23, one]).unflatten(0, (3, 3))
    d1 = m12 * squares[2] - m23 * squares[0]
    d2 = m13 * squares[2] - m23 * squares[1]
    # det(d1 + gamma d2): its coefficients are traces of adj(a) b
    mixed = [(cofactors3(a) * b).sum((0, 1)) for a, b in ((d2, d1), (d1, d2))]
    gamma = _cubic_root(det(d2), *mixed, det(d1))
    lines = _split(d1 + gamma * d2)  # (3, 2, B)
    other = gamma * d1 - d2

    # two directions in each plane of distances, and the roots of the other conic between them
    magnitude = lines.abs().argmax(0, keepdim=True)
    axis = torch.zeros_like(lines).scatter(0, (magnitude + 1) % 3, 1.0)
    u = cross(lines, axis)
    u = u / u.square().sum(0).sqrt()
    v = cross(lines, u)
    v = v / v.square().sum(0).sqrt()
    qu = (other[:, :, None] * u).sum(1)
    a, b, c = (qu * u).sum(0), (qu * v).sum(0), ((other[:, :, None] * v).sum(1) * v).sum(0)
    # a touching line has a double root, of which rounding can make a slightly negative discriminant
    discriminant = b * b - a * c
    touching = -torch.inf if nearly else -1e-7
    root = discriminant.clamp_min(0).sqrt()
    root = torch.where(discriminant > touching * (b * b + (a * c).abs()), root, torch.nan)
    q = -(b + torch.where(b < 0, -root, root))
    # (alpha : beta) of alpha u + beta v: the roots q / a and c / q of a x^2 + 2 b x + c
    alpha, beta = torch.cat([q, c]), torch.cat([a, q])
    ray = alpha * torch.cat([u, u], 1) + beta * torch.cat([v, v], 1)  # (3, 4, B)
    ray = ray * torch.where(ray.sum(0) < 0, -1.0, 1.0)
    total = sum(
        (ray[i].square() + ray[j].square() - 2 * cosines[k] * ray[i] * ray[j] for k, (i, j) in enumerate(_PAIRS)),
        start=torch.zeros_like(ray[0]),
    )
    x = ray / total.sqrt()

    x, residual = _polished(x, cosines, squares)
    positive = (x > 0).all(0)
    exact = nearly | (residual.abs().amax(0) < 1e-9)
    return torch.where(positive & exact, x, torch.nan) * unit.sqrt()


def _polished(x: Tensor, cosines: Tensor, squares: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (3, 4, B) after Newton steps on the cosine law, and by how much they missed it before the last."""
    for _ in range(_POLISHING):
        residual = torch.stack(
            [x[i] ** 2 + x[j] ** 2 - 2 * cosines[k] * x[i] * x[j] - squares[k] for k, (i, j) in enumerate(_PAIRS)]
        )
        rows = []
        for k, (i, j) in enumerate(_PAIRS):
            row = [torch.zeros_like(x[0])] * 3
            row[i], row[j] = 2 * (x[i] - cosines[k] * x[j]), 2 * (x[j] - cosines[k] * x[i])
            rows.append(torch.stack(row))
        step = (inverse3(torch.stack(rows)) * residual).sum(1)
        # at a double root the Jacobian is singular: the step is then of no use
        small = step.abs().amax(0) < 0.1
        x = torch.where(small, x - step, x)
    return x, residual


def _cubic_root(cubic: Tensor, *lower: Tensor) -> Tensor:
    """A real root x (B,) of a cubic polynomial, from its leading coefficient down, by trigonometry and Newton steps."""
    b, c, d = lower
    scale = torch.where(cubic.abs() > 1e-14 * (b.abs() + c.abs() + d.abs()), cubic, 1e-14)
    b, c, d = b / scale, c / scale, d / scale
    shift = b / 3
    p = c / 3 - shift * shift
    q = shift**3 - 0.5 * shift * c + 0.5 * d
    discriminant = q * q + p**3
    # one real root: without cancellation between the cube roots
    big = q.abs() + discriminant.clamp_min(0).sqrt()
    w = big ** (1 / 3)
    single = -torch.sign(q) * (w - p / torch.where(w > 0, w, torch.ones_like(w)))
    m = (-p).clamp_min(0).sqrt()
    cosine = (-q / torch.where(m > 0, m, torch.ones_like(m)) ** 3).clamp(-1, 1)
    # of three real roots, the one farthest from its neighbours: the largest or the smallest
    third = torch.acos(cosine) / 3
    three = 2 * m * torch.where(cosine > 0, torch.cos(third), torch.cos(third + 2 * torch.pi / 3))
    x = torch.where(discriminant > 0, single, three) - shift
    for _ in range(3):
        value = ((x + b) * x + c) * x + d
        slope = (3 * x + 2 * b) * x + c
        step = value / torch.where(slope == 0, torch.ones_like(slope), slope)
        x = torch.where((((x - step + b) * (x - step) + c) * (x - step) + d).abs() < value.abs(), x - step, x)
    return x


def _split(conic: Tensor) -> Tensor:
    """The two lines (3, 2, B) of degenerate conics (3, 3, B); NaN where they are not real."""
    adjugate = cofactors3(conic)
    diagonal = adjugate.diagonal(dim1=0, dim2=1).T
    k = diagonal.argmin(0)
    column = adjugate.gather(1, k.expand(3, 1, -1)).squeeze(1)
    p = column / (-diagonal.gather(0, k[None])).sqrt()
    zero = torch.zeros_like(p[0])
    skew = torch.stack([zero, p[2], -p[1], -p[2], zero, p[0], p[1], -p[0], zero]).unflatten(0, (3, 3))
    product = conic + skew  # of rank one: its rows are one line, its columns the other
    flat = product.flatten(0, 1)
    best = flat.abs().nan_to_num(0).argmax(0)
    row = product.gather(0, (best // 3).expand(1, 3, -1)).squeeze(0)
    other = product.gather(1, (best % 3).expand(3, 1, -1)).squeeze(1)
    return torch.stack([row, other], 1)


def _triad(corners: Tensor) -> Tensor:
    """Frame (3, 3, ...) in columns of three points (3, 3 points, ...)."""
    x = corners[:, 1] - corners[:, 0]
    x = x / x.square().sum(0).sqrt()
    z = cross(x, corners[:, 2] - corners[:, 0])
    z = z / z.square().sum(0).sqrt()
    return torch.stack([x, cross(z, x), z], 1)
