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
from typing import Annotated, Any, Protocol

import cv2
import torch
from jaxtyping import Float, UInt
from pydantic import Field, FiniteFloat, model_validator
from torch import Tensor

from torchpose.camera import Camera
from torchpose.config import beside, example, read_yaml, validate
from torchpose.config.kinds import Grey, Seed, Word
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.child import ChildEnded
from torchpose.rig.poses import from_transform, to_transform
from torchpose.rig.settings import AS_TUPLE, MOST_CAMERAS, Positive, Rig, Strict
from torchpose.rig.twin.controller import START_POSE, TwinController, TwinErrors
from torchpose.sim import add_noise, render
from torchpose.target import RigidTransformFile, Target


class TwinCamera(Strict):
    """What one camera of the rig really is, and where."""

    name: Word = "camera"  # as in the rig file
    camera: Word  # its camera file
    focal_scale: FiniteFloat = Field(default=1.0, ge=0.5, le=2)  # the true focal length over that of the file
    base_from_camera: RigidTransformFile | None = None  # where it is, one of both
    tool_from_camera: RigidTransformFile | None = None

    @model_validator(mode="after")
    def _one_place(self) -> TwinCamera:
        if (self.base_from_camera is None) == (self.tool_from_camera is None):
            raise ValueError("does not say where it is; give base_from_camera or tool_from_camera, one of both")
        return self


class TwinImaging(Strict):
    """Blur, grey levels and noise, see `torchpose.sim.render` and `torchpose.sim.add_noise`; levels of 0 to 255."""

    psf_sigma: FiniteFloat = Field(default=0.7, gt=0, le=100)
    dark: Grey = 30.0
    light: Grey = 220.0
    surround: Grey = 90.0
    plate: Annotated[tuple[Positive, Positive], AS_TUPLE] | None = None
    noise: Grey = 1.0
    full_well: Annotated[float, Field(gt=0, le=1e9)] | None = None


class TwinFile(Strict):
    """A twin file, see docs/rig.md."""

    host: str = Field(default="127.0.0.2", pattern=r"^127(\.\d{1,3}){3}$")
    robot: TwinErrors = TwinErrors()
    cameras: list[TwinCamera] = Field(min_length=1, max_length=MOST_CAMERAS)
    target: Word
    tool_from_target: RigidTransformFile | None = None
    base_from_target: RigidTransformFile | None = None
    imaging: TwinImaging = TwinImaging()
    seed: Seed = 0

    @model_validator(mode="after")
    def _one_place(self) -> TwinFile:
        if (self.tool_from_target is None) == (self.base_from_target is None):
            raise ValueError("does not say where the target is; give tool_from_target or base_from_target, one of both")
        return self


@dataclass(frozen=True, eq=False)
class Scene:
    """What the cameras of a twin see."""

    file: TwinFile
    cameras: dict[str, Camera]  # the true ones by name, in the file's order
    target: Target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Reads a twin file; files that it names are relative to it. Raises ConfigError."""
        path = example(path, "rig")
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
                sizes = f"{true.width} x {true.height} px, in the rig file {camera.width} x {camera.height}"
                raise ConfigError(f"{path}: cameras: {camera.name!r} has {sizes}; make both the same")

    def camera_from_target(self, name: str, tool: Sequence[float]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
        """R and t (mm) of the target in a camera while the tool is at the pose ``tool`` in the base."""
        given = next(camera for camera in self.file.cameras if camera.name == name)
        camera = _in_base(given.base_from_camera, given.tool_from_camera, tool)
        target = _in_base(self.file.base_from_target, self.file.tool_from_target, tool)
        return rotations.compose(*rotations.inverse(*camera), *target)

    def frame(self, name: str, tool: Sequence[float], number: int, bits: int) -> UInt[Tensor, "H W"]:
        """What a camera sees while the tool is at ``tool``; ``number`` picks the noise."""
        imaging = self.file.imaging
        R, t = self.camera_from_target(name, tool)
        looks: dict[str, Any] = imaging.model_dump(exclude={"noise", "full_well"})
        ideal = render(self.cameras[name], self.target, R[None], t[None], **looks)
        index = torch.tensor([number])
        return add_noise(ideal, imaging.noise, self.file.seed, index=index, bits=bits, full_well=imaging.full_well)[0]


def _in_base(
    fixed: RigidTransformFile | None, carried: RigidTransformFile | None, tool: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Where something is in the base that is fixed there, or carried by the tool at a pose."""
    place = fixed or carried
    assert place is not None  # the file's models see to it
    local = to_transform([*place.translation, *place.rotation])
    return local if fixed else rotations.compose(*to_transform(tool), *local)


class HasPose(Protocol):
    """What knows where the tool really is: mm, and a rotation vector in rad."""

    def true_pose(self) -> tuple[float, ...]: ...


class Standing:
    """Stands where it is. There is no controller, so nothing can move it."""

    def __init__(self, pose: Sequence[float]) -> None:
        self._pose = tuple(pose)

    def true_pose(self) -> tuple[float, ...]:
        return self._pose


class Twin:
    """A running twin of a rig, see `running_twin` and `standing_twin`; `rig` has it in the place of its robot."""

    def __init__(self, scene: Scene, rig: Rig, controller: HasPose, folder: Path, number: int) -> None:
        self.scene = scene
        self.rig = rig.model_copy(update={"robot": rig.robot.model_copy(update={"host": scene.file.host})})
        self.controller = controller
        self._folder = folder
        self._bits = {camera.name: camera.bits for camera in rig.cameras}
        self._number = number
        self._tool = controller.true_pose()

    def look(self, name: str) -> Path:
        """Image file of what the camera ``name`` sees now."""
        self._number += 1
        with contextlib.suppress(ChildEnded):  # the controller has ended, as the robot's client will say
            self._tool = self.controller.true_pose()
        bits = self._bits[name]
        image = self.scene.frame(name, self._tool, self._number, bits).numpy()
        if bits > 8:
            image <<= 16 - bits  # the emulator takes the upper bits
        path = self._folder / f"{name}.tiff"
        if not cv2.imwrite(str(path), image, [cv2.IMWRITE_TIFF_COMPRESSION, 1]):  # none: the fastest to read
            raise ConfigError(f"{path}: twin: cannot be written; free some space for temporary files")
        return path


@contextlib.contextmanager
def running_twin(
    path: str | os.PathLike[str], rig: Rig, start_pose: Sequence[float], number: int = 0
) -> Iterator[Twin]:
    """Starts the twin of a rig; ends it with the block.

    Args:
        path: twin file.
        rig: that of the rig file.
        start_pose: where the robot stands first, mm and rotation vector in rad.
        number: exposures of earlier runs, so that a resumed session does not see their noise again.

    Raises:
        ConfigError: the file is wrong or does not fit the rig, or the loopback address is in use.
    """
    scene = Scene.load(path)
    scene.check(rig, path)
    errors, host, start = scene.file.robot, scene.file.host, _flange(start_pose, rig.robot.tcp)
    with (
        _emulated_cameras(len(rig.cameras)),
        tempfile.TemporaryDirectory(prefix="torchpose-twin-") as folder,
        TwinController(host, start_pose=start, errors=errors, seed=scene.file.seed) as controller,
    ):
        yield Twin(scene, rig, controller, Path(folder), number)


@contextlib.contextmanager
def standing_twin(path: str | os.PathLike[str], rig: Rig, number: int = 0) -> Iterator[Twin]:
    """The cameras of a rig's twin alone: the tool stands in the middle of the workspace, pointing down.

    Arguments and errors as of `running_twin`; there is no controller whose address could be in use.
    """
    scene = Scene.load(path)
    scene.check(rig, path)
    box = rig.robot.workspace
    middle = [0.5 * (low + high) for low, high in zip(box.min, box.max, strict=True)]
    with (
        _emulated_cameras(len(rig.cameras)),
        tempfile.TemporaryDirectory(prefix="torchpose-twin-") as folder,
    ):
        yield Twin(scene, rig, Standing([*middle, *START_POSE[3:]]), Path(folder), number)


@contextlib.contextmanager
def _emulated_cameras(count: int) -> Iterator[None]:
    """As many cameras of pylon's emulator, which reads the variable at each enumeration."""
    before = os.environ.get("PYLON_CAMEMU")
    os.environ["PYLON_CAMEMU"] = str(count)
    try:
        yield
    finally:
        del os.environ["PYLON_CAMEMU"]
        os.environ.update({} if before is None else {"PYLON_CAMEMU": before})


def _flange(tool: Sequence[float], tcp: Sequence[float] | None) -> list[float]:
    """Where the flange is while the tool is at a pose: the controller starts without a tool."""
    if tcp is None:
        return list(tool)
    return list(from_transform(*rotations.compose(*to_transform(tool), *rotations.inverse(*to_transform(tcp)))))
