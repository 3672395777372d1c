"""The rig file: robot and cameras of one cell."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    field_validator,
    model_validator,
)

from torchpose.config import example, read_yaml, validate
from torchpose.config.kinds import MOST_LENGTH, MOST_SIDE_PX, Length, Side, Word, check_turn
from torchpose.target import Vector

MAX_SPEED_MM_S = 250.0  # the reduced speed of ISO 10218-1, for work beside people
MAX_ACCELERATION_MM_S2 = 1200.0  # the default of the controller's own moves

MOST_CAMERAS = 64  # of a rig (convention)
SOFTWARE = "Software"  # GenICam's name of the source of a trigger that is a call
ACTION = ("ActionDeviceKey", "ActionGroupKey", "ActionGroupMask")  # GenICam's, which an action command is addressed by
Positive = Annotated[FiniteFloat, Field(gt=0, le=MOST_LENGTH)]
AS_TUPLE = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)  # files have lists
SixNumbers = Annotated[
    list[Length], Field(min_length=6, max_length=6), AfterValidator(lambda pose: [*pose[:3], *check_turn(pose[3:])])
]
"""A pose: position in mm, rotation vector in rad."""


class Strict(BaseModel):
    """A part of a file: unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Workspace(Strict):
    """Box in the robot base that the tool may not leave, mm. Convex: straight moves between its points stay inside."""

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _not_empty(self) -> Workspace:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                raise ValueError(f"is empty along {axis} ({low:g} to {high:g} mm); give min below max")
        return self

    def left_by(self, pose: Sequence[float], slack_mm: float = 0.0) -> tuple[str, float, float, float] | None:
        """The first axis along which a pose lies outside, its value and the limits, mm; None where it is inside."""
        for axis, value, low, high in zip("xyz", pose, self.min, self.max, strict=False):
            if not low - slack_mm <= value <= high + slack_mm:
                return axis, value, low, high
        return None


class Settle(Strict):
    """When a move has arrived: `samples` fresh samples in a row, all within the tolerances of the commanded pose."""

    samples: int = Field(default=10, ge=1, le=1000)
    tolerance_mm: Positive = 0.05
    tolerance_deg: Positive = 0.02
    timeout_s: Positive = 3.0


class RobotSettings(Strict):
    """The `robot:` part of a rig file."""

    host: Word  # name or address of the controller
    tcp: SixNumbers | None = None  # tool in the flange, mm and rotation vector in rad; None: as set at the pendant
    workspace: Workspace
    speed_mm_s: FiniteFloat = Field(
        default=50.0, gt=0, le=MAX_SPEED_MM_S
    )  # turns a tool that only rotates at 0.05 rad/s
    acceleration_mm_s2: FiniteFloat = Field(default=200.0, gt=0, le=MAX_ACCELERATION_MM_S2)
    settle: Settle = Settle()
    connect_timeout_s: Positive = 10.0  # for each step of connecting
    move_margin_s: Positive = 3.0  # what a move may take beyond its computed time
    frequency_hz: FiniteFloat = Field(
        default=125.0, ge=10, le=500
    )  # of the stream; divides the controller's 500 or 125 Hz


class CameraSettings(Strict):
    """One of the `cameras:` of a rig file."""

    name: str = Field(default="camera", pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=40)  # in image names
    serial: Word | None = None  # as printed on the camera; None takes the first that is free
    width: Side  # of the frame, px
    height: Side
    offset_x: int | None = Field(default=None, ge=0, le=MOST_SIDE_PX)  # of its corner on the sensor; None: the middle
    offset_y: int | None = Field(default=None, ge=0, le=MOST_SIDE_PX)
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono8"  # above 8: 16-bit images, values as given
    exposure_us: Positive  # fixed, and the gain: the automatic functions are switched off
    gain_db: FiniteFloat = Field(default=0.0, ge=-100, le=100)
    timeout_s: Positive = 5.0  # from trigger to image
    attempts: int = Field(default=3, ge=1, le=20)  # at one frame, before the session ends
    # further GenICam features, set in this order; `TriggerSource` says that a line, or an action command, triggers it
    # with others at once
    nodes: dict[str, bool | int | FiniteFloat | str] = {}

    @field_validator("serial", mode="before")
    @classmethod
    def _digits(cls, value: Any) -> Any:
        if isinstance(value, int):
            raise ValueError(f"is a number; write it in quotes: '{value}'")
        return value

    @model_validator(mode="after")
    def _exposure_ends(self) -> CameraSettings:
        if self.timeout_s <= 1e-6 * self.exposure_us:
            raise ValueError(f"has timeout_s {self.timeout_s:g} below the exposure; give more time")
        return self

    @model_validator(mode="after")
    def _action_is_addressed(self) -> CameraSettings:
        missing = [name for name in ACTION if not isinstance(self.nodes.get(name), int)]
        if self.waits_for == "action" and missing:
            raise ValueError(f"waits for an action command without {missing[0]} among its nodes; give it as a number")
        return self

    @property
    def waits_for(self) -> Literal["", "line", "action"]:
        """What triggers it but its own software trigger."""
        source = str(self.nodes.get("TriggerSource", SOFTWARE))
        return "" if source == SOFTWARE else "action" if source.startswith("Action") else "line"

    @property
    def bits(self) -> int:
        """Of a pixel."""
        return int(self.pixel_format.removeprefix("Mono"))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the images."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)


class Rig(Strict):
    """What a rig file holds."""

    robot: RobotSettings
    cameras: list[CameraSettings] = Field(min_length=1, max_length=MOST_CAMERAS)
    dwell_s: FiniteFloat = Field(default=0.2, ge=0, le=60)  # before the exposure, for vibrations to fade

    @field_validator("cameras")
    @classmethod
    def _told_apart(cls, value: list[CameraSettings]) -> list[CameraSettings]:
        for what, given in (("name", [c.name for c in value]), ("serial", [c.serial for c in value if c.serial])):
            twice = sorted({entry for entry in given if given.count(entry) > 1})
            if twice:
                raise ValueError(f"has the {what} {twice[0]!r} twice; give every camera its own")
        return value

    @field_validator("cameras")
    @classmethod
    def _triggered_by_one(cls, value: list[CameraSettings]) -> list[CameraSettings]:
        lines = [c.name for c in value if c.waits_for == "line"]
        if lines and all(c.waits_for for c in value):
            raise ValueError(
                f"wait for a line that none of them drives ({', '.join(lines)}); leave TriggerSource out of the nodes "
                "of the one whose output line triggers the others"
            )
        actions = [[c.nodes[name] for name in ACTION[:2]] for c in value if c.waits_for == "action"]
        if any(action != actions[0] for action in actions):
            raise ValueError(f"wait for different action commands; give all the same {' and '.join(ACTION[:2])}")
        return value


def load_rig(path: str | os.PathLike[str]) -> Rig:
    """Reads a rig file. Raises ConfigError: one line ``FILE: FIELD: what is wrong; the fix``."""
    path = example(path, "rig")
    return validate(Rig, read_yaml(path), path)
