"""Poses that the first pass has left over: Levenberg-Marquardt from where it ended.

The other minimum is followed in float32 first, until it is reached or sure to be out of the question; only where it is
neither does it matter to the last digit.
"""

import torch

from torchpose.kernels import padded
from torchpose.pnp.first_pass import EVALUATIONS, Rest, upright
from torchpose.pnp.iterative import minimise
from torchpose.pnp.normal_equations import COST
from torchpose.pnp.problem import Problem
from torchpose.pnp.verdict import Found, Minima, choose, relevant

# iterations in float32: the few poses that take more, off a saddle, would do so once more in float64
_SINGLE = 8
# poses up to which an iteration takes the time of its calls, in either dtype
_FEW = 512


def second_pass(problem: Problem, late: Rest, max_iterations: int, compile: bool) -> Minima:
    """The minima of all that is left over."""
    batch, known = len(late.cost), late.cost
    bound = relevant(known)
    other, other_cost, enough = late.other.to(late.pose), late.other_cost.clone(), late.arrived[1].clone()
    index = (~enough).nonzero().squeeze(1)
    if len(index) > _FEW:
        single = problem.observed.to(torch.float32).select(index)
        found = minimise(
            single,
            late.other[..., index],
            max_iterations=min(max_iterations, _SINGLE),
            rtol=1e-6,
            enough=bound[index].to(single.xy),
            compile=compile,
        )
        cost = found.normal[COST].to(known)
        other_cost[index], enough[index] = cost, found.converged & (cost > bound[index])
        other[..., index] = torch.where(cost < torch.inf, found.pose.to(other), other[..., index])

    arrived = torch.cat([late.arrived[0], enough])
    poses = upright(torch.stack([late.pose, other], 2)).flatten(2)
    cost = torch.cat([known, other_cost])
    going = (~arrived).nonzero().squeeze(1)
    going = padded(going) if compile else going
    exact = minimise(
        problem.final.select(going % batch),
        poses[..., going],
        max_iterations=max_iterations,
        enough=torch.cat([torch.full_like(bound, torch.inf), bound])[going],
        compile=compile,
    )
    poses[..., going], cost[going] = exact.pose, exact.normal[COST]
    count = torch.full((2 * batch,), EVALUATIONS, dtype=torch.int64, device=going.device)
    count[going] += exact.iterations
    arrived[going] = exact.converged
    every = Found(*(v.unflatten(-1, (2, batch)) for v in (poses, cost, count, arrived)))
    return choose(problem.final, every, compile)
