"""The folder of a capture session: images and their manifest, written so that a fault leaves every earlier frame.

An image is written under a temporary name, synced and renamed, then its line is appended to the manifest and synced:
a line is there only for an image that is whole, with its digest. One process at a time writes a session: it holds the
file ``.lock``, as long as it lives and no longer. ``torchpose.io.manifest`` says what all manifests have in common.
"""

import contextlib
import errno
import hashlib
import os
import platform
import shutil
import time
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from torchpose.config import check_regular, is_inside, validate
from torchpose.errors import ConfigError
from torchpose.io.journal import Lock
from torchpose.io.manifest import read_records
from torchpose.rig.faults import SessionFault, SessionReason
from torchpose.rig.records import EndRecord, FrameRecord, SessionRecord


class Session:
    """A session's folder, for use in a ``with`` block.

    Args:
        folder: made where it is missing.
        plan: digest of the waypoints.
        images: what the images depend on, by camera.
        resume: go on with the session that is there.

    Attributes:
        done: ids of the frames that are there.
        begins_with: the record that it begins with; a session without a robot has another.
        frame_record: the record of a frame.

    Raises:
        ConfigError: another process writes it; a session is there and ``resume`` is not given; or it is, and none is
            there, it has another plan or other cameras, one of its records is wrong or one of its images is missing or
            not the one that was written; or the folder cannot be written.
    """

    begins_with: type[BaseModel] = SessionRecord
    frame_record: type[BaseModel] = FrameRecord

    def __init__(self, folder: Path, *, plan: str, images: Mapping[str, Any], resume: bool = False) -> None:
        self.folder = folder
        self.manifest = folder / "manifest.jsonl"
        self.done: set[str] = set()
        self._origin: dict[str, Any] = {"plan_digest": plan, "images": dict(images)}
        self._earlier: SessionRecord | None = None
        self._file: int | None = None
        self._lock: Lock | None = None
        if resume:
            if not os.path.exists(self.manifest):
                problem = "does not exist; leave --resume out to start the session"
                raise ConfigError(f"{self.manifest}: --resume: {problem}")
            self._hold()  # before a torn line is dropped, which may be one that is being written
            try:
                self._recover()
            except BaseException:
                self.close()
                raise
        else:
            self._check_new()

    def _check_new(self) -> None:
        if os.path.exists(self.manifest):
            raise ConfigError(f"{self.manifest}: --out: holds a session already; add --resume or choose another folder")

    def _hold(self) -> None:
        try:
            self._lock = Lock(self.folder / ".lock")
        except BlockingIOError:
            problem = "another capture is writing this session; wait for it or choose another folder"
            raise ConfigError(f"{self.folder}: --out: {problem}") from None
        except OSError as error:
            raise ConfigError(f"{self.folder}: --out: cannot be written ({error.strerror}); choose another") from None

    @property
    def begun(self) -> bool:
        """Whether there is a manifest to go on with."""
        return os.path.exists(self.manifest)

    def __enter__(self) -> Self:
        try:
            (self.folder / "images").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self.folder}: --out: cannot be made ({error.strerror}); choose another") from None
        if self._lock is None:
            self._hold()
            self._check_new()  # another capture may have begun and ended since
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self.close()

    def close(self) -> None:
        """Lets other processes write the session, where it has not been entered; leaving it does so too."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def check_space(self, size: int) -> None:
        """Raises a SessionFault where the disk has less than ``size`` bytes left."""
        free = shutil.disk_usage(self.folder).free
        if free < size:
            need = f"{free / 1e9:.1f} GB are left and the images may need {size / 1e9:.1f} GB"
            raise SessionFault(SessionReason.DISK_FULL, f"{self.folder}: {need}; free some")

    def begin(self, *, emulated: bool, **contents: Any) -> None:
        """Appends the session record.

        Args:
            emulated: whether any part of the rig is.
            contents: plan, waypoints, robot and cameras of a `SessionRecord`, and further entries.

        Raises:
            ConfigError: the session to be resumed has the other ``emulated``.
            SessionFault: it cannot be written.
        """
        if self._earlier is not None and self._earlier.emulated != emulated:
            problem = f"emulated is {not emulated} there and {emulated} now"
            raise ConfigError(f"{self.manifest}: --resume: {problem}; choose another --out")
        with _disk(self.manifest):
            self._file = os.open(self.manifest, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        versions = {name: _version(name) for name in ("torchpose", "pypylon", "ur-rtde")}
        self._append(
            self.begins_with(
                **self._origin,
                started=_now(),
                emulated=emulated,
                resumed=self._earlier is not None,
                versions=versions | {"python": platform.python_version()},
                **contents,
            )
        )

    def write(self, frame: str, image: NDArray[np.integer[Any]], **taken: Any) -> None:
        """Stores one frame: its image, then its record.

        Args:
            frame: id of the frame and name of the image.
            image: (H, W) uint8 or uint16.
            taken: the entries of a `FrameRecord` that the image does not tell.

        Raises:
            SessionFault: one of both cannot be written; nothing of the frame is left in the manifest.
        """
        name = f"images/{frame}.png"
        path = self.folder / name
        encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        temporary = path.with_name(f".{path.name}.tmp")
        try:
            with _disk(path):
                with temporary.open("wb") as file:
                    file.write(encoded)
                    file.flush()
                    os.fsync(file.fileno())
                temporary.replace(path)
                _sync_folder(path.parent)
        finally:
            with contextlib.suppress(OSError):  # its space is needed for the end record
                temporary.unlink(missing_ok=True)
        height, width = image.shape
        digest = hashlib.sha256(encoded).hexdigest()
        self._append(self.frame_record(id=frame, image=name, sha256=digest, width=width, height=height, **taken))
        self.done.add(frame)

    def end(self, reason: str, detail: str = "") -> None:
        """Appends the end record, if the session has begun and the disk lets it; its absence says something too."""
        if self._file is not None:
            with contextlib.suppress(SessionFault):
                self._append(EndRecord(frames=len(self.done), reason=reason, detail=detail, ended=_now()))

    def _append(self, record: BaseModel) -> None:
        """One line, on the disk when this returns; nothing of it is left where that fails."""
        assert self._file is not None
        before = os.fstat(self._file).st_size
        line = f"{record.model_dump_json(by_alias=True)}\n".encode()
        try:
            with _disk(self.manifest):
                while line:
                    line = line[os.write(self._file, line) :]
                os.fsync(self._file)
        except SessionFault:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, before)
            raise

    def _recover(self) -> None:
        """Reads what an earlier run finished and closes its last line."""
        last = 0
        for last, record in read_records(self.manifest):  # counts on behind the loop
            where = f"{self.manifest}: line {last}"
            if record.get("record") == "session" and self._earlier is None:
                self._earlier = validate(SessionRecord, record, where)
            elif record.get("record") == "frame":
                frame = validate(FrameRecord, record, where)
                if frame.id in self.done:
                    raise ConfigError(f"{where}: id: {frame.id!r} occurs twice; two captures have written here")
                self._check_image(frame, where)
                self.done.add(frame.id)
        words = {"plan_digest": "has another plan", "images": "has other cameras or image sizes"}
        for key, value in self._origin.items():
            if self._earlier is not None and getattr(self._earlier, key) != value:
                problem = f"the session {words[key]}"
                raise ConfigError(f"{self.manifest}: --resume: {problem}; give the same, or another --out")
        content = self.manifest.read_bytes()
        if last > content.count(b"\n"):  # a whole last line lacks its newline
            with self.manifest.open("ab") as file:
                file.write(b"\n")
        else:  # of a line that is torn, nothing is left
            os.truncate(self.manifest, content.rfind(b"\n") + 1)

    def _check_image(self, frame: FrameRecord, where: str) -> None:
        """Raises ConfigError unless the image of a frame is there as it was written."""
        image = self.folder / frame.image
        if not is_inside(image, self.folder):
            raise ConfigError(f"{where}: image: {frame.image!r} lies outside of the session; give it anew")
        try:
            check_regular(image)
            with image.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            problem = "is missing, but the manifest lists it"
        except OSError as error:
            problem = f"cannot be read ({error.strerror}), but the manifest lists it"
        else:
            if digest == frame.sha256:
                return
            problem = "is not the image that was written (its sha256 is another)"
        raise ConfigError(f"{image}: --resume: {problem}; restore it or start anew")


@contextlib.contextmanager
def _disk(path: Path) -> Iterator[None]:
    """Names the errors of the disk."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise SessionFault(SessionReason.DISK_FULL, f"{path}: no space left on the disk; free some") from None
        why = f"cannot be written ({error.strerror}); check the folder"
        raise SessionFault(SessionReason.NOT_WRITABLE, f"{path}: {why}") from None


def _sync_folder(folder: Path) -> None:
    """Makes a rename durable, where the system lets a folder be synced."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
