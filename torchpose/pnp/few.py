"""The arithmetic of the minimiser for a few poses: dense matrices, pose first, in the fewest calls.

Tensors, or arrays of NumPy (`pairs`): the same lines.
With the batch last (`normal_equations`) every number of a formula is a call, which pays from some hundreds of poses on.
Of one frame there are two starts, and each call costs more than what it computes; a product of matrices is one call.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# poses up to which LAPACK and products of matrices, one after the other, cost less than the calls that they save
MOST = 64


class Few(NamedTuple):
    """Image points of K poses.

    Attributes:
        points: (K, N, 4) object points, homogeneous.
        arms: (K, 2 N, 3), the same, each once for both of its residuals.
        root: (K, N, 2, 2), whitening.
        aimed: (K, N, 2), image points, whitened.
    """

    points: Any
    arms: Any
    root: Any
    aimed: Any

    @classmethod
    def of(cls, poses: int, points: Tensor, xy: Tensor, whitening: Tensor) -> Self:
        """Of points (3, N, K), image points (2, N, K) and whitening (2, N, K) or (2, 2, N, K), or broadcastable."""
        count = xy.shape[1]
        x = points.permute(2, 1, 0).expand(poses, count, 3)
        if whitening.ndim == xy.ndim:
            root = torch.diag_embed(whitening.expand(2, count, poses).permute(2, 1, 0))
        else:
            root = whitening.expand(2, 2, count, poses).permute(3, 2, 0, 1).contiguous()
        aimed = (root * xy.permute(2, 1, 0)[:, :, None]).sum(-1)
        return cls(torch.nn.functional.pad(x, (0, 1), value=1.0), x.repeat_interleave(2, 1), root, aimed)

    def normal(self, pose: Tensor, *, newton: bool) -> Tensor:
        """`normal_equations` (28, K) at poses (3, 4, K)."""
        whole, ahead = self.whole(pose.permute(2, 0, 1), newton=newton)
        packed = whole.flatten(1).index_select(1, _triangle(whole.device)).mT
        packed[27] = torch.where(ahead, packed[27], torch.inf)
        return packed

    def seen(self, pose: Any) -> tuple[Any, Any, Any]:
        """Depths (K, N, 1) under poses (K, 3, 4), image points (K, N, 2), and these whitened."""
        at = _product(self.points, _transposed(pose))
        uv, z = at[..., :2] / at[..., 2:], at[..., 2:]
        return z, uv, (self.root * uv[:, :, None]).sum(-1)

    def whole(self, pose: Any, *, newton: bool) -> tuple[Any, Any]:
        """[J r]^T [J r] (K, 7, 7) at poses (K, 3, 4), and whether all points lie in front (K,)."""
        poses, (z, _, seen) = len(pose), self.seen(pose)
        slope = _joined([self.root, -seen[..., None]]) / z[..., None]
        moved = _product(slope.reshape(poses, -1, 3), pose[..., :3])  # by a translation along the object's axes
        residual = (seen - self.aimed).reshape(poses, -1, 1)
        rows = _joined([moved, _crossed(self.arms, moved), residual])
        whole = _product(_transposed(rows), rows)
        if newton:
            whole[:, :6, :6] += self._bent(pose, z, rows[..., :6] * residual)
        return whole, (z > 0).all(1)[:, 0]

    def _bent(self, pose: Any, z: Any, gradient: Any) -> Any:
        """What second derivatives times residuals add (K, 6, 6): of u along two motions -(du dz' + du' dz) / z, and of
        a turn, which moves a point along [w]x [w]x X / 2 besides."""
        poses, points = len(pose), self.points[..., :3]
        gradient = gradient.reshape(poses, -1, 2, 6).sum(2)  # of each point, (K, N, 6)
        axis = points * 0 + pose[:, 2:, :3]
        depth = _joined([axis, _crossed(points, axis)]) / z
        outer = _product(_transposed(points), gradient[..., :3]).reshape(poses, 9) @ _like(_OF_TURNS, points)
        half = outer.reshape(poses, 6, 6) - _product(_transposed(gradient), depth)
        return half + _transposed(half)


def stepped(pose: Any, step: Any) -> Any:
    """Poses (K, 3, 4) after steps (K, 6), see `normal_equations.moved`."""
    half = _joined([step[:, :1] * 0 + 1, 0.5 * step[:, 3:]])  # the quaternion of Cayley's rotation
    turn = (half[:, :, None] * half[:, None]).reshape(-1, 16) @ _transposed(_like(_OF_QUATERNION, step))
    turn = (turn[:, :9] / turn[:, 9:]).reshape(-1, 3, 3)
    result = _product(pose[..., :3], _joined([turn, step[:, :3, None]]))
    result[..., 3] += pose[..., 3]
    return result


def moved_few(pose: Tensor, step: Tensor) -> Tensor:
    """`moved` of poses (3, 4, K) by steps (6, K)."""
    half = torch.nn.functional.pad(0.5 * step[3:], (0, 0, 1, 0), value=1.0)  # the quaternion of Cayley's rotation
    turn = _like(_OF_QUATERNION, step) @ (half[:, None] * half).flatten(0, 1)
    turn = (turn[:9] / turn[9]).unflatten(0, (3, 3))
    result = (pose[:, :3, None] * torch.cat([turn, step[:3, None]], 1)).sum(1)
    result[:, 3] += pose[:, 3]
    return result


@cache
def _triangle(device: torch.device) -> Tensor:
    """Where in a matrix (7, 7) the packed numbers are."""
    with torch.inference_mode(False):
        return torch.tensor([7 * i + k for i in range(7) for k in range(i, 7)], device=device)


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


def _like(table: NDArray[np.float64], values: Any) -> Any:
    """A table as an array, or as a tensor of the dtype and on the device of the values."""
    if not isinstance(values, Tensor):
        return table
    return _tensor(table is _OF_TURNS, values.device, values.dtype)


@cache
def _tensor(turns: bool, device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):
        return torch.from_numpy(_OF_TURNS if turns else _OF_QUATERNION).to(device, dtype)


def _transposed(matrices: Any) -> Any:
    return matrices.mT if isinstance(matrices, Tensor) else matrices.swapaxes(-1, -2)


def _product(one: Any, other: Any) -> Any:
    return torch.bmm(one, other) if isinstance(one, Tensor) else one @ other


def _joined(parts: list[Any]) -> Any:
    return torch.cat(parts, -1) if isinstance(parts[0], Tensor) else np.concatenate(parts, -1)


def _crossed(one: Any, other: Any) -> Any:
    if isinstance(one, Tensor):
        return torch.linalg.cross(one, other)
    (a, b, c), (x, y, z) = (v.transpose(2, 0, 1) for v in (one, other))
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)
