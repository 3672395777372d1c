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
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator
from torch import Tensor

from torchpose.config import read_yaml, validate
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.poses import Pose, as_pose, from_transform, to_transform
from torchpose.rig.settings import SixNumbers, Strict, Workspace
from torchpose.target import RigidTransformFile, Vector

_AXES = {"x": 0, "y": 1, "z": 2, "pitch": 3, "yaw": 4, "roll": 5}  # places in a shift (mm) and rotation vector (rad)

_Range = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
_Count = Annotated[int, Field(ge=1, le=10000)]
_NONE = [0.0, 0.0]


class Static(Strict):
    """Frames at the origin, the robot at rest."""

    repeats: _Count


class Translation(Strict):
    """The origin and moves away from it, axis by axis; ``repeats`` frames at each pose."""

    axes: list[Literal["x", "y", "z"]] = Field(default=["x", "y", "z"], min_length=1)
    values_mm: list[FiniteFloat] = Field(min_length=1)
    repeats: _Count = 1


class Rotation(Strict):
    """The origin and turns there, axis by axis; ``repeats`` frames at each pose."""

    axes: list[Literal["roll", "pitch", "yaw"]] = Field(default=["roll", "pitch", "yaw"], min_length=1)
    values_deg: list[FiniteFloat] = Field(min_length=1)
    repeats: _Count = 1


class Spread(Strict):
    """Poses that cover the given ranges around the origin evenly (scrambled Sobol points), tilted in all directions."""

    count: _Count
    x_mm: _Range = _NONE
    y_mm: _Range = _NONE
    z_mm: _Range = _NONE
    tilt_deg: _Range = _NONE
    roll_deg: _Range = _NONE
    seed: int = Field(default=0, ge=0)

    @field_validator("x_mm", "y_mm", "z_mm", "tilt_deg", "roll_deg")
    @classmethod
    def _ordered(cls, value: list[float]) -> list[float]:
        if value[0] > value[1]:
            raise ValueError(f"has the limits {value[0]:g} > {value[1]:g}; swap them")
        return value


class Step(Strict):
    """One of the kinds. ``poses`` are tool poses in the base, six numbers each, whatever the origin."""

    static: Static | None = None
    translation: Translation | None = None
    rotation: Rotation | None = None
    handeye: Spread | None = None
    calibration: Spread | None = None
    poses: list[SixNumbers] | None = None

    @model_validator(mode="after")
    def _one(self) -> Step:
        if len(self.model_fields_set) != 1:
            kinds = ", ".join(type(self).model_fields)
            raise ValueError(f"holds {len(self.model_fields_set)} kinds; write one entry for each of {kinds}")
        return self


class PlanFile(Strict):
    """A capture plan, see docs/rig.md."""

    name: str
    origin: RigidTransformFile
    axes: Literal["tool", "base"] | Vector = "tool"
    steps: list[Step] = Field(min_length=1)


class Label(BaseModel):
    """What a frame is for; part of its record in the manifest."""

    model_config = ConfigDict(frozen=True)
    id: str = ""  # of the waypoint, in frame ids and image names
    kind: str  # static, translation, rotation, handeye, calibration or pose
    axis: str | None = None  # x, y, z, roll, pitch or yaw of a translation or rotation
    value: float = 0.0  # along or about the axis, mm or deg
    origin: bool = False  # the reference of its axis, or a static frame


class Waypoint(Label):
    """One frame (of every camera) of a plan; `pose` is that of the tool in the base."""

    pose: Pose

    def __str__(self) -> str:
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

    def positions(self) -> Float[Tensor, "N 3"]:
        """Of the tool, mm."""
        return to_transform([waypoint.pose for waypoint in self.waypoints])[1]

    def turns(self) -> Float[Tensor, " N"]:
        """Angles in rad from the origin."""
        R, _ = to_transform([self.origin, *(waypoint.pose for waypoint in self.waypoints)])
        return rotations.angle_between(R[1:], R[0])

    def summary(self, workspace: Workspace) -> list[str]:
        """Lines about its size: waypoints by kind, bounds beside the workspace, angles, length."""
        positions, turns = self.positions(), self.turns().rad2deg()
        low, high = positions.amin(0).tolist(), positions.amax(0).tolist()
        moves = [0.0, *positions.diff(dim=0).norm(dim=1).tolist()]
        kinds = Counter(waypoint.kind for waypoint in self.waypoints)
        lines = ["  " + ", ".join(f"{kind} {count}" for kind, count in kinds.items())]
        for name, *numbers in zip("xyz", low, high, workspace.min, workspace.max, strict=True):
            lines.append("  {}: {:.1f} to {:.1f} mm in the base, workspace {:g} to {:g}".format(name, *numbers))
        lines.append(f"  turns up to {float(turns.max()):.1f} deg from the origin")
        lines.append(f"  path {sum(moves):.0f} mm, longest move {max(moves):.1f} mm")
        return lines

    def check(self, workspace: Workspace) -> None:
        """Raises ConfigError where a waypoint lies outside of the box; straight moves between others stay inside."""
        for waypoint in self.waypoints:
            if left := workspace.left_by(waypoint.pose):
                name, value, low, high = left
                raise ConfigError(
                    f"{self.path}: steps: waypoint {waypoint} has {name} = {value:.1f} mm, outside of the "
                    f"workspace [{low:g}, {high:g}]; change the plan, or the rig's robot.workspace if it is safe"
                )


def load_plan(path: str | os.PathLike[str]) -> CapturePlan:
    """Reads a capture plan and expands it. Raises ConfigError: one line ``FILE: FIELD: what is wrong; the fix``."""
    file = validate(PlanFile, read_yaml(path), path)
    origin = as_pose([*file.origin.translation, *file.origin.rotation])
    R, t = to_transform(origin)
    if file.axes == "base":
        axes = torch.eye(3, dtype=torch.float64)
    else:
        axes = R if file.axes == "tool" else rotations.exp(torch.tensor(file.axes, dtype=torch.float64))
    waypoints: list[Waypoint] = []
    for step in file.steps:
        for given in step.poses or ():
            waypoints.append(Waypoint(id=f"{len(waypoints):04d}", pose=as_pose(given), kind="pose"))
        for move, label in _expand(step):
            # along and about the axes (columns in the base), about the tool's point
            pose = from_transform(axes @ rotations.exp(move[3:]) @ axes.mT @ R, t + axes @ move[:3])
            waypoints.append(Waypoint(id=f"{len(waypoints):04d}", pose=pose, **label))
    return CapturePlan(file.name, os.fspath(path), origin, tuple(waypoints))


def _expand(step: Step) -> Iterator[tuple[Float[Tensor, " 6"], dict[str, Any]]]:
    """Shifts in mm with rotation vectors in rad along the plan's axes, and labels, of one step."""
    still = torch.zeros(6, dtype=torch.float64)
    if step.static is not None:
        for _ in range(step.static.repeats):
            yield still, {"kind": "static", "origin": True}
    for kind, sweep in (("translation", step.translation), ("rotation", step.rotation)):
        if sweep is not None:
            values = sweep.values_mm if isinstance(sweep, Translation) else sweep.values_deg
            for axis in sweep.axes:
                for value in [0.0, *(v for v in values if v != 0)]:  # the origin comes first, and once
                    move = still.clone()
                    move[_AXES[axis]] = value if kind == "translation" else math.radians(value)
                    for _ in range(sweep.repeats):
                        yield move, {"kind": kind, "axis": axis, "value": value, "origin": value == 0}
    for kind, spread in (("handeye", step.handeye), ("calibration", step.calibration)):
        if spread is not None:
            yield from ((move, {"kind": kind}) for move in _spread(spread))


def _spread(spread: Spread) -> Iterator[Float[Tensor, " 6"]]:
    """Shifts and turns that cover the ranges."""
    engine = torch.quasirandom.SobolEngine(6, scramble=True, seed=spread.seed)
    ranges = (spread.x_mm, spread.y_mm, spread.z_mm, spread.tilt_deg, spread.roll_deg)
    for *points, around in engine.draw(spread.count, dtype=torch.float64).tolist():
        x, y, z, tilt, roll = (low + (high - low) * p for (low, high), p in zip(ranges, points, strict=True))
        azimuth, tilt = 2 * math.pi * around, math.radians(tilt)
        lean = torch.tensor([tilt * math.cos(azimuth), tilt * math.sin(azimuth), 0], dtype=torch.float64)
        spin = torch.tensor([0, 0, math.radians(roll)], dtype=torch.float64)
        turn = rotations.log(rotations.exp(lean) @ rotations.exp(spin))
        yield torch.cat([torch.tensor([x, y, z], dtype=torch.float64), turn])
