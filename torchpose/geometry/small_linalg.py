"""Batched linear algebra of 2 x 2 to 6 x 6 matrices as structures of arrays: the batch is the last dimension.

`torch.linalg` treats a batch of small matrices one LAPACK call at a time. Here every scalar of the textbook algorithm
is a contiguous vector over the batch, so an elimination is a few dozen elementwise calls whatever the batch size. In
eager mode the calls run over rows and blocks (few calls: a small batch is bound by their number); while
`torch.compile` traces they run over scalars, which fuse into one kernel. All functions are differentiable and keep
dtype and device.
"""

from __future__ import annotations

import torch
from torch import Tensor


def solve_spd(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Solves a x = b for symmetric positive definite matrices by L D L^T without pivoting (Golub, Van Loan, ch. 4.1).

    Args:
        a: (n, n, B), only the upper triangle is used.
        b: (n, m, B).

    Returns:
        x (n, m, B) and the pivots D (n, B); a pivot that is not clearly positive says that the matrix is singular.
    """
    n = a.shape[0]
    if torch.compiler.is_compiling():
        return _solve_spd_scalars(a, b)
    block = torch.cat([a, b], 1)
    rows = []
    for k in range(n):
        row = block[0]
        rows.append(row)
        if k + 1 < n:
            factor = row[1 : n - k] / row[0]
            block = torch.addcmul(block[1:, 1:], factor[:, None], row[None, 1:], value=-1)
    pivots = torch.stack([row[0] for row in rows])
    x = (rows[-1][1:] / rows[-1][0])[None]
    for k in range(n - 2, -1, -1):
        row = rows[k]
        known = (row[1 : n - k, None] * x).sum(0)
        x = torch.cat([((row[n - k :] - known) / row[0])[None], x])
    return x, pivots


def _solve_spd_scalars(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    n, m = a.shape[0], b.shape[1]
    rows = [[a[i, j] for j in range(i, n)] + [b[i, j] for j in range(m)] for i in range(n)]
    for k in range(n):
        inverse = 1 / rows[k][0]
        for i in range(k + 1, n):
            factor = rows[k][i - k] * inverse
            rows[i] = [v - factor * u for v, u in zip(rows[i], rows[k][i - k :], strict=True)]
    x: list[list[Tensor]] = [[] for _ in range(n)]
    for k in range(n - 1, -1, -1):
        inverse = 1 / rows[k][0]
        for j in range(m):
            value = rows[k][n - k + j]
            for i in range(k + 1, n):
                value = value - rows[k][i - k] * x[i][j]
            x[k].append(value * inverse)
    return torch.stack([torch.stack(row) for row in x]), torch.stack([row[0] for row in rows])


def inverse_spd(a: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (n, n, B) of symmetric positive definite matrices (n, n, B), and the pivots (n, B) of `solve_spd`."""
    n = a.shape[0]
    eye = torch.eye(n, dtype=a.dtype, device=a.device)[..., None].expand(n, n, a.shape[-1])
    return solve_spd(a, eye)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product along the first dimension of (3, ...) tensors that broadcast against each other."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def det3(a: Tensor) -> Tensor:
    """Determinants (...) of matrices (3, 3, ...)."""
    return (a[0] * cross(a[1], a[2])).sum(0)


def inverse3(a: Tensor) -> Tensor:
    """Inverses of matrices (3, 3, ...) by their adjugates; infinite where the determinant is zero."""
    columns = torch.stack([cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])], 1)
    return columns / (a[0] * columns[:, 0]).sum(0)


def eigvalsh3(a: Tensor) -> Tensor:
    """Eigenvalues (3, ...) in ascending order of symmetric matrices (3, 3, ...) (Smith, CACM 4, 1961).

    Accurate to a few ulp of the largest eigenvalue; use `torch.linalg.eigh` where small ones count.
    """
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3
    off = a[0, 1].square() + a[0, 2].square() + a[1, 2].square()
    diagonal = torch.stack([a[0, 0], a[1, 1], a[2, 2]]) - mean
    p = ((diagonal.square().sum(0) + 2 * off) / 6).sqrt()
    d0, d1, d2 = diagonal.unbind()
    determinant = (
        d0 * (d1 * d2 - a[1, 2].square())
        - a[0, 1] * (a[0, 1] * d2 - a[1, 2] * a[0, 2])
        + a[0, 2] * (a[0, 1] * a[1, 2] - d1 * a[0, 2])
    )
    p3 = p * p * p
    cosine = torch.where(p3 > 0, determinant / (2 * torch.where(p3 > 0, p3, torch.ones_like(p3))), 1).clamp(-1, 1)
    angle = torch.acos(cosine) / 3
    largest = mean + 2 * p * torch.cos(angle)
    smallest = mean + 2 * p * torch.cos(angle + 2 * torch.pi / 3)
    return torch.stack([smallest, 3 * mean - largest - smallest, largest])


def orthonormalise(r: Tensor) -> Tensor:
    """Rotation matrices from matrices (3, 3, ...) that are rotations up to rounding (Gram-Schmidt on the rows)."""
    first = r[0] / r[0].square().sum(0).sqrt()
    second = r[1] - (first * r[1]).sum(0) * first
    second = second / second.square().sum(0).sqrt()
    return torch.stack([first, second, cross(first, second)])


def cayley(w: Tensor) -> Tensor:
    """Rotations (3, 3, ...) of the vectors w (3, ...): exp([w]x) up to third order, exactly orthogonal (Cayley 1846).

    Free of roots and trigonometric functions, hence the update of choice in iterative solvers.
    """
    c = 0.5 * w
    scale = 2 / (1 + c.square().sum(0))
    x, y, z = c.unbind()
    sx, sy, sz = (scale * c).unbind()
    xx, yy, zz, xy, xz, yz = x * sx, y * sy, z * sz, x * sy, x * sz, y * sz
    return torch.stack(
        [1 - yy - zz, xy - sz, xz + sy, xy + sz, 1 - xx - zz, yz - sx, xz - sy, yz + sx, 1 - xx - yy]
    ).unflatten(0, (3, 3))


def matmul3(a: Tensor, b: Tensor) -> Tensor:
    """Products of matrices (3, 3, ...) and (3, m, ...)."""
    return a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2]
