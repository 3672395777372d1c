"""The poses that a target is designed for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations

_TURNS = 12  # rolls and directions of the tilt that stand for a whole turn


@dataclass(frozen=True)
class WorkingVolume:
    """Where the target may be: R = exp(lean) Rz(roll), t = (x, y, z), the lean being across the optical axis.

    Attributes:
        distance: nearest and farthest z of the target's origin, mm.
        offset: largest |x| and |y| of the origin, mm.
        tilt: largest angle between the target's normal and the optical axis, in any direction, rad.
        roll: largest turn about the optical axis, rad; pi for any.
        nominal: distance of the middle, mm; by default half-way.

    Raises:
        ConfigError: a limit is negative, not finite or out of range.
    """

    distance: tuple[float, float]
    offset: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0
    roll: float = math.pi
    nominal: float | None = None

    def __post_init__(self) -> None:
        near, far = self.distance
        if not (0 < near <= far < math.inf):
            raise ConfigError(f"distance: {near:g} to {far:g} mm is not 0 < near <= far; correct it")
        if self.nominal is not None and not near <= self.nominal <= far:
            raise ConfigError(f"distance: {self.nominal:g} mm is not within the range {near:g} to {far:g}; correct one")
        if not all(0 <= x < math.inf for x in self.offset):
            raise ConfigError(f"offset: {self.offset[0]:g} {self.offset[1]:g} mm; give lengths of 0 or more")
        if not 0 <= self.tilt <= math.radians(80):
            raise ConfigError(f"tilt: {math.degrees(self.tilt):g} degrees; give 0 to 80, rings are lines beyond")
        if not 0 <= self.roll <= math.pi + 1e-9:
            raise ConfigError(f"roll: {math.degrees(self.roll):g} degrees; give 0 to 180, where 180 is any")

    @property
    def middle(self) -> tuple[Tensor, Tensor]:
        """R (1, 3, 3), t (1, 3): facing the camera at the nominal distance, on the optical axis."""
        z = sum(self.distance) / 2 if self.nominal is None else self.nominal
        return torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, z]], dtype=torch.float64)

    @property
    def corners(self) -> list[tuple[float, float]]:
        """x, y of the corners of the offset, mm, each once."""
        return _signs(self.offset)

    def extremes(self) -> tuple[Tensor, Tensor]:
        """R (N, 3, 3), t (N, 3): no and the largest tilt in all directions, at all rolls, at the borders of the volume.

        What a target needs of every view (all rings in the frame, large enough) holds within if it holds here.
        """
        return self.poses(
            distances=sorted(set(self.distance)),
            tilts=sorted({0.0, self.tilt}),
            azimuths=_TURNS,
            rolls=_TURNS if self.roll else 1,
            offsets=self.corners,
        )

    def poses(
        self,
        *,
        distances: list[float],
        tilts: list[float],
        azimuths: int,
        rolls: int,
        offsets: list[tuple[float, float]],
    ) -> tuple[Tensor, Tensor]:
        """All combinations: R (N, 3, 3), t (N, 3).

        Args:
            distances, tilts: mm, rad. azimuths: directions of each tilt but 0. rolls: over -roll..roll.
            offsets: x and y, mm.
        """
        leans = [
            (tilt * math.cos(2 * math.pi * k / azimuths), tilt * math.sin(2 * math.pi * k / azimuths))
            for tilt in tilts
            for k in range(azimuths if tilt else 1)
        ]
        turns = _turns(self.roll, rolls)
        rows = [(*lean, turn, x, y, z) for z in distances for x, y in offsets for lean in leans for turn in turns]
        ax, ay, turn, x, y, z = torch.tensor(rows, dtype=torch.float64).unbind(1)
        zero = torch.zeros_like(ax)
        R = rotations.exp(torch.stack([ax, ay, zero], 1)) @ rotations.exp(torch.stack([zero, zero, turn], 1))
        return R, torch.stack([x, y, z], 1)

    def random(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """R (count, 3, 3), t (count, 3) drawn evenly in distance, offset, tilt, its direction and roll."""
        u = torch.rand(6, count, dtype=torch.float64, generator=generator)
        lean, azimuth = self.tilt * u[0], 2 * math.pi * u[1]
        zero = torch.zeros_like(lean)
        R = rotations.exp(torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), zero], 1))
        R = R @ rotations.exp(torch.stack([zero, zero, self.roll * (2 * u[2] - 1)], 1))
        near, far = self.distance
        x, y = (half * (2 * v - 1) for half, v in zip(self.offset, u[3:5], strict=True))
        return R, torch.stack([x, y, near + (far - near) * u[5]], 1)

    def least_scale(self, camera: Camera, reach: tuple[float, float]) -> float:
        """Smallest px a mm of the target takes, in any direction, at any extreme, within ``reach`` (half sides, mm).

        A small ring of radius r mm has there a semi-minor axis of that many r px.
        """
        R, t = self.extremes()
        corner = torch.tensor([(x, y, 0.0) for x, y in [*_signs(reach), (0.0, 0.0)]], dtype=torch.float64)
        point = corner @ R.mT + t[:, None]  # (N, 5, 3)
        xy = point[..., :2] / point[..., 2:]
        # d(x, y) by a move in the target's plane, then d(u, v)
        in_plane = R[:, None, :, :2]
        ray = (in_plane[..., :2, :] - xy[..., None] * in_plane[..., 2:, :]) / point[..., 2:, None]
        return float(torch.linalg.svdvals(camera.J_distort(xy) @ ray)[..., -1].min())


def _signs(half: tuple[float, float]) -> list[tuple[float, float]]:
    x, y = half
    return sorted({(sx * x + 0.0, sy * y + 0.0) for sx in (-1, 1) for sy in (-1, 1)})  # no -0


def _turns(roll: float, count: int) -> list[float]:
    if count == 1:
        return [0.0]
    if roll > math.pi - 1e-9:
        return [2 * math.pi * k / count - math.pi for k in range(count)]
    return [roll * (2 * k / (count - 1) - 1) for k in range(count)]
