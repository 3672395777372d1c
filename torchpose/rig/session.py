"""The folder of a capture session: images and their manifest, written so that a fault leaves every earlier frame.

An image is written under a temporary name, synced and renamed, then its line is appended to the manifest and synced:
a line is there only for an image that is whole. ``torchpose.io.manifest`` describes the manifest.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import platform
import shutil
import time
from collections.abc import Mapping
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from torchpose.errors import ConfigError
from torchpose.io.manifest import read_records
from torchpose.rig.faults import RigFault

SCHEMA = "torchpose.capture/1"
MANIFEST = "manifest.jsonl"
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class SessionReason(StrEnum):
    """Why a session cannot be written on."""

    DISK_FULL = "disk_full"
    NOT_WRITABLE = "not_writable"


class SessionFault(RigFault):
    """A file of the session cannot be written."""

    reason: SessionReason


class Session:
    """A session's folder, for use in a ``with`` block.

    Args:
        folder: made where it is missing. plan: digest of the waypoints. images: what the images depend on, by camera.
        resume: go on with the session that is there.

    Attributes:
        done: ids of the frames that are there.

    Raises:
        ConfigError: a session is there and ``resume`` is not given; or it is, and none is there, it has another plan or
            other cameras, or one of its images is missing; or the folder cannot be written.
    """

    def __init__(self, folder: Path, *, plan: str, images: Mapping[str, Any], resume: bool = False) -> None:
        self.folder = folder
        self.manifest = folder / MANIFEST
        self.done: set[str] = set()
        self._origin: dict[str, Any] = {"plan_digest": plan, "images": dict(images)}
        self._earlier: dict[str, Any] | None = None
        self._file: int | None = None
        if resume:
            self._recover()
        elif self.manifest.exists():
            raise ConfigError(f"{self.manifest}: --out: holds a session already; add --resume or choose another folder")

    @property
    def begun(self) -> bool:
        """Whether there is a manifest to go on with."""
        return self.manifest.exists()

    def __enter__(self) -> Self:
        try:
            (self.folder / "images").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self.folder}: --out: cannot be made ({error.strerror}); choose another") from None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def check_space(self, size: int) -> None:
        """Raises a SessionFault where the disk has less than ``size`` bytes left."""
        free = shutil.disk_usage(self.folder).free
        if free < size:
            raise SessionFault(
                SessionReason.DISK_FULL,
                f"{self.folder}: {free / 1e9:.1f} GB are left and the images may need {size / 1e9:.1f} GB; free some",
            )

    def begin(self, *, emulated: bool, record: Mapping[str, Any]) -> None:
        """Appends the session record: with what, in which units, whether any part of the rig is emulated.

        Raises:
            ConfigError: the session to be resumed has the other ``emulated``. SessionFault: it cannot be written.
        """
        if self._earlier is not None and self._earlier.get("emulated") != emulated:
            raise ConfigError(
                f"{self.manifest}: --resume: emulated is {not emulated} there and {emulated} now; choose another --out"
            )
        try:
            self._file = os.open(self.manifest, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        except OSError as error:
            raise _fault(self.manifest, error) from None
        self._append(
            {
                "record": "session",
                "schema": SCHEMA,
                "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "units": {"length": "mm", "angle": "rad", "time": "s"},
                **self._origin,
                "emulated": emulated,
                "resumed": self._earlier is not None,
                "versions": {name: _version(name) for name in ("torchpose", "pypylon", "ur-rtde")}
                | {"python": platform.python_version()},
                **record,
            }
        )

    def write(self, frame: str, image: np.ndarray, record: Mapping[str, Any]) -> None:
        """Stores one frame: its image, then its record.

        Raises:
            SessionFault: one of both cannot be written; nothing of the frame is left in the manifest.
        """
        name = f"images/{frame}.png"
        path = self.folder / name
        done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        assert done  # of uint8 or uint16 every time
        encoded = data.tobytes()
        temporary = path.with_name(f".{path.name}.tmp")
        try:
            with temporary.open("wb") as file:
                file.write(encoded)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            _sync_folder(path.parent)
        except OSError as error:
            raise _fault(path, error) from None
        finally:
            with contextlib.suppress(OSError):  # its space is needed for the end record
                temporary.unlink(missing_ok=True)
        height, width = image.shape
        digest = hashlib.sha256(encoded).hexdigest()
        self._append(
            {
                "record": "frame",
                "id": frame,
                "image": name,
                "sha256": digest,
                "width": width,
                "height": height,
                **record,
            }
        )
        self.done.add(frame)

    def end(self, reason: str, detail: str = "") -> None:
        """Appends the end record, if the session has begun and the disk lets it.

        Its absence says too that the session was cut short.
        """
        if self._file is None:
            return
        ended = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        with contextlib.suppress(SessionFault):
            self._append(
                {"record": "end", "frames": len(self.done), "reason": reason, "detail": detail, "ended": ended}
            )

    def _append(self, record: Mapping[str, Any]) -> None:
        """One line, on the disk when this returns; nothing of it is left where that fails."""
        assert self._file is not None
        before = os.fstat(self._file).st_size
        line = (json.dumps(record, allow_nan=False) + "\n").encode()
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, before)
            raise _fault(self.manifest, error) from None

    def _recover(self) -> None:
        """Reads what an earlier run finished and cuts a line off that it left unfinished."""
        if not self.manifest.exists():
            raise ConfigError(f"{self.manifest}: --resume: does not exist; leave --resume out to start the session")
        records = [record for _, record in read_records(self.manifest)]
        self._earlier = next((record for record in records if record.get("record") == "session"), None)
        words = {"plan_digest": "has another plan", "images": "has other cameras or image sizes"}
        for key, value in self._origin.items():
            if self._earlier is not None and self._earlier.get(key) != value:
                raise ConfigError(
                    f"{self.manifest}: --resume: the session {words[key]}; give the same, or another --out"
                )
        for record in records:
            if record.get("record") != "frame":
                continue
            image = self.folder / record["image"]
            if not image.is_file():
                raise ConfigError(f"{image}: --resume: is missing, but the manifest lists it; restore it or start anew")
            self.done.add(record["id"])
        self._close_last_line()

    def _close_last_line(self) -> None:
        """Ends a whole last line that lacks its newline, and cuts off one that is torn, as `read_records` drops it."""
        content = self.manifest.read_bytes()
        last = content.rpartition(b"\n")[2]
        if not last:
            return
        try:
            json.loads(last)
        except ValueError:
            os.truncate(self.manifest, len(content) - len(last))
        else:
            with self.manifest.open("ab") as file:
                file.write(b"\n")


def _fault(path: Path, error: OSError) -> SessionFault:
    if error.errno in _NO_SPACE:
        return SessionFault(SessionReason.DISK_FULL, f"{path}: no space left on the disk; free some")
    return SessionFault(SessionReason.NOT_WRITABLE, f"{path}: cannot be written ({error.strerror}); check the folder")


def _sync_folder(folder: Path) -> None:
    """Makes a rename durable, where the system lets a folder be synced."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except ModuleNotFoundError:
        return None
