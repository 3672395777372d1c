"""Plan files of simulated data sets: which frames there are, under which conditions they were taken."""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, field_validator, model_validator
from torch import Tensor

from torchpose.camera import Camera
from torchpose.config import beside, read_yaml, validate, within
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.rotations import plane_axes
from torchpose.io.truth import Truth, read_truth
from torchpose.sim import faults_of
from torchpose.target import Target

_FROZEN = ConfigDict(extra="forbid", frozen=True)
_HALTON_BASES = (2, 3, 5, 7, 11, 13)
_TRIES = 50  # random poses drawn for one that keeps the target in view

Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


def _range(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [value, value]
    if not isinstance(value, list) or len(value) != 2 or not all(isinstance(v, int | float) for v in value):
        raise ValueError(f"is {value!r}; give a number or [low, high]")
    if value[0] > value[1]:
        raise ValueError(f"has the limits {value[0]:g} > {value[1]:g}; swap them")
    return value


Range = Annotated[list[FiniteFloat], BeforeValidator(_range)]
"""[low, high], from which every frame draws its own value; a plain number stands for both."""


class Grid(BaseModel):
    """All combinations of pitch, yaw and roll with every position: R = Rz(roll) Ry(yaw) Rx(pitch)."""

    model_config = _FROZEN
    distance: FiniteFloat
    angles_deg: Annotated[list[FiniteFloat], Field(min_length=1)]
    positions: Annotated[list[Vector], Field(min_length=1)] = [[0.0, 0.0, 0.0]]


class Random(BaseModel):
    """A low-discrepancy (Halton) cover of position, tilt (any direction) and roll."""

    model_config = _FROZEN
    count: Annotated[int, Field(ge=1)]
    x: Range
    y: Range
    z: Range
    tilt_deg: Range = [0.0, 45.0]
    roll_deg: Range = [-180.0, 180.0]


class Axes(BaseModel):
    """Moves along and turns about one camera axis at a time, from one start."""

    model_config = _FROZEN
    start: Vector
    rotation_deg: Vector = [0.0, 0.0, 0.0]
    translations: list[FiniteFloat] = []
    turns_deg: list[FiniteFloat] = []

    @model_validator(mode="after")
    def _moves(self) -> Axes:
        if not self.translations and not self.turns_deg:
            raise ValueError("moves nothing; give translations or turns_deg")
        return self


class Poses(BaseModel):
    """One of the ways to say where the target is; ``file`` names a truth file."""

    model_config = _FROZEN
    grid: Grid | None = None
    random: Random | None = None
    axes: Axes | None = None
    file: str | None = None

    @model_validator(mode="after")
    def _one(self) -> Poses:
        if len(self.model_fields_set) != 1:
            raise ValueError(f"holds {len(self.model_fields_set)} kinds; give one of grid, random, axes and file")
        return self


class Lens(BaseModel):
    """See `torchpose.sim.Defocus`."""

    model_config = _FROZEN
    f_number: Annotated[FiniteFloat, Field(gt=0)]
    focal_length: Annotated[FiniteFloat, Field(gt=0)]
    focus_distance: Annotated[FiniteFloat, Field(gt=0)]


class Light(BaseModel):
    """See `torchpose.sim.Lighting`."""

    model_config = _FROZEN
    gradient: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] = [0.0, 0.0]
    point: Vector | None = None
    vignetting: Annotated[FiniteFloat, Field(ge=0)] = 0.0


class Imaging(BaseModel):
    """Conditions of the picture, before the sensor."""

    model_config = _FROZEN
    psf_sigma: Range = [0.7, 0.7]
    dark: Range = [30.0, 30.0]
    light: Range = [220.0, 220.0]
    surround: Range = [90.0, 90.0]
    plate: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None = None
    background: str | None = None
    motion_mm: Range = [0.0, 0.0]
    motion_deg: Range = [0.0, 0.0]
    clutter: Annotated[int, Field(ge=0)] = 0
    covered: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.0
    defocus: Lens | None = None
    lighting: Light | None = None

    @field_validator("psf_sigma")
    @classmethod
    def _sharp(cls, value: list[float]) -> list[float]:
        if value[0] <= 0:
            raise ValueError(f"is {value[0]:g}; the blur must be above 0 px, such as 0.3 for a very sharp lens")
        return value

    @field_validator("motion_mm", "motion_deg")
    @classmethod
    def _motion(cls, value: list[float]) -> list[float]:
        if value[0] < 0:
            raise ValueError(f"is {value[0]:g}; give the length of the move during the exposure, 0 or more")
        return value

    @field_validator("plate")
    @classmethod
    def _plate(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and min(value) <= 0:
            raise ValueError("has a side that is not above 0; give its width and height in mm")
        return value

    @model_validator(mode="after")
    def _behind(self) -> Imaging:
        if self.background is not None and self.plate is None:
            raise ValueError("has a background and no plate, which would hide it; add plate: [width, height]")
        return self


class Sensor(BaseModel):
    """Noise after EMVA 1288 and the stored depth."""

    model_config = _FROZEN
    noise: Range = [1.0, 1.0]
    full_well: Annotated[FiniteFloat, Field(gt=0)] | None = None
    bits: Literal[8, 10, 12, 16] = 8
    gamma: Annotated[FiniteFloat, Field(gt=0)] = 1.0

    @field_validator("noise")
    @classmethod
    def _not_negative(cls, value: list[float]) -> list[float]:
        if value[0] < 0:
            raise ValueError(f"is {value[0]:g}; give the standard deviation in grey levels, 0 or more")
        return value


class PlanFile(BaseModel):
    """A plan file, see docs/simulation.md."""

    model_config = _FROZEN
    camera: str
    target: str
    seed: int = 0
    poses: Poses
    imaging: Imaging = Imaging()
    sensor: Sensor = Sensor()
    faults: dict[str, dict[str, Any]] = {}
    depth_range: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None = None
    out_of_view: Literal["error", "mark"] = "error"
    bounds: bool = True


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan that has been read: everything that the frames depend on, one row a frame.

    Attributes:
        file: what the plan file says. path: where it lies. camera, target: the models that it names.
        R, t: (N, 3, 3), (N, 3) float64, target to camera, mm.
        conditions: (N,) float64 by name: psf_sigma, dark, light, surround, noise.
        motion: (N, 6) float64, mm and rad during the exposure.
        backgrounds: pictures, in natural order; frame i takes the one of the number i modulo their count.
        seen: (N,) int64, markers that lie in the frame as a whole.
    """

    file: PlanFile
    path: Path
    camera: Camera
    target: Target
    R: Tensor
    t: Tensor
    conditions: dict[str, Tensor]
    motion: Tensor
    backgrounds: list[Path]
    seen: Tensor

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, which: Tensor) -> Plan:
        """The plan of the frames numbered ``which`` (K,) alone, which are then numbered from 0."""
        return replace(
            self,
            R=self.R[which],
            t=self.t[which],
            conditions={name: column[which] for name, column in self.conditions.items()},
            motion=self.motion[which],
            seen=self.seen[which],
        )

    @property
    def names(self) -> list[str]:
        """File names of the frames."""
        digits = max(4, len(str(len(self) - 1)))
        return [f"{i:0{digits}d}.png" for i in range(len(self))]


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Reads a plan file; files that it names are relative to it.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``. A frame with a marker out of view or a target out
            of the depth range is an error unless the plan says ``out_of_view: mark``.
    """
    path = Path(path)
    file = validate(PlanFile, read_yaml(path), path)
    camera = Camera.load(beside(path, file.camera))
    target = Target.load(beside(path, file.target))
    generator = torch.Generator().manual_seed(file.seed % 2**63)
    if file.faults:
        with within(f"{path}: "):
            faults_of(file.faults)
    if file.depth_range is not None and not 0 < file.depth_range[0] < file.depth_range[1]:
        raise ConfigError(f"{path}: depth_range: {file.depth_range} is not 0 < near < far; correct it")
    R, t = _poses(path, file, camera, target)
    count = len(t)
    image = file.imaging
    conditions = {
        name: _draw(value, count, generator)
        for name, value in (
            ("psf_sigma", image.psf_sigma),
            ("dark", image.dark),
            ("light", image.light),
            ("surround", image.surround),
            ("noise", file.sensor.noise),
        )
    }
    motion = torch.cat(
        [
            _direction(count, generator) * _draw(image.motion_mm, count, generator)[:, None],
            _direction(count, generator) * _draw(image.motion_deg, count, generator).deg2rad()[:, None],
        ],
        1,
    )
    seen = markers_in_view(camera, target, R, t)
    plan = Plan(file, path, camera, target, R, t, conditions, motion, _backgrounds(path, image.background), seen)
    if file.out_of_view == "error":
        _check_view(plan)
    return plan


def markers_in_view(camera: Camera, target: Target, R: Tensor, t: Tensor) -> Tensor:
    """(N,) int64: how many markers lie before the camera and in the frame as a whole, for poses (N, 3, 3), (N, 3)."""
    e1, e2 = plane_axes(target.normals)
    angle = torch.arange(36, dtype=t.dtype) * (2 * math.pi / 36)
    rim = angle.cos()[:, None, None] * e1 + angle.sin()[:, None, None] * e2
    points = (target.centers + target.radii[:, :1] * rim).reshape(-1, 3)  # (36 M, 3)
    x = points @ R.mT + t[:, None]
    pixel = camera.project(x)
    last = torch.tensor([camera.width - 1, camera.height - 1], dtype=t.dtype)
    inside = ((pixel >= 0) & (pixel <= last)).all(-1)
    inside &= (x[..., :2] / x[..., 2:]).norm(dim=-1) < camera.fold_radius
    return inside.view(len(t), 36, -1).all(1).sum(1)


def in_depth_range(plan: Plan) -> Tensor:
    """(N,) bool: whether the target's origin lies in the plan's depth range; all do where it has none."""
    near, far = plan.file.depth_range or (0.0, math.inf)
    return (plan.t[:, 2] >= near) & (plan.t[:, 2] <= far)


def _check_view(plan: Plan) -> None:
    fix = "change the poses, or write out_of_view: mark to keep such frames, marked in truth.csv"
    behind = (plan.t[:, 2] <= 0).nonzero().flatten()
    if len(behind):
        z = float(plan.t[behind[0], 2])
        raise ConfigError(f"{plan.path}: poses: frame {int(behind[0])} is behind the camera (z = {z:g} mm); {fix}")
    lost = (plan.seen < len(plan.target)).nonzero().flatten()
    if len(lost):
        i = int(lost[0])
        raise ConfigError(
            f"{plan.path}: poses: {len(plan.target) - int(plan.seen[i])} of {len(plan.target)} markers of frame {i} "
            f"are out of view ({len(lost)} such frames); {fix}"
        )
    far = (~in_depth_range(plan)).nonzero().flatten()
    if len(far):
        z = float(plan.t[far[0], 2])
        raise ConfigError(
            f"{plan.path}: poses: frame {int(far[0])} is at {z:g} mm, out of depth_range {plan.file.depth_range} "
            f"({len(far)} such frames); {fix}"
        )


def _poses(path: Path, file: PlanFile, camera: Camera, target: Target) -> tuple[Tensor, Tensor]:
    if (grid := file.poses.grid) is not None:
        angles = _floats(list(itertools.product(grid.angles_deg, repeat=3))).deg2rad()  # pitch, yaw, roll
        positions = _floats(grid.positions) + _floats([0.0, 0.0, grid.distance])
        return _euler(angles).repeat(len(positions), 1, 1), positions.repeat_interleave(len(angles), 0)
    if (random := file.poses.random) is not None:
        return _random_poses(path, random, file, camera, target)
    if (axes := file.poses.axes) is not None:
        eye, still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        moves = [step * eye[axis] for axis in range(3) for step in axes.translations]
        turns = [math.radians(angle) * eye[axis] for axis in range(3) for angle in axes.turns_deg]
        shift, turn = torch.stack(moves + [still] * len(turns)), torch.stack([still] * len(moves) + turns)
        return rotations.exp(turn) @ _euler(_floats([axes.rotation_deg]).deg2rad())[0], _floats(axes.start) + shift
    listed: Truth = read_truth(beside(path, str(file.poses.file)))
    return listed.R, listed.t


def _random_poses(path: Path, poses: Random, file: PlanFile, camera: Camera, target: Target) -> tuple[Tensor, Tensor]:
    """Halton poses; those that do not keep the target in view are passed over unless the plan marks them."""
    tries = poses.count if file.out_of_view == "mark" else poses.count * _TRIES
    u = torch.stack([_halton(tries, base, file.seed) for base in _HALTON_BASES])
    x, y, z, tilt, roll = (
        _spread(value, row)
        for value, row in zip((poses.x, poses.y, poses.z, poses.tilt_deg, poses.roll_deg), u, strict=False)
    )
    azimuth, zero = u[5] * 2 * math.pi, torch.zeros_like(x)
    lean = torch.stack([azimuth.cos(), azimuth.sin(), zero], 1) * tilt.deg2rad()[:, None]
    R = rotations.exp(lean) @ rotations.exp(torch.stack([zero, zero, roll.deg2rad()], 1))
    t = torch.stack([x, y, z], 1)
    if file.out_of_view == "mark":
        return R, t
    use = (markers_in_view(camera, target, R, t) == len(target)).nonzero().flatten()[: poses.count]
    if len(use) < poses.count:
        raise ConfigError(
            f"{path}: poses: only {len(use)} of {tries} random poses keep the target in view, {poses.count} are "
            "wanted; narrow x, y and tilt_deg or widen z"
        )
    return R[use], t[use]


def _halton(count: int, base: int, seed: int) -> Tensor:
    """(count,) van der Corput sequence (Halton 1960), shifted by the seed modulo 1 (Cranley and Patterson 1976)."""
    number = torch.arange(1, count + 1)
    value, fraction = torch.zeros(count, dtype=torch.float64), 1.0
    while bool((number > 0).any()):
        fraction /= base
        value += fraction * (number % base).double()
        number = number // base
    shift = float(torch.rand(1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed % 2**40 + base)))
    return (value + shift) % 1.0 if seed else value


def _euler(angles: Tensor) -> Tensor:
    """(N, 3, 3) Rz(roll) Ry(yaw) Rx(pitch) of (N, 3) pitch, yaw, roll in rad."""
    axes = torch.eye(3, dtype=angles.dtype)
    pitch, yaw, roll = (rotations.exp(angles[:, i, None] * axes[i]) for i in range(3))
    return roll @ yaw @ pitch


def _draw(value: list[float], count: int, generator: torch.Generator) -> Tensor:
    return _spread(value, torch.rand(count, dtype=torch.float64, generator=generator))


def _spread(value: list[float], u: Tensor) -> Tensor:
    return value[0] + (value[1] - value[0]) * u


def _direction(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=1)


def _floats(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _backgrounds(path: Path, name: str | None) -> list[Path]:
    if name is None:
        return []
    from torchpose.io.sources import find_sources

    return [source.path for source in find_sources([Path(beside(path, name))])]
