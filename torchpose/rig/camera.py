"""Basler cameras through pypylon: settings that are read back, software trigger, retries, faults with a name.

The emulator that ships with pypylon (``PYLON_CAMEMU=1``) runs the same code.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator

from torchpose.rig.faults import RigFault

EMULATOR = "BaslerCamEmu"  # device class of the emulated cameras
_FROZEN = ConfigDict(extra="forbid", frozen=True)
_Positive = Annotated[FiniteFloat, Field(gt=0)]


class CameraReason(StrEnum):
    """Why a camera cannot go on."""

    NOT_FOUND = "not_found"
    NOT_OPENED = "not_opened"
    REFUSED_SETTING = "refused_setting"
    NOT_READY = "not_ready"
    TIMED_OUT = "time_out"
    FAILED_BUFFER = "failed_buffer"
    WRONG_SIZE = "wrong_size"
    REMOVED = "camera_removed"
    DRIVER_ERROR = "camera_driver_error"


class CameraFault(RigFault):
    """A camera cannot go on."""

    reason: CameraReason


class CameraSettings(BaseModel):
    """One of the `cameras:` of a rig file.

    Attributes:
        name: in frame ids and image names. serial: as printed on the camera; None takes the first that is free.
        width, height: of the frame, px. offset_x, offset_y: of its corner on the sensor; the middle by default.
        pixel_format: more than 8 bits are stored as 16-bit images with the values as the camera gives them.
        exposure_us, gain_db: fixed; the automatic functions are switched off.
        timeout_s: from trigger to image. attempts: at one frame, before the session ends.
        nodes: further GenICam features by name, set in this order.
    """

    model_config = _FROZEN
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=40)] = "camera"
    serial: str | None = None
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    offset_x: Annotated[int, Field(ge=0)] | None = None
    offset_y: Annotated[int, Field(ge=0)] | None = None
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono8"
    exposure_us: _Positive
    gain_db: FiniteFloat = 0.0
    timeout_s: _Positive = 5.0
    attempts: Annotated[int, Field(ge=1, le=20)] = 3
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

    @property
    def dtype(self) -> type[np.uint8] | type[np.uint16]:
        """Of the images."""
        return np.uint8 if self.pixel_format == "Mono8" else np.uint16


class BaslerCamera:
    """One camera, opened and set up; `torchpose.rig.cameras.Cameras` uses it.

    Args:
        device: information of the enumeration.

    Raises:
        CameraFault: it cannot be opened, or refuses a setting.
    """

    def __init__(self, settings: CameraSettings, device: Any) -> None:
        from pypylon import genicam, pylon

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
        from pypylon import pylon

        with self._driver():
            self._camera.StartGrabbingMax(1)
            # a trigger that comes before the camera is ready is lost without a word
            if not self._camera.WaitForFrameTriggerReady(
                int(1e3 * self.settings.timeout_s), pylon.TimeoutHandling_Return
            ):
                raise self._fault(CameraReason.NOT_READY, "does not become ready for a trigger; check its cable")

    def trigger(self) -> float:
        """Triggers the exposure; Unix time just before."""
        now = time.time()
        with self._driver():
            self._camera.ExecuteSoftwareTrigger()
        return now

    def fetch(self) -> tuple[np.ndarray, int]:
        """The triggered image (H, W) and the camera's time stamp.

        Raises:
            CameraFault: it does not come in time, is incomplete or of another size, or the camera has gone.
        """
        from pypylon import pylon

        s = self.settings
        with self._driver():
            with self._camera.RetrieveResult(int(1e3 * s.timeout_s), pylon.TimeoutHandling_ThrowException) as result:
                if not result.GrabSucceeded():
                    why = result.ErrorDescription or f"error {result.ErrorCode}"
                    raise self._fault(CameraReason.FAILED_BUFFER, f"{why} Check cable, network and packet size")
                image, stamp = np.array(result.Array), int(result.TimeStamp)
            # an unplugged camera may still deliver what was under way
            if self._camera.IsCameraDeviceRemoved():
                raise self._removed()
        if image.shape != (s.height, s.width) or image.dtype != s.dtype:
            size = " x ".join(str(n) for n in image.shape[1::-1])
            raise self._fault(
                CameraReason.WRONG_SIZE,
                f"the frame is {size} {image.dtype} instead of {s.width} x {s.height} {s.pixel_format}; "
                "correct width and height of the rig file or reset the camera",
            )
        return image, stamp

    def stop(self) -> None:
        """Ends the acquisition; whatever is under way is dropped."""
        from pypylon import genicam

        with contextlib.suppress(genicam.GenericException):  # the next start says what is wrong
            self._camera.StopGrabbing()

    def close(self) -> None:
        """Gives the camera back."""
        from pypylon import genicam

        self.stop()
        with contextlib.suppress(genicam.GenericException):  # it has been unplugged
            self._camera.Close()

    def _configure(self) -> dict[str, Any]:
        """Sets everything and returns what the camera then says."""
        s = self.settings
        self._set("PixelFormat", s.pixel_format)
        for offset in ("OffsetX", "OffsetY"):  # they limit the size
            self._set(offset, 0, optional=True)
        for name, size in (("Width", s.width), ("Height", s.height)):
            if self._emulated and size > self._read(f"{name}Max"):
                self._set(f"{name}Max", size)
            self._set(name, size)
        for axis, side, corner, size in (("X", "Width", s.offset_x, s.width), ("Y", "Height", s.offset_y, s.height)):
            if corner is not None:
                self._set(f"Offset{axis}", corner)
            elif (free := (self._read(f"{side}Max") or size) - size) > 0:
                self._set(f"Offset{axis}", free // 2 // 4 * 4, optional=True)  # in steps of 4, which all models allow
        self._set("ExposureAuto", "Off", optional=True)
        self._set("GainAuto", "Off", optional=True)
        # older cameras write Abs behind a name
        exposure = self._set(("ExposureTime", "ExposureTimeAbs"), s.exposure_us)
        gain = self._set(("Gain", "GainAbs"), s.gain_db, optional=s.gain_db == 0)
        for name, value in s.nodes.items():
            self._set(name, value)
        # last, whatever the file's nodes say: waiting for a trigger that nobody sends would never end
        self._set("AcquisitionMode", "Continuous")
        self._set("TriggerSelector", "FrameStart")
        self._set("TriggerMode", "On")
        self._set("TriggerSource", "Software")
        wanted = ["Width", "Height", "OffsetX", "OffsetY", "PixelFormat", exposure, gain, "TriggerMode"]
        wanted += ["TriggerSource", *s.nodes]
        read = {name: self._read(name) for name in wanted if name}
        for name, value in (("Width", s.width), ("Height", s.height), ("PixelFormat", s.pixel_format)):
            if read[name] != value:
                raise self._fault(
                    CameraReason.REFUSED_SETTING, f"{name}: is {read[name]} instead of {value}; change it"
                )
        return read

    def _set(self, names: str | Sequence[str], value: Any, *, optional: bool = False) -> str | None:
        """Sets the first of the nodes that the camera has; its name, None where an optional one is missing."""
        from pypylon import genicam

        names = [names] if isinstance(names, str) else names
        node = None
        for name in names:
            node = self._nodes.GetNode(name)
            if node is not None and genicam.IsWritable(node):
                break
        else:
            if optional:
                return None
            raise self._fault(CameraReason.REFUSED_SETTING, f"{' or '.join(names)}: cannot be set; see its manual")
        try:
            node.SetValue(value)
        except (genicam.GenericException, TypeError) as error:
            raise self._fault(
                CameraReason.REFUSED_SETTING, f"{name}: {value!r} is refused ({first_line(error)}); change it"
            ) from None
        return name

    def _read(self, name: str) -> Any:
        from pypylon import genicam

        node = self._nodes.GetNode(name)
        if node is None or not genicam.IsReadable(node):
            return None
        return node.GetValue()

    @contextlib.contextmanager
    def _driver(self) -> Iterator[None]:
        """Names the errors of the driver."""
        from pypylon import genicam

        try:
            yield
        except genicam.TimeoutException:
            if self._camera.IsCameraDeviceRemoved():
                raise self._removed() from None
            wait = self.settings.timeout_s
            raise self._fault(
                CameraReason.TIMED_OUT, f"no image within {wait:g} s of the trigger; check trigger, cable, timeout_s"
            ) from None
        except genicam.GenericException as error:
            if self._camera.IsCameraDeviceRemoved():
                raise self._removed() from None
            raise self._fault(CameraReason.DRIVER_ERROR, f"{first_line(error)}; restart the camera") from None

    def _removed(self) -> CameraFault:
        return self._fault(CameraReason.REMOVED, "has been disconnected; check cable and power")

    def _fault(self, reason: CameraReason, message: str) -> CameraFault:
        return CameraFault(reason, " ".join(f"camera {self.settings.name}: {message}".split()))


def first_line(error: Exception) -> str:
    """What a driver's error says, without where in its sources."""
    text = " ".join(str(error).split())
    return text.split(" : ")[0].split(" (file")[0].rstrip(".")[:200]
