"""Generalised poses: from points in the pixels of several cameras, by all of their rays at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpose.camera import CameraRig
from torchpose.errors import ArgumentError
from torchpose.geometry import rotations
from torchpose.geometry.arguments import expect_index
from torchpose.geometry.least_squares import Code, minimise, scaled_inverse
from torchpose.geometry.rows import Rows
from torchpose.pnp.problem import Inputs
from torchpose.pnp.result import PnPCode, PnPResult
from torchpose.pnp.several.rays import Pixels, Rays, rays_of
from torchpose.pnp.several.starts import starts
from torchpose.pnp.verdict import COINCIDENCE, DECISION, relevant

LEAST = 3  # points that a pose needs (derived: six unknowns)
_FIRST = 6  # steps from all starts: most searches have ended then
_TOLERANCE = 1e-10  # of the cost: a step that promises less is none
_CHUNK = 4096  # poses at once


def solve_rig(
    inputs: Inputs, rig: CameraRig, camera_index: Tensor, initial: tuple[Tensor, Tensor] | None, most_steps: int
) -> PnPResult:
    """`torchpose.pnp.solve` for points of which each is seen by a camera of a rig; poses in the first camera."""
    batch, count = inputs.pixels.shape[:2]
    if camera_index.shape not in ((count,), (batch, count)) or camera_index.is_floating_point():
        raise ArgumentError(
            f"camera_index: has shape {tuple(camera_index.shape)}; give each point's camera, (N,) or (B, N)"
        )
    expect_index("camera_index", camera_index, len(rig))
    points = inputs.points.expand(batch, count, 3)
    seen = torch.ones(batch, count, dtype=torch.bool, device=points.device)
    if inputs.mask is not None:
        seen = inputs.mask.expand(batch, count)
    covariance = torch.eye(2).to(points).expand(1, count, 2, 2) * inputs.sigma_px**2
    if inputs.covariances is not None:
        covariance = inputs.covariances.to(points).view(-1, count, 2, 2)
    weight = None if inputs.weights is None else inputs.weights.to(points).view(-1, count)
    pixels = Pixels(inputs.pixels, covariance, weight, camera_index.view(-1, count))
    finite = (points.isfinite().all(-1) & inputs.pixels.isfinite().all(-1)) | ~seen
    good = _positive(covariance.expand(batch, count, 2, 2), seen) & finite.all(1)
    rays = rays_of(points, pixels, rig.to(points), seen & good[:, None])
    good &= rays.xy.isfinite().flatten(1).all(1)
    rays = rays.where(good, _nothing(rays))
    if initial is not None:
        initial = tuple(x[:, None] if x.ndim == n else x for x, n in zip(initial, (3, 2), strict=True))  # type: ignore[assignment]
    parts = [
        solve_rays(
            rays[k : k + _CHUNK],
            None if initial is None else (initial[0][k:][:_CHUNK], initial[1][k:][:_CHUNK]),
            most_steps,
        )
        for k in range(0, max(batch, 1), _CHUNK)
    ]
    result = PnPResult.cat(parts)
    failed = torch.where(good, torch.where(seen.sum(1) < LEAST, int(PnPCode.TOO_FEW), -1), int(PnPCode.NOT_FINITE))
    result = _failed(result, failed)
    return _with_rms(result, inputs, rig, camera_index.expand(batch, count), seen)


def solve_rays(rays: Rays, initial: tuple[Tensor, Tensor] | None = None, most_steps: int = 60) -> PnPResult:
    """Poses of B objects by their rays: the best minimum, and the next one; the RMS is NaN.

    Args:
        rays: of points.
        initial: R (B, S, 3, 3), t (B, S, 3) to start from, NaN where there are fewer; None: from what the rays tell.
        most_steps: of Levenberg-Marquardt.
    """
    R, t = starts(rays) if initial is None else initial
    batch, several = t.shape[:2]
    there = R.isfinite().flatten(2).all(2) & t.isfinite().all(2)
    eye = torch.eye(3).to(R)
    R, t = (
        torch.where(there[..., None, None], R, eye).flatten(0, 1),
        torch.where(there[..., None], t, 0.0).flatten(0, 1),
    )
    owner = torch.arange(batch, device=t.device).repeat_interleave(several)
    found = _descended(rays[owner], R, t, min(_FIRST, most_steps))
    found = found.where(there.flatten(), replace(found, cost=torch.full_like(found.cost, torch.inf)))
    # where a search has not ended, and may end at a minimum that matters
    best = found.cost.view(batch, several).amin(1)
    rest = (~found.converged & (found.cost <= relevant(best)[owner])).nonzero()[:, 0]
    if rest.numel() and most_steps > _FIRST:
        more = _descended(rays[owner[rest]], found.R[rest], found.t[rest], most_steps - _FIRST)
        found = found.replaced(rest, more)
    return _chosen(*(value.unflatten(0, (batch, several)) for value in vars(found).values()))


@dataclass(frozen=True, eq=False)
class _Ends(Rows):
    """Where searches ended: poses, costs, information about pose and numbers, and whether they converged."""

    R: Tensor
    t: Tensor
    cost: Tensor
    information: Tensor
    converged: Tensor


def _descended(rays: Rays, R: Tensor, t: Tensor, steps: int) -> _Ends:
    found = minimise(rays.normal, rays.unknowns(R, t), steps, damping=1e-4, adaptive=True, tolerance=_TOLERANCE)
    pose = found.unknowns.pose
    return _Ends(pose.R, pose.t, found.normal.cost, found.information, found.code == Code.CONVERGED)


def _chosen(R: Tensor, t: Tensor, cost: Tensor, information: Tensor, converged: Tensor) -> PnPResult:
    """The best of S minima (B, S, ...), and the next one that is not the same."""
    cost, order = cost.nan_to_num(nan=torch.inf).sort(1)
    row = torch.arange(len(t), device=t.device)
    at = row[:, None], order
    R, t, converged = R[at], t[at], converged[at]
    best = information[row, order[:, 0]]
    off = torch.cat([t - t[:, :1], rotations.log(R @ R[:, :1].mT)], -1)
    # of the pose alone, whatever else is open
    whole, determined = scaled_inverse(best)
    covariance = whole[:, :6, :6]
    near = (off @ scaled_inverse(covariance)[0] * off).sum(-1) < COINCIDENCE
    other = cost.isfinite() & ~near
    second = torch.where(other.any(1), other.int().argmax(1), 0)
    has = other.any(1) & (second > 0)
    code = torch.zeros_like(order[:, 0])
    for failed, verdict in (
        (has & (cost[row, second] - cost[:, 0] < DECISION), PnPCode.AMBIGUOUS),
        (~converged[:, 0], PnPCode.NOT_CONVERGED),
        (~determined, PnPCode.DEGENERATE),
        (~cost[:, 0].isfinite(), PnPCode.BEHIND_CAMERA),
    ):
        code = torch.where(failed, int(verdict), code)
    nothing, unknown = torch.full_like(cost[:, 0], torch.nan), torch.nan
    result = PnPResult(
        R=R[:, 0],
        t=t[:, 0],
        covariance=covariance,
        rms=nothing,
        chi2=cost[:, 0],
        iterations=torch.zeros_like(code),
        code=code,
        R_alt=torch.where(has[:, None, None], R[row, second], unknown),
        t_alt=torch.where(has[:, None], t[row, second], unknown),
        rms_alt=nothing,
        chi2_alt=torch.where(has, cost[row, second], unknown),
        ratio=nothing,
    )
    return _failed(result, torch.where(code > PnPCode.AMBIGUOUS, code, -1))


def _failed(result: PnPResult, code: Tensor) -> PnPResult:
    """With NaN, and these codes (B,), where they are none of -1."""
    bad = code >= 0
    changed = {
        name: torch.where(bad.view(-1, *[1] * (value.ndim - 1)), torch.nan, value)
        for name, value in vars(result).items()
        if value.is_floating_point()
    }
    integers = {"code": torch.where(bad, code, result.code), "iterations": result.iterations}
    return PnPResult(**changed, **integers)


def _with_rms(result: PnPResult, inputs: Inputs, rig: CameraRig, index: Tensor, seen: Tensor) -> PnPResult:
    """With the RMS of the pixels of both poses, through the lenses."""

    def rms(R: Tensor, t: Tensor) -> Tensor:
        at = inputs.points @ R.mT + t[:, None]
        square = at.new_zeros(at.shape[:2])
        for number, camera in enumerate(rig.cameras):
            own = at @ rig.R[number].to(at).mT + rig.t[number].to(at)
            error = (camera.project(own) - inputs.pixels).square().sum(-1)
            square = torch.where(index == number, error, square)
        return (torch.where(seen, square, 0.0).sum(1) / seen.sum(1)).sqrt()

    first, other = rms(result.R, result.t), rms(result.R_alt, result.t_alt)
    whole = vars(result) | {"rms": first, "rms_alt": other, "ratio": other / first}
    return PnPResult(**whole)


def _positive(covariance: Tensor, seen: Tensor) -> Tensor:
    """Problems (B,) bool whose covariances are positive definite where points were seen."""
    determinant = torch.linalg.det(covariance)
    return (((determinant > 0) & (covariance[..., 0, 0] > 0)) | ~seen).all(1)


def _nothing(rays: Rays) -> Rays:
    """The same with nothing but zeros of weight zero."""
    return Rays(*(torch.zeros_like(value) for value in vars(rays).values()))
