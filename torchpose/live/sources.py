"""Where the frames of the live page come from: a folder or a video played as a camera, or a camera of a rig.

Nothing is queued. Whoever has the time asks for the newest frame, and what has passed since the last one is counted.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from torchpose.errors import ConfigError
from torchpose.io.images import UnreadableImageError, WrongSizeError
from torchpose.io.reader import Fault
from torchpose.io.sources import Source, find_sources
from torchpose.results import Status
from torchpose.rig.cameras import Cameras
from torchpose.rig.settings import Rig, load_rig

FILMS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mpeg", ".webm")
FOLDER_RATE = 5.0  # frames/s (convention): what a camera of 20 MP gives
_PAUSE_S = 0.05  # at most between two looks at whether to end
_FILM_RATE = 25.0  # frames/s, of a film that does not say
_CATCH_UP_S = 1.0  # of a film that is passed over at once; beyond, it is played more slowly


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame, or why there is none.

    Attributes:
        name: what the row calls it.
        taken_s: Unix time.
        image: (H, W) uint8 or uint16.
        fault: where there is no image.
        passed_over: frames of the source since the last shot that nobody had time for.
        white: full scale of the grey values; None: as the frame tells.
    """

    name: str
    taken_s: float
    image: NDArray[np.integer[Any]] | None
    fault: Fault | None = None
    passed_over: int = 0
    white: float | None = None


class Frames(Protocol):
    """A source of frames, for use in a ``with`` block by one thread."""

    kind: str
    """What a page says of it: folder, video, camera, twin."""
    encoded: bool
    """Whether its grey values are likely bent by a tone curve."""

    def __enter__(self) -> Frames: ...

    def __exit__(self, *_: object) -> None: ...

    def newest(self, wait: Callable[[float], object]) -> Shot:
        """The newest frame; where there is none yet, ``wait`` is called with seconds to wait.

        Raises:
            CameraFault: a camera cannot go on; entering the block anew may mend it.
        """
        ...


class Clock:
    """Which frame of something that is played at a rate is due."""

    def __init__(self, rate: float, now: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._now = rate, now
        self._start: float | None = None
        self._last = -1

    def due(self, wait: Callable[[float], object]) -> int:
        """Number of the frame that is due, later than the last one, which is waited for."""
        if self._start is None:
            self._start = self._now()
        while (number := math.floor((self._now() - self._start) * self._rate)) <= self._last:
            wait(min(_PAUSE_S, max(0.0, self._start + (self._last + 1) / self._rate - self._now())))
        self._last = number
        return number

    def set_back(self, frames: int) -> None:
        """So many frames are still to come that should have been."""
        assert self._start is not None
        self._start += frames / self._rate
        self._last -= frames


class Player:
    """A folder, or a manifest, played as a camera, over and over.

    Args:
        sources: the frames, in order.
        size: width and height of the camera, px.
        rate: frames/s.
    """

    kind = "folder"

    def __init__(self, sources: Sequence[Source], size: tuple[int, int], rate: float = FOLDER_RATE) -> None:
        self._sources, self._size = sources, size
        self.encoded = sources[0].likely_encoded()
        self._clock, self._number = Clock(rate), -1

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def newest(self, wait: Callable[[float], object]) -> Shot:
        number = self._clock.due(wait)
        passed, self._number = number - self._number - 1, number
        source, now = self._sources[number % len(self._sources)], time.time()
        try:
            return Shot(source.name, now, source.decode(size=self._size), passed_over=passed)
        except UnreadableImageError as error:
            return Shot(source.name, now, None, Fault(Status.UNREADABLE, error.reason), passed)
        except WrongSizeError as error:
            return Shot(source.name, now, None, Fault(Status.WRONG_SIZE, str(error)), passed)


class Film:
    """A video file played as a camera, over and over; frames are called by their number.

    Args:
        path: of the file.
        size: width and height of the camera, px.
        rate: frames/s; None: the file's own.

    Raises:
        ConfigError: there is no frame in it.
    """

    kind, encoded = "video", True

    def __init__(self, path: Path, size: tuple[int, int], rate: float | None = None) -> None:
        self._path, self._size = path, size
        self._film = cv2.VideoCapture(str(path))
        if not self._film.isOpened() or not self._film.grab():
            self._film.release()
            raise ConfigError(f"{path}: SOURCE: holds no frame that OpenCV reads; give a folder of images or a video")
        own = self._film.get(cv2.CAP_PROP_FPS)
        self._rate = rate or (own if math.isfinite(own) and own > 0 else _FILM_RATE)
        self._clock, self._number, self._at = Clock(self._rate), -1, 0  # the first frame is at hand

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *_: object) -> None:
        self._film.release()

    def newest(self, wait: Callable[[float], object]) -> Shot:
        number = self._clock.due(wait)
        late = number - self._number - 1 - int(_CATCH_UP_S * self._rate)
        if late > 0:
            self._clock.set_back(late)
            number -= late
        for _ in range(number - self._number - (self._number < 0)):
            self._forward()
        passed, self._number = number - self._number - 1, number
        there, picture = self._film.retrieve()
        name, now = f"{self._path.name}#{self._at}", time.time()
        if not there:
            return Shot(name, now, None, Fault(Status.UNREADABLE, "corrupt"), passed)
        image: Any = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        if image.shape[::-1] != self._size:
            return Shot(name, now, None, Fault(Status.WRONG_SIZE, f"{image.shape[1]}x{image.shape[0]}"), passed)
        return Shot(name, now, image, passed_over=passed)

    def _forward(self) -> None:
        """To the next frame, or to the first one again."""
        self._at += 1
        if not self._film.grab():
            self._film.release()
            self._film = cv2.VideoCapture(str(self._path))
            self._film.grab()
            self._at = 0


class RigCamera:
    """A camera of a rig; its robot is left alone.

    Args:
        rig: of the rig file.
        name: of the camera.
        twin: twin file, or None for what is there.
        rate: most frames/s; None: as many as there is time for.
    """

    encoded = False

    def __init__(self, rig: Rig, name: str, twin: Path | None, rate: float | None = None) -> None:
        self.kind = "camera" if twin is None else "twin"
        (self._settings,) = (camera for camera in rig.cameras if camera.name == name)
        self._rig, self._twin, self._rate = rig, twin, rate
        self._clock = None if rate is None else Clock(rate)
        self._open = contextlib.ExitStack()
        self._number = 0

    def __enter__(self) -> RigCamera:
        with contextlib.ExitStack() as stack:
            scene = None
            if self._twin is not None:
                from torchpose.rig.twin.scene import standing_twin

                scene = stack.enter_context(standing_twin(self._twin, self._rig, self._number)).look
            self._cameras = stack.enter_context(Cameras([self._settings], scene))
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def newest(self, wait: Callable[[float], object]) -> Shot:
        if self._clock is not None:
            self._clock.due(wait)
        (frame,) = self._cameras.grab([self._settings.name])
        self._number += 1
        name = f"{self._settings.name}-{self._number:06d}"
        return Shot(name, frame.trigger_time_s, frame.image, white=float((1 << self._settings.bits) - 1))


def folder_or_film(path: Path, size: tuple[int, int], rate: float | None, tell: Callable[[str], None]) -> Frames:
    """The player of a SOURCE. ConfigError: it is none."""
    if path.suffix.lower() in FILMS and not path.is_dir():
        if not path.is_file():
            raise ConfigError(f"{path}: SOURCE: does not exist; give a folder of images or a video file")
        return Film(path, size, rate)
    try:
        return Player(find_sources([path], tell), size, rate or FOLDER_RATE)
    except ConfigError as error:
        raise ConfigError(str(error).replace(": INPUT: ", ": SOURCE: ", 1)) from None


def camera_of_rig(given: Path, twin: Path | None, size: tuple[int, int], rate: float | None) -> RigCamera:
    """The camera that ``RIG`` or ``RIG#NAME`` names.

    Raises:
        ConfigError: a file is wrong, the rig has several cameras and none is named, or it has another frame size.
    """
    name, _, wanted = str(given).partition("#") if not given.exists() else (str(given), "", "")
    rig = load_rig(name)
    names = [camera.name for camera in rig.cameras]
    if not wanted and len(names) > 1:
        raise ConfigError(f"{given}: --rig: has {len(names)} cameras; pick one: {Path(name).name}#{names[0]}")
    if wanted and wanted not in names:
        raise ConfigError(f"{name}: --rig: has no camera {wanted!r}; known are {', '.join(names)}")
    settings = next(camera for camera in rig.cameras if camera.name == (wanted or names[0]))
    if (settings.width, settings.height) != size:
        there = f"camera {settings.name} has {settings.width} x {settings.height}"
        raise ConfigError(f"{name}: --rig: {there}, but --camera {size[0]} x {size[1]}; give its own camera file")
    if twin is not None:
        from torchpose.rig.twin.scene import Scene

        Scene.load(twin).check(rig, twin)
    return RigCamera(rig, settings.name, twin, rate)
