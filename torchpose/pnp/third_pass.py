"""Poses of which two passes know one minimum, or none: every other start that a closed form finds, each to its end.

The homography of a plane gives two starts at little cost, and mostly they lead to the two minima. Where its points
hardly fix it (three of four nearly on a line, two that nearly coincide), or noise is large for the size of the image,
both lead to the same minimum, or nowhere. The poses of three of the points do not depend on a homography.
"""

import torch
from torch import Tensor

from torchpose.kernels import padded
from torchpose.pnp.first_pass import upright
from torchpose.pnp.iterative import minimise
from torchpose.pnp.normal_equations import COST, camera_points
from torchpose.pnp.p3p import of_three, widest_triple
from torchpose.pnp.problem import Body, Problem
from torchpose.pnp.result import PnPCode
from torchpose.pnp.starts import of_planes, planes, starts
from torchpose.pnp.verdict import Bad, Found, Minima, choose, relevant

# distance over extent below which two points count as one: that of rounding in float32 (derived)
_COINCIDENT = 1e-6
# points from which `starts` uses all of them at once, so that those of three do not have to do where there is depth
_ENOUGH = 6
# curvature above which the two starts of a plane miss next to nothing; that of a square is 4 (measured:
# scripts/pnp_degenerate.py; of 80,000 random sets with 0.3 px 21 of 13,544 below 0.25 were missed, 2 of 42,075 from
# there to 2, 1 of 24,381 above)
_FIRMNESS = 2.0
# residuals over the extent of the image from which a pose in front explains no points behind the camera (convention)
_UNEXPLAINED = 0.1


def start_roughly(problem: Problem) -> Tensor:
    """(B|1,) bool: are the starts rough, those of a plane for few points that do not quite lie in one?"""
    return problem.body.warped & (problem.seen < _ENOUGH)


def firm(body: Body, weight: Tensor | None) -> Tensor:
    """(B|1,) bool: do points in a plane fix a homography so firmly that its two starts find what there is to find?

    By the least eigenvalue of the curvature that `ippe` divides by, were the image a drawing of the plane: with r the
    residuals of x^2, x y and y^2 after the best linear function, that of [[xx.xx + xy.xy, .], [., xy.xy + yy.yy]].
    """
    x, y = ((axis[:, None] * body.points).sum(0) for axis in body.frame[:2])  # missing points are at the centre
    ones = torch.ones_like(x) if weight is None else weight.expand_as(x)
    basis = torch.stack([ones, x, y])
    lengths = basis.square().sum(1)
    squares = torch.stack([x * x, x * y, y * y])
    fit = moments_of(squares, basis) / lengths  # (3, 3, B): of each square by 1, x, y
    gram = moments_of(squares, squares) - (fit[:, None] * fit * lengths).sum(2)
    left, mixed, right = gram[0, 0] + gram[1, 1], gram[0, 1] + gram[1, 2], gram[1, 1] + gram[2, 2]
    least = 0.5 * (left + right - ((left - right).square() + 4 * mixed.square()).sqrt())
    return body.flat & (least > _FIRMNESS)


def moments_of(left: Tensor, right: Tensor) -> Tensor:
    """Sums over the points (K, L, B) of products of (K, N, B) and (L, N, B)."""
    return (left[:, None] * right).sum(2)


def every_start(problem: Problem, known: Tensor) -> Tensor:
    """Poses (3, 4, S, B), the ``known`` minimum (3, 4, B) first; NaN where there is none, infinite as in `starts`."""
    observed = problem.observed
    r, t = of_three(observed.points, observed.xy, problem.weight, nearly=True)
    three = torch.cat([r, t[:, None]], 1)
    # those of a plane have led to what is known
    more = [] if planes(problem) else [torch.where(problem.body.flat, torch.nan, starts(problem)), _of_thin(problem)]
    return torch.cat([known[:, :, None], three, *(v.to(three) for v in more)], 2)


def _of_thin(problem: Problem) -> Tensor:
    return torch.where(problem.body.thin & ~problem.body.flat, of_planes(problem), torch.nan)


def third_pass(problem: Problem, poses: Tensor, known: Tensor, max_iterations: int, compile: bool) -> Minima:
    """The best minima that ``poses`` (3, 4, S, B) lead to, given the chi-squared (B,) of the first of them, or NaN."""
    options, batch = poses.shape[2:]
    every = poses.flatten(2)
    index = every.isfinite().all(0).all(0).nonzero().squeeze(1)
    index = padded(index) if compile else index
    cost, count = torch.full_like(every[0, 0], torch.inf), torch.zeros_like(every[0, 0], dtype=torch.int64)
    done = torch.zeros_like(count, dtype=torch.bool)
    if len(index):
        row = index % batch
        ends = minimise(
            problem.final.select(row),
            upright(every[..., index]),
            max_iterations=max_iterations,
            enough=relevant(known).nan_to_num(nan=torch.inf)[row],
            compile=compile,
        )
        cost[index], count[index], done[index] = ends.normal[COST], ends.iterations, ends.converged
        every = every.index_copy(2, index, ends.pose)
    found = Found(*(v.unflatten(-1, (options, batch)) for v in (every, cost, count, done)))
    return choose(problem.final, found, compile)


def verdicts(problem: Problem, minima: Minima, failed: Tensor) -> Bad:
    """Poses that are none though there is a minimum; ``failed`` (B,) bool, did the passes before find nothing?"""
    observed, best = problem.observed, minima.best.pose
    p = camera_points(observed, best)
    ones = torch.ones_like(p[0]) if problem.weight is None else problem.weight
    center = (observed.xy * ones).sum(1) / ones.sum(0)
    off, extent = (
        (v.square().sum(0) * ones).sum(0) for v in (p[:2] / p[2] - observed.xy, observed.xy - center[:, None])
    )
    return (
        (failed & ~(off <= _UNEXPLAINED**2 * extent), PnPCode.BEHIND_CAMERA),
        (_of_three(problem), PnPCode.TOO_FEW),
    )


def _of_three(problem: Problem) -> Tensor:
    """(B|1,) bool: are only three points distinct? They have several poses, each of which explains them."""
    points, weight = problem.body.points, problem.weight
    index = widest_triple(points, weight)
    points = points.expand(-1, -1, index.shape[-1])
    corners = points.gather(1, index.expand(3, 3, -1))
    apart = (points[:, :, None] - corners[:, None]).square().sum(0).amin(1)  # (N, B)
    return (apart if weight is None else apart * weight).amax(0) <= _COINCIDENT**2
