"""The rig file: robot and cameras of one cell."""

from __future__ import annotations

import os
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from torchpose.config import read_yaml, validate
from torchpose.rig.camera import CameraSettings
from torchpose.rig.robot_settings import RobotSettings


class Rig(BaseModel):
    """What a rig file holds.

    Attributes:
        robot, cameras: see there. dwell_s: wait between the settled move and the exposure, for vibrations to fade.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    robot: RobotSettings
    cameras: Annotated[list[CameraSettings], Field(min_length=1)]
    dwell_s: Annotated[FiniteFloat, Field(ge=0, le=60)] = 0.2

    @field_validator("cameras")
    @classmethod
    def _told_apart(cls, value: list[CameraSettings]) -> list[CameraSettings]:
        for what, given in (("name", [c.name for c in value]), ("serial", [c.serial for c in value if c.serial])):
            twice = sorted({entry for entry in given if given.count(entry) > 1})
            if twice:
                raise ValueError(f"has the {what} {twice[0]!r} twice; give every camera its own")
        return value


def load_rig(path: str | os.PathLike[str]) -> Rig:
    """Reads a rig file.

    Raises:
        ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
    """
    return validate(Rig, read_yaml(path), path)
