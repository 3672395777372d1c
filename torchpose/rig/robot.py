"""A UR robot, driven through a child process so that no call can hang or crash the program that takes the pictures.

Lengths mm, angles rad, poses ``(x, y, z, rx, ry, rz)`` of the tool in the robot base with a rotation vector; the child
converts to the controller's metres. A protective stop is never unlocked here: a person looks at the robot first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import TracebackType
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from torchpose.errors import TorchposeError
from torchpose.target import Vector

MAX_SPEED_MM_S = 250.0  # what ISO 10218-1 allows beside people (reduced speed)
MAX_ACCELERATION_MM_S2 = 1200.0

_FROZEN = ConfigDict(extra="forbid", frozen=True)
_Positive = Annotated[FiniteFloat, Field(gt=0)]


class RobotReason(StrEnum):
    """Why the robot cannot go on; goes into the manifest and decides nothing but the words of the message."""

    UNREACHABLE = "unreachable"
    NOT_REMOTE = "not_remote"
    NOT_READY = "not_ready"
    REFUSED_SCRIPT = "refused_script"
    INVALID_POSE = "invalid_pose"
    OUTSIDE_WORKSPACE = "outside_workspace"
    PROTECTIVE_STOP = "protective_stop"
    EMERGENCY_STOP = "emergency_stop"
    TIMED_OUT = "timed_out"
    NOT_SETTLED = "not_settled"
    STALE_STREAM = "stale_stream"
    CONNECTION_LOST = "connection_lost"
    CHILD_DIED = "child_died"
    STOPPED = "stopped"


class RobotFault(TorchposeError):
    """The robot cannot go on. One line with the fix; `reason` is its name."""

    def __init__(self, reason: RobotReason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Workspace(BaseModel):
    """Box in the robot base that the tool may not leave, mm."""

    model_config = _FROZEN
    min: Vector
    max: Vector


class Settle(BaseModel):
    """When a move has arrived: `samples` fresh samples in a row, all within the tolerances of the commanded pose."""

    model_config = _FROZEN
    samples: Annotated[int, Field(ge=1, le=1000)] = 10
    tolerance_mm: _Positive = 0.05
    tolerance_deg: _Positive = 0.02
    timeout_s: _Positive = 3.0


class RobotSettings(BaseModel):
    """The `robot:` part of a rig file."""

    model_config = _FROZEN
    host: str
    tcp: Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)] | None = None
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
        robot_time_s: the controller's clock. host_time_s: this machine's clock (Unix time) when the sample was read.
        robot_mode, safety_mode, safety_bits, runtime_state: as the controller numbers them.
    """

    pose: tuple[float, float, float, float, float, float]
    joints: tuple[float, float, float, float, float, float]
    robot_time_s: float
    host_time_s: float
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int


class Robot:
    """Connection to one robot, for use in a ``with`` block."""

    def __init__(self, settings: RobotSettings) -> None:
        self.settings = settings

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def preflight(self) -> dict[str, Any]:
        """Looks at the robot before anything moves, and connects."""
        raise NotImplementedError

    def check(self, pose: Sequence[float]) -> tuple[float, ...]:
        """The pose as a tuple, or a `RobotFault` when it is not six finite numbers within the workspace."""
        raise NotImplementedError

    def read(self, fresh: int = 1) -> RobotReading:
        """A sample that is at least `fresh` samples younger than this call."""
        raise NotImplementedError

    def move(self, pose: Sequence[float]) -> RobotReading:
        """Moves the tool on a straight line and returns the last sample of the settled robot."""
        raise NotImplementedError

    def stop(self) -> None:
        """Stops the robot now; for a signal handler or another thread while `move` runs."""

    def close(self) -> None:
        """Stops the script, disconnects and ends the child; never hangs."""
