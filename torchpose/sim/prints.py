"""Prints of a target as printers make them: places, dot gain, scale and a plate that is not flat.

A print keeps the frame of its target file: the pose of a frame is that of the nominal target, from which the print
differs. Nothing of a common shift, turn or scale is taken out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows, shared
from torchpose.sim.raster import raster_sides
from torchpose.sim.shapes import Circles, Shapes, Sides
from torchpose.target import Target

_INCH = 25.4  # mm
Warp = Literal["dome", "cylinder", "twist"]
# height on the unit disc, offset + (x, y) diag (x, y): mean 0 over the disc, 2 from its lowest to its highest point
_WARPS: dict[str, tuple[float, tuple[float, float]]] = {
    "dome": (-1.0, (2.0, 2.0)),
    "cylinder": (-0.5, (2.0, 0.0)),
    "twist": (0.0, (1.0, -1.0)),
}


@dataclass(frozen=True)
class PrintErrors:
    """How prints differ from their target; a number for all prints, or a tensor (B,).

    Attributes:
        center_sigma: standard deviation in mm of the places of markers along x, y and z, each on its own; a number
            stands for all three.
        gain: dot gain in mm, beyond that of the target file: every dark edge lies so much further outwards.
        scale: relative error of all lengths.
        warp: half of the height in mm from the lowest to the highest point of the plate that is bent, on the smallest
            disc about the mean of the markers' centres that holds all rings.
        shape: of the plate: ``dome``, ``cylinder`` (bent along x) or ``twist`` (a saddle, up along x, down along y).
        direction: by which its x lies off that of the target, rad from x towards y.
        dpi: cells an inch of a raster printer, aligned with the target's x and y, which makes a cell black where its
            centre is to be; None for smooth edges.
    """

    center_sigma: float | Sequence[float] = 0.0
    gain: float | Tensor = 0.0
    scale: float | Tensor = 0.0
    warp: float | Tensor = 0.0
    shape: Warp = "twist"
    direction: float | Tensor = 0.0
    dpi: float | None = None


@dataclass(frozen=True, eq=False)
class Prints(Rows):
    """B prints of a target of M markers, in the frame of the target file; mm, float64.

    Attributes:
        centers: where the rings are.
        normals: of their planes.
        radii: outer and inner.
        curvature: second derivatives of the plate's height along z by x and y, per mm, everywhere the same.
        rise: height of the plate at the mean of the target's markers.
        gain: dot gain, that of the target file included.
        phase: a corner of the raster.
        target: what was to be printed.
        cell: side of the raster's cells; 0 for smooth edges.
    """

    centers: Float[Tensor, "B M 3"]
    normals: Float[Tensor, "B M 3"]
    radii: Float[Tensor, "B M 2"]
    curvature: Float[Tensor, "B 2 2"]
    rise: Float[Tensor, " B"]
    gain: Float[Tensor, " B"]
    phase: Float[Tensor, "B 2"]
    target: Target = shared()
    cell: float = shared(0.0)

    def as_target(self, number: int = 0) -> Target:
        """One of the prints as a target that knows it: its rings in the planes that touch the plate in their centres.

        Raises:
            ConfigError: its rings overlap.
        """
        target, gain = self.target, float(self.gain[number])
        outwards = self.radii.new_tensor([gain, -gain]) * (1 if target.background == "light" else -1)
        return replace(
            target,
            centers=self.centers[number],
            normals=self.normals[number],
            radii=self.radii[number] - outwards,
            edge_gain=gain,
            covariance=None,
        )

    def height(self, place: Float[Tensor, "N 2"]) -> Float[Tensor, "B N"]:
        """How far the plates lie along z beyond the flat target at (x, y), mm."""
        away = place - self.target.centers[:, :2].mean(0)
        return self.rise[:, None] + 0.5 * ((away @ self.curvature) * away).sum(-1)

    def repeated(self, count: int) -> Self:
        """A print that was made once, for ``count`` frames."""
        return self[torch.zeros(count, dtype=torch.int64, device=self.gain.device)]

    def rings(self, level: Float[Tensor, " B"]) -> Shapes:
        """The rings as shapes of B frames, one print a frame, each frame's of one grey level."""
        count, markers = self.centers.shape[:2]
        each = torch.arange(count * markers, device=self.radii.device)
        axes = torch.stack(plane_axes(self.normals), -2).flatten(0, 1)  # (B M, 2, 3)
        bend = _bend(axes, self.normals.flatten(0, 1), self.curvature.repeat_interleave(markers, 0))
        center, radii = self.centers.flatten(0, 1), self.radii.flatten(0, 1)
        circles = Circles(
            each.repeat_interleave(2),
            center.repeat_interleave(2, 0),
            (radii[..., None, None] * axes[:, None]).flatten(0, 1),
            radii.new_tensor([1.0, -1.0]).repeat(len(each)),
            (radii.square()[..., None, None] * bend[:, None]).flatten(0, 1),
        )
        frame, marker = each // markers, each % markers
        sides = Sides(each[:0], radii.new_zeros(0, 2, 3))
        if self.cell > 0:
            circles, sides = circles[each[:0]], self._rastered()
        return Shapes(frame, marker, level[frame], center, circles, sides)

    def _rastered(self) -> Sides:
        """Outlines of the rings of all prints, on their bent plates."""
        print_ = torch.arange(len(self), device=self.gain.device).repeat_interleave(2 * self.centers.shape[1])
        center, normal = (x.flatten(0, 1).repeat_interleave(2, 0) for x in (self.centers, self.normals))
        circle, ends = raster_sides(center[:, :2], self.radii.flatten(), self.cell, self.phase[print_])
        away, slope = ends - center[circle, None, :2], -normal[:, :2] / normal[:, 2:]
        bend = 0.5 * ((away @ self.curvature[print_[circle]]) * away).sum(-1)
        height = center[circle, None, 2] + (away * slope[circle, None]).sum(-1) + bend
        ends = torch.cat([ends, height[..., None]], -1)
        hole = circle % 2 == 1
        return Sides(circle // 2, torch.where(hole[:, None, None], ends.flip(1), ends))


@checked
def printed(target: Target, errors: PrintErrors, count: int = 1, generator: torch.Generator | None = None) -> Prints:
    """``count`` prints of a target, each with errors of its own.

    The plate is the quadric of `PrintErrors.shape`: markers keep x and y (their way along the plate differs from that
    by the square of the slope), get its height and turn with it, and their rings are bent as it is.

    Raises:
        ConfigError: a deviation is negative, the dot gain leaves nothing of a ring, or a target that is not flat in a
            plane z = const is warped or rastered.
    """
    like = target.centers

    def each(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(count)

    sigma = torch.as_tensor(errors.center_sigma, dtype=like.dtype, device=like.device).expand(3)
    if not bool((sigma >= 0).all()):
        raise ConfigError("center_sigma: is negative; give 0 mm or more")
    error = sigma * torch.randn(count, *like.shape, dtype=like.dtype, device=like.device, generator=generator)
    gain, scale = target.edge_gain + each(errors.gain), 1 + each(errors.scale)
    curvature, rise = _plate(target, each(errors.warp), errors.shape, each(errors.direction))
    centers, normals = _laid(target, scale[:, None, None] * target.centers + error, curvature, rise)
    # ink and toner spread: dark rings grow, light ones shrink
    outwards = gain if target.background == "light" else -gain
    radii = scale[:, None, None] * target.radii + outwards[:, None, None] * like.new_tensor([1.0, -1.0])
    radii = torch.stack([radii[..., 0], radii[..., 1].clamp_min(0.0)], -1)  # a hole may be filled
    if not bool((radii[..., 0] > radii[..., 1]).all()):
        raise ConfigError("gain: leaves nothing of a ring; give less")
    phase, cell = like.new_zeros(count, 2), 0.0
    if errors.dpi is not None:
        if not errors.dpi > 0:
            raise ConfigError(f"dpi: is {errors.dpi:g}; give cells an inch, such as 600")
        _check_upright("dpi", target)
        cell = _INCH / errors.dpi
        phase = cell * torch.rand(count, 2, dtype=like.dtype, device=like.device, generator=generator)
    return Prints(centers, normals, radii, curvature, rise, gain, phase, target, cell)


def _check_upright(field: str, target: Target) -> None:
    if not (target.coplanar and bool(target.normals[:, :2].abs().max() < 1e-6)):
        raise ConfigError(f"{field}: is for targets in a plane z = const; leave it out")


def _plate(target: Target, warp: Tensor, shape: Warp, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Curvature (B, 2, 2) of plates of such heights (B,), and their height (B,) at the mean of the markers."""
    if not bool(warp.any()):
        return warp.new_zeros(len(warp), 2, 2), warp
    _check_upright("warp", target)
    radius = ((target.centers - target.centers.mean(0)).norm(dim=1) + target.radii[:, 0]).max()
    offset, diagonal = _WARPS[shape]
    axis = torch.stack([direction.cos(), direction.sin()], -1)
    turn = torch.stack([axis, torch.stack([-axis[:, 1], axis[:, 0]], -1)], -1)  # columns: the quadric's x and y
    unit = turn @ torch.diag(warp.new_tensor(diagonal)) @ turn.mT
    return unit * (2 * warp / radius.square())[:, None, None], offset * warp


def _laid(target: Target, centers: Tensor, curvature: Tensor, rise: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (B, M, 3) lifted onto bent plates, and normals (B, M, 3) of these there."""
    count = len(centers)
    if not bool(curvature.any()):
        return centers, target.normals.expand(count, -1, -1)
    place = centers[..., :2] - target.centers[:, :2].mean(0)
    slope = place @ curvature
    height = rise[:, None] + 0.5 * (slope * place).sum(-1)
    lifted = torch.cat([centers[..., :2], (centers[..., 2] + height)[..., None]], -1)
    normals = torch.nn.functional.normalize(torch.cat([-slope, torch.ones_like(height)[..., None]], -1), dim=-1)
    return lifted, target.normals[:, 2:].sign() * normals


def _bend(axes: Tensor, normal: Tensor, curvature: Tensor) -> Tensor:
    """(K, 3, 3) `Circles.bend` of circles of the radius 1 with axes (K, 2, 3), for curvatures (K, 2, 2)."""
    flat = axes[..., :2]
    by_axes = flat @ curvature @ flat.mT  # (K, 2, 2)
    along = normal * torch.where(normal[:, 2:] < 0, -1.0, 1.0).to(normal)
    parts = torch.stack([0.5 * by_axes[:, 0, 0], by_axes[:, 0, 1], 0.5 * by_axes[:, 1, 1]], -1)
    return parts[..., None] * along[:, None]
