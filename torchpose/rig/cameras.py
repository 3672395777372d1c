"""All cameras of a rig: which device is which, frames triggered together, retries.

Every frame is an acquisition of its own: started, triggered, fetched, stopped. So no buffer of an earlier pose can be
taken for the frame of this one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from torchpose.errors import ConfigError
from torchpose.rig import camera as basler
from torchpose.rig.camera import EMULATOR, BaslerCamera, first_line
from torchpose.rig.faults import CameraFault, CameraReason
from torchpose.rig.settings import CameraSettings

T = TypeVar("T")
_PASSING = (CameraReason.NOT_READY, CameraReason.TIMED_OUT, CameraReason.FAILED_BUFFER)  # worth another attempt


@dataclass(frozen=True, eq=False)
class Frame:
    """One image with its circumstances."""

    camera: str  # its name
    image: np.ndarray[Any, Any]  # (H, W) uint8 or uint16
    trigger_time_s: float  # Unix time of this machine just before the trigger
    camera_time: int  # the camera's own counter, 0 where it has none
    failures: tuple[str, ...]  # reasons of the attempts that failed before

    @property
    def attempts(self) -> int:
        """How many it took."""
        return len(self.failures) + 1


class Cameras:
    """All cameras of a rig, for use in a ``with`` block, which opens and closes them.

    Args:
        settings: of each camera; names are unique.
        scene: the image file that an emulated camera shall see now, by camera name; makes every camera an emulated one.

    Raises:
        ConfigError: pypylon is not installed.
        CameraFault: a camera is missing, in use or refuses a setting.
    """

    def __init__(self, settings: Sequence[CameraSettings], scene: Callable[[str], Path] | None = None) -> None:
        self._settings = settings
        self._scene = scene
        self._open: dict[str, BaslerCamera] = {}

    def __enter__(self) -> Self:
        try:
            for settings, device in self._devices():
                self._open[settings.name] = BaslerCamera(settings, device)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Gives all cameras back."""
        for camera in self._open.values():
            camera.close()
        self._open.clear()

    @property
    def descriptions(self) -> list[dict[str, Any]]:
        """Model, serial number and the settings read back, of each camera."""
        return [camera.description for camera in self._open.values()]

    def grab(self, names: Collection[str]) -> list[Frame]:
        """A frame of each of the named cameras, triggered one right after the other.

        A camera whose frame fails is tried again alone, up to its number of attempts.

        Raises:
            CameraFault: a camera has none left, has been removed or gives frames of another size.
        """
        waiting = {name: camera for name, camera in self._open.items() if name in names}
        if self._scene is not None:
            for name, camera in waiting.items():
                camera.show(self._scene(name))
        failures: dict[str, tuple[str, ...]] = dict.fromkeys(waiting, ())
        done: dict[str, Frame] = {}
        while waiting:
            taken, faults = _attempt(waiting)
            for name, (trigger_time, image, stamp) in taken.items():
                done[name] = Frame(name, image, trigger_time, stamp, failures[name])
            for name, fault in faults.items():
                failures[name] += (fault.reason.value,)
                if fault.reason not in _PASSING or len(failures[name]) >= waiting[name].settings.attempts:
                    raise fault
            waiting = {name: waiting[name] for name in faults}
        return [done[name] for name in self._open if name in done]

    def _devices(self) -> list[tuple[CameraSettings, Any]]:
        """The device of each camera: by serial number, the others in the order of the enumeration."""
        if basler.pylon is None:
            raise ConfigError("cameras: pypylon is not installed; pip install 'torchpose[rig]'")
        try:
            found = list(basler.pylon.TlFactory.GetInstance().EnumerateDevices())
        except basler.genicam.GenericException as error:
            raise CameraFault(
                CameraReason.NOT_FOUND, f"cameras: the search failed ({first_line(error)}); check the drivers"
            ) from None
        emulated = self._scene is not None
        devices = {d.GetSerialNumber(): d for d in found if not emulated or d.GetDeviceClass() == EMULATOR}
        wanted = {s.name: None if emulated else s.serial for s in self._settings}
        free = [serial for serial in devices if serial not in wanted.values()]
        pairs = []
        for settings in self._settings:
            serial = wanted[settings.name] or (free.pop(0) if free else None)
            if serial not in devices:
                which = f"with serial number {serial} " if serial else ""
                there = ", ".join(devices) or "none"
                raise CameraFault(
                    CameraReason.NOT_FOUND,
                    f"camera {settings.name}: no camera {which}is there (found: {there}); check power, cable, serial",
                )
            pairs.append((settings, devices[serial]))
        return pairs


def _attempt(
    cameras: Mapping[str, BaslerCamera],
) -> tuple[dict[str, tuple[float, np.ndarray[Any, Any], int]], dict[str, CameraFault]]:
    """One try at a frame of each camera: trigger time, image and time stamp by name; the faults of the others."""
    faults: dict[str, CameraFault] = {}

    def each(step: Callable[[BaslerCamera], T]) -> dict[str, T]:
        results = {}
        for name in [name for name in cameras if name not in faults]:
            try:
                results[name] = step(cameras[name])
            except CameraFault as fault:
                faults[name] = fault
        return results

    try:
        each(lambda camera: camera.start())
        times = each(lambda camera: camera.trigger())
        images = each(lambda camera: camera.fetch())
    finally:
        for camera in cameras.values():
            camera.stop()
    return {name: (times[name], *image) for name, image in images.items()}, faults
