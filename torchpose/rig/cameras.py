"""All cameras of a rig: which device is which, frames triggered together, retries.

Every frame is an acquisition of its own: started, triggered, fetched, stopped. So no buffer of an earlier pose can be
taken for the frame of this one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from torchpose.errors import ConfigError
from torchpose.rig.camera import EMULATOR, BaslerCamera, CameraFault, CameraReason, CameraSettings, first_line

_PASSING = (CameraReason.NOT_READY, CameraReason.TIMED_OUT, CameraReason.FAILED_BUFFER)  # worth another attempt


@dataclass(frozen=True, eq=False)
class Frame:
    """One image with its circumstances.

    Attributes:
        camera: name. image: (H, W) uint8 or uint16.
        trigger_time_s: Unix time of this machine just before the trigger. camera_time: the camera's own counter, 0
            where it has none.
        attempts: how many it took. failures: reasons of those that failed.
    """

    camera: str
    image: np.ndarray
    trigger_time_s: float
    camera_time: int
    attempts: int
    failures: tuple[str, ...]


class Cameras:
    """All cameras of a rig, for use in a ``with`` block, which opens and closes them.

    Args:
        settings: of each camera; names are unique.
        scene: the image file that an emulated camera shall see now, by camera name; makes every camera an emulated one.

    Raises:
        ConfigError: pypylon is not installed. CameraFault: a camera is missing, in use or refuses a setting.
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

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
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
        waiting = [self._open[name] for name in self._open if name in names]
        if self._scene is not None:
            for camera in waiting:
                camera.show(self._scene(camera.settings.name))
        failures: dict[str, list[str]] = {name: [] for name in names}
        done: dict[str, Frame] = {}
        while waiting:
            faults = self._attempt(waiting, failures, done)
            for camera, fault in faults:
                tried = failures[camera.settings.name]
                tried.append(fault.reason.value)
                if fault.reason not in _PASSING or len(tried) >= camera.settings.attempts:
                    raise fault
            waiting = [camera for camera, _ in faults]
        return [done[name] for name in self._open if name in done]

    def _attempt(
        self, cameras: Sequence[BaslerCamera], failures: dict[str, list[str]], done: dict[str, Frame]
    ) -> list[tuple[BaslerCamera, CameraFault]]:
        """Tries every camera once, adds the frames to ``done`` and returns the faults."""
        faults: dict[BaslerCamera, CameraFault] = {}
        times: dict[BaslerCamera, float] = {}
        try:
            for camera in cameras:
                with _noted(faults, camera):
                    camera.start()
            for camera in (c for c in cameras if c not in faults):
                with _noted(faults, camera):
                    times[camera] = camera.trigger()
            for camera, trigger_time in times.items():
                with _noted(faults, camera):
                    image, stamp = camera.fetch()
                    name = camera.settings.name
                    failed = tuple(failures[name])
                    done[name] = Frame(name, image, trigger_time, stamp, len(failed) + 1, failed)
        finally:
            for camera in cameras:
                camera.stop()
        return list(faults.items())

    def _devices(self) -> list[tuple[CameraSettings, Any]]:
        """The device of each camera: by serial number, the others in the order of the enumeration."""
        try:
            from pypylon import genicam, pylon
        except ImportError:
            raise ConfigError("cameras: pypylon is not installed; pip install 'torchpose[rig]'") from None
        try:
            found = list(pylon.TlFactory.GetInstance().EnumerateDevices())
        except genicam.GenericException as error:
            raise CameraFault(
                CameraReason.NOT_FOUND, f"cameras: the search failed ({first_line(error)}); check the drivers"
            ) from None
        if self._scene is not None:
            found = [device for device in found if device.GetDeviceClass() == EMULATOR]
        by_serial = {} if self._scene is not None else {device.GetSerialNumber(): device for device in found}
        named = {s.serial for s in self._settings if s.serial is not None}
        free = [device for device in found if self._scene is not None or device.GetSerialNumber() not in named]
        pairs = []
        for settings in self._settings:
            fixed = settings.serial is not None and self._scene is None
            device = by_serial.get(settings.serial) if fixed else (free.pop(0) if free else None)
            if device is None:
                wanted = f"with serial number {settings.serial} " if fixed else ""
                there = ", ".join(by_serial) or "none"
                raise CameraFault(
                    CameraReason.NOT_FOUND,
                    f"camera {settings.name}: no camera {wanted}is there (found: {there}); check power, cable, serial",
                )
            pairs.append((settings, device))
        return pairs


@contextlib.contextmanager
def _noted(faults: dict[BaslerCamera, CameraFault], camera: BaslerCamera) -> Iterator[None]:
    try:
        yield
    except CameraFault as fault:
        faults[camera] = fault
