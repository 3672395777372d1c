"""The records of a capture session's manifest, as they are written and read back; docs/rig.md describes them."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from torchpose.config.kinds import Side, Text, Word
from torchpose.rig.plan import Label
from torchpose.rig.poses import Pose
from torchpose.rig.robot import RobotReading


class SessionRecord(BaseModel):
    """A session begins, or goes on: with what, and whether any part of the rig is emulated."""

    model_config = ConfigDict(extra="allow")
    record: Literal["session"] = "session"
    version: Literal["torchpose.capture/1"] = Field(default="torchpose.capture/1", alias="schema")
    started: str
    units: dict[str, str] = {"length": "mm", "angle": "rad", "time": "s"}
    plan_digest: str  # of the waypoints
    images: dict[str, list[int | str]]  # width, height and pixel format by camera
    emulated: bool
    resumed: bool
    versions: dict[str, str | None]
    plan: str  # its name
    waypoints: int  # how many it has
    robot: dict[str, Any]  # what it says of itself, as the cameras do, their settings read back
    cameras: list[dict[str, Any]]


class FrameRecord(BaseModel):
    """An image that is there, where the robot stood and when the camera exposed."""

    record: Literal["frame"] = "frame"
    id: Word
    image: Word
    sha256: Word
    width: Side
    height: Side
    camera: Text
    waypoint: Label
    commanded_pose: Pose
    robot_pose: Pose  # the middle of the readings before and after the exposure
    before: RobotReading
    after: RobotReading
    trigger_time_s: float  # Unix time of this machine
    camera_time: int  # the camera's own counter
    attempts: int  # how many it took
    failures: list[str]  # why the earlier ones failed


class EndRecord(BaseModel):
    """A session has ended, with how many frames and why."""

    record: Literal["end"] = "end"
    frames: int
    reason: str
    detail: str
    ended: str
