"""The arithmetic of the minimiser for a few poses: dense matrices, pose first, in the fewest calls.

With the batch last (`normal_equations`) every number of a formula is a call, which pays from some hundreds of poses on.
Of one frame there are two starts, and each call costs more than what it computes; a product of matrices is one call.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, Self

import torch
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

    points: Tensor
    arms: Tensor
    root: Tensor
    aimed: Tensor

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

    def seen(self, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depths (K, N, 1) under poses (K, 3, 4), image points (K, N, 2), and these whitened."""
        uv, z = torch.bmm(self.points, pose.mT).split_with_sizes([2, 1], -1)
        uv = uv / z
        return z, uv, (self.root * uv[:, :, None]).sum(-1)

    def whole(self, pose: Tensor, *, newton: bool) -> tuple[Tensor, Tensor]:
        """[J r]^T [J r] (K, 7, 7) at poses (K, 3, 4), and whether all points lie in front (K,)."""
        z, _, seen = self.seen(pose)
        slope = torch.cat([self.root, -seen[..., None]], -1) / z[..., None]
        moved = torch.bmm(slope.flatten(1, 2), pose[..., :3])  # by a translation along the object's axes
        residual = (seen - self.aimed).flatten(1)[..., None]
        rows = torch.cat([moved, torch.linalg.cross(self.arms, moved), residual], -1)
        whole = torch.bmm(rows.mT, rows)
        if newton:
            whole[:, :6, :6] += self._bent(pose, z, rows[..., :6] * residual)
        return whole, z.amin((1, 2)) > 0

    def _bent(self, pose: Tensor, z: Tensor, gradient: Tensor) -> Tensor:
        """What second derivatives times residuals add (K, 6, 6): of u along two motions -(du dz' + du' dz) / z, and of
        a turn, which moves a point along [w]x [w]x X / 2 besides."""
        gradient = gradient.unflatten(1, (-1, 2)).sum(2)  # of each point, (K, N, 6)
        points = self.points[..., :3]
        axis = pose[:, 2:, :3].expand_as(points)
        depth = torch.cat([axis, torch.linalg.cross(points, axis)], -1) / z
        outer = torch.bmm(points.mT, gradient[..., :3]).flatten(1) @ _of_turns(z.device, z.dtype)
        half = outer.unflatten(1, (6, 6)) - torch.bmm(gradient.mT, depth)
        return half + half.mT


def stepped(pose: Tensor, step: Tensor) -> Tensor:
    """Poses (K, 3, 4) after steps (K, 6), see `normal_equations.moved`."""
    half = torch.nn.functional.pad(0.5 * step[:, 3:], (1, 0), value=1.0)  # the quaternion of Cayley's rotation
    turn = (half[:, :, None] * half[:, None]).flatten(1) @ _of_quaternion(step.device, step.dtype).mT
    turn = (turn[:, :9] / turn[:, 9:]).view(-1, 3, 3)
    result = torch.bmm(pose[..., :3], torch.cat([turn, step[:, :3, None]], -1))
    result[..., 3] += pose[..., 3]
    return result


def moved_few(pose: Tensor, step: Tensor) -> Tensor:
    """`moved` of poses (3, 4, K) by steps (6, K)."""
    half = torch.nn.functional.pad(0.5 * step[3:], (0, 0, 1, 0), value=1.0)  # the quaternion of Cayley's rotation
    turn = _of_quaternion(step.device, step.dtype) @ (half[:, None] * half).flatten(0, 1)
    turn = (turn[:9] / turn[9]).unflatten(0, (3, 3))
    result = (pose[:, :3, None] * torch.cat([turn, step[:3, None]], 1)).sum(1)
    result[:, 3] += pose[:, 3]
    return result


@cache
def _triangle(device: torch.device) -> Tensor:
    """Where in a matrix (7, 7) the packed numbers are."""
    with torch.inference_mode(False):
        return torch.tensor([7 * i + k for i in range(7) for k in range(i, 7)], device=device)


@cache
def _of_turns(device: torch.device, dtype: torch.dtype) -> Tensor:
    """(9, 36): from sums of X g^T over the points to half of what a turn's second derivatives add."""
    with torch.inference_mode(False):
        table = torch.zeros(3, 3, 6, 6, dtype=dtype)
        for i in range(3):
            for k in range(3):
                table[i, k, 3 + i, 3 + k] += 0.5
                table[i, i, 3 + k, 3 + k] -= 0.5
        return table.view(9, 36).to(device)


@cache
def _of_quaternion(device: torch.device, dtype: torch.dtype) -> Tensor:
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
    with torch.inference_mode(False):
        table = torch.zeros(10, 4, 4, dtype=dtype)
        for row, terms in zip(table, signed, strict=True):
            for i, k, factor in terms:
                row[i, k] += factor
        return table.view(10, 16).to(device)


def ippe_few(
    points: Tensor, xy: Tensor, weight: Tensor, axes: Tensor, center: Tensor, fixed: float
) -> tuple[Tensor, Tensor, Tensor]:
    """`planar.ippe` of K planes: R (K, 2, 3, 3), t (K, 2, 3), and the points in the camera frame (K, N, 2, 3).

    Args:
        points: (K, N, 3). xy: (K, N, 2). weight: (K, N), 1 or 0.
        axes: (K, 3, 3), those of the planes as rows. center: (K, 3).
    """
    offset = (points - center[:, None]) * weight[..., None]
    plane = torch.cat([torch.bmm(offset, axes[:, :2].mT), weight[..., None]], -1)
    basis, factor = torch.linalg.qr(plane)
    # Harker, O'Leary: with h3 given, the first two rows of H follow by linear least squares from u (h3 . m)
    products = (xy[..., None] * plane[:, :, None]).flatten(2)
    coefficients = torch.bmm(basis.mT, products)
    residual = (products - torch.bmm(basis, coefficients)).unflatten(2, (2, 3)).flatten(1, 2)
    gram = torch.bmm(residual.mT, residual)
    scatter = coefficients[:, :2, 2::3].square().sum((1, 2)) * plane[..., 0].square().sum(1) / weight.sum(1).square()
    firm = torch.linalg.det(gram[:, :2, :2]) > fixed * scatter * gram.diagonal(dim1=1, dim2=2)[:, :2].sum(1)
    p = -torch.linalg.solve_ex(gram[:, :2, :2], gram[:, :2, 2]).result
    h = torch.bmm(coefficients.view(-1, 6, 3), torch.nn.functional.pad(p, (0, 1), value=1.0)[..., None])
    h = torch.linalg.solve_triangular(factor, h.view(-1, 3, 2), upper=True)
    q = h[:, 2]  # image of the centroid
    jacobian = h[:, :2].mT - q[..., None] * p[:, None]
    # a rotation of the axis towards the centroid, by half a turn about the middle between them
    aim = torch.nn.functional.normalize(torch.nn.functional.pad(q, (0, 1), value=1.0), dim=-1)
    eye = torch.eye(3, dtype=xy.dtype, device=xy.device)
    middle = torch.nn.functional.normalize(aim + eye[2], dim=-1)
    ray = 2 * middle[..., None] * middle[:, None] - eye
    both = torch.linalg.solve_ex(ray[:, :2, :2] - q[..., None] * ray[:, 2:, :2], jacobian).result
    # the largest singular value is the inverse depth
    half, area = 0.5 * both.square().sum((1, 2)), torch.linalg.det(both)
    both = both * (half + (half.square() - area.square()).clamp_min(0).sqrt()).rsqrt()[:, None, None]
    third = (1 - both.square().sum(1)).clamp_min(0).sqrt()
    third = torch.stack([third[:, 0], torch.where(both.prod(2).sum(1) > 0, -third[:, 1], third[:, 1])], -1)
    columns = torch.cat([both[:, None].expand(-1, 2, 2, 2), torch.stack([third, -third], 1)[:, :, None]], 2)
    normal = torch.linalg.cross(columns[..., 0], columns[..., 1])
    R = ray[:, None] @ torch.cat([columns, normal[..., None]], -1) @ axes[:, None]
    R = torch.where(firm[:, None, None, None], R, torch.nan)
    # the translation of least |(x, y) Z - (X, Y)|^2
    x = torch.bmm(offset, R.flatten(1, 2).mT).unflatten(2, (2, 3))
    rows = torch.cat([eye[:2, :2].expand(*xy.shape, 2), -xy[..., None]], -1) * weight[..., None, None]
    right = (xy[:, :, None] * x[..., 2:] - x[..., :2]).mT.flatten(1, 2)
    rows = rows.flatten(1, 2)
    t = torch.linalg.solve_ex(torch.bmm(rows.mT, rows), torch.bmm(rows.mT, right)).result.mT
    return R, t - (R @ center[:, None, :, None]).squeeze(-1), x + t[:, None]
