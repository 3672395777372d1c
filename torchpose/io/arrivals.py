"""Pictures that arrive in a folder, each once it is whole.

A writer has closed its file, or has renamed it into place, where the system tells so (watchdog); else the file has kept
its size and time for a while. That is no proof: a writer may come back. So a file that does not decode yet waits for
its next change, and only one that has been left alone for long is taken as it is.

Events are hints. The folder is read at the start and again and again, for events that were lost and for drives that
send none. Without watchdog, or where the system refuses, that reading is all there is.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchpose.errors import ConfigError
from torchpose.io.films import FILM_SUFFIXES
from torchpose.io.sources import IMAGE_SUFFIXES, OTHERS, natural_key

_PATIENCE = 10  # times the settling time (convention), after which a file that does not decode is taken as it is
_TICK = 0.05  # s between looks at the files that wait (convention)
_RESCAN = 2.0  # s between readings of the folder where there are events (convention)
_SHARE = 20  # of the time that reading the folder may take, one part (convention)

_Stamp = tuple[int, int]
_PASSED = OTHERS.union(FILM_SUFFIXES)  # what somebody may expect to be read


@dataclass(frozen=True)
class Arrival:
    """A file that is taken.

    Attributes:
        path: of the file.
        name: below the folder, with forward slashes.
        stamp: its size and time of change when it was taken.
        last: whether it has been left alone for so long that it counts as it is.
    """

    path: Path
    name: str
    stamp: _Stamp
    last: bool

    @property
    def unchanged(self) -> bool:
        """Whether the file is still as it was when it was taken."""
        return _stamp(self.path) == self.stamp


@dataclass
class _Waiting:
    stamp: _Stamp | None
    since: float  # when this stamp was first seen
    closed: bool = False  # since it has this stamp
    failed: _Stamp | None = None  # with which it did not decode


class Arrivals:
    """Watches a folder and all below it. Hidden files and folders, and linked folders, are passed over.

    Args:
        folder: to watch.
        settle: seconds that a file has to keep its size and time where nothing says that it was closed.
        events: whether to ask the system for events.
        tell: is given a line for each kind of pictures that is passed over, and when the folder is gone or back.

    Attributes:
        by_events: whether the system sends any.

    Raises:
        ConfigError: the folder cannot be read.
    """

    def __init__(
        self, folder: Path, *, settle: float = 1.0, events: bool = True, tell: Callable[[str], None] = lambda line: None
    ) -> None:
        self._folder, self._settle, self._tell = folder, settle, tell
        self._passed: set[str] = set()  # suffixes that are told
        self._gone = False
        self._waiting: dict[Path, _Waiting] = {}
        self._taken: set[Path] = set()
        self._hints: dict[Path, bool] = {}  # whether it was closed or renamed
        self._lock, self._woken = threading.Lock(), threading.Event()
        try:
            os.listdir(folder)
        except OSError as error:
            raise ConfigError(f"{folder}: FOLDER: cannot be read ({error.strerror}); give a folder") from None
        self._observer = self._observe() if events else None
        self.by_events = self._observer is not None
        self._next_scan = 0.0
        self._first = True

    def ready(self, timeout: float) -> list[Arrival]:
        """Files that are whole, in the order of their arrival; waits for one until ``timeout`` seconds are over."""
        end = time.monotonic() + timeout
        while True:
            self._take_hints()
            if time.monotonic() >= self._next_scan:
                self._scan()
            found = self._whole()
            if found or time.monotonic() >= end:
                return found
            self._woken.wait(_TICK)
            self._woken.clear()

    @property
    def waiting(self) -> bool:
        """Whether there are files that are not whole yet."""
        return bool(self._waiting or self._hints)

    def put_back(self, arrival: Arrival) -> None:
        """Has a file wait that was not whole after all."""
        self._taken.discard(arrival.path)
        now = _stamp(arrival.path)
        if now is not None:
            failed = arrival.stamp if now == arrival.stamp else None
            self._waiting[arrival.path] = _Waiting(now, time.monotonic(), failed=failed)

    def close(self) -> None:
        """Ends the watching."""
        if self._observer is not None:
            self._observer.stop()
            self._observer.join()

    def _observe(self) -> Any:
        """What calls `_hint`; None where there are no events."""
        try:
            from watchdog.events import FileSystemEvent, FileSystemEventHandler
            from watchdog.observers import Observer
        except ImportError:
            return None
        hint = self._hint

        class Handler(FileSystemEventHandler):
            def on_any_event(self, event: FileSystemEvent) -> None:
                if event.event_type not in ("opened", "closed_no_write", "deleted"):
                    whole = event.event_type in ("closed", "moved")
                    hint(event.dest_path if event.event_type == "moved" else event.src_path, whole, event.is_directory)

        # a folder that is made while its own folder is read is seen twice, with the same result
        warnings.filterwarnings("ignore", "Callback with id", RuntimeWarning)
        observer = Observer()
        try:
            observer.schedule(Handler(), os.fspath(self._folder), recursive=True)
            observer.start()
        except OSError:  # no room for further watches, or a drive that has none
            return None
        return observer

    def _hint(self, name: str | bytes, whole: bool, folder: bool) -> None:
        """Called by the observer's thread."""
        path = Path(os.fsdecode(name))
        with self._lock:
            if folder:
                self._next_scan = 0.0  # it may have been filled before it was watched
            elif path.suffix.lower() in IMAGE_SUFFIXES:
                self._hints[path] = whole
        self._woken.set()

    def _take_hints(self) -> None:
        with self._lock:
            hints, self._hints = self._hints, {}
        for path, whole in hints.items():
            hidden = any(part.startswith(".") for part in path.relative_to(self._folder).parts)
            if not hidden and path not in self._taken:
                self._see(path, closed=whole)

    def _see(self, path: Path, *, closed: bool, age: float = 0.0) -> None:
        """Notes what a file looks like now; ``age`` in seconds since its last change, where that is known."""
        now, stamp = time.monotonic(), _stamp(path)
        if stamp is None:
            self._waiting.pop(path, None)
            return
        known = self._waiting.setdefault(path, _Waiting(stamp, now - age))
        if known.stamp != stamp:
            known.stamp, known.since, known.closed = stamp, now, False
        known.closed = known.closed or closed

    def _scan(self) -> None:
        """Reads the folder."""
        start = time.monotonic()
        if self._gone != (not os.path.isdir(self._folder)):
            self._gone = not self._gone
            state = "cannot be read any more; waiting for it" if self._gone else "is back"
            self._tell(f"{self._folder}: FOLDER: {state}")
        pictures = [path for path in _files(self._folder) if self._is_read(path)]
        found = [path for path in pictures if path not in self._taken and path not in self._waiting]
        for path in sorted(found, key=lambda path: natural_key(path.as_posix())):
            # before the start nobody saw when a file was written, but its time says when
            self._see(path, closed=False, age=min(_age(path), self._settle) if self._first else 0.0)
        self._first = False
        now = time.monotonic()
        pause = _RESCAN if self.by_events else self._settle
        self._next_scan = now + max(pause, _SHARE * (now - start))

    def _is_read(self, path: Path) -> bool:
        """Whether a file ends like a picture that is read; of another kind of pictures the first is told."""
        suffix = path.suffix.lower()
        if suffix in _PASSED and suffix not in self._passed:
            self._passed.add(suffix)
            read = ", ".join(IMAGE_SUFFIXES)
            self._tell(f"{path}: passed over, as all {suffix} are here; what is read ends in {read}")
        return suffix in IMAGE_SUFFIXES

    def _whole(self) -> list[Arrival]:
        """Takes the files that are whole."""
        found = []
        for path in list(self._waiting):
            self._see(path, closed=False)
            waiting = self._waiting.get(path)
            if waiting is None or waiting.stamp is None:
                continue
            left = time.monotonic() - waiting.since
            last = left >= _PATIENCE * self._settle
            if last or (waiting.stamp != waiting.failed and (waiting.closed or left >= self._settle)):
                name = os.fsencode(path.relative_to(self._folder).as_posix()).decode("utf-8", "backslashreplace")
                found.append(Arrival(path, name, waiting.stamp, last))
                self._taken.add(path)
                del self._waiting[path]
        return found


def _stamp(path: Path) -> _Stamp | None:
    """Size and time of change of a file; None where there is none."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found.st_size, found.st_mtime_ns


def _age(path: Path) -> float:
    stamp = _stamp(path)
    return 0.0 if stamp is None else max(0.0, time.time() - stamp[1] / 1e9)


def _files(folder: Path) -> Iterator[Path]:
    """Files below a folder."""
    for base, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in files:
            if not name.startswith("."):
                yield Path(base, name)
