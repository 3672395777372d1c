"""From minima to the result: covariance in camera axes, the other pose, and a code for every pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpose.geometry.small_linalg import cross, eliminate, matmul3
from torchpose.kernels import compiled, tracing
from torchpose.pnp.iterative import Estimate
from torchpose.pnp.normal_equations import (
    COST,
    Observations,
    camera_points,
    differentiate,
    distance,
    few,
    information,
    normal_equations,
    residuals,
    rows_of,
)
from torchpose.pnp.problem import Problem
from torchpose.pnp.result import PnPCode, PnPResult

# chi-squared difference below which two minima are called ambiguous
DECISION = 20.0
# squared Mahalanobis distance below which two minima are one
COINCIDENCE = 1.0
# least 1 - (multiple correlation)^2 of a parameter below which the points do not fix the pose
INDEPENDENCE = 1e-11

Bad = tuple[tuple[Tensor, PnPCode], ...]  # (B,) bool, and why these poses have no answer


class Found(NamedTuple):
    """Minima found: [R | t] (3, 4, ...), cost, iterations and converged (...)."""

    pose: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor


class Minima(NamedTuple):
    """The best minimum, and the other one: pose (3, 4, B), cost (B,), is there one, and is enough known of it?"""

    best: Estimate
    other: Tensor
    other_cost: Tensor
    different: Tensor
    reached: Tensor


class Table(NamedTuple):
    """The result as rows of one vector each, so that every chunk writes its own columns.

    Attributes:
        floats: (65, B) [R | t], R_alt | t_alt, covariance, chi2, rms, chi2_alt, rms_alt, ratio.
        integers: (2, B) iterations, code.
    """

    floats: Tensor
    integers: Tensor

    @staticmethod
    def empty(batch: int, like: Tensor, compile: bool) -> Table:
        """Rows in memory for eager mode; for compiled code, which has all of a pose at once, poses."""
        shape = (batch, 65) if compile else (65, batch)
        # NumPy asks the system for huge pages: a tenth of the time of a compiled solve
        floats = torch.from_numpy(np.empty(shape)) if like.device.type == "cpu" else like.new_empty(shape)
        integers = torch.empty((batch, 2) if compile else (2, batch), dtype=torch.int64, device=like.device)
        return Table(floats.T, integers.T) if compile else Table(floats, integers)

    def columns(self, rows: slice) -> Table:
        return Table(self.floats[:, rows], self.integers[:, rows])

    def replace(self, index: Tensor, part: Table) -> None:
        self.floats.index_copy_(1, index, part.floats)
        self.integers.index_copy_(1, index, part.integers)

    def doubtful(self, another: Tensor, rough: Tensor) -> Tensor:
        """Poses (L,) that have no minimum though the points are sound, or one though there may be ``another`` (B,).

        And all of those whose starts were ``rough`` (B,).
        """
        code = self.integers[1]
        sound = (code != PnPCode.TOO_FEW) & (code != PnPCode.NOT_FINITE)
        alone = self.floats[62].isnan() & (another | (code > PnPCode.AMBIGUOUS))
        return (sound & (alone | rough)).nonzero().squeeze(1)

    def minimum(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """[R | t] (3, 4, L), chi-squared and code (L,) of the poses ``index``."""
        return self.floats[:12, index].unflatten(0, (3, 4)), self.floats[60, index], self.integers[1, index]

    def result(self) -> PnPResult:
        """As views."""
        pose, alt = (self.floats[k : k + 12].unflatten(0, (3, 4)) for k in (0, 12))
        chi2, rms, chi2_alt, rms_alt, ratio = self.floats[60:]
        return PnPResult(
            R=pose[:, :3].permute(2, 0, 1),
            t=pose[:, 3].T,
            covariance=self.floats[24:60].unflatten(0, (6, 6)).permute(2, 0, 1),
            rms=rms,
            chi2=chi2,
            iterations=self.integers[0],
            code=self.integers[1],
            R_alt=alt[:, :3].permute(2, 0, 1),
            t_alt=alt[:, 3].T,
            rms_alt=rms_alt,
            chi2_alt=chi2_alt,
            ratio=ratio,
        )


def relevant(chi2: Tensor) -> Tensor:
    """Chi-squared above which another minimum matters no more, given that of the best."""
    return 2 * chi2 + 2 * DECISION


def choose(obs: Observations, found: Found, compile: bool = False) -> Minima:
    """The best of S minima (..., S, B), and the next one that is not the same."""
    options, batch = found.converged.shape
    chi2, order = found.cost.nan_to_num(nan=torch.inf, posinf=torch.inf).sort(0)

    def pick(rank: int) -> Found:
        return Found(*(v.gather(-2, order[rank].expand(*v.shape[:-2], 1, batch)).squeeze(-2) for v in found))

    pose, cost, iterations, converged = pick(0)
    normal = compiled(normal_equations)(obs, pose) if compile else normal_equations(obs, pose)
    # a minimum is known by the cost that its last step promised; one behind the camera from the start by none
    normal[COST] = cost
    best = Estimate(pose, normal, iterations, converged)
    other, cost = best.pose, torch.full_like(chi2[0], torch.nan)
    different = torch.zeros_like(best.converged)
    reached = torch.ones_like(different)
    for k in range(1, options):
        candidate = pick(k)
        new = chi2[k].isfinite() & ~_coincide(best, candidate.pose) & ~different
        other = torch.where(new, candidate.pose, other)
        cost, reached = torch.where(new, chi2[k], cost), torch.where(new, candidate.converged, reached)
        different = different | new
    return Minima(best, other, cost, different, reached)


def _coincide(best: Estimate, pose: Tensor) -> Tensor:
    """(B,): is a pose (3, 4, B) within a standard deviation of the estimate, by its information?"""
    back = best.pose[:, :3].transpose(0, 1)
    relative = matmul3(back, torch.cat([pose[:, :3], (pose[:, 3] - best.pose[:, 3])[:, None]], 1))
    axis = torch.stack([relative[i, k] - relative[k, i] for i, k in ((2, 1), (0, 2), (1, 0))])
    trace = relative[0, 0] + relative[1, 1] + relative[2, 2]
    # twice the tangent of half the angle; Cayley's vector, as in the steps of the minimiser
    step = torch.cat([relative[:, 3], 2 * axis / (1 + trace).clamp_min(1e-12)])
    return distance(best.normal, step) < COINCIDENCE


def write(problem: Problem, minima: Minima, bad: Bad, table: Table, again: Tensor | None = None) -> None:
    """Writes the columns of ``table``; ``bad`` are the codes of poses without a sensible problem, the last one wins.

    Poses that will be written ``again`` (B,) need not be made NaN.
    """
    best, other, other_cost, different, reached = minima
    center, unit, pixel = problem.body.center, problem.body.unit, problem.pixel
    chi2 = best.normal[COST]
    mixed = None if problem.calibration is None else _mixed(problem.final, problem.calibration, best.pose)
    pose, alt, matrix, figures = table.floats.split([12, 12, 36, 5])
    place(best.pose, center, unit, pose.unflatten(0, (3, 4)))
    place(other.to(chi2), center, unit, alt.unflatten(0, (3, 4)))
    independence = covariance(best, center, unit, mixed, matrix.unflatten(0, (6, 6)))
    chi2_alt = other_cost.to(chi2)
    if isinstance(pixel, Observations):
        rms, rms_alt = (_mean_square(pixel, problem.weight, v.to(chi2)).sqrt() for v in (best.pose, other))
    else:  # of equal weights and squares: chi-squared says it all
        rms, rms_alt = (pixel * (v / problem.seen).sqrt() for v in (chi2, chi2_alt))

    finite = chi2 < torch.inf
    verdicts = (
        (different & (chi2_alt - chi2 < DECISION), PnPCode.AMBIGUOUS),
        # another minimum that was not reached may be lower than where its search ended
        (~(best.converged & reached), PnPCode.NOT_CONVERGED),
        (~finite, PnPCode.BEHIND_CAMERA),
        (finite & ~(independence > INDEPENDENCE), PnPCode.DEGENERATE),
        *bad,
    )
    code = torch.zeros_like(best.iterations)
    for failed, verdict in verdicts:
        code = torch.where(failed, int(verdict), code)

    figures.copy_(torch.stack([chi2, rms, chi2_alt, rms_alt, rms_alt / rms]))
    table.integers.copy_(torch.stack([best.iterations, code]))
    failed = code > PnPCode.AMBIGUOUS
    for unknown, rows in ((failed, (table.floats,)), (failed | ~different, (alt, figures[2:]))):
        if tracing():
            for part in rows:
                part.copy_(torch.where(unknown, torch.nan, part))
        else:  # few lines rather than one more pass
            index = (unknown if again is None else unknown & ~again).nonzero().squeeze(1)
            for part in rows if len(index) else ():
                part.index_fill_(1, index, torch.nan)


def place(pose: Tensor, center: Tensor, unit: Tensor, out: Tensor) -> None:
    """Poses (3, 4, B) from the centroid in units of the extent to the origin of the object: t = unit t' - R c."""
    r = pose[:, :3]
    out[:, :3] = r
    torch.mul(pose[:, 3], unit, out=out[:, 3])
    for k in range(3):
        out[:, 3].addcmul_(r[:, k], center[k], value=-1)


def covariance(best: Estimate, center: Tensor, unit: Tensor, mixed: Tensor | None, out: Tensor) -> Tensor:
    """Writes the covariance to ``out`` (6, 6, B), translation first, rotation from the left; the independence (B,).

    The latter is the least pivot over its diagonal entry, that is the least 1 - (multiple correlation)^2: 0 where a
    parameter is not fixed. With J^T J = L D L^T and T the derivative of (t, R) by a step, the covariance is the square
    of D^-1/2 L^-1 T^T. ``mixed`` (6, 4, B) adds what uncertain intrinsics do, see `_mixed`.
    """
    columns = best.pose[:, :3].transpose(0, 1)
    if few(unit[None]) and mixed is None:
        return _covariance_of_few(best, columns, center, unit, out)
    rows = rows_of(best.normal)
    to_t = [*(columns * unit), *cross(columns, center[:, None])]
    if mixed is not None:
        to_t = [torch.cat(pair) for pair in zip(to_t, mixed, strict=True)]
    block, pivots = eliminate([torch.cat([row[:-1], part]) for row, part in zip(rows, to_t, strict=True)])
    scale = pivots.rsqrt()
    t = [row[6 - k :] * scale[k] for k, row in enumerate(block)]  # (3, B) each, or (3 + 4, B)
    to_r = list(columns)  # in the last three rows alone: nothing but a turn moves the rotation
    for k in range(3):
        for i in range(k + 1, 3):
            to_r[i] = torch.addcmul(to_r[i], block[3 + k][i - k] / pivots[3 + k], to_r[k], value=-1)
    r = [row * scale[3 + k] for k, row in enumerate(to_r)]
    for i in range(3):
        _sum_of_products([v[i] for v in t], [v[i:3] for v in t], out[i, i:3])
        _sum_of_products([v[i] for v in t[3:]], r, out[i, 3:])
        _sum_of_products([v[i] for v in r], [v[i:] for v in r], out[3 + i, 3 + i :])
    for i in range(5):
        out[i + 1 :, i] = out[i, i + 1 :]
    if mixed is not None:  # (6, 4, B), of the pose by the intrinsics
        shift = torch.empty_like(mixed)
        for i in range(3):
            _sum_of_products([v[i] for v in t], [v[3:] for v in t], shift[i])
            _sum_of_products([v[i] for v in r], [v[3:] for v in t[3:]], shift[3 + i])
        out += (shift[:, None] * shift).sum(2)
    return (pivots / torch.stack([row[0] for row in rows])).amin(0)


def _covariance_of_few(best: Estimate, columns: Tensor, center: Tensor, unit: Tensor, out: Tensor) -> Tensor:
    """The same by Cholesky's factor of each matrix."""
    matrix = information(best.normal).permute(2, 0, 1)
    factor, failed = torch.linalg.cholesky_ex(matrix)
    # derivative of (t, R) by a step, transposed: (6, 6, B)
    turned = torch.linalg.cross(columns, center[:, None].expand_as(columns), dim=0)
    by_step = torch.cat([torch.cat([columns * unit, turned]), torch.nn.functional.pad(columns, (0, 0, 0, 0, 3, 0))], 1)
    root = torch.linalg.solve_triangular(factor, by_step.permute(2, 0, 1), upper=False)
    out.copy_(torch.bmm(root.mT, root).permute(1, 2, 0))
    independence = (factor.diagonal(dim1=1, dim2=2).square() / matrix.diagonal(dim1=1, dim2=2)).amin(1)
    return torch.where(failed == 0, independence, 0.0)


def _sum_of_products(left: Sequence[Tensor], right: Sequence[Tensor], out: Tensor) -> None:
    """Without a tensor for each product."""
    torch.mul(left[0], right[0], out=out)
    for x, y in zip(left[1:], right[1:], strict=True):
        out.addcmul_(x, y)


def _mixed(obs: Observations, calibration: tuple[Tensor, Tensor], pose: Tensor) -> Tensor:
    """J^T W J_K L (6, 4, B) at a pose (3, 4, B), where L L^T is the covariance of the intrinsics."""
    du, dv = calibration
    b = differentiate(obs, pose).rows[:3]  # (3, 2, N, B)
    by_intrinsics = b[:, 0, None] * du + b[:, 1, None] * dv  # (3, 4, N, B)
    turned = cross(obs.points[:, None], by_intrinsics)
    return torch.cat([by_intrinsics.sum(2), turned.sum(2)])


def _mean_square(pixel: Observations, weight: Tensor | None, pose: Tensor) -> Tensor:
    p = camera_points(pixel, pose)
    square = residuals(pixel, p[:2] / p[2]).square().sum(0)
    return square.mean(0) if weight is None else (square * weight).sum(0) / weight.sum(0)
