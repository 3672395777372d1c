"""Minima of a few poses through a pinhole, on the host: matrices in NumPy, pose first.

With the batch last (`normal_equations`) every number of a formula is a call, which pays from some hundreds of poses on.
Of one frame there are two starts, and each call of torch costs more than all their arithmetic; a device would be waited
for at every decision besides. So the numbers are fetched once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]
MOST = 64  # poses up to which NumPy's calls, one pose after the other inside, cost less than torch's
# promised decreases by which the cost of a second minimum may yet fall: 2.9 at most in 564,000 cases but for one
# (scripts/pnp_statistics.py, seeds 0 to 5); a start from which it falls by more mostly ends in the best minimum
RESERVE = 4.0
RTOL = 1e-12  # of its cost: a step that promises less is the last one
_MOST_DAMPING = 1e8  # steps have shrunk to nothing
_TRIANGLE = np.array([7 * i + k for i in range(7) for k in range(i, 7)])  # where in (7, 7) the packed numbers are


def on_host(function: Callable[..., tuple[Array, ...]], *args: Any) -> tuple[Tensor, ...]:
    """What a function of arrays makes of tensors, on their device."""
    device = next(v.device for v in args if isinstance(v, Tensor))
    with np.errstate(all="ignore"):  # what is no number is none in the end
        found = function(*(v.detach().cpu().numpy() if isinstance(v, Tensor) else v for v in args))
    return tuple(torch.from_numpy(v).to(device) for v in found)


class Few(NamedTuple):
    """Image points of K poses.

    Attributes:
        points: (K, N, 4) object points, homogeneous.
        arms: (K, 2 N, 3), the same, each once for both of its residuals.
        root: (K, N, 2, 2), whitening.
        aimed: (K, N, 2), image points, whitened.
    """

    points: Array
    arms: Array
    root: Array
    aimed: Array

    @classmethod
    def of(cls, poses: int, points: Array, xy: Array, whitening: Array) -> Self:
        """Of points (3, N, K), image points (2, N, K) and whitening (2, N, K) or (2, 2, N, K), or broadcastable."""
        count = xy.shape[1]
        x = np.broadcast_to(points.transpose(2, 1, 0), (poses, count, 3))
        if whitening.ndim == xy.ndim:
            root = np.broadcast_to(whitening, (2, count, poses)).transpose(2, 1, 0)[..., None] * np.eye(2)
        else:
            root = np.broadcast_to(whitening, (2, 2, count, poses)).transpose(3, 2, 0, 1)
        return cls.at(x, xy.transpose(2, 1, 0), root)

    @classmethod
    def at(cls, x: Array, xy: Array, root: Array) -> Self:
        """Of points (K, N, 3), image points (K, N, 2) and whitening (K, N, 2, 2)."""
        whole = np.concatenate([x, np.ones_like(x[..., :1])], -1)
        return cls(whole, x.repeat(2, 1), root, (root * xy[:, :, None]).sum(-1))

    def seen(self, pose: Array) -> tuple[Array, Array, Array]:
        """Depths (K, N, 1) under poses (K, 3, 4), image points (K, N, 2), and these whitened."""
        at = self.points @ pose.swapaxes(-1, -2)
        uv, z = at[..., :2] / at[..., 2:], at[..., 2:]
        return z, uv, (self.root * uv[:, :, None]).sum(-1)

    def whole(self, pose: Array, *, newton: bool) -> Array:
        """[J r]^T [J r] (K, 7, 7) at poses (K, 3, 4); its last entry, the cost, is infinite with a point behind."""
        poses, (z, _, seen) = len(pose), self.seen(pose)
        slope = np.concatenate([self.root, -seen[..., None]], -1) / z[..., None]
        moved = slope.reshape(poses, -1, 3) @ pose[..., :3]  # by a translation along the object's axes
        residual = (seen - self.aimed).reshape(poses, -1, 1)
        rows = np.concatenate([moved, _crossed(self.arms, moved), residual], -1)
        whole = rows.swapaxes(-1, -2) @ rows
        if newton:
            whole[:, :6, :6] += self._bent(pose, z, rows[..., :6] * residual)
        whole[np.logical_not(z.min((1, 2)) > 0), 6, 6] = np.inf
        return whole

    def _bent(self, pose: Array, z: Array, gradient: Array) -> Array:
        """What second derivatives times residuals add (K, 6, 6): of u along two motions -(du dz' + du' dz) / z, and of
        a turn, which moves a point along [w]x [w]x X / 2 besides."""
        poses, points = len(pose), self.points[..., :3]
        gradient = gradient.reshape(poses, -1, 2, 6).sum(2)  # of each point, (K, N, 6)
        axis = np.broadcast_to(pose[:, 2:, :3], points.shape)
        depth = np.concatenate([axis, _crossed(points, axis)], -1) / z
        outer = (points.swapaxes(-1, -2) @ gradient[..., :3]).reshape(poses, 9) @ _OF_TURNS
        half = outer.reshape(poses, 6, 6) - gradient.swapaxes(-1, -2) @ depth
        return half + half.swapaxes(-1, -2)


def packed(whole: Array) -> Array:
    """`normal_equations` (28, K) of matrices (K, 7, 7)."""
    return whole.reshape(len(whole), 49)[:, _TRIANGLE].T


class Ends(NamedTuple):
    """Where minimisations ended: poses (K, 3, 4), Newton's [J r]^T [J r] (K, 7, 7) before the last step, costs (K,),
    iterations (K,), and whether they have converged (K,) bool."""

    pose: Array
    whole: Array
    cost: Array
    iterations: Array
    done: Array


def minimised(
    few: Few, start: Array, floor: Array, steps: int, enough: Array | Callable[[Array], Array], rtol: float = RTOL
) -> Ends:
    """`iterative.minimise` of poses (K, 3, 4), step by step the same.

    Args:
        few: the image points.
        start: where to begin.
        floor: (K,) cost of residuals that are wrong by the rounding of their image points.
        steps: the most.
        enough, rtol: as there; or what the former is, given the costs at the starts.
    """
    pose = trial = start
    over = done = np.zeros(len(floor), bool)
    damping, cost, whole = np.full_like(floor, 1e-3), np.full_like(floor, np.inf), np.full((len(floor), 7, 7), np.inf)
    limit = decrease = cost
    iterations = np.zeros(len(floor), np.int64)
    for number in range(steps):
        there = few.whole(trial, newton=True)
        lower = there[:, 6, 6] <= cost + 2 * np.sqrt(cost * floor) + floor
        accept = (lower & ~over)[:, None, None]
        pose, whole = np.where(accept, trial, pose), np.where(accept, there, whole)
        cost = whole[:, 6, 6]
        limit = enough if isinstance(enough, np.ndarray) else enough(cost) if number == 0 else limit
        old = (trial, decrease, damping, done)
        # never so small that many rejections in a row would be needed to matter again
        damping = np.where(lower, (0.1 * damping).clip(1e-6), (10 * damping).clip(1e-2))
        step, decrease, definite = _damped(whole, damping)
        if not (definite | over).all():
            step, decrease = _off_saddle(few, pose, cost, damping, (step, decrease, definite))
        trial, sure = _stepped(pose, -step), damping <= 1
        left = sure & (cost - RESERVE * decrease > limit)
        trial, decrease = np.where(left[:, None, None], pose, trial), np.where(left, 0.0, decrease)
        done = sure & (decrease <= rtol * cost + floor) & (cost < np.inf)
        trial = np.where(over[:, None, None], old[0], trial)
        decrease, damping, done = (
            np.where(over, a, b) for a, b in zip(old[1:], (decrease, damping, done), strict=True)
        )
        iterations += ~over
        # neither a pose without numbers nor one whose steps have shrunk to nothing will come to an end
        over = done | ~((damping < _MOST_DAMPING) & (cost < np.inf))
        if over.all():
            break
    settled = (cost - np.where(done, decrease, 0)).clip(0)
    return Ends(np.where(done[:, None, None], trial, pose), whole, settled, iterations, done)


def _damped(whole: Array, damping: Array) -> tuple[Array, Array, Array]:
    """Steps (K, 6), the decrease of the cost that they promise, and whether they are to a minimum (K,)."""
    matrix, right = whole[:, :6, :6].copy(), whole[:, :6, 6]
    matrix[:, range(6), range(6)] *= 1 + damping[:, None]
    definite = np.isfinite(factors(matrix).sum((1, 2)))
    step = np.full_like(right, np.nan)
    step[definite] = np.linalg.solve(matrix[definite], right[definite, :, None])[..., 0]
    return step, (step * right).sum(1), definite


def factors(matrices: Array) -> Array:
    """Cholesky's factors (K, n, n), NaN where a matrix is not positive definite."""
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        if matrices.ndim == 2:
            return np.full_like(matrices, np.nan)
    return np.stack([factors(matrix) for matrix in matrices])


def _off_saddle(
    few: Few, pose: Array, cost: Array, damping: Array, newton: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Steps and decreases, those of Gauss-Newton, stretched, where the matrix is not definite; see `iterative`."""
    step, decrease, _ = _damped(few.whole(pose, newton=False), damping)
    stretch = np.where(damping < 1e-3, np.sqrt(0.1 * cost / decrease).clip(1, 1e3), 1.0)
    definite = newton[2]
    step = np.where(definite[:, None], newton[0], stretch[:, None] * step)
    return step, np.where(definite, newton[1], decrease)


def _stepped(pose: Array, step: Array) -> Array:
    """Poses (K, 3, 4) after steps (K, 6), see `normal_equations.moved`."""
    half = np.concatenate([np.ones_like(step[:, :1]), 0.5 * step[:, 3:]], -1)  # the quaternion of Cayley's rotation
    turn = (half[:, :, None] * half[:, None]).reshape(-1, 16) @ _OF_QUATERNION.T
    turn = (turn[:, :9] / turn[:, 9:]).reshape(-1, 3, 3)
    result = pose[..., :3] @ np.concatenate([turn, step[:, :3, None]], -1)
    result[..., 3] += pose[..., 3]
    return result


def _of_turns() -> NDArray[np.float64]:
    """(9, 36): from sums of X g^T over the points to half of what a turn's second derivatives add."""
    table = np.zeros((3, 3, 6, 6))
    for i in range(3):
        for k in range(3):
            table[i, k, 3 + i, 3 + k] += 0.5
            table[i, i, 3 + k, 3 + k] -= 0.5
    return table.reshape(9, 36)


def _of_quaternion() -> NDArray[np.float64]:
    """(10, 16): from the products q q^T of quaternions to their rotations times |q|^2, and to |q|^2."""
    w, x, y, z = range(4)
    signed = (
        ((w, w, 1), (x, x, 1), (y, y, -1), (z, z, -1)),
        ((x, y, 2), (w, z, -2)),
        ((x, z, 2), (w, y, 2)),
        ((x, y, 2), (w, z, 2)),
        ((w, w, 1), (x, x, -1), (y, y, 1), (z, z, -1)),
        ((y, z, 2), (w, x, -2)),
        ((x, z, 2), (w, y, -2)),
        ((y, z, 2), (w, x, 2)),
        ((w, w, 1), (x, x, -1), (y, y, -1), (z, z, 1)),
        ((w, w, 1), (x, x, 1), (y, y, 1), (z, z, 1)),
    )
    table = np.zeros((10, 4, 4))
    for row, terms in zip(table, signed, strict=True):
        for i, k, factor in terms:
            row[i, k] += factor
    return table.reshape(10, 16)


_OF_TURNS, _OF_QUATERNION = _of_turns(), _of_quaternion()


def _crossed(one: Array, other: Array) -> Array:
    (a, b, c), (x, y, z) = (v.transpose(2, 0, 1) for v in (one, other))
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)
