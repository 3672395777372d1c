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

import numpy as np
from numpy.typing import NDArray

from torchpose.errors import ConfigError
from torchpose.io.films import rate_of_film
from torchpose.io.reader import Fault, decoded
from torchpose.io.sources import Source, find_sources
from torchpose.rig.cameras import Cameras
from torchpose.rig.settings import Rig, load_rig

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
    """Frames of files played as a camera, over and over: a folder, a manifest, or a film.

    Args:
        sources: the frames, in order.
        size: width and height of the camera, px.
        rate: frames/s; None: a film's own, or `FOLDER_RATE`.
    """

    def __init__(self, sources: Sequence[Source], size: tuple[int, int], rate: float | None = None) -> None:
        film = sources[0].film
        self.kind = "folder" if film is None else "video"
        self.sources, self._size = list(sources), size
        own = FOLDER_RATE if film is None else rate_of_film(film.path) or _FILM_RATE
        self._rate = rate or own
        self._clock, self._number, self._at = Clock(self._rate), -1, -1

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def newest(self, wait: Callable[[float], object]) -> Shot:
        step = self._clock.due(wait) - self._number
        late = step - 1 - int(_CATCH_UP_S * self._rate)
        if late > 0 and self.kind == "video":  # decodes what it passes over
            self._clock.set_back(late)
            step -= late
        self._number, self._at = self._number + step, (self._at + step) % len(self.sources)
        now, found = time.time(), decoded(self.sources[self._at], size=self._size)
        while found is None:
            self._leave_out(self.sources[self._at])
            found = decoded(self.sources[self._at], size=self._size)
        name, passed = self.sources[self._at].name, step - 1
        if isinstance(found, Fault):
            return Shot(name, now, None, found, passed)
        return Shot(name, now, found, passed_over=passed)

    def _leave_out(self, missing: Source) -> None:
        """Of a film that has ended, leaves out what would follow, and goes on behind it."""
        first = next(k for k, one in enumerate(self.sources) if one.film is missing.film)
        kept = [one for one in self.sources if one.film is not missing.film or one.directory < missing.directory]
        self._at = (first + missing.directory) % len(kept)
        self.sources = kept


class RigCamera:
    """A camera of a rig; its robot is left alone.

    Args:
        rig: of the rig file.
        name: of the camera.
        twin: twin file, or None for what is there.
        rate: most frames/s; None: as many as there is time for.
    """

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


def player(path: Path, size: tuple[int, int], rate: float | None, tell: Callable[[str], None]) -> Player:
    """The player of a SOURCE: folder, manifest or film, as INPUTs of `estimate` are read.

    Raises:
        ConfigError: it is none, or a film without a frame.
    """
    try:
        sources = find_sources([path], tell)
    except ConfigError as error:
        raise ConfigError(str(error).replace(": INPUT: ", ": SOURCE: ", 1)) from None
    if sources[0].film is not None and sources[0].film.frames == 0 and len(sources) == 1:
        fault = decoded(sources[0])
        why = fault.reason if isinstance(fault, Fault) else "empty"
        raise ConfigError(f"{path}: SOURCE: holds no frame that can be read ({why}); give a folder of images or a film")
    return Player(sources, size, rate)


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
