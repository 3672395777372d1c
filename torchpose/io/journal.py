"""A file of JSON objects, one a line, that survives being killed, and that one process writes at a time.

Every line begins with the checksum of its rest, ``{"crc32": "0a1b2c3d", ...``: what a disk or an editor has changed is
told from what was written. What is appended is on the disk when `Journal.append` returns. The lock is the system's
(flock): it ends with the process that holds it, however that ends.
"""

import contextlib
import errno
import json
import os
import weakref
import zlib
from collections.abc import Iterator, Mapping, Sequence
from io import FileIO
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

from filelock import lock_descriptor

from torchpose.config import check_regular, parse_json
from torchpose.errors import ConfigError

Place = tuple[int, int]
"""Offset and length of a line."""
_HEAD = b'{"crc32": "%08x", '
_HEAD_LENGTH = len(_HEAD % 0)


def seal(record: Mapping[str, Any]) -> bytes:
    """The line of a record that is not empty."""
    rest = json.dumps(record, allow_nan=False).encode()[1:]
    return (_HEAD % zlib.crc32(rest)) + rest + b"\n"


def unseal(line: bytes) -> dict[str, Any] | None:
    """The record of a line; None where the line is not as it was written."""
    rest = line[_HEAD_LENGTH:-1]
    if not line.endswith(b"}\n") or line[:_HEAD_LENGTH] != _HEAD % zlib.crc32(rest):
        return None
    try:
        record = parse_json(b"{" + rest)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def locked(descriptor: int) -> bool:
    """Whether the open file is now this process's alone; so it counts where a file system has no locks."""
    try:
        return lock_descriptor(descriptor, blocking=False)
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise
        return True


class Lock:
    """Holds a file, made where it is missing, until it is released or the process ends, however it ends.

    Raises:
        BlockingIOError: another process holds it.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        self.release = weakref.finalize(self, os.close, descriptor)
        if not locked(descriptor):
            self.release()
            raise BlockingIOError(errno.EWOULDBLOCK, "another process holds it", os.fspath(path))


class Journal:
    """The journal at ``path``, made where it is missing.

    Raises:
        ConfigError: another process holds it, or what is there is no file.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if os.path.exists(path):
            check_regular(path)
        while True:
            # unbuffered: what a full disk refuses must not be tried again when the file is closed
            self._file: FileIO = path.open("a+b", buffering=0)
            try:
                if not locked(self._file.fileno()):
                    raise ConfigError(f"{path}: --out: another run is writing it; wait for it or choose another file")
                if self.is_at_its_path():
                    return
            except BaseException:
                self._file.close()
                raise
            self._file.close()  # whoever held it before has just ended and removed it

    def is_at_its_path(self) -> bool:
        """Whether what is open is what others find under its name."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            return False

    def lines(self) -> Iterator[tuple[Place, dict[str, Any] | None]]:
        """Places and records of the lines that have an end, None for a record that is damaged; drops a torn end."""
        offset = 0
        with self._reader() as lines:
            for line in lines:
                if not line.endswith(b"\n"):
                    break
                yield (offset, len(line)), unseal(line)
                offset += len(line)
        self._file.truncate(offset)

    def append(self, records: Sequence[Mapping[str, Any]]) -> list[Place]:
        """Writes records in one go; their places. OSError: the disk is full or gone."""
        lines = [seal(record) for record in records]
        starts = accumulate(map(len, lines), initial=self._file.seek(0, os.SEEK_END))
        rest = memoryview(b"".join(lines))
        while rest:
            rest = rest[self._file.write(rest) :]
        os.fsync(self._file.fileno())
        return [(start, len(line)) for start, line in zip(starts, lines, strict=False)]

    def read(self, places: Sequence[Place]) -> Iterator[dict[str, Any]]:
        """The records at places. ConfigError: one has been damaged since it was written."""
        with self._reader() as journal:
            for offset, length in places:
                journal.seek(offset)
                record = unseal(journal.read(length))
                if record is None:
                    raise ConfigError(f"{self.path}: --out: was changed by another program; add --resume to mend it")
                yield record

    def clear(self) -> None:
        """Leaves nothing in it."""
        self._file.truncate(0)

    @property
    def empty(self) -> bool:
        return os.fstat(self._file.fileno()).st_size == 0

    def close(self) -> None:
        """Leaves it to the next process."""
        self._file.close()

    def remove(self) -> None:
        """Closes it for good: removed while the lock is held, so that nobody else's is."""
        if os.name == "posix":
            self.path.unlink(missing_ok=True)
            self.close()
        else:  # where an open file cannot be removed
            self.close()
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)

    def _reader(self) -> BinaryIO:
        """To read from, by the journal's own descriptor: elsewhere than on POSIX the lock keeps others out."""
        self._file.seek(0)
        return open(self._file.fileno(), "rb", closefd=False)
