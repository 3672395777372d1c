"""Reprojection residuals of a pose and their normal equations, through the full camera model.

A pose is [R | t] (3, 4, ...), the batch last. Its step is a twist of the object, X_cam = R (C(w) X + d) + t, with d a
translation and w a rotation about the axes of the *object*. The derivative of an image point by d is then
b = (du/dX_cam) R, and by w it is X x b, where X is a constant. Hence J^T J and J^T r are linear in ten products of
b and the residual at each point, with coefficients that depend on the object alone: where all poses share their
points, the sums over the points are one matrix product.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.small_linalg import cayley, cross, matmul3, solve_rows
from torchpose.kernels import tracing
from torchpose.pnp.few import MOST

# upper triangle of the 6 x 7 matrix [J^T J | J^T r] row by row, and the cost, packed in 28 numbers
STARTS = (0, 7, 13, 18, 22, 25, 27)
COST = 27
# the products of b and the residual r: b0 b0, b0 b1, b0 b2, b0 r, b1 b1, b1 b2, b1 r, b2 b2, b2 r, r r
_PRODUCTS = 10
_BB = ((0, 1, 2), (1, 4, 5), (2, 5, 7))
_BR = (3, 6, 8)


class Sums(NamedTuple):
    """What sums over points that all poses share are, as matrices; none for compiled code.

    Attributes:
        points: (N, 4) homogeneous: @ pose gives the points in the camera frame.
        gauss, newton: (28, 10 N): @ products gives `assemble`, without and with the second derivatives.
    """

    points: Tensor
    gauss: Tensor
    newton: Tensor


class Observations(NamedTuple):
    """Image points of B poses and what they weigh; batch last.

    Attributes:
        points: (3, N, B) or (3, N, 1), object points about their centroid in units of their extent.
        xy: (2, N, B) normalised image points, or pixels where there is a ``camera``.
        whitening: (2, N, B) or broadcastable to it, or (2, 2, N, B): takes a difference of ``xy`` to units of its
            standard deviation; zero for a point that was not seen.
        camera: distorted camera through which the poses are projected; None: the pinhole of normalised coordinates.
        huber: residual in standard deviations above which the cost grows linearly; None: least squares.
        sums: `Sums` of the points where all poses share them, None otherwise.
    """

    points: Tensor
    xy: Tensor
    whitening: Tensor
    camera: Camera | None = None
    huber: float | Tensor | None = None
    sums: Sums | None = None

    def select(self, index: Tensor) -> Observations:
        """The poses ``index``."""
        return self._each(lambda x: x if x.shape[-1] == 1 else x.index_select(-1, index))

    def each(self) -> Observations:
        """With a dimension of one before the batch, for several poses of the same points."""
        return self._each(lambda x: x.unsqueeze(-2))

    def few(self, poses: int) -> bool:
        """Whether so many poses of them are few enough for `few.minimised`."""
        return not (poses > MOST or self.camera is not None or self.huber is not None or tracing())

    def to(self, dtype: torch.dtype) -> Observations:
        sums = None if self.sums is None else Sums(*(v.to(dtype) for v in self.sums))
        return self._each(lambda x: x.to(dtype))._replace(sums=sums)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Observations:
        points, xy, whitening = map(change, self[:3])
        return self._replace(points=points, xy=xy, whitening=whitening)


class Derivatives(NamedTuple):
    """At every point: depth z (N, ...), derivatives b and residual (4, 2, N, ...), cost (N, ...)."""

    z: Tensor
    rows: Tensor
    cost: Tensor


def sums_of(points: Tensor) -> Sums:
    """The sums over points (3, N, 1), found by applying them to unit vectors, the points one by one."""
    unit = torch.eye(_PRODUCTS, dtype=points.dtype, device=points.device)[:, None, :, None]
    single, unit = points.transpose(1, 2)[:, :, None], unit.expand(-1, -1, -1, points.shape[1])  # (3, 1, 1, N)
    model = torch.cat([points.flatten(1), torch.ones_like(points[0].flatten(1)).T]).T.contiguous()
    return Sums(model, assemble(single, unit).flatten(1), assemble(single, unit, newton=True).flatten(1))


def camera_points(obs: Observations, pose: Tensor) -> Tensor:
    """(3, N, ...) of poses (3, 4, ...)."""
    if obs.sums is not None:
        return (obs.sums.points @ pose.flatten(2)).unflatten(2, pose.shape[2:])
    x, y, z = obs.points
    p = torch.addcmul(pose[:, None, 3], pose[:, None, 0], x)
    return p.addcmul_(pose[:, None, 1], y).addcmul_(pose[:, None, 2], z)


def residuals(obs: Observations, uv: Tensor) -> Tensor:
    """Whitened residuals (2, N, ...) of projections ``uv`` (2, N, ...) in normalised coordinates."""
    if obs.camera is not None:
        uv = obs.camera.distort(uv.movedim(0, -1)).movedim(-1, 0)
    difference = uv - obs.xy
    if obs.whitening.ndim == obs.xy.ndim:
        return difference * obs.whitening
    return obs.whitening[:, 0] * difference[0] + obs.whitening[:, 1] * difference[1]


def robust(square: Tensor, huber: float | Tensor) -> tuple[Tensor, Tensor]:
    """Huber's cost of squared residuals, linear in the residual above ``huber``, and the weight of their squares."""
    outside = square > huber**2
    length = torch.where(outside, square, 1).sqrt()
    return torch.where(outside, huber * (2 * length - huber), square), torch.where(outside, huber / length, 1)


def product2(left: Tensor, right: Tensor) -> Tensor:
    """Products of matrices (2, 2, N, ...), one of which may be diagonal, (2, N, ...)."""
    if left.ndim != right.ndim:
        return (left[:, None] if left.ndim < right.ndim else left) * right
    return left[:, 0, None] * right[0] + left[:, 1, None] * right[1]


def differentiate(obs: Observations, pose: Tensor, fine: Observations | None = None) -> Derivatives:
    """Residuals and their derivatives by the position of the point, at poses (3, 4, ...).

    With ``fine``, the same observations in a longer dtype, which is that of the poses, residuals are computed in this
    and then rounded to the dtype of ``obs``, as is all the rest.
    """
    p = camera_points(fine or obs, pose)
    d = 1 / p[2]
    uv = p[:2] * d
    residual = residuals(fine or obs, uv)
    pose, z, d, uv, residual = (v.to(obs.xy) for v in (pose, p[2], d, uv, residual))
    rows = torch.empty((4, *uv.shape), dtype=uv.dtype, device=uv.device)
    b = rows[:3]
    # (du/dX_cam) R z, the unwhitened derivatives of u and v by the three axes of the object
    torch.addcmul(pose[:2, :3].transpose(0, 1)[:, :, None], uv, pose[2, :3, None, None], value=-1, out=b)
    weight = obs.whitening
    if obs.camera is not None:
        slope = obs.camera.J_distort(uv.movedim(0, -1)).movedim((-2, -1), (0, 1))
        weight = product2(weight, slope)
    if weight.ndim == uv.ndim:
        b.mul_(weight * d)
    else:
        weight = weight * d
        b.copy_(weight[:, 0] * b[:, 0, None] + weight[:, 1] * b[:, 1, None])
    rows[3] = residual
    cost = residual[0].square().addcmul_(residual[1], residual[1])
    if obs.huber is not None:
        cost, robust_weight = robust(cost, obs.huber)
        rows *= robust_weight.sqrt()
    return Derivatives(z, rows, cost)


def normal_equations(obs: Observations, pose: Tensor, newton: bool = False, fine: Observations | None = None) -> Tensor:
    """Packed J^T J, J^T r and cost (28, ...) at the poses (3, 4, ...); the cost is infinite with a point behind.

    With ``newton`` the second derivatives of the projections times r are added to J^T J. That of u along two motions of
    the point is -(du dz' + du' dz) / z; the distortion of a camera is taken as linear.
    ``fine`` as in `differentiate`: a step has then the accuracy of its dtype, but for an error in proportion to itself.
    """
    z, rows, cost = differentiate(obs, pose, fine)
    u, v = rows.unbind(1)
    products = torch.empty((_PRODUCTS, *cost.shape), dtype=cost.dtype, device=cost.device)
    depth = pose[2, :3, None].to(z) / z if newton else None
    gradient = [products[k] for k in _BR]
    for m, part in enumerate(products[:9].split([4, 3, 2])):
        torch.mul(u[m], u[m:], out=part).addcmul_(v[m], v[m:])
    if depth is not None:
        for m in range(3):
            for k in range(m, 3):
                products[_BB[m][k]].addcmul_(gradient[m], depth[k], value=-1).addcmul_(depth[m], gradient[k], value=-1)
    products[9] = cost
    if obs.sums is not None:
        sums = obs.sums.newton if newton else obs.sums.gauss
        normal = (sums @ products.flatten(0, 1).flatten(1)).unflatten(1, cost.shape[1:])
    else:
        normal = assemble(obs.points, products, newton)
    normal[COST] = torch.where(z.amin(0) > 0, normal[COST], torch.inf)
    return normal


def costs(obs: Observations, pose: Tensor) -> Tensor:
    """The cost (...) alone at the poses (3, 4, ...), as `normal_equations` has it."""
    p = camera_points(obs, pose)
    square = residuals(obs, p[:2] / p[2]).square().sum(0)
    cost = square if obs.huber is None else robust(square, obs.huber)[0]
    return torch.where(p[2].amin(0) > 0, cost.sum(0), torch.inf)


def assemble(points: Tensor, products: Tensor, newton: bool = False) -> Tensor:
    """Packed normal equations (28, ...) of the ten products (10, N, ...) at points (3, N, ...).

    With ``newton``, of products that hold the second derivatives: a point moves along [w]x [w]x X / 2 besides.
    """
    x = points[:, None]
    bb = torch.stack([products[k] for row in _BB for k in row]).unflatten(0, (3, 3))
    gradient = torch.stack([products[k] for k in _BR])
    mixed = cross(x, bb).transpose(0, 1)  # by translation m and rotation k: b_m (X x b)_k
    both = cross(x, mixed).sum(2)
    if newton:
        outer = (x * gradient).sum(2)
        both = both + 0.5 * (outer + outer.transpose(0, 1))
        both.diagonal(dim1=0, dim2=1).sub_(outer.diagonal(dim1=0, dim2=1).sum(-1, keepdim=True))
    bb, mixed = bb.sum(2), mixed.sum(2)
    turn = cross(points, gradient).sum(1)
    gradient = gradient.sum(1)
    top = [torch.cat([bb[m, m:], mixed[m], gradient[m, None]]) for m in range(3)]
    return torch.cat([*top, *(torch.cat([both[k, k:], turn[k, None]]) for k in range(3)), products[9].sum(0)[None]])


def rows_of(normal: Tensor) -> list[Tensor]:
    """Rows of [J^T J | J^T r] from the diagonal on."""
    return [normal[a:b] for a, b in pairwise(STARTS)]


def few(value: Tensor) -> bool:
    """Whether ``value`` (k, B) is of so few poses that calls cost more than what they compute."""
    return not tracing() and value.ndim == 2 and value.shape[-1] <= MOST


def information(normal: Tensor) -> Tensor:
    """J^T J (6, 6, B) of packed numbers (28, B)."""
    return normal.index_select(0, _full(normal.device)[:36]).unflatten(0, (6, 6))


def distance(normal: Tensor, step: Tensor) -> Tensor:
    """Squared Mahalanobis length (...) of steps (6, ...), translation first, by the information J^T J."""
    if few(step):
        return (information(normal) * step * step[:, None]).sum((0, 1))
    twice = [(row[:-1] * step[i:]).sum(0) - 0.5 * row[0] * step[i] for i, row in enumerate(rows_of(normal))]
    return 2 * (torch.stack(twice) * step).sum(0)


def damped_step(normal: Tensor, damping: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Minimum (6, ...) of the quadratic model, the decrease of the cost that it promises (...), and is it one? (...)

    Where the matrix is not positive definite, the first two mean nothing.
    """
    batch = normal.shape[1:]
    if not tracing() and normal.device.type == "cpu" and batch.numel() <= MOST:
        numbers = normal.index_select(0, _full(normal.device)).flatten(1)
        gradient = numbers[36:]
        if damping is not None:
            numbers[:36:7] *= 1 + damping.flatten()
        factor, info = torch.linalg.cholesky_ex(numbers[:36].T.unflatten(1, (6, 6)))
        step = torch.cholesky_solve(gradient.T[..., None], factor).squeeze(2).T
        valid = (info == 0).unflatten(0, batch)
        return -step.unflatten(1, batch), (step * gradient).sum(0).unflatten(0, batch), valid
    rows = rows_of(normal)
    solution, pivots = solve_rows(rows, damping)
    step = solution.squeeze(1)
    decrease = step[0] * rows[0][-1]
    for value, row in zip(step[1:], rows[1:], strict=True):
        decrease = torch.addcmul(decrease, value, row[-1])
    return step.neg_(), decrease, pivots.amin(0) > 0


@cache
def _full(device: torch.device) -> Tensor:
    """Where in the packed numbers J^T J is, row by row, then J^T r; made once: every call for one pose counts."""
    matrix = [STARTS[min(i, j)] + abs(i - j) for i in range(6) for j in range(6)]
    with torch.inference_mode(False):
        return torch.tensor(matrix + [start + 6 - i for i, start in enumerate(STARTS[:6])], device=device)


def moved(pose: Tensor, step: Tensor) -> Tensor:
    """Poses [R C(w) | R d + t] (3, 4, ...) of steps (d, w) (6, ...), with Cayley's rotation C(w)."""
    result = matmul3(pose[:, :3], torch.cat([cayley(step[3:]), step[:3, None]], 1))
    result[:, 3] += pose[:, 3]
    return result
