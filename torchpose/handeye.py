"""The hand-eye file: where the calibrated camera sits, on the robot's base or on its tool."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, model_validator
from torch import Tensor

from torchpose.config import format_list, read_yaml, validate, write_text
from torchpose.config.kinds import Number, RotationVector
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.covariance import covariance_fault
from torchpose.target import Vector

_ORTHONORMAL = 1e-6  # largest entry of R^T R - I that a file may have


class _Pose(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    rotation: RotationVector | None = None
    translation: Vector | None = None
    matrix: list[list[Number]] | None = None
    covariance: list[list[Number]] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> _Pose:
        vectors = self.rotation is not None and self.translation is not None
        if vectors == (self.matrix is not None) or (self.rotation is None) != (self.translation is None):
            raise ValueError("is not one pose; give rotation and translation, or matrix alone")
        if self.matrix is not None:
            _check_matrix(self.matrix)
        if self.covariance is not None:
            _check_covariance(self.covariance)
        return self


class _HandEyeFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    base_from_camera: _Pose | None = None
    tool_from_camera: _Pose | None = None

    @model_validator(mode="after")
    def _one_mount(self) -> _HandEyeFile:
        if (self.base_from_camera is None) == (self.tool_from_camera is None):
            raise ValueError("does not say where the camera is; give base_from_camera or tool_from_camera, one of them")
        return self


def _check_matrix(rows: list[list[float]]) -> None:
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise ValueError("matrix is not 4 x 4; give 4 rows of 4")
    if rows[3] != [0, 0, 0, 1]:
        raise ValueError(f"matrix has the last row {rows[3]}; write [0, 0, 0, 1]")
    r = torch.tensor(rows, dtype=torch.float64)[:3, :3]
    error = float((r.T @ r - torch.eye(3, dtype=r.dtype)).abs().max())
    if error > _ORTHONORMAL:
        raise ValueError(f"matrix has a rotation part off orthonormal by {error:.2g}; write more digits or correct it")
    if torch.linalg.det(r) < 0:
        raise ValueError("matrix is a reflection (determinant -1); give a right-handed rotation")


def _check_covariance(rows: list[list[float]]) -> None:
    if len(rows) != 6 or any(len(row) != 6 for row in rows):
        raise ValueError("covariance is not 6 x 6; give that of translation (mm), then rotation (rad)")
    c = torch.tensor(rows, dtype=torch.float64)
    if fault := covariance_fault(c):
        raise ValueError(f"covariance {fault}; give that of translation (mm), then rotation (rad)")


@dataclass(frozen=True, eq=False)
class HandEye:
    """Pose of the camera on the robot: X_mount = R X_cam + t.

    Attributes:
        mount: 'base' for a camera fixed in the cell, 'tool' for one carried by the robot.
        rotation: (3, 3) float64.
        translation: (3,) float64, mm.
        source: the file, for messages.
        covariance: (6, 6) float64 of the translation (mm), then the rotation w (rad) with R_true = exp(w) R, along and
            about the axes of the mount; None where it is not known.
    """

    mount: Literal["base", "tool"]
    rotation: Tensor
    translation: Tensor
    source: str = "hand-eye"
    covariance: Tensor | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> HandEye:
        """Reads a YAML or JSON file with one of the keys ``base_from_camera`` and ``tool_from_camera``.

        Either holds ``{rotation: [rx, ry, rz], translation: [x, y, z]}`` (rotation vector in rad, mm) or
        ``{matrix: ...}``, a 4 x 4 rigid transform in mm, whose rotation part is orthonormal to 1e-6; either may hold
        ``covariance``, 6 x 6.

        Raises:
            ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
        """
        source = os.fspath(path)
        data = validate(_HandEyeFile, read_yaml(source), source)
        pose = data.base_from_camera or data.tool_from_camera
        assert pose is not None  # checked by the model
        if pose.matrix is not None:
            m = torch.tensor(pose.matrix, dtype=torch.float64)
            u, _, vh = torch.linalg.svd(m[:3, :3])  # the nearest rotation: removes the rounding of the file
            rotation, translation = u @ vh, m[:3, 3]
        else:
            rotation = rotations.exp(torch.tensor(pose.rotation, dtype=torch.float64))
            translation = torch.tensor(pose.translation, dtype=torch.float64)
        spread = None if pose.covariance is None else torch.tensor(pose.covariance, dtype=torch.float64)
        return cls("base" if data.base_from_camera else "tool", rotation, translation, source, spread)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the hand-eye file in one piece.

        Raises:
            ConfigError: the folder does not exist or cannot be written.
        """
        text = (
            f"# pose of the camera: rotation vector in rad, translation in mm\n{self.mount}_from_camera:\n"
            f"  rotation: {format_list(rotations.log(self.rotation).tolist())}\n"
            f"  translation: {format_list(self.translation.tolist())}\n"
        )
        if self.covariance is not None:
            rows = "".join(f"    - {format_list(row)}\n" for row in self.covariance.tolist())
            text += f"  covariance:  # translation, mm^2, then rotation, rad^2\n{rows}"
        write_text(path, text)

    def base_from_camera(self, tool_poses: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """The transform from camera to robot base, for `Poses.seen_from`.

        Args:
            tool_poses: base_from_tool of N frames, R (N, 3, 3) and t (N, 3) in mm; not used for a camera on the base.

        Returns:
            R (3, 3), t (3,) for a camera on the base; R (N, 3, 3), t (N, 3) for one on the tool; mm.

        Raises:
            ConfigError: the camera is on the tool and no robot poses are given.
        """
        if self.mount == "base":
            return self.rotation, self.translation
        if tool_poses is None:
            raise ConfigError(
                f"{self.source}: tool_from_camera: needs the robot's pose at each frame; "
                "give a capture manifest with robot poses as INPUT, or calibrate base_from_camera"
            )
        r, t = tool_poses
        return rotations.compose(r, t, self.rotation.to(r), self.translation.to(t))

    def base_covariance(self, translation: Tensor, tool_poses: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """What the uncertainty of this calibration adds to poses in the robot base, (N, 6, 6); zero if not known.

        Args:
            translation: (N, 3) of the poses in the base, mm.
            tool_poses: as in `base_from_camera`.
        """
        jacobian = translation.new_zeros(len(translation), 6, 6)
        if self.covariance is None:
            return jacobian
        _, camera = self.base_from_camera(tool_poses)
        turn = tool_poses[0] if self.mount == "tool" and tool_poses else torch.eye(3).to(translation)
        jacobian[:, :3, :3] = jacobian[:, 3:, 3:] = turn
        # a turn w of the camera about itself takes what is ``arm`` away along
        jacobian[:, :3, 3:] = -rotations.skew(translation - camera) @ turn
        return jacobian @ self.covariance.to(translation) @ jacobian.mT
