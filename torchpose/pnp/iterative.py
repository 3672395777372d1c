"""Maximum-likelihood poses by Levenberg-Marquardt with Newton's matrix, each pose damped and stopped by itself.

Gauss-Newton takes hundreds of steps to a minimum with large residuals, and the wrong one of the two minima of a plane
is such a minimum. The second derivatives cost little more than the first (`normal_equations`); where they
leave no positive definite matrix, the step is that of Gauss-Newton, stretched.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.kernels import repeated, tracing
from torchpose.pnp.few import RESERVE as RESERVE
from torchpose.pnp.few import RTOL, Array, Few, minimised, on_host, packed
from torchpose.pnp.normal_equations import COST, Observations, damped_step, moved, normal_equations


class Estimate(NamedTuple):
    """Minimisations: [R | t] (3, 4, ...), packed normal equations (28, ...), iterations and converged (...)."""

    pose: Tensor
    normal: Tensor
    iterations: Tensor
    converged: Tensor


class _State(NamedTuple):
    """Poses under way: the best so far with Newton's matrix and damping, and the trial that comes next.

    ``over`` (B,) bool: done, or without a prospect of it; these stay as they are, so that a pose does not depend on the
    others of its batch.
    """

    pose: Tensor
    normal: Tensor
    damping: Tensor
    trial: Tensor
    decrease: Tensor
    done: Tensor
    over: Tensor
    iterations: Tensor


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


def _advance(
    state: _State, obs: Observations, rtol: float | Tensor, floor: Tensor, enough: Tensor
) -> tuple[_State, Tensor]:
    """Evaluates the trial poses, accepts those that lower the cost, and proposes the next step. (B,): who goes on?"""
    pose, normal = state.trial, normal_equations(obs, state.trial, newton=True)
    lower = not_above(normal[COST], state.normal[COST], floor)
    accept = lower & ~state.over
    if tracing() or not bool(accept.all()):
        pose, normal = torch.where(accept, pose, state.pose), torch.where(accept, normal, state.normal)
    # never so small that many rejections in a row would be needed to matter again
    damping = torch.where(lower, (0.1 * state.damping).clamp_min(1e-6), (10 * state.damping).clamp_min(1e-2))
    cost = normal[COST]
    step, decrease, definite = damped_step(normal, damping)
    trial, decrease, done = _proposal(pose, cost, damping, step, decrease, rtol, floor, enough)
    if tracing():
        bent = _off_saddle(obs, pose, cost, damping, rtol, floor, enough)
        trial, decrease, done = (
            torch.where(definite, a, b) for a, b in zip((trial, decrease, done), bent, strict=True)
        )
    elif not bool(definite.all()):
        rows = (~(definite | state.over)).nonzero().squeeze(1)
        some = obs.select(rows), pose[..., rows], cost[rows], damping[rows]
        bent = _off_saddle(*some, rtol, floor[rows], enough[rows])
        for whole, part in zip((trial, decrease, done), bent, strict=True):
            whole.index_copy_(-1, rows, part)
    if tracing() or bool(state.over.any()):
        trial, decrease = (torch.where(state.over, *v) for v in ((state.trial, trial), (state.decrease, decrease)))
        damping, done = torch.where(state.over, state.damping, damping), torch.where(state.over, state.done, done)
    # neither a pose without numbers nor one whose steps have shrunk to nothing will come to an end
    over = done | ~((damping < 1e8) & (cost < torch.inf))
    return _State(pose, normal, damping, trial, decrease, done, over, state.iterations + ~state.over), ~over


def _off_saddle(
    obs: Observations, pose: Tensor, cost: Tensor, damping: Tensor, rtol: float | Tensor, floor: Tensor, enough: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`_proposal` of Gauss-Newton, for poses at which Newton's matrix is not positive definite.

    Near a saddle its step is as small as the gradient and grows by half each time. So the step is stretched until it
    promises a tenth of the cost, unless such a one was rejected.
    """
    step, decrease, _ = damped_step(normal_equations(obs, pose), damping)
    stretch = torch.where(damping < 1e-3, (0.1 * cost / decrease).sqrt().clamp(1, 1e3), 1)
    return _proposal(pose, cost, damping, stretch * step, decrease, rtol, floor, enough)


def _proposal(
    pose: Tensor,
    cost: Tensor,
    damping: Tensor,
    step: Tensor,
    decrease: Tensor,
    rtol: float | Tensor,
    floor: Tensor,
    enough: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Next trial, its promised decrease, and are we done? No step for poses that are sure to stay above ``enough``."""
    trial, sure = moved(pose, step), damping <= 1  # a step that is cut short promises little, wherever it is
    left = sure & (cost - RESERVE * decrease > enough)
    trial, decrease = torch.where(left, pose, trial), torch.where(left, 0, decrease)
    return trial, decrease, sure & (decrease <= rtol * cost + floor) & (cost < torch.inf)


def settled(pose: Tensor, cost: Tensor, trial: Tensor, decrease: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
    """Poses and costs, with the last step of those that are done, of which the cost is predicted."""
    return torch.where(done, trial, pose), (cost - torch.where(done, decrease, 0)).clamp_min(0)


def minimise(
    obs: Observations,
    pose: Tensor,
    *,
    max_iterations: int,
    rtol: float | Tensor = RTOL,
    enough: Tensor | None = None,
    compile: bool = False,
) -> Estimate:
    """Minima reached from poses (3, 4, B) in the dtype of ``obs``; those that stay above the costs ``enough`` (B,) are
    only followed until this is sure. The normal equations are Newton's, from just before the last step.

    A pose has converged when the step promises to lower its cost by no more than ``rtol`` of it, or than rounding
    could; that step is still taken. Converged poses leave the batch when a quarter of it is done.
    """
    floor = rounding(obs).expand(pose.shape[2:])
    if enough is None:
        enough = torch.full_like(pose[0, 0], torch.inf)
    unknown = pose.new_full((28, pose.shape[-1]), torch.inf)
    lam = torch.full_like(unknown[0], 1e-3)
    none = lam < 0
    state = _State(pose, unknown, lam, pose, lam, none, none, torch.zeros_like(none, dtype=torch.int64))
    if compile:
        return _ended(repeated(_advance)(max_iterations, state, obs, rtol, floor, enough))
    if obs.few(pose.shape[-1]):
        return _of_few(obs, pose, max_iterations, float(rtol), floor, enough)
    result, index = None, torch.arange(pose.shape[-1], device=pose.device)  # of the poses still under way
    for iteration in range(1, max_iterations + 1):
        state, going = _advance(state, obs, rtol, floor, enough)
        remaining = going.nonzero().squeeze(1)
        last = iteration == max_iterations or len(remaining) == 0
        if last or (len(going) > 64 and 4 * len(remaining) <= 3 * len(going)):
            ended = _ended(state)
            if result is None:
                result = ended
            else:
                for whole, part in zip(result, ended, strict=True):
                    whole.index_copy_(-1, index, part)
            if last:
                return result
            obs, floor, enough, index = obs.select(remaining), floor[remaining], enough[remaining], index[remaining]
            state = _State(*(v.index_select(-1, remaining) for v in state))
    raise AssertionError("unreachable: the last iteration returns")


def _of_few(obs: Observations, start: Tensor, steps: int, rtol: float, floor: Tensor, enough: Tensor) -> Estimate:
    """`minimise` on the host."""

    def solved(
        points: Array, xy: Array, whitening: Array, start: Array, floor: Array, enough: Array
    ) -> tuple[Array, ...]:
        few = Few.of(start.shape[-1], points, xy, whitening)
        ends = minimised(few, start.transpose(2, 0, 1), floor, steps, enough, rtol)
        ends.whole[:, 6, 6] = ends.cost
        return ends.pose.transpose(1, 2, 0), packed(ends.whole), ends.iterations, ends.done

    pose, normal, iterations, done = on_host(solved, *obs[:3], start, floor, enough)
    return Estimate(pose.to(start), normal.to(start), iterations, done)


def _ended(state: _State) -> Estimate:
    pose, cost = settled(state.pose, state.normal[COST], state.trial, state.decrease, state.done)
    return Estimate(pose, torch.cat([state.normal[:COST], cost[None]]), state.iterations, state.done)
