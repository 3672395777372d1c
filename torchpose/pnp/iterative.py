"""Maximum-likelihood poses by Levenberg-Marquardt with Newton's matrix, each pose damped and stopped by itself.

Gauss-Newton takes hundreds of steps to a minimum with large residuals, and the wrong one of the two minima of a plane
is such a minimum. The second derivatives cost little more than the first (`normal_equations`); where they
leave no positive definite matrix, the step is Gauss-Newton's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.pnp._compile import compiled
from torchpose.pnp.normal_equations import (
    COST,
    Observations,
    damped_step,
    moved,
    normal_equations,
)

# promised decreases by which the cost of a minimum may yet fall
RESERVE = 10.0


class Estimate(NamedTuple):
    """Minimisations: [R | t] (3, 4, ...), packed normal equations (28, ...), iterations and converged (...)."""

    pose: Tensor
    normal: Tensor
    iterations: Tensor
    converged: Tensor


class _State(NamedTuple):
    """Poses under way: the best so far with Newton's matrix and damping, and the trial that comes next."""

    pose: Tensor
    normal: Tensor
    damping: Tensor
    trial: Tensor
    decrease: Tensor
    done: Tensor


def rounding(obs: Observations) -> Tensor:
    """Cost (B,) of residuals that are wrong by the rounding of their image points."""
    eps = torch.finfo(obs.xy.dtype).eps
    scale = obs.whitening.square()
    scale = scale.amax(0) if scale.ndim == obs.xy.ndim else scale.amax((0, 1))
    magnitude = obs.xy.square().sum(0)
    return (4 * eps) ** 2 * (scale * (magnitude if obs.camera is not None else 1 + magnitude)).sum(0)


def not_above(cost: Tensor, old: Tensor, floor: Tensor) -> Tensor:
    """Is ``cost`` no more than ``old``? Residuals of length sqrt(floor) can change it by this much (Cauchy-Schwarz)."""
    return cost <= old + 2 * (old * floor).sqrt() + floor


def _advance(obs: Observations, state: _State, rtol: float, floor: Tensor, enough: Tensor) -> _State:
    """Evaluates the trial poses, accepts those that lower the cost, and proposes the next damped step.

    That is null for poses whose cost is sure to stay above ``enough``. Poses that were done stay as they are, so that a
    pose does not depend on the others of its batch.
    """
    pose = state.trial
    normal = normal_equations(obs, pose, newton=True)
    lower = not_above(normal[COST], state.normal[COST], floor)
    accept = lower & ~state.done
    if torch.compiler.is_compiling() or not bool(accept.all()):
        pose, normal = torch.where(accept, pose, state.pose), torch.where(accept, normal, state.normal)
    # never so small that many rejections in a row would be needed to matter again
    damping = torch.where(lower, (0.1 * state.damping).clamp_min(1e-6), (10 * state.damping).clamp_min(1e-2))
    step, decrease, definite = damped_step(normal, damping)
    if torch.compiler.is_compiling():
        plain, promise, _ = damped_step(normal_equations(obs, pose), damping)
        step, decrease = torch.where(definite, step, plain), torch.where(definite, decrease, promise)
    elif len(rows := (~definite).nonzero().squeeze(1)):
        plain, promise, _ = damped_step(normal_equations(obs.select(rows), pose[..., rows]), damping[rows])
        step, decrease = step.index_copy(1, rows, plain), decrease.index_copy(0, rows, promise)
    trial = moved(pose, step)
    left = normal[COST] - RESERVE * decrease > enough
    trial, decrease = torch.where(left, pose, trial), torch.where(left, 0, decrease)
    done = (decrease <= rtol * normal[COST] + floor) & (damping <= 1) & (normal[COST] < torch.inf)
    was = state.done
    if torch.compiler.is_compiling() or bool(was.any()):
        trial, decrease = torch.where(was, state.trial, trial), torch.where(was, state.decrease, decrease)
    return _State(pose, normal, damping, trial, decrease, done | was)


def settled(pose: Tensor, normal: Tensor, trial: Tensor, decrease: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and normal equations, with the last step of those that are done, of which the cost is predicted."""
    cost = (normal[COST] - torch.where(done, decrease, 0)).clamp_min(0)
    return torch.where(done, trial, pose), torch.cat([normal[:COST], cost[None]])


def minimise(
    obs: Observations,
    pose: Tensor,
    *,
    max_iterations: int,
    rtol: float = 1e-12,
    enough: Tensor | None = None,
    report: bool = True,
    compile: bool = False,
) -> Estimate:
    """Minima reached from poses (3, 4, B) in the dtype of ``obs``; those that stay above the costs ``enough`` (B,) are
    only followed until this is sure. Without ``report``, of the normal equations only the cost is of use.

    A pose has converged when the step promises to lower its cost by no more than ``rtol`` of it, or than rounding
    could; that step is still taken. Converged poses leave the batch when a quarter of it is done.
    """
    # the distortion model is left to eager mode: its Python would be traced anew for every camera
    compile = compile and obs.camera is None
    advance = compiled(_advance) if compile else _advance
    if compile:
        obs = obs._replace(sums=None)
    whole, floor = obs, rounding(obs).expand(pose.shape[2:])
    if enough is None:
        enough = torch.full_like(pose[0, 0], torch.inf)
    unknown = pose.new_full((28, pose.shape[-1]), torch.inf)
    lam = torch.full_like(unknown[0], 1e-3)
    # copies: torch.compile would make one more graph for tensors that are the same
    state = _State(pose, unknown, lam, pose.clone(), lam.clone(), lam < 0)
    result: Estimate | None = None
    index: Tensor | None = None  # of the poses still under way; None: all

    for iteration in range(1, max_iterations + 1):
        state = _State(*advance(obs, state, rtol, floor, enough))
        # neither a pose without numbers nor one whose steps have shrunk to nothing will come to an end
        over = state.done | ~((state.damping < 1e8) & (state.normal[COST] < torch.inf))
        remaining = (~over).nonzero().squeeze(1)
        last = iteration == max_iterations or len(remaining) == 0
        if last or (len(over) > 64 and 4 * len(remaining) <= 3 * len(over)):
            pose, normal = settled(state.pose, state.normal, state.trial, state.decrease, state.done)
            if result is None or index is None:
                count = torch.full_like(over, iteration, dtype=torch.int64)
                result = Estimate(pose, normal, count, state.done)
            else:
                result.pose.index_copy_(-1, index, pose)
                result.normal.index_copy_(-1, index, normal)
                result.iterations.index_fill_(0, index, iteration)
                result.converged.index_copy_(0, index, state.done)
            if last and not report:
                return result
            if last:
                normal = normal_equations(whole, result.pose)
                # behind the camera from the start: not evaluated anew, the pose may not be one
                normal[COST] = torch.where(result.normal[COST].isinf(), torch.inf, normal[COST])
                return result._replace(normal=normal)
            index = remaining if index is None else index[remaining]
            obs, floor, enough = obs.select(remaining), floor[remaining], enough[remaining]
            state = _State(*(v.index_select(-1, remaining) for v in state))
    raise AssertionError("unreachable: the last iteration returns")
