"""Several cameras that keep their places to each other: their lenses, and where each of them is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera.model import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.covariance import covariance_fault
from torchpose.geometry.least_squares import covariance_factor

POSE = 6
# largest entry of R^T R - I of a transform that a file may have (convention: four digits were written)
_ORTHONORMAL = 1e-3


@dataclass(frozen=True, eq=False)
class CameraRig:
    """C cameras and their places: X_n = R_n X_0 + t_n, from the axes of the first camera to those of camera n.

    Attributes:
        cameras: of any sizes and lens models.
        R: (C, 3, 3) float64; the first is the identity.
        t: (C, 3) float64, mm; the first is 0.
        covariance: of the places of the C - 1 other cameras (6 (C - 1), 6 (C - 1)): of each the translation (mm), then
            the rotation w (rad, R_true = exp(w) R), about the axes of that camera. None: the places are exact.
        names: of the cameras: what their folders of pictures are called; cam0, cam1, ... by default.

    Raises:
        ConfigError: a field is wrong.
    """

    cameras: tuple[Camera, ...]
    R: Tensor
    t: Tensor
    covariance: Tensor | None = None
    names: tuple[str, ...] = ()

    if TYPE_CHECKING:

        def __init__(
            self,
            cameras: Sequence[Camera],
            R: Tensor | Sequence[Any],
            t: Tensor | Sequence[Any],
            covariance: Tensor | Sequence[Any] | None = None,
            names: Sequence[str] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        cameras = tuple(self.cameras)
        if not cameras or not all(isinstance(camera, Camera) for camera in cameras):
            raise ConfigError("cameras: are not all a Camera; give one or more")
        count = len(cameras)
        R, t = _table("R", self.R, (count, 3, 3)), _table("t", self.t, (count, 3))
        for number, turn in enumerate(R.detach()):
            if fault := rotation_fault(turn):
                raise ConfigError(f"R: of camera {number} {fault}")
        if bool((R[0] != torch.eye(3).to(R)).any()) or bool((t[0] != 0).any()):
            raise ConfigError("R, t: those of the first camera are not 1 and 0; give places as seen from the first one")
        names = tuple(str(name) for name in self.names) or tuple(f"cam{n}" for n in range(count))
        if len(names) != count or len(set(names)) < count:
            raise ConfigError(f"names: {', '.join(names)}; give every one of the {count} cameras its own")
        if odd := next((name for name in names if not _names_a_folder(name)), None):
            raise ConfigError(f"names: {odd!a} is no name of a folder, which pictures of a camera lie in; give another")
        covariance = self.covariance
        if covariance is not None:
            covariance = _table("extrinsics_covariance", covariance, (POSE * (count - 1), POSE * (count - 1)))
            if count > 1 and (fault := covariance_fault(covariance.detach())):
                raise ConfigError(f"extrinsics_covariance: {fault}; give that of translation (mm), then rotation (rad)")
        for name, value in (("cameras", cameras), ("R", R), ("t", t), ("covariance", covariance), ("names", names)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.cameras)

    @classmethod
    def alone(cls, camera: Camera) -> CameraRig:
        """A rig of one camera."""
        return cls((camera,), torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))

    @classmethod
    def of(cls, camera: Camera | CameraRig) -> CameraRig:
        """The rig itself, or one of one camera."""
        return camera if isinstance(camera, CameraRig) else cls.alone(camera)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> CameraRig:
        """Reads a rig, see `torchpose.camera.formats.rig.load`."""
        from torchpose.camera.formats import rig

        return rig.load(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a Kalibr camchain in one piece, see `torchpose.camera.formats.rig.save`."""
        from torchpose.camera.formats import rig

        rig.save(self, path)

    def to(self, *args: Any, **kwargs: Any) -> CameraRig:
        """Same as `Tensor.to` on every tensor."""
        covariance = None if self.covariance is None else self.covariance.to(*args, **kwargs)
        cameras = [camera.to(*args, **kwargs) for camera in self.cameras]
        return CameraRig(cameras, self.R.to(*args, **kwargs), self.t.to(*args, **kwargs), covariance, self.names)

    def seen_by(self, camera: int, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., 3, 3), (..., 3) in the axes of a camera, given in those of the first."""
        return rotations.compose(self.R[camera].to(R), self.t[camera].to(t), R, t)

    def from_camera(self, camera: int, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., 3, 3), (..., 3) in the axes of the first camera, given in those of another one."""
        back = rotations.inverse(self.R[camera].to(R), self.t[camera].to(t))
        return rotations.compose(*back, R, t)

    def factor(self) -> Float[Tensor, "C 6 k"]:
        """By how much the places of the cameras vary with k independent numbers of unit variance; 0 of the first."""
        if self.covariance is None or len(self) == 1:
            return self.t.new_zeros(len(self), POSE, 0)
        rows = covariance_factor(self.covariance).unflatten(0, (-1, POSE))
        return torch.cat([torch.zeros_like(rows[:1]), rows])


def _names_a_folder(name: str) -> bool:
    """Whether a name leads to a folder below another one, and nowhere else."""
    return name not in ("", ".", "..") and name.isprintable() and not {"/", "\\"} & set(name)


def rotation_fault(rotation: Tensor) -> str:
    """What forbids that a table (3, 3) is a rotation; empty where nothing does."""
    error = float((rotation.mT @ rotation - torch.eye(3).to(rotation)).abs().max())
    if not error <= _ORTHONORMAL:
        return f"is no rotation (off orthonormal by {error:.2g}); write more digits or correct it"
    if float(torch.linalg.det(rotation)) < 0:
        return "is a reflection (determinant -1); give a right-handed rotation"
    return ""


def nearest_rotation(table: Tensor) -> Tensor:
    """The rotation nearest to a table (3, 3): takes off the rounding of a file."""
    u, _, vh = torch.linalg.svd(table)
    return u @ vh


def _table(name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    try:
        table = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError):
        raise ConfigError(f"{name}: is not a table of numbers; write numbers only") from None
    if tuple(table.shape) != shape:
        raise ConfigError(f"{name}: has shape {tuple(table.shape)}; give {' x '.join(map(str, shape))}")
    if not bool(table.detach().isfinite().all()):
        raise ConfigError(f"{name}: holds NaN or infinity; calibrate again or correct the entry")
    return table.double()
