"""Capture plans: at which poses of the tool the frames are taken, from a few lines of YAML.

Moves and turns are relative to the plan's origin, along and about three axes through the tool: those of the tool at
the origin, those of the base, or given ones. Roll is about z, pitch about x, yaw about y.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator
from torch import Tensor

from torchpose.config import read_yaml, validate
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.robot_settings import Pose, Workspace
from torchpose.target import RigidTransformFile, Vector

_FROZEN = ConfigDict(extra="forbid", frozen=True)
_AXES = {"x": 0, "y": 1, "z": 2, "pitch": 0, "yaw": 1, "roll": 2}

_Numbers = Annotated[list[FiniteFloat], Field(min_length=1)]
_Range = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
_Count = Annotated[int, Field(ge=1, le=10000)]


class Static(BaseModel):
    """Frames at the origin, the robot at rest."""

    model_config = _FROZEN
    repeats: _Count


class Translation(BaseModel):
    """The origin and moves away from it, axis by axis; ``repeats`` frames at each pose."""

    model_config = _FROZEN
    axes: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)] = ["x", "y", "z"]
    values_mm: _Numbers
    repeats: _Count = 1


class Rotation(BaseModel):
    """The origin and turns there, axis by axis; ``repeats`` frames at each pose."""

    model_config = _FROZEN
    axes: Annotated[list[Literal["roll", "pitch", "yaw"]], Field(min_length=1)] = ["roll", "pitch", "yaw"]
    values_deg: _Numbers
    repeats: _Count = 1


class Spread(BaseModel):
    """Poses that cover the given ranges around the origin evenly (scrambled Sobol points), tilted in all directions."""

    model_config = _FROZEN
    count: _Count
    x_mm: _Range = [0.0, 0.0]
    y_mm: _Range = [0.0, 0.0]
    z_mm: _Range = [0.0, 0.0]
    tilt_deg: _Range = [0.0, 0.0]
    roll_deg: _Range = [0.0, 0.0]
    seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("x_mm", "y_mm", "z_mm", "tilt_deg", "roll_deg")
    @classmethod
    def _ordered(cls, value: list[float]) -> list[float]:
        if value[0] > value[1]:
            raise ValueError(f"has the limits {value[0]:g} > {value[1]:g}; swap them")
        return value


class Step(BaseModel):
    """One of the kinds. ``poses`` are tool poses in the base, six numbers each, whatever the origin."""

    model_config = _FROZEN
    static: Static | None = None
    translation: Translation | None = None
    rotation: Rotation | None = None
    handeye: Spread | None = None
    calibration: Spread | None = None
    poses: list[Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]] | None = None

    @model_validator(mode="after")
    def _one(self) -> Step:
        if len(self.model_fields_set) != 1:
            kinds = ", ".join(type(self).model_fields)
            raise ValueError(f"holds {len(self.model_fields_set)} kinds; write one entry for each of {kinds}")
        return self


class PlanFile(BaseModel):
    """A capture plan, see docs/rig.md."""

    model_config = _FROZEN
    name: str
    origin: RigidTransformFile
    axes: Literal["tool", "base"] | Vector = "tool"
    steps: Annotated[list[Step], Field(min_length=1)]


@dataclass(frozen=True)
class Waypoint:
    """One frame (of every camera) of a plan.

    Attributes:
        id: in frame ids and image names. pose: of the tool in the base.
        kind: static, translation, rotation, handeye, calibration or pose.
        axis: x, y, z, roll, pitch or yaw of a translation or rotation, else None. value: along or about it, mm or deg.
        origin: whether it is the reference of its axis, or a static frame.
    """

    id: str
    pose: Pose
    kind: str
    axis: str | None = None
    value: float = 0.0
    origin: bool = False

    @property
    def label(self) -> str:
        """In words, for messages."""
        unit = "" if self.axis is None else f" {self.axis} {self.value:g} {'mm' if self.axis in 'xyz' else 'deg'}"
        return f"{self.id} ({self.kind}{unit})"


@dataclass(frozen=True)
class CapturePlan:
    """A plan that has been read: its waypoints in the order of capture, of which the first is where the tool starts."""

    name: str
    path: str
    origin: Pose
    waypoints: tuple[Waypoint, ...]

    @property
    def digest(self) -> str:
        """SHA-256 of all waypoints: the same for the same poses, however the file is laid out."""
        rows = [[w.id, *w.pose, w.kind, w.axis, w.value, w.origin] for w in self.waypoints]
        return hashlib.sha256(json.dumps(rows).encode()).hexdigest()

    def positions(self) -> Tensor:
        """(N, 3) mm."""
        return torch.tensor([w.pose[:3] for w in self.waypoints], dtype=torch.float64)

    def turns(self) -> Tensor:
        """(N,) angles in rad from the origin."""
        vectors = torch.tensor([w.pose[3:] for w in self.waypoints], dtype=torch.float64)
        return rotations.angle_between(rotations.exp(vectors), rotations.exp(vectors.new_tensor(self.origin[3:])))

    def summary(self, workspace: Workspace) -> list[str]:
        """Lines about its size: waypoints by kind, bounds beside the workspace, angles, length."""
        positions, turns = self.positions(), self.turns().rad2deg()
        low, high = positions.amin(0).tolist(), positions.amax(0).tolist()
        steps = positions.diff(dim=0).norm(dim=1)
        kinds = Counter(waypoint.kind for waypoint in self.waypoints)
        lines = ["  " + ", ".join(f"{kind} {count}" for kind, count in kinds.items())]
        for name, *numbers in zip("xyz", low, high, workspace.min, workspace.max, strict=True):
            lines.append("  {}: {:.1f} to {:.1f} mm in the base, workspace {:g} to {:g}".format(name, *numbers))
        lines.append(f"  turns up to {float(turns.max()):.1f} deg from the origin")
        longest = float(steps.max()) if len(steps) else 0.0
        lines.append(f"  path {float(steps.sum()):.0f} mm, longest move {longest:.1f} mm")
        return lines

    def check(self, workspace: Workspace) -> None:
        """Raises ConfigError where a waypoint lies outside of the box; straight moves between others stay inside."""
        for waypoint in self.waypoints:
            for name, value, low, high in zip("xyz", waypoint.pose[:3], workspace.min, workspace.max, strict=True):
                if not low <= value <= high:
                    raise ConfigError(
                        f"{self.path}: steps: waypoint {waypoint.label} has {name} = {value:.1f} mm, outside of the "
                        f"workspace [{low:g}, {high:g}]; change the plan, or the rig's robot.workspace if it is safe"
                    )


def load_plan(path: str | os.PathLike[str]) -> CapturePlan:
    """Reads a capture plan and expands it.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
    """
    file = validate(PlanFile, read_yaml(path), path)
    (x, y, z), (rx, ry, rz) = file.origin.translation, file.origin.rotation
    rotation = rotations.exp(torch.tensor(file.origin.rotation, dtype=torch.float64))
    if file.axes == "tool":
        axes = rotation
    elif file.axes == "base":
        axes = torch.eye(3, dtype=torch.float64)
    else:
        axes = rotations.exp(torch.tensor(file.axes, dtype=torch.float64))
    start = (rotation, torch.tensor(file.origin.translation, dtype=torch.float64))
    waypoints: list[Waypoint] = []
    for step in file.steps:
        for pose, labels in _expand(step, start, axes):
            waypoints.append(Waypoint(id=f"{len(waypoints):04d}", pose=pose, **labels))
    return CapturePlan(file.name, os.fspath(path), (x, y, z, rx, ry, rz), tuple(waypoints))


def _expand(step: Step, start: tuple[Tensor, Tensor], axes: Tensor) -> Iterator[tuple[Pose, dict[str, Any]]]:
    """Poses and labels of one step."""
    still = torch.zeros(3, dtype=torch.float64)
    if step.static is not None:
        for _ in range(step.static.repeats):
            yield _moved(start, axes, still, still), {"kind": "static", "origin": True}
    elif (sweep := step.translation or step.rotation) is not None:
        kind = "rotation" if step.translation is None else "translation"
        values = sweep.values_mm if isinstance(sweep, Translation) else sweep.values_deg
        for axis in sweep.axes:
            for value in [0.0, *(v for v in values if v != 0)]:  # the origin comes first, and once
                along = value * torch.eye(3, dtype=torch.float64)[_AXES[axis]]
                move = (along, still) if kind == "translation" else (still, along.deg2rad())
                labels = {"kind": kind, "axis": axis, "value": value, "origin": value == 0}
                for _ in range(sweep.repeats):
                    yield _moved(start, axes, *move), labels
    elif (spread := step.handeye or step.calibration) is not None:
        for shift, turn in _spread(spread):
            yield _moved(start, axes, shift, turn), {"kind": "handeye" if step.handeye else "calibration"}
    else:
        for given in step.poses or []:
            x, y, z, rx, ry, rz = given
            yield (x, y, z, rx, ry, rz), {"kind": "pose"}


def _spread(spread: Spread) -> Iterator[tuple[Tensor, Tensor]]:
    """Shifts (3,) in mm and rotation vectors (3,) in rad along the plan's axes."""
    engine = torch.quasirandom.SobolEngine(6, scramble=True, seed=spread.seed)
    for u in engine.draw(spread.count, dtype=torch.float64):
        ranges = (spread.x_mm, spread.y_mm, spread.z_mm, spread.tilt_deg, spread.roll_deg)
        x, y, z, tilt, roll = (low + (high - low) * float(p) for (low, high), p in zip(ranges, u, strict=False))
        azimuth = 2 * math.pi * float(u[5])
        lean = math.radians(tilt) * torch.tensor([math.cos(azimuth), math.sin(azimuth), 0], dtype=torch.float64)
        spin = torch.tensor([0, 0, math.radians(roll)], dtype=torch.float64)
        yield torch.tensor([x, y, z], dtype=torch.float64), rotations.log(rotations.exp(lean) @ rotations.exp(spin))


def _moved(start: tuple[Tensor, Tensor], axes: Tensor, shift: Tensor, turn: Tensor) -> Pose:
    """The start shifted along and turned about the axes (columns in the base), about the tool's point."""
    rotation = axes @ rotations.exp(turn) @ axes.mT @ start[0]
    x, y, z = (start[1] + axes @ shift).tolist()
    rx, ry, rz = rotations.log(rotation).tolist()
    return x, y, z, rx, ry, rz
