"""Maximum-likelihood pose by Levenberg-Marquardt on reprojection errors, through the full camera model.

The state is the pose about the centroid of the points; a step is a translation and a rotation from the left,
X_cam = C(w) R (X - c) + t, with Cayley's C(w) = exp([w]x) to third order. The Jacobian is analytic; damping, acceptance
and convergence are per pose. The iterations run in float32 on undistorted points first and finish in float64 on the
pixels themselves.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.geometry.small_linalg import cayley, matmul3, solve_rows
from torchpose.pnp._compile import compiled

# upper triangle of the 6 x 7 matrix [J^T J | J^T r] row by row, and the squared length of r, packed in 28 numbers
_STARTS = (0, 7, 13, 18, 22, 25, 27)
# columns of the Jacobian are kept with these signs: it saves their negation
SIGNS = (1.0, 1.0, -1.0, -1.0, 1.0, 1.0)
# where in the packed numbers J^T r is, and J^T J row by row
_GRADIENT = tuple(start + 6 - i for i, start in enumerate(_STARTS[:6]))
_FULL = tuple(_STARTS[min(i, j)] + abs(i - j) for i in range(6) for j in range(6))
# poses up to which LAPACK, one matrix after the other, costs less than the calls of an elimination
_FEW = 64


class Observations(NamedTuple):
    """Image points of B poses and what they weigh; batch last.

    Attributes:
        points: (3, N, B) or (3, N, 1), object points about their centroid in units of their extent.
        xy: (2, N, B) normalised image points, or pixels where there is a ``camera``.
        whitening: (2, N, B) or broadcastable to it, or (2, 2, N, B): takes a difference of ``xy`` to units of its
            standard deviation; zero for a point that was not seen.
        camera: distorted camera through which the poses are projected; None: the pinhole of normalised coordinates.
        huber: residual in standard deviations above which the cost grows linearly; inf: least squares.
    """

    points: Tensor
    xy: Tensor
    whitening: Tensor
    camera: Camera | None = None
    huber: float = float("inf")

    def select(self, index: Tensor) -> Observations:
        """The poses ``index``."""

        def pick(x: Tensor) -> Tensor:
            return x if x.shape[-1] == 1 else x.index_select(-1, index)

        return self._replace(points=pick(self.points), xy=pick(self.xy), whitening=pick(self.whitening))

    def repeat(self, count: int) -> Observations:
        """``count`` copies one after the other."""
        if count == 1:
            return self

        def tile(x: Tensor) -> Tensor:
            return x if x.shape[-1] == 1 else torch.cat([x] * count, -1)

        return self._replace(points=tile(self.points), xy=tile(self.xy), whitening=tile(self.whitening))

    def to(self, dtype: torch.dtype) -> Observations:
        return self._replace(points=self.points.to(dtype), xy=self.xy.to(dtype), whitening=self.whitening.to(dtype))


class Estimate(NamedTuple):
    """B minimisations: R (3, 3, B), t (3, B), packed normal equations (28, B), iterations and converged (B,)."""

    r: Tensor
    t: Tensor
    normal: Tensor
    iterations: Tensor
    converged: Tensor


def residuals(obs: Observations, uv: Tensor) -> Tensor:
    """Whitened residuals (2, N, B) of projections ``uv`` (2, N, B) in normalised coordinates."""
    if obs.camera is not None:
        uv = obs.camera.distort(uv.movedim(0, -1)).movedim(-1, 0)
    difference = uv - obs.xy
    if obs.whitening.ndim == 3:
        return difference * obs.whitening
    return obs.whitening[:, 0] * difference[0] + obs.whitening[:, 1] * difference[1]


def linearise(obs: Observations, r: Tensor, t: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Rows of [J | r] for u and for v, seven (N, B) each, and the cost (B,), infinite where a point is behind."""
    px, py, pz = rotated = r[:, 0, None] * obs.points[0] + r[:, 1, None] * obs.points[1] + r[:, 2, None] * obs.points[2]
    camera_points = rotated + t[:, None]
    z = camera_points[2]
    d = 1 / z
    uv = camera_points[:2] * d
    residual = residuals(obs, uv)
    weight = obs.whitening
    if obs.camera is not None:
        slope = obs.camera.J_distort(uv.movedim(0, -1)).movedim((-2, -1), (0, 1))
        weight = weight[:, None] * slope if weight.ndim == 3 else product2(weight, slope)
    full = weight.ndim == 4
    e = d.expand_as(uv) if full else d * weight
    f = e * uv
    zero = torch.zeros_like(d)
    (ex, ey), (fx, fy) = e, f
    u_row = [ex, zero, fx, fx * py, ex * pz + fx * px, -ex * py]
    v_row = [zero, ey, fy, ey * pz + fy * py, fy * px, ey * px]
    if full:
        pairs = list(zip(u_row, v_row, strict=True))
        u_row = [weight[0, 0] * a + weight[0, 1] * b for a, b in pairs]
        v_row = [weight[1, 0] * a + weight[1, 1] * b for a, b in pairs]
    u_row.append(residual[0])
    v_row.append(residual[1])
    cost = residual.square().sum(0)
    if obs.huber != float("inf"):
        length = cost.sqrt()
        outside = length > obs.huber
        scale = torch.where(outside, obs.huber / torch.where(outside, length, 1), 1).sqrt()
        u_row, v_row = [a * scale for a in u_row], [a * scale for a in v_row]
        cost = torch.where(outside, obs.huber * (2 * length - obs.huber), cost)
    return u_row, v_row, torch.where(z.amin(0) > 0, cost.sum(0), torch.inf)


def product2(a: Tensor, b: Tensor) -> Tensor:
    """Products of matrices (2, 2, ...)."""
    return a[:, 0, None] * b[0] + a[:, 1, None] * b[1]


def normal_equations(obs: Observations, r: Tensor, t: Tensor) -> Tensor:
    """Packed J^T J, J^T r and cost (28, B) at the poses R (3, 3, B), t (3, B)."""
    u_row, v_row, cost = linearise(obs, r, t)
    if torch.compiler.is_compiling():
        sums = [(u_row[i] * u_row[j] + v_row[i] * v_row[j]).sum(0) for i in range(6) for j in range(i, 7)]
        return torch.stack([*sums, cost])
    rows = (
        torch.stack([row for pair in zip(u_row, v_row, strict=True) for row in pair]).unflatten(0, (7, 2)).flatten(1, 2)
    )
    return torch.cat([*((rows[i] * rows[i:]).sum(1) for i in range(6)), cost[None]])  # rows: (7, 2N, B)


def _rows(normal: Tensor) -> list[Tensor]:
    """Rows of [J^T J | J^T r] from the diagonal on."""
    return [normal[a:b] for a, b in pairwise(_STARTS)]


@cache
def _constants(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """`SIGNS` (6, 1) and `_FULL`, `_GRADIENT` in a row, made once: every call for one pose counts."""
    with torch.inference_mode(False):
        signs = torch.tensor(SIGNS, dtype=dtype, device=device)[:, None]
        return signs, torch.tensor(_FULL + _GRADIENT, device=device)


def _signs(like: Tensor) -> Tensor:
    if torch.compiler.is_compiling():  # a constant of the kernel
        return torch.tensor(SIGNS, dtype=like.dtype, device=like.device)[:, None]
    return _constants(like.device, like.dtype)[0]


def _step(normal: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Damped step (6, B) in the signs of the Jacobian, and the decrease of the cost that it promises (B,)."""
    if not torch.compiler.is_compiling() and normal.device.type == "cpu" and normal.shape[-1] <= _FEW:
        numbers = normal.index_select(0, _constants(normal.device, normal.dtype)[1])
        gradient = numbers[36:]
        numbers[:36:7] *= 1 + damping
        a = numbers[:36].T.unflatten(1, (6, 6))
        step = torch.linalg.solve_ex(a, gradient.T)[0].T
        return step, (step * gradient).sum(0)
    rows = _rows(normal)
    step = solve_rows(rows, damping)[0].squeeze(1)
    return step, sum((step[i] * row[-1] for i, row in enumerate(rows)), start=torch.zeros_like(damping))


def distance(normal: Tensor, step: Tensor) -> Tensor:
    """Squared Mahalanobis length (B,) of steps (6, B), translation first, by the information J^T J."""
    step = step * _signs(step)
    twice = [(row[:-1] * step[i:]).sum(0) - 0.5 * row[0] * step[i] for i, row in enumerate(_rows(normal))]
    return 2 * (torch.stack(twice) * step).sum(0)


def covariance(normal: Tensor) -> tuple[Tensor, Tensor]:
    """(J^T J)^-1 (6, 6, B), translation first, and how independent the parameters are (B,): 0 where one is not fixed.

    The latter is the least pivot over its diagonal entry, that is the least 1 - (multiple correlation)^2.
    """
    signed = torch.diag(torch.tensor(SIGNS, dtype=normal.dtype, device=normal.device))[..., None]
    rows = _rows(normal)
    eye = signed.expand(6, 6, normal.shape[-1])
    inverse, pivots = solve_rows([torch.cat([row[:-1], eye[i]]) for i, row in enumerate(rows)])
    return inverse * signed.sum(1)[:, None], (pivots / torch.stack([row[0] for row in rows])).amin(0)


class _State(NamedTuple):
    """Poses under way: the best so far with its normal equations and damping, and the trial that comes next."""

    r: Tensor
    t: Tensor
    normal: Tensor
    damping: Tensor
    r_trial: Tensor
    t_trial: Tensor
    decrease: Tensor
    done: Tensor


def _advance(obs: Observations, state: _State, rtol: float, floor: Tensor) -> _State:
    """Evaluates the trial poses, accepts those that lower the cost, and proposes the next damped step.

    Poses that were done stay as they are, so that a pose does not depend on the others of its batch.
    """
    r, t = state.r_trial, state.t_trial
    normal = normal_equations(obs, r, t)
    # residuals that err by sqrt(floor) in length change the cost by as much as this (Cauchy-Schwarz)
    old = state.normal[27]
    lower = normal[27] <= old + 2 * (old * floor).sqrt() + floor
    accept = lower & ~state.done
    everywhere = not torch.compiler.is_compiling() and bool(accept.all())
    if not everywhere:
        r, t = torch.where(accept, r, state.r), torch.where(accept, t, state.t)
        normal = torch.where(accept, normal, state.normal)
    damping = state.damping * torch.where(lower, 0.1, 10.0)
    step, decrease = _step(normal, damping)
    done = (decrease <= rtol * normal[27] + floor) & (damping <= 1) & (normal[27] < torch.inf)
    step = step * -_signs(r)
    r_trial, t_trial = matmul3(cayley(step[3:]), r), t + step[:3]
    if not everywhere:
        was = state.done
        r_trial, t_trial = torch.where(was, state.r_trial, r_trial), torch.where(was, state.t_trial, t_trial)
        decrease, done = torch.where(was, state.decrease, decrease), done | was
    return _State(r, t, normal, damping, r_trial, t_trial, decrease, done)


def _settle(state: _State) -> tuple[Tensor, Tensor, Tensor]:
    """Poses and normal equations, with the last step of those that are done, of which the cost is predicted."""
    r, t = torch.where(state.done, state.r_trial, state.r), torch.where(state.done, state.t_trial, state.t)
    cost = (state.normal[27] - torch.where(state.done, state.decrease, 0)).clamp_min(0)
    return r, t, torch.cat([state.normal[:27], cost[None]])


def minimise(
    obs: Observations,
    r: Tensor,
    t: Tensor,
    *,
    max_iterations: int,
    rtol: float,
    damping: float = 1e-3,
    compile: bool = False,
) -> Estimate:
    """Levenberg-Marquardt from R (3, 3, B), t (3, B) in the dtype of ``obs``.

    A pose has converged when the step promises to lower its cost by no more than ``rtol`` of it, or than rounding
    could; that step is still taken, but not evaluated. Converged poses leave the batch.
    """
    # the distortion model is left to eager mode: its Python would be traced anew for every camera
    advance = compiled(_advance) if compile and obs.camera is None else _advance
    settle = compiled(_settle) if compile else _settle
    eps = torch.finfo(r.dtype).eps
    scale = obs.whitening.square().amax(0) if obs.whitening.ndim == 3 else obs.whitening.square().amax((0, 1))
    magnitude = obs.xy.square().sum(0)
    floor = (4 * eps) ** 2 * (scale * (magnitude if obs.camera is not None else 1 + magnitude)).sum(0)
    unknown = r.new_full((28, r.shape[-1]), torch.inf)
    lam = torch.full_like(unknown[0], 10 * damping)
    state = _State(r, t, unknown, lam, r, t, lam, lam < 0)
    result: Estimate | None = None
    index: Tensor | None = None  # of the poses still under way; None: all

    for iteration in range(1, max_iterations + 1):
        state = _State(*advance(obs, state, rtol, floor))
        # neither a pose without numbers nor one whose steps have shrunk to nothing will come to an end
        over = state.done | ~((state.damping < 1e8) & (state.normal[27] < torch.inf))
        remaining = (~over).nonzero().squeeze(1)
        last = iteration == max_iterations or len(remaining) == 0
        if last or (len(over) > 64 and 2 * len(remaining) <= len(over)):
            r, t, normal = settle(state)
            if result is None or index is None:
                count = torch.full_like(over, iteration, dtype=torch.int64)
                result = Estimate(r, t, normal, count, state.done)
            else:
                for whole, part in zip(result[:3], (r, t, normal), strict=True):
                    whole.index_copy_(-1, index, part)
                result.iterations.index_fill_(0, index, iteration)
                result.converged.index_copy_(0, index, state.done)
            if last:
                return result
            index = remaining if index is None else index[remaining]
            obs, floor = obs.select(remaining), floor[remaining]
            state = _State(*(v.index_select(-1, remaining) for v in state))
    raise AssertionError("unreachable: the last iteration returns")
