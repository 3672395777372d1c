"""Starts of the iterative method: every pose that a closed form finds."""

import torch
from torch import Tensor

from torchpose.pnp.candidates import Candidates
from torchpose.pnp.epnp import epnp
from torchpose.pnp.normal_equations import Observations
from torchpose.pnp.p3p import p3p
from torchpose.pnp.planar import FIXED_FIRMLY, ippe
from torchpose.pnp.problem import Problem

# root mean square of a start, in normalised coordinates, above which points may lie behind the camera
_SUSPICIOUS = 1e-3


def starts(problem: Problem) -> Tensor:
    """Poses [R | t] (3, 4, 2, B) in float32, about the centroid, in units of the extent.

    NaN where there is none; infinite where the points lie behind the camera.
    """
    pose = of_planes(problem)
    if planes(problem):
        return pose
    body = problem.body
    pose = torch.where(body.flat & ~body.line, pose, torch.nan)
    rows = (~(body.flat | body.line)).expand(pose.shape[-1]).nonzero().squeeze(1)
    return pose if len(rows) == 0 else pose.index_copy(3, rows, _in_space(problem, rows).to(pose))


def planes(problem: Problem) -> bool:
    """Do the points of every pose lie in a plane, and not on a line?"""
    return bool((problem.body.flat & ~problem.body.line).all())


def of_planes(problem: Problem) -> Tensor:
    """`starts` of points that all lie in planes."""
    body, weight, single = problem.body, problem.weight, problem.observed.to(torch.float32)
    center = torch.zeros_like(body.center).to(single.xy)
    mask = None if weight is None else weight.to(single.xy)
    r, t = ippe(single.points, single.xy, mask, body.frame.to(single.xy), center, FIXED_FIRMLY)
    return torch.cat([r, t[:, None]], 1)


def batch_first(observed: Observations, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Object points, image points and mask, as the closed forms want them."""
    points = observed.points.permute(2, 1, 0)
    points = points[0] if points.shape[0] == 1 else points
    return points, observed.xy.permute(2, 1, 0), None if weight is None else weight.T > 0


def _in_space(problem: Problem, rows: Tensor) -> Tensor:
    """Poses (3, 4, 2, B) of points in no plane: from three of them, and from all at once where there are enough."""
    weight = problem.weight
    points, xy, mask = batch_first(problem.observed.select(rows), None if weight is None else weight[:, rows])
    found = p3p(points, xy, mask)
    solutions = [Candidates(*(v[:, :2] for v in found))]
    if xy.shape[1] >= 6:
        solutions = [epnp(points, xy, mask), Candidates(*(v[:, :1] for v in found))]
        # points behind the camera have the image of their reflection at the centroid, in front of it
        rms = torch.fmin(*(s.rms[:, :1] for s in solutions))
        if bool((rms > _SUSPICIOUS).any()):
            reflected = epnp(-points, xy, mask).rms < 0.1 * rms
            solutions = [
                Candidates(torch.where(reflected[..., None, None], torch.inf, s.R), s.t, s.rms) for s in solutions
            ]
    return as_poses(solutions)


def as_poses(solutions: list[Candidates]) -> Tensor:
    """All solutions as poses (3, 4, S, B)."""
    r, t = torch.cat([s.R for s in solutions], 1), torch.cat([s.t for s in solutions], 1)
    return torch.cat([r, t[..., None]], 3).permute(2, 3, 1, 0)
