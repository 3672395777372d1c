"""Where the search for a generalised pose begins: the minima of the distances between points and rays.

With a rotation given, the translation under which the points lie nearest to their rays follows in closed form, and the
sum of squared distances is a quadratic form in the nine entries of the rotation (Schweighofer and Pinz 2008, for rays
that do not meet; Terzakis and Lourakis 2020 solve the same form of one camera). It takes a few products to form,
however many points there are; its minima over the rotations are then looked for from 24 that are spread evenly. Nothing
in it asks whether points lie in a plane, nor how far the cameras are apart.
"""

from itertools import permutations, product

import torch
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.pnp.several.rays import Rays

# of Levenberg-Marquardt from all 24 rotations, and from the best ones then: what they leave is for the reprojection
# errors to mend
_FIRST, _MORE = 3, 7
_KEPT = 8
MINIMA = 4  # that are followed: two of a plane, and as many where the cameras are far apart (convention)
APART_DEG = 5.0  # between two minima (convention): nearer ones are one, not ended yet
_DAMPING = 1e-3  # to begin with


def starts(rays: Rays) -> tuple[Tensor, Tensor]:
    """Poses R (B, S, 3, 3), t (B, S, 3), the best ones first; NaN where there are fewer."""
    form, to_t = _form(rays)
    R, cost = _minima(form)
    t = -(to_t[:, None] @ _vector(R)[..., None])[..., 0]
    cost = torch.where(rays.ahead(R, t), cost, torch.inf)
    return _different(R, t, cost)


def _form(rays: Rays) -> tuple[Tensor, Tensor]:
    """The quadratic form (B, 10, 10) in the columns of R and 1, and -t as a linear one (B, 3, 10)."""
    # in the axes of the first camera
    direction = torch.nn.functional.pad(rays.xy, (0, 1), value=1.0)
    direction = torch.nn.functional.normalize((rays.turn.mT @ direction[..., None])[..., 0], dim=-1)
    origin = -(rays.turn.mT @ rays.shift[..., None])[..., 0]
    eye = torch.eye(3).to(direction)
    across = (eye - direction[..., :, None] * direction[..., None, :]) * rays.seen[..., None, None]
    by_R = (rays.points[..., None, :, None] * eye[:, None, :]).flatten(-2)  # (B, N, 3, 9): X_j on column j
    columns = torch.cat([by_R, -origin[..., None]], -1)
    off = across @ columns
    total, mixed = across.sum(1), off.sum(1)
    to_t = torch.linalg.solve_ex(total, mixed).result
    return (columns.mT @ off).sum(1) - mixed.mT @ to_t, to_t


def _minima(form: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (B, S, 3, 3) and the values (B, S) of the form there, from 24 starts."""
    R = _spread().to(form).expand(len(form), -1, -1, -1)
    damping = torch.full_like(R[..., 0, 0], _DAMPING)
    R, damping, cost = _descended(form, R, damping, _FIRST)
    best = cost.topk(_KEPT, 1, largest=False).indices
    row = torch.arange(len(form), device=form.device)[:, None]
    R, _, cost = _descended(form, R[row, best], damping[row, best], _MORE)
    return R, cost


def _descended(form: Tensor, R: Tensor, damping: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (B, S, 3, 3), dampings (B, S) and values (B, S) after steps of Levenberg-Marquardt."""
    cost, gradient, curvature = _at(form, R)
    eye = torch.eye(3).to(form)
    for _ in range(steps):
        scale = curvature.diagonal(dim1=-2, dim2=-1).mean(-1) * damping
        step = torch.linalg.solve_ex(curvature + scale[..., None, None] * eye, -gradient).result.nan_to_num(nan=0.0)
        trial = rotations.exp(step) @ R
        there, by_one, by_two = _at(form, trial)
        better = there < cost
        wide = better[..., None, None]
        R, curvature = torch.where(wide, trial, R), torch.where(wide, by_two, curvature)
        gradient, cost = torch.where(better[..., None], by_one, gradient), torch.where(better, there, cost)
        damping = torch.where(better, 0.1 * damping, 10 * damping)
    return R, damping, cost


def _at(form: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Value (B, S), gradient (B, S, 3) and Gauss-Newton curvature (B, S, 3, 3) by a turn from the left."""
    vector = _vector(R)
    turn = -rotations.skew(R.mT).flatten(-3, -2)  # (B, S, 9, 3): of every column
    columns = torch.cat([vector[..., None], torch.nn.functional.pad(turn, (0, 0, 0, 1))], -1)
    # one product for all starts of a problem
    weighted = (form @ columns.permute(0, 2, 1, 3).flatten(2)).unflatten(2, (*R.shape[1:2], 4)).permute(0, 2, 1, 3)
    products = columns.mT @ weighted
    return products[..., 0, 0], products[..., 1:, 0], products[..., 1:, 1:]


def _vector(R: Tensor) -> Tensor:
    """The columns of R (..., 3, 3), and 1: (..., 10)."""
    return torch.nn.functional.pad(R.mT.flatten(-2), (0, 1), value=1.0)


def _spread() -> Tensor:
    """The 24 rotations of a cube."""
    every = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = torch.zeros(3, 3, dtype=torch.float64)
            for row, (axis, sign) in enumerate(zip(axes, signs, strict=True)):
                turn[row, axis] = sign
            if float(torch.linalg.det(turn)) > 0:
                every.append(turn)
    return torch.stack(every)


def _different(R: Tensor, t: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """The best `MINIMA` of S poses (B, S, ...) that are not the same."""
    row = torch.arange(len(R), device=R.device)
    least = 1 + 2 * torch.cos(torch.deg2rad(torch.tensor(APART_DEG)))
    chosen = []
    for _ in range(MINIMA):
        best = cost.argmin(1)
        known = cost[row, best].isfinite()
        one = R[row, best]
        chosen.append([torch.where(known[(...,) + (None,) * (x.ndim - 1)], x, torch.nan) for x in (one, t[row, best])])
        trace = (R * one[:, None]).sum((-1, -2))
        cost = torch.where(trace > least.to(R), torch.inf, cost)
    both = [torch.stack(parts, 1) for parts in zip(*chosen, strict=True)]
    return both[0], both[1]
