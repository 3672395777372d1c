"""The one least-squares core: many nonlinear problems side by side, each of few unknowns.

A problem is a function that gives its normal equations (`Normal`) at values of its unknowns; `minimise` does the rest.
Unknowns come in named blocks (`Pose`, `Vector`, ...), so new physics is a new block and not a new loop. Unknowns of
which there are many, each tied to one problem (the grey levels of a marker, the pose of a view), are eliminated by the
Schur complement (Triggs et al. 2000, section 6). All is in units of chi-squared: residuals over their deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol, Self, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.constants import eye
from torchpose.geometry.rows import Rows, replace, shared
from torchpose.geometry.segments import segment_sum

_RIDGE = 1e-12  # of a unit diagonal
_LEAST_DIAGONAL = 1e-30  # of unknowns that nothing tells of
# beyond, and below its inverse, rounding decides: nowhere lower (derived: float64 has 16 digits)
_MOST_DAMPING = 1e12
_PROMISED = 1e-12  # chi-squared: a step that promises less is none (convention: far below any digit that counts)
# of a parameter's variance by the others' freedom, beyond which it counts as open (derived: the inverse has lost ten of
# 16 digits)
_MOST_INFLATION = 1e10
LEAST_DIRECTION = 1e-9  # of the largest variance of correlations: less is rounding of what a file holds (convention)


class Code(IntEnum):
    """How a minimisation ended."""

    CONVERGED = 0  # the last step promised next to nothing
    STEPS = 1  # all steps were made


class Block(Protocol):
    """Some unknowns of N problems, ``size`` each; what it means to move them is theirs."""

    @property
    def size(self) -> int: ...

    def moved(self, step: Tensor) -> Self: ...

    def where(self, condition: Tensor, other: Self, /) -> Self: ...


@dataclass(frozen=True, eq=False)
class Pose(Rows):
    """Rotation and translation; steps are a translation, then a rotation from the left, R' = exp(w) R."""

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]

    @property
    def size(self) -> int:
        return 6

    def moved(self, step: Tensor) -> Self:
        return replace(self, R=torch.bmm(rotations.exp(step[:, 3:]), self.R), t=self.t + step[:, :3])


@dataclass(frozen=True, eq=False)
class Vector(Rows):
    """Plain numbers, each within its bounds, and moved by at most so much a step; (k,) each, or None for no limit."""

    values: Float[Tensor, "N k"]
    low: Tensor | None = shared(None)
    high: Tensor | None = shared(None)
    most: Tensor | None = shared(None)

    @property
    def size(self) -> int:
        return self.values.shape[1]

    def moved(self, step: Tensor) -> Self:
        if self.most is not None:
            step = step.clamp(-self.most, self.most)
        values = self.values + step
        return replace(self, values=values if self.low is None else values.clamp(self.low, self.high))


@dataclass(frozen=True, eq=False)
class PosePrior(Rows):
    """What is known of poses beside the data: the information about them, and where it has them.

    It may be about more unknowns than the pose, which come after it and are known to be about zero.
    """

    information: Float[Tensor, "N k k"]
    pose: Pose

    @property
    def more(self) -> bool:
        """Whether it is about more than the pose."""
        return self.information.shape[-1] > self.pose.size

    def at(self, pose: Pose, size: int = 6) -> tuple[Tensor, Tensor]:
        """For `Normal.with_prior`: information (N, size, size) about a pose and more unknowns, and how far it moved."""
        moved = torch.cat([pose.t - self.pose.t, rotations.log(pose.R @ self.pose.R.mT)], -1)
        more = (0, size - 6)
        return torch.nn.functional.pad(self.information, 2 * more), torch.nn.functional.pad(moved, more)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Named blocks of unknowns, in the order of their columns.

    Attributes:
        own: of the N problems.
        eliminated: of K items, each part of one problem.
        owner: (K,) int64, the problem of each item.
    """

    own: Mapping[str, Block]
    eliminated: Mapping[str, Block] = field(default_factory=dict)
    owner: Tensor | None = None

    @property
    def pose(self) -> Pose:
        """The block of that name."""
        return cast(Pose, self.own["pose"] if "pose" in self.own else self.eliminated["pose"])

    def values(self, name: str) -> Tensor:
        """Values (N, k) or (K, k) of a `Vector`."""
        return cast(Vector, self.own[name] if name in self.own else self.eliminated[name]).values

    def moved(self, step: Step) -> Unknowns:
        """Every block moved by its columns of the step; what the step does not tell (NaN) stays."""
        own = _moved(self.own, step.own)
        return replace(self, own=own, eliminated=_moved(self.eliminated, step.eliminated))

    def where(self, condition: Tensor, other: Unknowns) -> Unknowns:
        """These of the problems where the condition (N,) bool holds, those of ``other`` elsewhere."""
        own = {name: block.where(condition, other.own[name]) for name, block in self.own.items()}
        if self.owner is None:
            return replace(self, own=own)
        items = condition[self.owner]
        rest = {name: block.where(items, other.eliminated[name]) for name, block in self.eliminated.items()}
        return replace(self, own=own, eliminated=rest)


def _moved(blocks: Mapping[str, Block], step: Tensor) -> dict[str, Block]:
    if not blocks:
        return {}
    parts = step.nan_to_num(nan=0.0).split_with_sizes([block.size for block in blocks.values()], -1)
    return {name: block.moved(part) for (name, block), part in zip(blocks.items(), parts, strict=True)}


@dataclass(frozen=True, eq=False)
class Eliminated(Rows):
    """Part of normal equations that is of K items with m unknowns each.

    Attributes:
        mixed: sums of weighted products of the derivatives by the n unknowns of the problem and the m of the item.
        information: the same of the item's own.
        right: of the item's derivatives and the residuals.
        owner: the problem of each item.
    """

    mixed: Float[Tensor, "K n m"]
    information: Float[Tensor, "K m m"]
    right: Float[Tensor, "K m"]
    owner: Int[Tensor, " K"]


class Step(NamedTuple):
    """What normal equations give.

    own: (N, n), step of the problems' own unknowns. eliminated: (K, m), of the others, empty where there are none.
    information: (N, n, n), about the own unknowns, the others being unknown. own_chi2: (N,), what the own step takes
    off chi-squared. variances: (K, m), of the eliminated unknowns; empty if not asked for.
    """

    own: Tensor
    eliminated: Tensor
    information: Tensor
    own_chi2: Tensor
    variances: Tensor


@dataclass(frozen=True, eq=False)
class Normal(Rows):
    """Normal equations of N problems of n unknowns at a state.

    Attributes:
        information: J^T W J.
        right: J^T W r, r measured less predicted.
        cost: r^T W r, chi-squared; infinite where the state is impossible.
        eliminated: what belongs to items of the problems, if there are any.
    """

    information: Float[Tensor, "N n n"]
    right: Float[Tensor, "N n"]
    cost: Float[Tensor, " N"]
    eliminated: Eliminated | None = None

    def where(self, condition: Tensor, other: Self) -> Self:
        mine, theirs = self.eliminated, other.eliminated
        if mine is None or theirs is None:
            return super().where(condition, other)
        chosen = replace(self, eliminated=None).where(condition, replace(other, eliminated=None))
        return replace(chosen, eliminated=mine.where(condition[mine.owner], theirs))

    def with_prior(self, information: Tensor, moved: Tensor) -> Self:
        """With prior information (N, n, n) about the own unknowns, now ``moved`` (N, n) from where it puts them."""
        pull = (information @ moved[..., None]).squeeze(-1)
        cost = self.cost + (pull * moved).sum(-1)
        return replace(self, information=self.information + information, right=self.right - pull, cost=cost)

    def solve(self, damping: Tensor | None = None, *, variances: bool = False) -> Step:
        """The step to the least cost.

        Args:
            damping: (N,) share of its own information by which that about every unknown is raised.
            variances: find those of the eliminated unknowns, too.
        """
        part, information, right = self.eliminated, self.information, self.right
        if damping is not None:
            information = _damped(information, damping)
        if part is None:
            own = solve_scaled(information, right)
            return Step(own, own[:0], information, (own * right).sum(-1), own[:0])
        n, owner = right.shape[1], part.owner
        inner = part.information if damping is None else _damped(part.information, damping[owner])
        columns = [part.mixed.mT, part.right[..., None], *([_eye_like(inner)] if variances else [])]
        solved = solve_scaled(inner, torch.cat(columns, -1))
        by_own, alone, inverse = solved.split_with_sizes([n, 1, solved.shape[-1] - n - 1], -1)
        taken = segment_sum(torch.bmm(part.mixed, solved[..., : n + 1]), owner, len(self))
        both = torch.cat([information, right[..., None]], -1) - taken
        information, right = both[..., :n], both[..., n]
        columns = [both[..., n:], *([_eye_like(information)] if variances else [])]
        solved = solve_scaled(information, torch.cat(columns, -1) if variances else both[..., n:])
        own, covariance = solved.split_with_sizes([1, solved.shape[-1] - 1], -1)
        rest = torch.baddbmm(alone, by_own, own[owner], alpha=-1).squeeze(-1)
        own = own.squeeze(-1)
        if variances:
            variance = inverse.diagonal(dim1=-2, dim2=-1) + (torch.bmm(by_own, covariance[owner]) * by_own).sum(-1)
        return Step(own, rest, information, (own * right).sum(-1), variance if variances else rest[:0])

    def promised(self, step: Step, damping: Tensor | None = None) -> Tensor:
        """Decrease (N,) of the cost that a step promises, made with that damping."""
        own, part = step.own * self.right, self.eliminated
        if damping is not None:
            own = own + damping[:, None] * step.own.square() * self.information.diagonal(dim1=-2, dim2=-1)
        if part is None:
            return own.sum(-1)
        rest = step.eliminated * part.right
        if damping is not None:
            size = part.information.diagonal(dim1=-2, dim2=-1)
            rest = rest + damping[part.owner, None] * step.eliminated.square() * size
        return own.sum(-1) + segment_sum(rest.sum(-1), part.owner, len(self))


class Minimum(NamedTuple):
    """Where a minimisation ended.

    The unknowns; the normal equations formed last and the step they gave; the information (N, n, n) that they hold
    about the own unknowns, the eliminated ones being unknown; the `Code` (N,); and the cost (N,) at the start.
    """

    unknowns: Unknowns
    normal: Normal
    step: Step
    information: Tensor
    code: Tensor
    first_cost: Tensor

    def covariance(self) -> tuple[Tensor, Tensor]:
        """Covariance (N, n, n) of the own unknowns, and whether the data determine them all (N,) bool."""
        return scaled_inverse(self.information)


def minimise(
    problem: Callable[[Unknowns], Normal],
    unknowns: Unknowns,
    steps: int,
    *,
    damping: float | None = None,
    adaptive: bool = False,
    tolerance: float | None = None,
    settle: bool = True,
) -> Minimum:
    """Gauss-Newton, damped or not, or Levenberg-Marquardt with a damping of its own for every problem.

    Args:
        problem: normal equations at any values of the unknowns.
        unknowns: to start from.
        steps: the most that are made, one at least.
        damping: share of its own information that is added to every unknown's; to begin with, if ``adaptive``.
        adaptive: a step that does not lower a problem's cost is not made, and its damping grows; else it falls.
        tolerance: share of its cost; a problem whose step promises less has converged. None: all steps are made.
        settle: form the normal equations after the last step, too; without, the result has those before it.
    """
    now = problem(unknowns)
    first_cost = now.cost
    share = None if damping is None else torch.full_like(now.cost, damping)
    code = torch.full_like(now.cost, int(Code.STEPS), dtype=torch.int64)
    for number in range(steps):
        step = now.solve(share)
        if tolerance is not None:
            done = now.promised(step, share) < tolerance * now.cost + _PROMISED
            if share is not None:
                done |= share > _MOST_DAMPING
            code = torch.where(done, int(Code.CONVERGED), int(Code.STEPS))
            if bool(done.all()):
                break
        trial = unknowns.moved(step)
        if not settle and number == steps - 1:
            unknowns = trial
            break
        there = problem(trial)
        if adaptive and share is not None:
            better = there.cost < now.cost
            unknowns, now = trial.where(better, unknowns), there.where(better, now)
            share = torch.where(better, 0.1 * share, 10 * share).clamp_min(1 / _MOST_DAMPING)
        else:
            unknowns, now = trial, there
    information = now.solve().information if settle or share is not None else step.information
    return Minimum(unknowns, now, step, information, code, first_cost)


def solve_scaled(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves symmetric (N, n, n) x = right, (N, n) or (N, n, m), every unknown scaled by its own information.

    Units differ by orders (mm and rad); a trace of the diagonal keeps problems solvable of which nothing is seen.
    """
    columns = right[..., None] if right.ndim < matrix.ndim else right
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(_LEAST_DIAGONAL).rsqrt()[..., None]
    scaled = torch.addcmul(eye(matrix.shape[-1], matrix, _RIDGE), matrix * scale, scale.mT)
    solution = scale * torch.linalg.solve_ex(scaled, columns * scale).result
    return solution.squeeze(-1) if right.ndim < matrix.ndim else solution


def scaled_inverse(information: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of information (N, n, n), scaled as `solve_scaled`, and whether it determines all unknowns (N,) bool."""
    scale = information.diagonal(dim1=-2, dim2=-1).rsqrt()
    scale = scale[..., :, None] * scale[..., None, :]
    inverse, info = torch.linalg.inv_ex(information * scale)
    variance = inverse.diagonal(dim1=-2, dim2=-1)
    determined = (info == 0) & ((variance > 0) & (variance < _MOST_INFLATION)).all(-1)
    return inverse * scale, determined


def covariance_factor(covariance: Float[Tensor, "n n"]) -> Float[Tensor, "n k"]:
    """L with L L^T = covariance, by its k directions of any variance."""
    scale = covariance.diagonal().clamp_min(torch.finfo(covariance.dtype).tiny).sqrt()
    values, vectors = torch.linalg.eigh(covariance / scale / scale[:, None])
    there = values > LEAST_DIRECTION * values.amax()
    return scale[:, None] * vectors[:, there] * values[there].sqrt()


def geman_mcclure(deviation: Tensor) -> Tensor:
    """Robust weights of residuals in units of the scale: (1 + d^2)^-2 (Geman and McClure 1987)."""
    return (1 + deviation.square()).pow(-2)


def _eye_like(matrix: Tensor) -> Tensor:
    return eye(matrix.shape[-1], matrix).expand_as(matrix)


def _damped(information: Tensor, share: Tensor) -> Tensor:
    return information + torch.diag_embed(share[:, None] * information.diagonal(dim1=-2, dim2=-1))
