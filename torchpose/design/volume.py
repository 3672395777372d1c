"""The poses that a target is designed for."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.projection import image_by_point

_TURNS = 12  # rolls and directions of the tilt that stand for a whole turn

Poses = tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3"]]
"""R and t, target to camera, mm; from here in float64 on the host."""
Offsets = Sequence[tuple[float, float]]
"""x and y, mm."""
_AXIS = ((0.0, 0.0),)


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
    def middle(self) -> Poses:
        """One pose: facing the camera at the nominal distance, on the optical axis."""
        z = sum(self.distance) / 2 if self.nominal is None else self.nominal
        return self.poses(distances=[z], tilts=[0.0])

    def extremes(self) -> Poses:
        """No and the largest tilt in all directions, at all rolls, at the borders of the volume.

        What a target needs of every view (all rings in the frame, large enough) holds within if it holds here.
        """
        return self.borders(sorted({0.0, self.tilt}), _TURNS)

    def borders(self, tilts: list[float], turns: int) -> Poses:
        """Tilts in as many directions as rolls, at the borders of distance and offset."""
        distances, rolls = sorted(set(self.distance)), turns if self.roll else 1
        return self.poses(distances=distances, tilts=tilts, azimuths=turns, rolls=rolls, offsets=_signs(self.offset))

    def poses(
        self, *, distances: list[float], tilts: list[float], azimuths: int = 1, rolls: int = 1, offsets: Offsets = _AXIS
    ) -> Poses:
        """All combinations of distances, offsets, tilts in a number of directions (azimuths) and rolls."""
        leans = [
            (tilt * math.cos(2 * math.pi * k / azimuths), tilt * math.sin(2 * math.pi * k / azimuths))
            for tilt in tilts
            for k in range(azimuths if tilt else 1)
        ]
        turns = _turns(self.roll, rolls)
        rows = [(*lean, turn, x, y, z) for z in distances for x, y in offsets for lean in leans for turn in turns]
        return _posed(torch.tensor(rows, dtype=torch.float64, device="cpu"))

    def random(self, count: int, generator: torch.Generator) -> Poses:
        """Drawn evenly in distance, offset, tilt, its direction and roll, on the generator's device."""
        drawn = torch.rand(6, count, dtype=torch.float64, generator=generator, device=generator.device)
        lean, azimuth = self.tilt * drawn[0], 2 * math.pi * drawn[1]
        roll, x, y = (half * (2 * u - 1) for half, u in zip((self.roll, *self.offset), drawn[2:5], strict=True))
        z = self.distance[0] + (self.distance[1] - self.distance[0]) * drawn[5]
        return _posed(torch.stack([lean * azimuth.cos(), lean * azimuth.sin(), roll, x, y, z], 1))

    def least_scale(self, camera: Camera, reach: tuple[float, float]) -> float:
        """Smallest px a mm of the target takes, in any direction, at any extreme, within ``reach`` (half sides, mm).

        A small ring of radius r mm has there a semi-minor axis of that many r px.
        """
        R, t = (part.to(camera.matrix) for part in self.extremes())
        corner = t.new_tensor([(x, y, 0.0) for x, y in [*_signs(reach), (0.0, 0.0)]])
        point = corner @ R.mT + t[:, None]  # (N, 5, 3)
        xy = point[..., :2] / point[..., 2:]
        by_place = camera.J_distort(xy) @ image_by_point(xy, point[..., 2]) @ R[:, None, :, :2]
        return float(torch.linalg.svdvals(by_place)[..., -1].min())


def _posed(rows: Tensor) -> Poses:
    """Poses of a lean about x and y, a roll, and x y z: (N, 6)."""
    lean, roll = (torch.nn.functional.pad(part, pad) for part, pad in ((rows[:, :2], (0, 1)), (rows[:, 2:3], (2, 0))))
    return rotations.exp(lean) @ rotations.exp(roll), rows[:, 3:]


def _signs(half: tuple[float, float]) -> Offsets:
    x, y = half
    return sorted({(sx * x + 0.0, sy * y + 0.0) for sx in (-1, 1) for sy in (-1, 1)})  # no -0


def _turns(roll: float, count: int) -> list[float]:
    if count == 1:
        return [0.0]
    if roll > math.pi - 1e-9:
        return [2 * math.pi * k / count - math.pi for k in range(count)]
    return [roll * (2 * k / (count - 1) - 1) for k in range(count)]
