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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from torch import Tensor

from torchpose.config import example, read_yaml, validate
from torchpose.config.kinds import Degrees, Length, RotationVector, Seed, Text, Word
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.poses import Pose, as_pose, to_transform
from torchpose.rig.settings import SixNumbers, Strict, Workspace
from torchpose.target import RigidTransformFile

_AXES = {"x": 0, "y": 1, "z": 2, "pitch": 3, "yaw": 4, "roll": 5}  # places in a move
_F64 = torch.float64

MOST_WAYPOINTS = 20_000  # of a plan (convention): a day at four seconds each
_Range = Annotated[list[Length], Field(min_length=2, max_length=2)]
_Turns = Annotated[list[Degrees], Field(min_length=2, max_length=2)]
_Values = Annotated[list[Length], Field(min_length=1, max_length=MOST_WAYPOINTS)]
_Angles = Annotated[list[Degrees], Field(min_length=1, max_length=MOST_WAYPOINTS)]
_NONE = [0.0, 0.0]
_Count = Annotated[int, Field(ge=1, le=10000)]
# shifts in mm and rotation vectors in rad along the plan's axes; what the waypoints' labels say besides their kind
Moves = tuple[Float[Tensor, "N 6"], list[dict[str, Any]]]


class Static(Strict):
    """Frames at the origin, the robot at rest."""

    repeats: _Count

    def size(self) -> int:
        return self.repeats

    def moves(self) -> Moves:
        return torch.zeros(self.repeats, 6, dtype=_F64), [{"origin": True}] * self.repeats


class Translation(Strict):
    """The origin and moves away from it, axis by axis; ``repeats`` frames at each pose."""

    axes: list[Literal["x", "y", "z"]] = Field(default=["x", "y", "z"], min_length=1, max_length=3)
    values_mm: _Values
    repeats: _Count = 1

    def size(self) -> int:
        return len(self.axes) * (1 + len(self.values_mm)) * self.repeats

    def moves(self) -> Moves:
        return _sweep(self.axes, self.values_mm, self.repeats)


class Rotation(Strict):
    """The origin and turns there, axis by axis; ``repeats`` frames at each pose."""

    axes: list[Literal["roll", "pitch", "yaw"]] = Field(default=["roll", "pitch", "yaw"], min_length=1, max_length=3)
    values_deg: _Angles
    repeats: _Count = 1

    def size(self) -> int:
        return len(self.axes) * (1 + len(self.values_deg)) * self.repeats

    def moves(self) -> Moves:
        return _sweep(self.axes, self.values_deg, self.repeats)


def _sweep(axes: Sequence[str], values: Sequence[float], repeats: int) -> Moves:
    # the origin comes first, and once
    places = [(axis, value) for axis in axes for value in (0.0, *(v for v in values if v != 0)) for _ in range(repeats)]
    moves = torch.zeros(len(places), 6, dtype=_F64)
    lengths = [value if axis in "xyz" else math.radians(value) for axis, value in places]
    moves[torch.arange(len(places)), [_AXES[axis] for axis, _ in places]] = torch.tensor(lengths, dtype=_F64)
    return moves, [{"axis": axis, "value": value, "origin": value == 0} for axis, value in places]


class Spread(Strict):
    """Poses that cover the given ranges around the origin evenly (scrambled Sobol points), tilted in all directions."""

    count: _Count
    x_mm: _Range = _NONE
    y_mm: _Range = _NONE
    z_mm: _Range = _NONE
    tilt_deg: _Turns = _NONE
    roll_deg: _Turns = _NONE
    seed: Seed = 0

    @field_validator("x_mm", "y_mm", "z_mm", "tilt_deg", "roll_deg")
    @classmethod
    def _ordered(cls, value: list[float]) -> list[float]:
        if value[0] > value[1]:
            raise ValueError(f"has the limits {value[0]:g} > {value[1]:g}; swap them")
        return value

    def size(self) -> int:
        return self.count

    def moves(self) -> Moves:
        engine = torch.quasirandom.SobolEngine(6, scramble=True, seed=self.seed)
        ranges = torch.tensor([self.x_mm, self.y_mm, self.z_mm, self.tilt_deg, self.roll_deg], dtype=_F64)
        low, high = ranges.unbind(1)
        points = engine.draw(self.count, dtype=_F64)
        *shift, tilt, roll = (low + (high - low) * points[:, :5]).unbind(1)
        azimuth, tilt, zero = 2 * math.pi * points[:, 5], tilt.deg2rad(), torch.zeros_like(tilt)
        lean = torch.stack([tilt * azimuth.cos(), tilt * azimuth.sin(), zero], -1)
        spin = torch.stack([zero, zero, roll.deg2rad()], -1)
        turn = rotations.log(rotations.exp(lean) @ rotations.exp(spin))
        return torch.cat([torch.stack(shift, -1), turn], -1), [{}] * self.count


class Step(Strict):
    """One of the kinds. ``poses`` are tool poses in the base, six numbers each, whatever the origin."""

    static: Static | None = None
    translation: Translation | None = None
    rotation: Rotation | None = None
    handeye: Spread | None = None
    calibration: Spread | None = None
    poses: Annotated[list[SixNumbers], Field(min_length=1, max_length=MOST_WAYPOINTS)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Step:
        kinds = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(kinds) != 1 or len(self.model_fields_set) != 1:
            known = ", ".join(type(self).model_fields)
            raise ValueError(f"holds {len(self.model_fields_set)} kinds; write one entry for each of {known}")
        return self

    @property
    def kind(self) -> str:
        """Name of the one that it is."""
        return next(iter(self.model_fields_set))

    def size(self) -> int:
        """Number of its waypoints, or a little more."""
        return len(self.poses) if self.poses is not None else int(getattr(self, self.kind).size())


class PlanFile(Strict):
    """A capture plan, see docs/rig.md."""

    name: Word
    origin: RigidTransformFile
    axes: Literal["tool", "base"] | RotationVector = "tool"
    steps: list[Step] = Field(min_length=1)

    @field_validator("steps")
    @classmethod
    def _few_enough(cls, steps: list[Step]) -> list[Step]:
        if (count := sum(step.size() for step in steps)) > MOST_WAYPOINTS:
            raise ValueError(f"has {count} waypoints; give at most {MOST_WAYPOINTS}, the rest in another plan")
        return steps


class Label(BaseModel):
    """What a frame is for; part of its record in the manifest."""

    model_config = ConfigDict(frozen=True)
    id: Text = ""  # of the waypoint, in frame ids and image names
    kind: Text  # static, translation, rotation, handeye, calibration or pose
    axis: Text | None = None  # x, y, z, roll, pitch or yaw of a translation or rotation
    value: Length = 0.0  # along or about the axis, mm or deg
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
        """SHA-256 of all waypoints: the same for the same poses to 1e-9, however the file is laid out and computed."""
        rows = [
            [w.id, *(round(number, 9) + 0.0 for number in w.pose), w.kind, w.axis, w.value, w.origin]
            for w in self.waypoints
        ]
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
                axis, value, low, high = left
                problem = f"waypoint {waypoint} has {axis} = {value:.1f} mm, outside of the workspace"
                fix = f"[{low:g}, {high:g}]; change the plan, or the rig's robot.workspace if it is safe"
                raise ConfigError(f"{self.path}: steps: {problem} {fix}")


def load_plan(path: str | os.PathLike[str]) -> CapturePlan:
    """Reads a capture plan and expands it. Raises ConfigError: one line ``FILE: FIELD: what is wrong; the fix``."""
    path = example(path, "rig")
    file = validate(PlanFile, read_yaml(path), path)
    origin = as_pose([*file.origin.translation, *file.origin.rotation])
    R, t = to_transform(origin)
    if file.axes == "base":
        axes = torch.eye(3, dtype=_F64)
    else:
        axes = R if file.axes == "tool" else rotations.exp(torch.tensor(file.axes, dtype=_F64))
    waypoints: list[Waypoint] = []
    for step in file.steps:
        for given in step.poses or ():
            waypoints.append(Waypoint(id=f"{len(waypoints):04d}", pose=as_pose(given), kind="pose"))
        if step.poses is None:
            moves, labels = getattr(step, step.kind).moves()
            # along and about the axes (columns in the base), about the tool's point
            turn = rotations.log(axes @ rotations.exp(moves[:, 3:]) @ axes.mT @ R)
            poses = torch.cat([t + moves[:, :3] @ axes.mT, turn], 1).tolist()
            for pose, label in zip(poses, labels, strict=True):
                identity = f"{len(waypoints):04d}"
                waypoints.append(Waypoint(id=identity, pose=as_pose(pose), kind=step.kind, **label))
    return CapturePlan(file.name, os.fspath(path), origin, tuple(waypoints))
