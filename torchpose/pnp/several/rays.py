"""Image points of several cameras as rays, whitened, with the numbers that their cameras leave open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.camera import CameraRig
from torchpose.camera.derivatives import by_intrinsics
from torchpose.geometry.least_squares import Normal, Pose, Unknowns, Vector, covariance_factor
from torchpose.geometry.projection import image_by_point
from torchpose.geometry.rotations import exp
from torchpose.geometry.rows import Rows


@dataclass(frozen=True, eq=False)
class Rays(Rows):
    """N points of B objects, each seen by a camera of its own: x_camera = turn (R X + t) + shift.

    Attributes:
        points: of the objects.
        xy: their images, undistorted, on the plane z = 1 of each one's camera.
        root: square roots of their information.
        turn, shift: from the axes of the first camera to those of each point's.
        places: how these six vary with k numbers of unit variance (`CameraRig.factor`).
        lens: how whitened images vary with q numbers of the lenses.
        seen: what others hold does not matter, but that it is finite.
    """

    points: Float[Tensor, "B N 3"]
    xy: Float[Tensor, "B N 2"]
    root: Float[Tensor, "B N 2 2"]
    turn: Float[Tensor, "B N 3 3"]
    shift: Float[Tensor, "B N 3"]
    places: Float[Tensor, "B N 6 k"]
    lens: Float[Tensor, "B N 2 q"]
    seen: Bool[Tensor, "B N"]

    @property
    def numbers(self) -> int:
        """How many numbers of the cameras are uncertain."""
        return self.places.shape[-1] + self.lens.shape[-1]

    def ahead(self, R: Tensor, t: Tensor) -> Tensor:
        """Poses (B, ..., 3, 3), (B, ..., 3), (B, ...) bool, that have all points seen in front of their cameras."""
        more = [1] * (t.ndim - 2)
        at = self.points.view(len(t), *more, -1, 3) @ R.mT + t[..., None, :]
        turn, shift = self.turn.view(len(t), *more, -1, 3, 3), self.shift.view(len(t), *more, -1, 3)
        z = (turn[..., 2, :] * at).sum(-1) + shift[..., 2]
        return ((z > 0) | ~self.seen.view(len(t), *more, -1)).all(-1)

    def normal(self, unknowns: Unknowns) -> Normal:
        """Normal equations of the pose, and of the numbers where there are any."""
        by_turned, (of_pose, of_numbers), residual, ahead = self._linear(unknowns)
        columns = torch.cat([of_pose, torch.linalg.cross(by_turned, of_pose, dim=-1), of_numbers], -1)
        flat = columns.flatten(1, 2)
        cost = torch.where(ahead, residual.square().sum((1, 2)), torch.inf)
        normal = Normal(flat.mT @ flat, (flat.mT @ residual.flatten(1)[..., None])[..., 0], cost)
        if not self.numbers:
            return normal
        information = torch.zeros_like(normal.information)
        information.diagonal(dim1=-2, dim2=-1)[:, 6:] = 1
        return normal.with_prior(information, torch.nn.functional.pad(unknowns.values("numbers"), (6, 0)))

    def _linear(self, unknowns: Unknowns) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor, Tensor]:
        """Arms for the turn, whitened derivatives by translation and numbers, residuals, and what is ahead."""
        pose, k = unknowns.pose, self.places.shape[-1]
        arm = self.points @ pose.R.mT
        turned = (self.turn @ (arm + pose.t[:, None])[..., None])[..., 0]
        own, u = turned, unknowns.values("numbers") if self.numbers else None
        at = turned + self.shift
        if u is not None and k:
            moved = (self.places @ u[:, None, :k, None])[..., 0]
            own = (exp(moved[..., 3:]) @ turned[..., None])[..., 0]
            at = own + self.shift + moved[..., :3]
        z = torch.where(self.seen, at[..., 2], 1.0)
        ahead = (z > 0).all(-1)
        z = torch.where(z > 0, z, 1.0)
        image = at[..., :2] / z[..., None]
        slope = self.root @ image_by_point(image, z)
        residual = (self.root @ (self.xy - image)[..., None])[..., 0]
        by_t = slope @ self.turn
        numbers = []
        if k:
            both = torch.cat([slope, torch.linalg.cross(own[..., None, :].expand_as(slope), slope, dim=-1)], -1)
            numbers.append(both @ self.places)
        if u is not None and u.shape[1] > k:
            numbers.append(self.lens)
            residual = residual - (self.lens @ u[:, None, k:, None])[..., 0]
        none = by_t.new_zeros(*by_t.shape[:-1], 0)
        arms = arm[..., None, :].expand_as(by_t)
        return arms, (by_t, torch.cat(numbers, -1) if numbers else none), residual, ahead

    def unknowns(self, R: Tensor, t: Tensor) -> Unknowns:
        """To start from at poses (B, 3, 3), (B, 3)."""
        own: dict[str, Pose | Vector] = {"pose": Pose(R, t)}
        if self.numbers:
            own["numbers"] = Vector(t.new_zeros(len(t), self.numbers))
        return Unknowns(own)


class Pixels(NamedTuple):
    """Image points (B, N, 2) px with their covariances (B|1, N, 2, 2), weights (B|1, N) or None, and which camera saw
    each (B|1, N)."""

    at: Tensor
    covariance: Tensor
    weight: Tensor | None
    camera: Tensor


def rays_of(points: Tensor, pixels: Pixels, rig: CameraRig, seen: Tensor) -> Rays:
    """Rays of pixels: lenses are taken off, and their slopes go into the weights.

    Args:
        points: (B, N, 3).
        pixels: of these.
        rig: the cameras.
        seen: (B, N) bool.
    """
    batch, count = seen.shape
    index = pixels.camera.expand(batch, count).flatten()
    at = torch.where(seen[..., None], pixels.at, 0.0).flatten(0, 1)
    xy, slope = torch.zeros_like(at), torch.eye(2).to(at).repeat(len(at), 1, 1)
    factors = [None if c.covariance is None else covariance_factor(c.covariance.to(at)) for c in rig.cameras]
    widths = [0 if f is None else f.shape[1] for f in factors]
    lens = at.new_zeros(len(at), 2, sum(widths))
    for number, (camera, factor) in enumerate(zip(rig.cameras, factors, strict=True)):
        own = ((index == number) & seen.flatten()).nonzero()[:, 0]
        xy[own] = camera.undistort_points(at[own])
        slope[own] = camera.J_distort(xy[own])
        if factor is not None:
            first = sum(widths[:number])
            lens[own, :, first : first + widths[number]] = by_intrinsics(camera, xy[own])[..., : len(factor)] @ factor
    eye = torch.eye(2).to(at)
    covariance = torch.where(seen[..., None, None], pixels.covariance, eye)
    root = torch.linalg.cholesky(torch.linalg.inv(covariance)).mT
    if pixels.weight is not None:
        root = root * pixels.weight.sqrt()[..., None, None]
    root = (root * seen[..., None, None]).flatten(0, 1)
    index = index.clamp(0, len(rig) - 1)

    def laid_out(values: Tensor) -> Tensor:
        return values.unflatten(0, (batch, count))

    turn, shift, places = (x.to(at)[index] for x in (rig.R, rig.t, rig.factor()))
    turn, shift, places = laid_out(turn), laid_out(shift), laid_out(places)
    return Rays(
        torch.where(seen[..., None], points, 0.0),
        laid_out(xy),
        laid_out(root @ slope),
        turn,
        shift,
        places,
        laid_out(root @ lens),
        seen,
    )
