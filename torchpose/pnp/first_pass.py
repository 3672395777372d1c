"""The same few steps for every pose: enough for nearly all of them, and no bookkeeping.

One evaluation in float32 of both starts says which minimum is the better one, and mostly that the other one is out of
the question. Then only the better one goes on: a Newton step with residuals in float64 and all the rest in float32, and
an evaluation in float64, which gives the covariance and says whether the pose has arrived. What has not, and what is
not decided, is left to `second_pass`.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import orthonormalise
from torchpose.pnp.iterative import RESERVE, Estimate, not_above, rounding, settled
from torchpose.pnp.normal_equations import COST, STARTS, Observations, damped_step, moved, normal_equations
from torchpose.pnp.verdict import Minima, relevant

EVALUATIONS = 3
# promised decrease over cost below which a pose has arrived; the step that promises it is taken
_RTOL = 1e-12


class Rest(NamedTuple):
    """What `second_pass` has to know of poses.

    Attributes:
        pose: (3, 4, B) of the better minimum, or from where to go on. other: of the other one, the same, in float32.
        cost, other_cost: (B,), what is known of both; infinite where there is no other minimum.
        arrived: (2, B) bool, is enough known of this minimum?
    """

    pose: Tensor
    other: Tensor
    cost: Tensor
    other_cost: Tensor
    arrived: Tensor


def first_pass(
    single: Observations, double: Observations, final: Observations, start: Tensor
) -> tuple[Minima, Rest, Tensor]:
    """From starts (3, 4, S, B), S one or two; the observations without distortion in both dtypes, and as they are.

    The minima, what a second pass would have to know, and (B,) which poses need one: those with a start that has not
    led to all that is wanted.
    """
    better, pose, least, other, other_cost, bound = _begin(single.each(), start)
    pose, newton = _improve(single, double, pose)
    minima, onward, known, decided = _finish(final, pose, newton, least, other, other_cost, bound, better)
    done = minima.best.converged
    cost = torch.where(done, minima.best.normal[COST], known)
    rest = Rest(onward, other, cost, other_cost.to(cost), torch.stack([done, decided]))
    return minima, rest, (least < torch.inf) & ~(done & decided)


def _begin(obs: Observations, start: Tensor) -> tuple[Tensor, ...]:
    """The better start (3, 4, B), its next pose, its cost; the other one, its cost, and what this may fall to."""
    normal = normal_equations(obs, start)
    step, decrease, _ = damped_step(normal)
    cost = normal[COST]
    if start.shape[2] == 1:
        better, none = start[:, :, 0], torch.full_like(cost[0], torch.inf)
        return better, moved(better, step[:, 0]), cost[0], better, none, none
    swap = cost[1] < cost[0]
    better, other = (torch.where(swap, start[:, :, 1 - k], start[:, :, k]) for k in (0, 1))
    pose = moved(better, torch.where(swap, step[:, 1], step[:, 0]))
    least, most = torch.minimum(cost[0], cost[1]), torch.maximum(cost[0], cost[1])
    return better, pose, least, other, most, most - RESERVE * torch.where(swap, decrease[0], decrease[1])


def _improve(single: Observations, double: Observations, pose: Tensor) -> tuple[Tensor, Tensor]:
    """The next pose, in float64, and Newton's equations (28, B) at this one."""
    pose = upright(pose.to(double.xy))
    newton = normal_equations(single, pose, newton=True, fine=double)
    step, _, _ = damped_step(newton)
    return moved(pose, step.to(pose)), newton


def _finish(
    obs: Observations,
    pose: Tensor,
    newton: Tensor,
    least: Tensor,
    other: Tensor,
    other_cost: Tensor,
    bound: Tensor,
    start: Tensor,
) -> tuple[Minima, Tensor, Tensor, Tensor]:
    """The last evaluation; its step takes the matrix of the one before, which has hardly changed.

    The minima; from where a pose would have to go on (3, 4, B), which is from its start if the steps were no good; the
    least cost known (B,), and is enough known of the other minimum?
    """
    normal = normal_equations(obs, pose)
    rows = [v for a, b in pairwise(STARTS) for v in (newton[a : b - 1], normal[b - 1 : b].to(newton))]
    step, decrease, definite = damped_step(torch.cat([*rows, newton[COST:]]))
    cost, before, floor = torch.where(least < torch.inf, normal[COST], torch.inf), newton[COST], rounding(obs)
    # the cost has never risen by more than rounding can make it: it is still the minimum of this start
    sane = not_above(cost, before, 1e-3 * before + 1) & not_above(before, least, 1e-3 * least + 1)
    done = (decrease <= _RTOL * cost + floor) & definite & sane
    trial = moved(pose, step.to(pose))
    found, normal[COST] = settled(pose, cost, trial, decrease, done)
    known = torch.where(sane, cost, least)
    different = other_cost < torch.inf
    decided = ~different | (bound > relevant(known))
    count = torch.full_like(done, EVALUATIONS, dtype=torch.int64)
    minima = Minima(Estimate(found, normal, count, done), other, other_cost, different, decided)
    return minima, torch.where(sane & definite, trial, start.to(trial)), known, decided


def upright(pose: Tensor) -> Tensor:
    """Poses (3, 4, ...) with R made a rotation again."""
    return torch.cat([orthonormalise(pose[:, :3]), pose[:, 3:]], 1)
