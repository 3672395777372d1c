"""Basler cameras through pypylon: settings that are read back, frames triggered together, retries, faults with a name.

Every frame is an acquisition of its own: started, triggered, fetched, stopped. So no buffer of an earlier pose can be
taken for the frame of this one. The emulator that ships with pypylon (``PYLON_CAMEMU=1``) runs the same code.
"""

import contextlib
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchpose.errors import ConfigError
from torchpose.rig.faults import CameraFault, CameraReason
from torchpose.rig.settings import ACTION, SOFTWARE, CameraSettings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # as an error, a warning of its types crashes the interpreter
    try:
        from pypylon import genicam, pylon
    except ImportError:  # `Cameras` says so
        pylon = None

T = TypeVar("T")
EMULATOR = "BaslerCamEmu"  # device class of the emulated cameras
_PASSING = (CameraReason.NOT_READY, CameraReason.TIMED_OUT, CameraReason.FAILED_BUFFER)  # worth another attempt


class BaslerCamera:
    """One camera, opened and set up.

    Args:
        settings: of the rig file.
        device: information of the enumeration.

    Raises:
        CameraFault: it cannot be opened, or refuses a setting.
    """

    def __init__(self, settings: CameraSettings, device: Any) -> None:
        self.settings = settings
        self.emulated = device.GetDeviceClass() == EMULATOR
        try:
            self._camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(device))
            self._camera.Open()
        except genicam.GenericException as error:
            why = f"{_first_line(error)}; close other programs that use it"
            raise self._fault(CameraReason.NOT_OPENED, why) from None
        self._nodes = self._camera.GetNodeMap()
        self.description: dict[str, Any] = {
            "name": settings.name,
            "model": device.GetModelName(),
            "serial": device.GetSerialNumber(),
            "device_class": device.GetDeviceClass(),
            "firmware": self._read("DeviceFirmwareVersion"),
            "emulated": self.emulated,
        }
        try:
            self.description["settings"] = self._configure()
        except BaseException:
            self.close()
            raise

    def show(self, image: Path) -> None:
        """Lays an image file before an emulated camera: its next frames are this one."""
        self._set("TestImageSelector", "Off")
        self._set("ImageFileMode", "On")
        self._set("ImageFilename", str(image))

    def start(self) -> None:
        """Starts the acquisition of one frame and waits until the camera takes a trigger."""
        with self._driver():
            self._camera.StartGrabbingMax(1)
            # a trigger that comes before the camera is ready is lost without a word
            if not self._camera.WaitForFrameTriggerReady(self._timeout_ms, pylon.TimeoutHandling_Return):
                raise self._fault(CameraReason.NOT_READY, "does not become ready for a trigger; check its cable")

    def trigger(self) -> float:
        """Triggers the exposure, unless something else does; Unix time just before."""
        now = time.time()
        with self._driver():
            if self.emulated or not self.settings.waits_for:  # emulated cameras have no wire
                self._camera.ExecuteSoftwareTrigger()
            elif self.settings.waits_for == "action":
                device, group, _ = (self.settings.nodes[name] for name in ACTION)
                layer = pylon.TlFactory.GetInstance().CreateTl(pylon.BaslerGigEDeviceClass)
                layer.ActionCommand(device, group, pylon.AllGroupMask).IssueNoWait()
        return now

    def fetch(self) -> tuple[NDArray[np.integer[Any]], int]:
        """The triggered image (H, W) and the camera's time stamp.

        Raises:
            CameraFault: it does not come in time, is incomplete or of another size, or the camera has gone.
        """
        given = self.settings
        with self._driver():
            with self._camera.RetrieveResult(self._timeout_ms, pylon.TimeoutHandling_ThrowException) as result:
                if not result.GrabSucceeded():
                    why = result.ErrorDescription or f"error {result.ErrorCode}"
                    raise self._fault(CameraReason.FAILED_BUFFER, f"{why} Check cable, network and packet size")
                image, stamp = np.array(result.Array), int(result.TimeStamp)
            # an unplugged camera may still deliver what was under way
            if self._camera.IsCameraDeviceRemoved():
                raise self._removed()
        if image.shape != (given.height, given.width) or image.dtype != given.dtype:
            size = " x ".join(str(n) for n in image.shape[1::-1])
            why = f"the frame is {size} {image.dtype} instead of {given.width} x {given.height} {given.pixel_format}"
            fix = "correct width and height of the rig file or reset the camera"
            raise self._fault(CameraReason.WRONG_SIZE, f"{why}; {fix}")
        return image, stamp

    def stop(self) -> None:
        """Ends the acquisition; whatever is under way is dropped."""
        with contextlib.suppress(genicam.GenericException):  # the next start says what is wrong
            self._camera.StopGrabbing()

    def close(self) -> None:
        """Gives the camera back."""
        self.stop()
        with contextlib.suppress(genicam.GenericException):  # it has been unplugged
            self._camera.Close()

    def _configure(self) -> dict[str, Any]:
        """Sets everything and returns what the camera then says."""
        given = self.settings
        self._set("PixelFormat", given.pixel_format)
        for offset in ("OffsetX", "OffsetY"):  # they limit the size
            self._set(offset, 0, optional=True)
        for axis, side, corner, size in (
            ("X", "Width", given.offset_x, given.width),
            ("Y", "Height", given.offset_y, given.height),
        ):
            if self.emulated and size > self._read(f"{side}Max"):
                self._set(f"{side}Max", size)
            self._set(side, size)
            if corner is not None:
                self._set(f"Offset{axis}", corner)
            elif (free := (self._read(f"{side}Max") or size) - size) > 0:
                self._set(f"Offset{axis}", free // 2 // 4 * 4, optional=True)  # in steps of 4, which all models allow
        self._set("ExposureAuto", "Off", optional=True)
        self._set("GainAuto", "Off", optional=True)
        # older cameras write Abs behind a name
        exposure = self._set("ExposureTime", given.exposure_us, "ExposureTimeAbs")
        gain = self._set("Gain", given.gain_db, "GainAbs", optional=given.gain_db == 0)
        # last, whatever the file's nodes say: waiting for a trigger that nobody sends would never end
        trigger = {"TriggerSelector": "FrameStart", "TriggerMode": "On"}
        if self.emulated or not given.waits_for:
            trigger["TriggerSource"] = SOFTWARE
        for nodes in (given.nodes, {"AcquisitionMode": "Continuous"}, trigger):
            for name, value in nodes.items():
                self._set(name, value)
        wanted = ["Width", "Height", "OffsetX", "OffsetY", "PixelFormat", exposure, gain, "TriggerMode"]
        read = {name: self._read(name) for name in [*wanted, "TriggerSource", *given.nodes] if name}
        for name, value in (("Width", given.width), ("Height", given.height), ("PixelFormat", given.pixel_format)):
            if read[name] != value:
                why = f"{name}: is {read[name]} instead of {value}; change it"
                raise self._fault(CameraReason.REFUSED_SETTING, why)
        return read

    def _set(self, name: str, value: Any, *others: str, optional: bool = False) -> str | None:
        """Sets the first of the named nodes that the camera has; its name, None where an optional one is missing."""
        names = [name, *others]
        nodes = {name: self._nodes.GetNode(name) for name in names}
        found = next((name for name, node in nodes.items() if node is not None and genicam.IsWritable(node)), None)
        if found is None and not optional:
            raise self._fault(CameraReason.REFUSED_SETTING, f"{' or '.join(names)}: cannot be set; see its manual")
        if found is not None:
            try:
                nodes[found].SetValue(value)
            except (genicam.GenericException, TypeError) as error:
                why = f"{found}: {value!r} is refused ({_first_line(error)}); change it"
                raise self._fault(CameraReason.REFUSED_SETTING, why) from None
        return found

    def _read(self, name: str) -> Any:
        node = self._nodes.GetNode(name)
        return node.GetValue() if node is not None and genicam.IsReadable(node) else None

    @property
    def _timeout_ms(self) -> int:
        return int(1e3 * self.settings.timeout_s)

    @contextlib.contextmanager
    def _driver(self) -> Iterator[None]:
        """Names the errors of the driver."""
        try:
            yield
        except genicam.GenericException as error:
            if self._camera.IsCameraDeviceRemoved():
                raise self._removed() from None
            if isinstance(error, genicam.TimeoutException):
                wait = f"no image within {self.settings.timeout_s:g} s of the trigger"
                raise self._fault(CameraReason.TIMED_OUT, f"{wait}; check trigger, cable, timeout_s") from None
            raise self._fault(CameraReason.DRIVER_ERROR, f"{_first_line(error)}; restart the camera") from None

    def _removed(self) -> CameraFault:
        return self._fault(CameraReason.REMOVED, "has been disconnected; check cable and power")

    def _fault(self, reason: CameraReason, message: str) -> CameraFault:
        return CameraFault(reason, " ".join(f"camera {self.settings.name}: {message}".split()))


@dataclass(frozen=True, eq=False)
class Frame:
    """One image with its circumstances."""

    camera: str  # its name
    image: NDArray[np.integer[Any]]  # (H, W) uint8 or uint16
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
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for camera in self._open.values():
            camera.close()
        self._open.clear()

    @property
    def descriptions(self) -> list[dict[str, Any]]:
        """Model, serial number and the settings read back, of each camera."""
        return [camera.description for camera in self._open.values()]

    def grab(self, names: Collection[str]) -> list[Frame]:
        """A frame of each of the named cameras, triggered one right after the other, or by one line or action command.

        A camera whose frame fails is tried again, up to its number of attempts: alone, or with all others where they
        are triggered at once.

        Raises:
            CameraFault: a camera has none left, has been removed or gives frames of another size.
        """
        wanted = {name: camera for name, camera in self._open.items() if name in names}
        at_once = any(camera.settings.waits_for for camera in wanted.values())
        if any(camera.settings.waits_for == "line" for camera in wanted.values()):
            # whoever drives the line exposes, too
            wanted = {n: c for n, c in self._open.items() if n in wanted or not c.settings.waits_for}
        waiting = wanted
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
            waiting = wanted if at_once and faults else {name: waiting[name] for name in faults}
        return [done[name] for name in self._open if name in names]

    def _devices(self) -> list[tuple[CameraSettings, Any]]:
        """The device of each camera: by serial number, the others in the order of the enumeration."""
        if pylon is None:
            raise ConfigError("cameras: pypylon is not installed; pip install 'torchpose[rig]'")
        try:
            found = list(pylon.TlFactory.GetInstance().EnumerateDevices())
        except genicam.GenericException as error:
            why = f"cameras: the search failed ({_first_line(error)}); check the drivers"
            raise CameraFault(CameraReason.NOT_FOUND, why) from None
        emulated = self._scene is not None
        devices = {d.GetSerialNumber(): d for d in found if not emulated or d.GetDeviceClass() == EMULATOR}
        wanted = {s.name: None if emulated else s.serial for s in self._settings}
        free = [serial for serial in devices if serial not in wanted.values()]
        pairs = []
        for settings in self._settings:
            serial = wanted[settings.name] or (free.pop(0) if free else None)
            if serial not in devices:
                which = f"with serial number {serial} " if serial else ""
                why = f"camera {settings.name}: no camera {which}is there (found: {', '.join(devices) or 'none'})"
                raise CameraFault(CameraReason.NOT_FOUND, f"{why}; check power, cable, serial")
            pairs.append((settings, devices[serial]))
        return pairs


def _attempt(
    cameras: Mapping[str, BaslerCamera],
) -> tuple[dict[str, tuple[float, NDArray[np.integer[Any]], int]], dict[str, CameraFault]]:
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
        times = _triggered(cameras, each, faults)
        images = each(lambda camera: camera.fetch()) if times else {}
    finally:
        for camera in cameras.values():
            camera.stop()
    return {name: (times[name], *image) for name, image in images.items()}, faults


def _triggered(
    cameras: Mapping[str, BaslerCamera],
    each: Callable[[Callable[[BaslerCamera], float]], dict[str, float]],
    faults: Mapping[str, CameraFault],
) -> dict[str, float]:
    """Triggers cameras that take one; trigger times by name, of those that wait for others the first of these."""
    waits = {name: camera.settings.waits_for for name, camera in cameras.items()}
    if faults and any(waits.values()):  # all at once, or none
        return {}
    commands = [name for name in cameras if waits[name] == "action"]
    unneeded = set(commands[1:])  # one command is for all

    def own(camera: BaslerCamera) -> float:
        return time.time() if camera.settings.name in unneeded and not camera.emulated else camera.trigger()

    times = each(own)
    first = min(times.values(), default=0.0)
    return {name: first if waits[name] else at for name, at in times.items()}


def _first_line(error: Exception) -> str:
    """What a driver's error says, without where in its sources."""
    text = " ".join(str(error).split())
    return text.split(" : ")[0].split(" (file")[0].rstrip(".")[:200]
