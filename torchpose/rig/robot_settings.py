"""What is said about a robot: its settings in a rig file, and one reading of its stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from torchpose.target import Vector

MAX_SPEED_MM_S = 250.0  # the reduced speed of ISO 10218-1, for work beside people
MAX_ACCELERATION_MM_S2 = 1200.0  # the default of the controller's own moves

_FROZEN = ConfigDict(extra="forbid", frozen=True)
_Positive = Annotated[FiniteFloat, Field(gt=0)]
SixNumbers = Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]
Pose = tuple[float, float, float, float, float, float]


class Workspace(BaseModel):
    """Box in the robot base that the tool may not leave, mm. Convex: straight moves between its points stay inside."""

    model_config = _FROZEN
    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _not_empty(self) -> Workspace:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                raise ValueError(f"is empty along {axis} ({low:g} to {high:g} mm); give min below max")
        return self


class Settle(BaseModel):
    """When a move has arrived: `samples` fresh samples in a row, all within the tolerances of the commanded pose."""

    model_config = _FROZEN
    samples: Annotated[int, Field(ge=1, le=1000)] = 10
    tolerance_mm: _Positive = 0.05
    tolerance_deg: _Positive = 0.02
    timeout_s: _Positive = 3.0


class RobotSettings(BaseModel):
    """The `robot:` part of a rig file.

    Attributes:
        host: name or address of the controller. tcp: tool in the flange, mm and rotation vector in rad; the one that is
            set at the pendant where it is left out.
        speed_mm_s, acceleration_mm_s2: of every move; 50 mm/s turns a tool that only rotates at 0.05 rad/s.
        connect_timeout_s: for each step of connecting. move_margin_s: what a move may take beyond its computed time.
        frequency_hz: of the stream; the controller divides 500 Hz (e-Series) or 125 Hz (CB3).
    """

    model_config = _FROZEN
    host: Annotated[str, Field(min_length=1)]
    tcp: SixNumbers | None = None
    workspace: Workspace
    speed_mm_s: Annotated[FiniteFloat, Field(gt=0, le=MAX_SPEED_MM_S)] = 50.0
    acceleration_mm_s2: Annotated[FiniteFloat, Field(gt=0, le=MAX_ACCELERATION_MM_S2)] = 200.0
    settle: Settle = Settle()
    connect_timeout_s: _Positive = 10.0
    move_margin_s: _Positive = 3.0
    frequency_hz: Annotated[FiniteFloat, Field(ge=10, le=500)] = 125.0


@dataclass(frozen=True)
class RobotReading:
    """One sample of the controller's stream.

    Attributes:
        pose: tool in the base, mm and rotation vector in rad. joints: rad.
        robot_time_s: the controller's clock. host_time_s: this computer's clock (Unix time) when the sample came in.
        robot_mode, safety_mode, safety_bits, runtime_state: as the controller numbers them (RTDE guide).
    """

    pose: Pose
    joints: Pose
    robot_time_s: float
    host_time_s: float
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int
