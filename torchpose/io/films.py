"""Frames of video files, one after the other: decoded by FFmpeg in OpenCV, colour by its luma, 8 bits.

Few codecs have checksums, and FFmpeg fills what it cannot decode: damage within a film is mostly not told
(docs/pictures.md). That it ends early is. Frames are counted by their packets, which decodes nothing; what a header
says of their number may be wrong either way.
"""

import math
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchpose.io.images import UnreadableImageError
from torchpose.io.images.header import Header, check_size

FILM_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
_HEAD = 1 << 16  # bytes in which the boxes of a fragmented file say so
# by FFmpeg's own guess a text file would be a play list, whose entries are fetched from anywhere
_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
_EBML = b"\x1a\x45\xdf\xa3"  # Matroska and WebM
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's AV_LOG_QUIET: the rows say the same


class NoFrameError(UnreadableImageError):
    """The film ended before; the row of its first missing frame says so."""


class Film:
    """An open video file, whose frames threads ask for about in order.

    One thread decodes at a time. Of the frames that it passes on its way, as many are kept as there are threads.

    Args:
        path: of the file.
        frames: that it has.
    """

    def __init__(self, path: Path, frames: int) -> None:
        self.path, self.frames = path, frames
        self._lock = threading.Lock()
        self._capture: Any = None
        self._at = 0  # the frame that comes next
        self._end = frames  # the first that is not there
        self._ahead: dict[int, np.ndarray] = {}

    def __reduce__(self) -> tuple[type["Film"], tuple[Path, int]]:
        return Film, (self.path, self.frames)

    def decode(self, number: int, *, threads: int = 1, size: tuple[int, int] | None = None) -> np.ndarray:
        """Grey values (H, W) of a frame, uint8.

        Args:
            number: of the frame, from 0.
            threads: that decode side by side.
            size: width and height that the frame has to have, if known.

        Raises:
            NoFrameError: the film has ended before its first missing frame.
            UnreadableImageError: the film cannot be opened, or this is its first missing frame.
            WrongSizeError: the film has another size.
        """
        with self._lock:
            if number in self._ahead:
                return self._ahead.pop(number)
            if number >= self._end:
                if not self.frames:
                    self._open(threads)  # which says what is wrong
                raise self._missing(number)
            if self._capture is None or number < self._at:
                self._open(threads)
            get = self._capture.get
            width, height = int(get(cv2.CAP_PROP_FRAME_WIDTH)), int(get(cv2.CAP_PROP_FRAME_HEIGHT))
            check_size(Header(width, height, float("inf")), size)
            image = self._forward(number, threads)
            if image.shape != (height, width):
                raise UnreadableImageError("corrupt")
            return image

    def _missing(self, number: int) -> UnreadableImageError:
        return UnreadableImageError("truncated") if number == self._end else NoFrameError("truncated")

    def _open(self, threads: int) -> None:
        self._capture, self._at = _opened(self.path, [cv2.CAP_PROP_N_THREADS, threads]), 0
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # a camera file describes the rows of the sensor

    def _forward(self, number: int, threads: int) -> np.ndarray:
        """The frame, from those that come next."""
        while True:
            wanted = number - self._at < max(1, threads)
            try:
                there, image = self._capture.read() if wanted else (self._capture.grab(), None)
            except cv2.error:
                there, image = False, None
            if not there:
                self._end = self._at
                self._capture = None
                raise self._missing(number)
            self._at += 1
            if self._at >= self.frames:
                self._capture = None
            if image is None:
                continue
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            if self._at > number:
                return grey
            self._ahead[self._at - 1] = grey
            if len(self._ahead) > threads:
                self._ahead.pop(min(self._ahead))


def frames_of_film(path: Path) -> tuple[int, bool]:
    """How many frames a film has, and whether it was to have more: 0 and True where it cannot be opened."""
    try:
        capture = _opened(path, [cv2.CAP_PROP_FORMAT, -1])  # packets as they are
    except UnreadableImageError:
        return 0, True
    count = 0
    while capture.grab():
        count += 1
    return count, count == 0 or (_counts_frames(path) and capture.get(cv2.CAP_PROP_FRAME_COUNT) > count)


def rate_of_film(path: Path) -> float | None:
    """Frames/s by the film's header, where it has one and says so."""
    try:
        rate = _opened(path, []).get(cv2.CAP_PROP_FPS)
    except UnreadableImageError:
        return None
    return float(rate) if math.isfinite(rate) and rate > 0 else None


def _counts_frames(path: Path) -> bool:
    """Whether the header says how many frames there are; in others OpenCV guesses that from the duration."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return not head.startswith(_EBML) and b"mvex" not in head


def _opened(path: Path, options: Sequence[int]) -> Any:
    """The film. UnreadableImageError: with the reason."""
    try:
        if not path.is_file():
            raise UnreadableImageError("not_a_file" if path.exists() else "missing")
        with path.open("rb") as file:
            head = file.read(12)
    except (OSError, ValueError):
        raise UnreadableImageError("unreadable_file") from None
    if not head:
        raise UnreadableImageError("empty")
    if not (head.startswith(_EBML) or head[4:8] in _BOXES or (head.startswith(b"RIFF") and head[8:] == b"AVI ")):
        raise UnreadableImageError("not_an_image")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        # absolute: a name such as http:... is a file, too
        capture = cv2.VideoCapture(os.path.abspath(path), cv2.CAP_FFMPEG, list(options))
        if capture.isOpened():
            return capture
    except (cv2.error, UnicodeError):
        pass
    finally:
        cv2.utils.logging.setLogLevel(level)
    raise UnreadableImageError("corrupt")
