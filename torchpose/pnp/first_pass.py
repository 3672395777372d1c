"""The same few steps for every pose: enough for nearly all of them, and no bookkeeping.

Two evaluations in float32 of both starts say which minimum is the better one, and nearly always that the other one is
out of the question. The better one gets two more in float64, the last of which gives the covariance too. What has not
arrived then, and what is not decided, is left to `iterative.minimise`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.geometry.small_linalg import orthonormalise
from torchpose.pnp._compile import compiled
from torchpose.pnp.iterative import Estimate, not_above, rounding, settled
from torchpose.pnp.normal_equations import (
    COST,
    Observations,
    damped_step,
    moved,
    normal_equations,
)
from torchpose.pnp.verdict import Minima, relevant

EVALUATIONS = 4
# promised decreases by which the cost of a minimum may yet fall
_RESERVE = 10.0


class FirstPass(NamedTuple):
    """Minima found; (B,) bool, is there a start? and (3, 4, B), from where the better one may go on."""

    minima: Minima
    ahead: Tensor
    fallback: Tensor


def first_pass(single: Observations, final: Observations, start: Tensor, compile: bool) -> FirstPass:
    """From starts (3, 4, S, B), S one or two, on the observations in float32 and those in float64."""
    # the distortion model is left to eager mode: its Python would be traced anew for every camera
    fast = compile and final.camera is None
    evaluate = compiled(_evaluate) if fast else _evaluate
    decide = compiled(_decide) if fast else _decide
    finish = compiled(_finish) if fast else _finish
    several, exact = single.each(), final
    if fast:
        several, exact = several._replace(sums=None), final._replace(sums=None)
    pose, first, _ = evaluate(several, start, False)
    trial, cost, decrease = evaluate(several, pose, False)
    better, fallback, other, least, other_cost, different, undecided = decide(
        start, pose, trial, first, cost, decrease, final.xy.new_empty(0)
    )
    ahead = first.isfinite().any(0)
    better, before, _ = evaluate(exact, better, True)
    pose, normal, done = finish(exact, better, before, least, ahead)
    count = torch.full_like(ahead, EVALUATIONS, dtype=torch.int64)
    minima = Minima(Estimate(pose, normal, count, done), other, other_cost, different, ~undecided)
    return FirstPass(minima, ahead, fallback)


def _evaluate(obs: Observations, pose: Tensor, newton: bool) -> tuple[Tensor, Tensor, Tensor]:
    """The next pose, by a step that is not damped; the cost of this one, and the decrease that the step promises."""
    normal = normal_equations(obs, pose, newton)
    step, decrease, _ = damped_step(normal)
    return moved(pose, step), normal[COST], decrease


def _decide(
    start: Tensor, pose: Tensor, trial: Tensor, first: Tensor, cost: Tensor, decrease: Tensor, like: Tensor
) -> tuple[Tensor, ...]:
    """The better pose, in the dtype of ``like``, and its fallback; the other one; both costs; is there another minimum,
    and is it undecided?"""
    ahead = first.isfinite()
    worse = ~(cost <= first)
    # a start that Gauss-Newton leaves for the worse says nothing about its minimum
    cost = torch.where(ahead, torch.where(worse, first, cost), torch.inf)
    if torch.compiler.is_compiling() or bool(worse.any()):
        pose, trial = torch.where(worse, start, pose), torch.where(worse, start, trial)
    if start.shape[2] == 1:
        nothing = torch.zeros_like(ahead[0])
        better, fallback = trial[:, :, 0], pose[:, :, 0]
        return (
            upright(better.to(like)),
            fallback,
            fallback,
            cost[0],
            torch.full_like(cost[0], torch.nan),
            nothing,
            nothing,
        )
    swap = cost[1] < cost[0]
    better = torch.where(swap, trial[:, :, 1], trial[:, :, 0])
    fallback, other = (torch.where(swap, pose[:, :, k], pose[:, :, 1 - k]) for k in (1, 0))
    least, other_cost = torch.minimum(cost[0], cost[1]), torch.maximum(cost[0], cost[1])
    bound = other_cost - _RESERVE * torch.where(swap, decrease[0], decrease[1])
    different = other_cost.isfinite()
    undecided = different & (~(bound > relevant(least)) | worse[0] | worse[1])
    return upright(better.to(like)), fallback, other, least, other_cost, different, undecided


def _finish(
    obs: Observations, pose: Tensor, before: Tensor, least: Tensor, ahead: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The last evaluation: pose, normal equations, and has it arrived?"""
    normal = normal_equations(obs, pose)
    step, decrease, _ = damped_step(normal)
    floor, cost = rounding(obs), normal[COST]
    done = (decrease <= 1e-10 * cost + floor) & not_above(cost, before, floor)
    # nor has it jumped to another minimum
    done = done & not_above(before, least, 1e-3 * least + 1)
    pose, normal = settled(pose, normal, moved(pose, step), decrease, done)
    cost = torch.where(ahead, normal[COST], torch.inf)
    return pose, torch.cat([normal[:COST], cost[None]]), done


def upright(pose: Tensor) -> Tensor:
    """Poses (3, 4, ...) with R made a rotation again."""
    return torch.cat([orthonormalise(pose[:, :3]), pose[:, 3:]], 1)
