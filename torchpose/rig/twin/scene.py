"""The whole rig emulated: the controller's twin, and cameras that see a rendered target at its true pose.

The twin file says what the real cell would hide: where cameras and target really are, the lens as it really is, the
noise. Before every exposure the frame of the controller's true pose is rendered and laid before pypylon's emulator.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import cv2
import torch
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator
from torch import Tensor

from torchpose.camera import Camera
from torchpose.config import beside, read_yaml, validate
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.settings import Rig
from torchpose.rig.twin.controller import TwinController, TwinErrors
from torchpose.sim import add_noise, render
from torchpose.target import RigidTransformFile, Target

_FROZEN = ConfigDict(extra="forbid", frozen=True)
_Positive = Annotated[FiniteFloat, Field(gt=0)]
_Grey = Annotated[FiniteFloat, Field(ge=0, le=255)]


class TwinCamera(BaseModel):
    """What one camera of the rig really is, and where.

    Attributes:
        name: as in the rig file. camera: its camera file. focal_scale: the true focal length over that of the file.
        base_from_camera, tool_from_camera: where it is, one of both.
    """

    model_config = _FROZEN
    name: str = "camera"
    camera: str
    focal_scale: _Positive = 1.0
    base_from_camera: RigidTransformFile | None = None
    tool_from_camera: RigidTransformFile | None = None

    @model_validator(mode="after")
    def _one_place(self) -> TwinCamera:
        if (self.base_from_camera is None) == (self.tool_from_camera is None):
            raise ValueError("does not say where it is; give base_from_camera or tool_from_camera, one of both")
        return self


class TwinImaging(BaseModel):
    """Blur, grey levels and noise, see `torchpose.sim.render` and `torchpose.sim.add_noise`; levels of 0 to 255."""

    model_config = _FROZEN
    psf_sigma: _Positive = 0.7
    dark: _Grey = 30.0
    light: _Grey = 220.0
    surround: _Grey = 90.0
    plate: Annotated[list[_Positive], Field(min_length=2, max_length=2)] | None = None
    noise: Annotated[FiniteFloat, Field(ge=0)] = 1.0
    full_well: _Positive | None = None


class TwinFile(BaseModel):
    """A twin file, see docs/rig.md."""

    model_config = _FROZEN
    host: Annotated[str, Field(pattern=r"^127(\.\d{1,3}){3}$")] = "127.0.0.2"
    robot: TwinErrors = TwinErrors()
    cameras: Annotated[list[TwinCamera], Field(min_length=1)]
    target: str
    tool_from_target: RigidTransformFile | None = None
    base_from_target: RigidTransformFile | None = None
    imaging: TwinImaging = TwinImaging()
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _one_place(self) -> TwinFile:
        if (self.tool_from_target is None) == (self.base_from_target is None):
            raise ValueError("does not say where the target is; give tool_from_target or base_from_target, one of both")
        return self


@dataclass(frozen=True, eq=False)
class Scene:
    """What the cameras of a twin see.

    Attributes:
        file: what the twin file says. cameras: the true ones by name, in the file's order. target: the target.
    """

    file: TwinFile
    cameras: dict[str, Camera]
    target: Target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Reads a twin file; files that it names are relative to it.

        Raises:
            ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
        """
        path = Path(path)
        file = validate(TwinFile, read_yaml(path), path)
        cameras = {}
        for given in file.cameras:
            camera = Camera.load(beside(path, given.camera))
            matrix = camera.matrix.clone()
            matrix[[0, 1], [0, 1]] *= given.focal_scale
            cameras[given.name] = replace(camera, matrix=matrix, covariance=None)
        if len(cameras) < len(file.cameras):
            raise ConfigError(f"{path}: cameras: two have the same name; give every camera its own")
        return cls(file, cameras, Target.load(beside(path, file.target)))

    def check(self, rig: Rig, path: str | os.PathLike[str]) -> None:
        """Raises ConfigError, with the twin file ``path``, unless the rig's cameras are those of the scene."""
        for camera in rig.cameras:
            true = self.cameras.get(camera.name)
            if true is None:
                raise ConfigError(f"{path}: cameras: {camera.name!r} of the rig file is missing; add it")
            if (true.width, true.height) != (camera.width, camera.height):
                raise ConfigError(
                    f"{path}: cameras: {camera.name!r} has {true.width} x {true.height} px, in the rig file "
                    f"{camera.width} x {camera.height}; make both the same"
                )

    def camera_from_target(self, name: str, tool: Sequence[float]) -> tuple[Tensor, Tensor]:
        """R (3, 3) and t (3,), mm, of the target in a camera while the tool is at the pose ``tool`` in the base."""
        given = next(camera for camera in self.file.cameras if camera.name == name)
        pose = torch.tensor(tool, dtype=torch.float64)
        base_from_tool = (rotations.exp(pose[3:]), pose[:3])
        camera, target = _placed(given.base_from_camera), _placed(self.file.base_from_target)
        if camera is None:
            camera = rotations.compose(*base_from_tool, *_known(given.tool_from_camera))
        if target is None:
            target = rotations.compose(*base_from_tool, *_known(self.file.tool_from_target))
        return rotations.compose(*rotations.inverse(*camera), *target)

    def frame(self, name: str, tool: Sequence[float], number: int, bits: int) -> Tensor:
        """(H, W) uint8 or uint16, what a camera sees while the tool is at ``tool``; ``number`` picks the noise."""
        image = self.file.imaging
        R, t = self.camera_from_target(name, tool)
        ideal = render(
            self.cameras[name],
            self.target,
            R[None],
            t[None],
            psf_sigma=image.psf_sigma,
            dark=image.dark,
            light=image.light,
            surround=image.surround,
            plate=None if image.plate is None else (image.plate[0], image.plate[1]),
        )
        index = torch.tensor([number])
        return add_noise(ideal, image.noise, self.file.seed, index=index, bits=bits, full_well=image.full_well)[0]


class Twin:
    """A running twin of a rig; see `running_twin`.

    Attributes:
        rig: the rig with the twin in the place of its robot.
        controller: the robot's twin.
    """

    def __init__(self, scene: Scene, rig: Rig, controller: TwinController, folder: Path, number: int) -> None:
        self.scene = scene
        self.rig = rig.model_copy(update={"robot": rig.robot.model_copy(update={"host": scene.file.host})})
        self.controller = controller
        self._folder = folder
        self._formats = {camera.name: camera.pixel_format for camera in rig.cameras}
        self._number = number
        self._tool = controller.true_pose()

    def look(self, name: str) -> Path:
        """Image file of what the camera ``name`` sees now."""
        bits = int(self._formats[name].removeprefix("Mono"))
        self._number += 1
        with contextlib.suppress(ConnectionError):  # the controller has ended, as the robot's client will say
            self._tool = self.controller.true_pose()
        seen = self.scene.frame(name, self._tool, self._number, bits)
        path = self._folder / f"{name}.tiff"
        image = seen.numpy() << (16 - bits) if bits > 8 else seen.numpy()  # the emulator takes the upper bits
        if not cv2.imwrite(str(path), image, [cv2.IMWRITE_TIFF_COMPRESSION, 1]):  # none: the fastest to read
            raise ConfigError(f"{path}: twin: cannot be written; free some space for temporary files")
        return path


@contextlib.contextmanager
def running_twin(
    path: str | os.PathLike[str], rig: Rig, start_pose: Sequence[float], number: int = 0
) -> Iterator[Twin]:
    """Starts the twin of a rig; ends it with the block.

    Args:
        path: twin file. start_pose: where the robot stands first, mm and rotation vector in rad.
        number: exposures of earlier runs, so that a resumed session does not see their noise again.

    Raises:
        ConfigError: the file is wrong or does not fit the rig, or the loopback address is in use.
    """
    scene = Scene.load(path)
    scene.check(rig, path)
    errors, host, start = scene.file.robot, scene.file.host, _flange(start_pose, rig.robot.tcp)
    before = os.environ.get("PYLON_CAMEMU")
    os.environ["PYLON_CAMEMU"] = str(len(rig.cameras))  # read at each enumeration
    try:
        with (
            tempfile.TemporaryDirectory(prefix="torchpose-twin-") as folder,
            TwinController(host, start_pose=start, errors=errors, seed=scene.file.seed) as controller,
        ):
            yield Twin(scene, rig, controller, Path(folder), number)
    finally:
        if before is None:
            os.environ.pop("PYLON_CAMEMU", None)
        else:
            os.environ["PYLON_CAMEMU"] = before


def _flange(tool: Sequence[float], tcp: Sequence[float] | None) -> list[float]:
    """Where the flange is while the tool is at a pose: the controller starts without a tool."""
    if tcp is None:
        return list(tool)
    (r, t), offset = (
        (rotations.exp(v[3:]), v[:3]) for v in (torch.tensor(list(p), dtype=torch.float64) for p in (tool, tcp))
    )
    rotation, translation = rotations.compose(r, t, *rotations.inverse(*offset))
    return [*translation.tolist(), *rotations.log(rotation).tolist()]


def _placed(pose: RigidTransformFile | None) -> tuple[Tensor, Tensor] | None:
    if pose is None:
        return None
    vector, translation = (torch.tensor(v, dtype=torch.float64) for v in (pose.rotation, pose.translation))
    return rotations.exp(vector), translation


def _known(pose: RigidTransformFile | None) -> tuple[Tensor, Tensor]:
    placed = _placed(pose)
    assert placed is not None  # the file's models see to it
    return placed
