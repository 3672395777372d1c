"""Batched linear algebra of 2 x 2 to 6 x 6 matrices as structures of arrays: the batch is the last dimension.

`torch.linalg` treats a batch of small matrices one LAPACK call at a time. Here every scalar of the textbook algorithm
is a contiguous vector over the batch, so an elimination is a few dozen elementwise calls whatever the batch size; a
compiler fuses them (`torchpose.kernels`). All functions are differentiable and keep dtype and device.
"""

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor


def eliminate(rows: Sequence[Tensor], damping: Tensor | None = None) -> tuple[list[Tensor], Tensor]:
    """L D L^T of symmetric positive definite a without pivoting (Golub, Van Loan, section 4.1), applied to [a | b].

    Args:
        rows: n tensors; the i-th holds row i of [a | b] from the diagonal on, (n - i + m, ...).
        damping: (...), the diagonal of a is multiplied by one plus this (Marquardt).

    Returns:
        Rows of L^-1 [a | b] from the diagonal on, (n - i + m, ...), and the pivots D (n, ...); a pivot that is not
        clearly positive says that the matrix is singular.
    """
    n = len(rows)
    block = list(rows)
    pivots = []
    for k in range(n):
        pivot = block[k][0] if damping is None else torch.addcmul(block[k][0], damping, rows[k][0])
        pivots.append(pivot)
        factors = block[k][1 : n - k] / pivot
        for i in range(k + 1, n):
            block[i] = torch.addcmul(block[i], factors[i - k - 1], block[k][i - k :], value=-1)
    return block, torch.stack(pivots)


def solve_rows(rows: Sequence[Tensor], damping: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Solves a x = b for symmetric positive definite a, by `eliminate`: x (n, m, ...) and the pivots (n, ...)."""
    block, pivots = eliminate(rows, damping)
    return _substitute(block, pivots.unbind()), pivots


def _substitute(block: Sequence[Tensor], pivots: Sequence[Tensor]) -> Tensor:
    """x (n, m, ...) from rows of an upper triangle, from the diagonal on, with the right-hand sides behind."""
    n = len(block)
    x = [block[-1][1:] / pivots[-1]]
    for k in range(n - 2, -1, -1):
        value = block[k][n - k :]
        for i in range(k + 1, n):
            value = torch.addcmul(value, block[k][i - k], x[n - 1 - i], value=-1)
        x.append(value / pivots[k])
    return torch.stack(x[::-1])


def solve_spd(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """`solve_rows` of matrices (n, n, B), of which the upper triangle is used, and right-hand sides (n, m, B)."""
    return solve_rows([torch.cat([a[i, i:], b[i]]) for i in range(a.shape[0])])


def solve(a: Tensor, b: Tensor) -> Tensor:
    """Solutions (n, m, ...) of a x = b for any a (n, n, ...), with partial pivoting (Golub, Van Loan, section 3.4)."""
    rows = [torch.cat([a[i], b[i].expand(-1, *a.shape[2:])]) for i in range(len(a))]
    for k in range(len(rows)):
        for i in range(k + 1, len(rows)):
            swap = rows[i][0].abs() > rows[k][0].abs()
            rows[k], rows[i] = torch.where(swap, rows[i], rows[k]), torch.where(swap, rows[k], rows[i])
        for i in range(k + 1, len(rows)):
            rows[i] = torch.addcmul(rows[i][1:], rows[i][0] / rows[k][0], rows[k][1:], value=-1)
    return _substitute(rows, [row[0] for row in rows])


def eigh(a: Tensor, sweeps: int = 6) -> tuple[Tensor, Tensor]:
    """Eigenvalues (n, ...), ascending, and eigenvectors (n, n, ...), in columns, of symmetric matrices (n, n, ...).

    By cyclic Jacobi rotations (Golub, Van Loan, section 8.5), which converge quadratically: six rounds are enough for
    matrices of up to 4 x 4 or so.
    """
    n = len(a)
    m = [list(row.unbind()) for row in a]
    v = [[torch.full_like(a[0, 0], float(i == k)) for k in range(n)] for i in range(n)]
    for _ in range(sweeps):
        for p, q in combinations(range(n), 2):
            off, apart = m[p][q], m[q][q] - m[p][p]
            root = (apart.square() + 4 * off.square()).sqrt()
            tangent = torch.where(root > 0, 2 * off / (apart + torch.where(apart < 0, -root, root)), 0)
            c = (1 + tangent.square()).rsqrt()
            s = tangent * c
            m[p][p], m[q][q] = m[p][p] - tangent * off, m[q][q] + tangent * off
            m[p][q] = m[q][p] = torch.zeros_like(off)
            for k in range(n):
                v[k][p], v[k][q] = c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]
                if k not in (p, q):
                    m[k][p], m[k][q] = c * m[k][p] - s * m[k][q], s * m[k][p] + c * m[k][q]
                    m[p][k], m[q][k] = m[k][p], m[k][q]
    columns = [torch.stack([m[k][k], *(row[k] for row in v)]) for k in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            swap = columns[i][0] < columns[k][0]
            columns[k], columns[i] = (
                torch.where(swap, columns[i], columns[k]),
                torch.where(swap, columns[k], columns[i]),
            )
    whole = torch.stack(columns, 1)
    return whole[0], whole[1:]


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product along the first dimension of (3, ...) tensors that broadcast against each other."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return torch.stack([torch.addcmul(a[i] * b[k], a[k], b[i], value=-1) for i, k in pairs])


def det(a: Tensor) -> Tensor:
    """Determinants (...) of matrices (n, n, ...), by the first row (Laplace): for n up to 4."""
    if len(a) == 1:
        return a[0, 0]
    if len(a) == 3:
        return (a[0] * cross(a[1], a[2])).sum(0)
    minors = (det(torch.cat([a[1:, :k], a[1:, k + 1 :]], 1)) for k in range(len(a)))
    return sum((a[0, k] * minor * (-1) ** k for k, minor in enumerate(minors)), start=torch.zeros_like(a[0, 0]))


def cofactors3(a: Tensor) -> Tensor:
    """Cofactors (3, 3, ...) of matrices (3, 3, ...): their adjugates, transposed."""
    return torch.stack([cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])])


def inverse3(a: Tensor) -> Tensor:
    """Inverses of matrices (3, 3, ...) by their adjugates; infinite where the determinant is zero."""
    rows = cofactors3(a)
    return rows.transpose(0, 1) / (a[0] * rows[0]).sum(0)


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
    return torch.addcmul(torch.addcmul(a[:, 0, None] * b[0], a[:, 1, None], b[1]), a[:, 2, None], b[2])
