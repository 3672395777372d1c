"""Recordings and stills: sessions that `torchpose estimate` reads, written by a thread of their own.

A frame that comes while another one is being written is left out and counted; the estimator never waits for the disk.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
from pydantic import BaseModel, ConfigDict, Field

from torchpose.config.kinds import Side, Text, Word
from torchpose.errors import ConfigError, TorchposeError
from torchpose.io.rows import Row
from torchpose.io.writers import atomic_path
from torchpose.live.sources import Shot
from torchpose.rig.faults import SessionFault
from torchpose.rig.session import Session

_LEFT_FREE = 1 << 30  # bytes (convention): a recording ends before it fills the disk
_MOST_FRAMES = 100_000  # of one recording (convention): a day at one frame a second


class _LiveRecord(BaseModel):
    """A recording begins: of what, by whom. No robot is known."""

    model_config = ConfigDict(extra="ignore")
    record: Literal["session"] = "session"
    version: Literal["torchpose.live/1"] = Field(default="torchpose.live/1", alias="schema")
    started: str
    units: dict[str, str] = {"length": "mm", "angle": "rad", "time": "s"}
    images: dict[str, list[int | str]]
    emulated: bool
    versions: dict[str, str | None]
    source: Text
    target: Text


class _PictureRecord(BaseModel):
    """An image that is there, when it was taken, what the source called it and what was seen in it."""

    record: Literal["frame"] = "frame"
    id: Word
    image: Word
    sha256: Word
    width: Side
    height: Side
    source_frame: Text
    taken_s: float
    status: Word


class _LiveSession(Session):
    begins_with = _LiveRecord
    frame_record = _PictureRecord


@dataclass(frozen=True)
class RecordingState:
    """What a page says of recording: its name while one runs and of the last one, frames in it and left out, and why it
    ended by itself."""

    on: bool = False
    name: str | None = None
    frames: int = 0
    left_out: int = 0
    fault: str | None = None


class Recorder:
    """Writes recordings and stills below a folder, for use in a ``with`` block.

    Names are made of the time and a number; nobody else has a say in them.

    Args:
        folder: made when the first one is written.
        about: entries of the session record: source, target, emulated, and images as in `rig.capture.image_origin`.

    Attributes:
        state: what there is to tell.
    """

    def __init__(self, folder: Path, **about: Any) -> None:
        self.state = RecordingState()
        self._folder, self._about = folder, about
        self._images = about.pop("images")
        self._session: _LiveSession | None = None
        self._next: tuple[Shot, str] | None = None
        self._changed, self._open = threading.Condition(), True
        self._thread = threading.Thread(target=self._write_all, name="recorder", daemon=True)

    def __enter__(self) -> Recorder:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._thread.join()

    def start(self) -> RecordingState:
        """Begins a recording where none runs. ConfigError or SessionFault: the disk does not let it."""
        with self._changed:
            if self._session is None:
                folder = self._fresh("recording")
                session = _LiveSession(folder, plan="", images=self._images)
                with contextlib.ExitStack() as stack:
                    stack.enter_context(session)
                    session.check_space(_LEFT_FREE)
                    session.begin(**self._about)
                    stack.pop_all()
                self._session, self.state = session, RecordingState(on=True, name=folder.name)
            return self.state

    def stop(self) -> RecordingState:
        """Ends the recording that runs, its last frame written."""
        with self._changed:
            while self._next is not None and self._session is not None:
                self._changed.wait()
            self._end("complete")
            return self.state

    def offer(self, shot: Shot, status: str) -> None:
        """Has a frame written if a recording runs and nothing else is being written."""
        if self._session is None or shot.image is None:
            return
        with self._changed:
            if self._next is not None:
                self.state = replace(self.state, left_out=self.state.left_out + 1)
                return
            self._next = (shot, status)
            self._changed.notify_all()

    def still(self, shot: Shot, row: Row) -> str:
        """Writes a frame and, beside it, its row; the name of the picture.

        Raises:
            ConfigError: it cannot be written.
        """
        assert shot.image is not None
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self._folder}: --record: cannot be made ({error.strerror}); choose another") from None
        picture = self._fresh("still", ".png")
        encoded = cv2.imencode(".png", shot.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        with atomic_path(picture, option="--record: ") as temporary:
            temporary.write_bytes(encoded)
        with atomic_path(picture.with_suffix(".json"), option="--record: ") as temporary:
            temporary.write_text(json.dumps(row, allow_nan=False) + "\n", encoding="utf-8")
        return picture.name

    def _fresh(self, what: str, suffix: str = "") -> Path:
        """A name that is not there yet."""
        stamp = time.strftime("%Y%m%d-%H%M%S")
        number = 1
        while (path := self._folder / f"{what}-{stamp}-{number}{suffix}").exists():
            number += 1
        return path

    def _end(self, reason: str, fault: str | None = None) -> None:
        """Closes the session; called with the lock held."""
        if self._session is not None:
            self._session.end(reason)
            self._session.__exit__()
            self._session = None
            self.state = replace(self.state, on=False, fault=fault)

    def _write_all(self) -> None:
        while True:
            with self._changed:
                while self._next is None and self._open:
                    self._changed.wait()
                if self._next is None:
                    return
                (shot, status), session = self._next, self._session
            problem = self._write(session, shot, status)
            with self._changed:
                self._next = None
                if session is not None and session is self._session:
                    self.state = replace(self.state, frames=len(session.done))
                    if problem is not None:
                        self._end(problem, problem)
                    elif len(session.done) >= _MOST_FRAMES:
                        self._end("complete", "full")
                self._changed.notify_all()

    def _write(self, session: _LiveSession | None, shot: Shot, status: str) -> str | None:
        """Writes a frame; why it could not be, in a word."""
        if session is None or shot.image is None:
            return None
        try:
            session.check_space(_LEFT_FREE)
            number = f"{len(session.done) + 1:06d}"
            session.write(number, shot.image, source_frame=shot.name, taken_s=shot.taken_s, status=status)
        except SessionFault as fault:
            return fault.reason.value
        except (TorchposeError, OSError):
            return "not_writable"
        return None
