"""The records of a capture session's manifest, as they are written and read back; docs/rig.md describes them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from torchpose.rig.plan import Label
from torchpose.rig.poses import Pose
from torchpose.rig.robot import RobotReading


class SessionRecord(BaseModel):
    """A session begins, or goes on: with what, and whether any part of the rig is emulated.

    Attributes:
        plan_digest: of the waypoints.
        images: width, height and pixel format by camera.
        plan, waypoints: name of the plan and number of its waypoints.
        robot, cameras: what they say of themselves, settings read back.
    """

    model_config = ConfigDict(extra="allow")
    record: Literal["session"] = "session"
    version: Literal["torchpose.capture/1"] = Field("torchpose.capture/1", alias="schema")
    started: str
    units: dict[str, str] = {"length": "mm", "angle": "rad", "time": "s"}
    plan_digest: str
    images: dict[str, list[int | str]]
    emulated: bool
    resumed: bool
    versions: dict[str, str | None]
    plan: str
    waypoints: int
    robot: dict[str, Any]
    cameras: list[dict[str, Any]]


class FrameRecord(BaseModel):
    """An image that is there, where the robot stood and when the camera exposed.

    Attributes:
        robot_pose: the middle of the readings before and after the exposure.
        trigger_time_s: Unix time of this machine; camera_time is the camera's own counter.
        attempts, failures: how many it took, and why the earlier ones failed.
    """

    record: Literal["frame"] = "frame"
    id: str
    image: str
    sha256: str
    width: int
    height: int
    camera: str
    waypoint: Label
    commanded_pose: Pose
    robot_pose: Pose
    before: RobotReading
    after: RobotReading
    trigger_time_s: float
    camera_time: int
    attempts: int
    failures: list[str]


class EndRecord(BaseModel):
    """A session has ended, with how many frames and why."""

    record: Literal["end"] = "end"
    frames: int
    reason: str
    detail: str
    ended: str
