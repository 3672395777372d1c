"""The arithmetic of `normal_equations` number by number, in the form that torch.compile turns into tight loops.

Eager mode wants few calls on large tensors; a compiler wants expressions of single vectors, which it keeps in
registers. These are the same formulas in the second form, used while torch.compile traces. Points are summed over by
reductions, so that the size of the code does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchpose.pnp.normal_equations import Observations

Vector = Sequence[Any]


def cross(a: Vector, b: Vector) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def differentiate(
    obs: Observations, pose: Tensor, fine: Observations | None
) -> tuple[Tensor, list[list[Tensor]], Tensor]:
    """Depth (N, ...), rows b and residual, each for u and v, (4, 2) of (N, ...), and cost (N, ...)."""
    exact = fine or obs
    x, y, z = exact.points
    px, py, pz = (pose[i, 0] * x + pose[i, 1] * y + pose[i, 2] * z + pose[i, 3] for i in range(3))
    d = 1 / pz
    u, v = px * d, py * d
    residual = _whitened(exact.whitening, u - exact.xy[0], v - exact.xy[1], exact.xy.ndim)
    pose, pz, d, u, v, *residual = (value.to(obs.xy.dtype) for value in (pose, pz, d, u, v, *residual))
    rows = []
    for m in range(3):
        a, b = (pose[0, m] - u * pose[2, m]) * d, (pose[1, m] - v * pose[2, m]) * d
        rows.append(_whitened(obs.whitening, a, b, obs.xy.ndim))
    rows.append(residual)
    cost = rows[3][0] * rows[3][0] + rows[3][1] * rows[3][1]
    if obs.huber != float("inf"):
        length = cost.sqrt()
        outside = length > obs.huber
        scale = torch.where(outside, obs.huber / torch.where(outside, length, 1), 1).sqrt()
        rows = [[a * scale, b * scale] for a, b in rows]
        cost = torch.where(outside, obs.huber * (2 * length - obs.huber), cost)
    return pz, rows, cost


def _whitened(w: Tensor, u: Tensor, v: Tensor, diagonal: int) -> list[Tensor]:
    """Whitening (2, N, ...), of ``diagonal`` dimensions, or (2, 2, N, ...) times the vector (u, v)."""
    if w.ndim == diagonal:
        return [u * w[0], v * w[-1]]
    return [w[0, 0] * u + w[0, 1] * v, w[1, 0] * u + w[1, 1] * v]


def normal_equations(obs: Observations, pose: Tensor, newton: bool, fine: Observations | None) -> Tensor:
    """Packed (28, ...)."""
    z, rows, cost = differentiate(obs, pose, fine)
    x = obs.points.unbind()
    u, v = ([row[k] for row in rows] for k in (0, 1))
    ju, jv = [*u[:3], *cross(x, u), u[3]], [*v[:3], *cross(x, v), v[3]]
    c = [a * u[3] + b * v[3] for a, b in rows[:3]]
    q = [pose[2, m].to(z) / z for m in range(3)]
    s, depth = [*c, *cross(x, c)], [*q, *cross(x, q)]
    along = c[0] * x[0] + c[1] * x[1] + c[2] * x[2]
    sums = []
    for i in range(6):
        for k in range(i, 7):
            value = ju[i] * ju[k] + jv[i] * jv[k]
            if newton and k < 6:
                value = value - (s[i] * depth[k] + s[k] * depth[i])
                if i >= 3:
                    value = value + 0.5 * (c[i - 3] * x[k - 3] + c[k - 3] * x[i - 3]) - (along if i == k else 0)
            sums.append(value.sum(0))
    return torch.stack([*sums, torch.where(z.amin(0) > 0, cost.sum(0), torch.inf)])


def eliminate(rows: Sequence[Vector], damping: Tensor | None) -> tuple[list[list[Any]], list[Any]]:
    """As `small_linalg.eliminate`, rows of [a | b] as lists from the diagonal on."""
    n = len(rows)
    block, pivots = [list(row) for row in rows], []
    for k in range(n):
        pivots.append(block[k][0] if damping is None else block[k][0] + damping * rows[k][0])
        inverse = 1 / pivots[k]
        for i in range(k + 1, n):
            factor = block[k][i - k] * inverse
            block[i] = [a - factor * b for a, b in zip(block[i], block[k][i - k :], strict=True)]
    return block, pivots


def solve(rows: Sequence[Vector], damping: Tensor | None) -> tuple[list[Any], list[Any]]:
    """x with a x = b and the pivots; one column b."""
    n = len(rows)
    block, pivots = eliminate(rows, damping)
    x: list[Any] = [None] * n
    for k in range(n - 1, -1, -1):
        value = block[k][-1]
        for i in range(k + 1, n):
            value = value - block[k][i - k] * x[i]
        x[k] = value / pivots[k]
    return x, pivots


def moved(pose: Tensor, step: Tensor) -> Tensor:
    """As `normal_equations.moved`."""
    c = [0.5 * step[3 + k] for k in range(3)]
    scale = 2 / (1 + c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
    x, y, z = c
    sx, sy, sz = (scale * v for v in c)
    xx, yy, zz, xy, xz, yz = x * sx, y * sy, z * sz, x * sy, x * sz, y * sz
    turn = [[1 - yy - zz, xy - sz, xz + sy], [xy + sz, 1 - xx - zz, yz - sx], [xz - sy, yz + sx, 1 - xx - yy]]
    columns = [[turn[i][k] for i in range(3)] for k in range(3)] + [[step[0], step[1], step[2]]]
    return torch.stack(
        [
            torch.stack(
                [
                    pose[i, 0] * b[0] + pose[i, 1] * b[1] + pose[i, 2] * b[2] + (pose[i, 3] if k == 3 else 0)
                    for k, b in enumerate(columns)
                ]
            )
            for i in range(3)
        ]
    )
