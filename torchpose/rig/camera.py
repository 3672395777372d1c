"""Basler cameras through pypylon: settings that are read back, software trigger, faults with a name.

The emulator that ships with pypylon (``PYLON_CAMEMU=1``) runs the same code.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchpose.rig.faults import CameraFault, CameraReason
from torchpose.rig.settings import CameraSettings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # as an error, a warning of its types crashes the interpreter
    try:
        from pypylon import genicam, pylon
    except ImportError:  # `torchpose.rig.cameras.Cameras` says so
        pylon = None

EMULATOR = "BaslerCamEmu"  # device class of the emulated cameras


class BaslerCamera:
    """One camera, opened and set up; `torchpose.rig.cameras.Cameras` uses it.

    Args:
        settings: of the rig file.
        device: information of the enumeration.

    Raises:
        CameraFault: it cannot be opened, or refuses a setting.
    """

    def __init__(self, settings: CameraSettings, device: Any) -> None:
        self.settings = settings
        self._emulated = device.GetDeviceClass() == EMULATOR
        try:
            self._camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(device))
            self._camera.Open()
        except genicam.GenericException as error:
            raise self._fault(
                CameraReason.NOT_OPENED, f"{first_line(error)}; close other programs that use it"
            ) from None
        self._nodes = self._camera.GetNodeMap()
        info = self._camera.GetDeviceInfo()
        self.description: dict[str, Any] = {
            "name": settings.name,
            "model": info.GetModelName(),
            "serial": info.GetSerialNumber(),
            "device_class": info.GetDeviceClass(),
            "firmware": self._read("DeviceFirmwareVersion"),
            "emulated": self._emulated,
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
        """Triggers the exposure; Unix time just before."""
        now = time.time()
        with self._driver():
            self._camera.ExecuteSoftwareTrigger()
        return now

    def fetch(self) -> tuple[np.ndarray[Any, Any], int]:
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
            raise self._fault(
                CameraReason.WRONG_SIZE,
                f"the frame is {size} {image.dtype} instead of {given.width} x {given.height} {given.pixel_format}; "
                "correct width and height of the rig file or reset the camera",
            )
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
            if self._emulated and size > self._read(f"{side}Max"):
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
        trigger = {"TriggerSelector": "FrameStart", "TriggerMode": "On", "TriggerSource": "Software"}
        for nodes in (given.nodes, {"AcquisitionMode": "Continuous"}, trigger):
            for name, value in nodes.items():
                self._set(name, value)
        wanted = ["Width", "Height", "OffsetX", "OffsetY", "PixelFormat", exposure, gain, "TriggerMode"]
        read = {name: self._read(name) for name in [*wanted, "TriggerSource", *given.nodes] if name}
        for name, value in (("Width", given.width), ("Height", given.height), ("PixelFormat", given.pixel_format)):
            if read[name] != value:
                raise self._fault(
                    CameraReason.REFUSED_SETTING, f"{name}: is {read[name]} instead of {value}; change it"
                )
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
                raise self._fault(
                    CameraReason.REFUSED_SETTING, f"{found}: {value!r} is refused ({first_line(error)}); change it"
                ) from None
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
            raise self._fault(CameraReason.DRIVER_ERROR, f"{first_line(error)}; restart the camera") from None

    def _removed(self) -> CameraFault:
        return self._fault(CameraReason.REMOVED, "has been disconnected; check cable and power")

    def _fault(self, reason: CameraReason, message: str) -> CameraFault:
        return CameraFault(reason, " ".join(f"camera {self.settings.name}: {message}".split()))


def first_line(error: Exception) -> str:
    """What a driver's error says, without where in its sources."""
    text = " ".join(str(error).split())
    return text.split(" : ")[0].split(" (file")[0].rstrip(".")[:200]
