"""Tables that go to a store: made on this machine, where a journal can grow, and sent when they are whole."""

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from torchpose.errors import ConfigError
from torchpose.io.storage import Place, StorageError, refused
from torchpose.io.writers import TABLE_SUFFIXES

_ORIGIN = ".run.json"  # beside a table, see `ResultStore`
_MOST = 1 << 36  # bytes of a table that is resumed (convention)


class Staged:
    """Where a run writes, and what is sent where at its end. Paths of a disk are their own.

    Args:
        out: table of the poses.
        detections: that of the markers.
        resume: whether to go on with what an earlier run has left here, or else with what it has sent.

    Raises:
        ConfigError: a table cannot be written or read there.
    """

    def __init__(self, out: Path | Place, detections: Path | Place | None, *, resume: bool) -> None:
        self._sent: list[tuple[Path, Place, str]] = []
        self.out = self._here(out, "--out", resume=resume, origin=True)
        self.detections = None if detections is None else self._here(detections, "--detections", resume=resume)

    def _here(self, where: Path | Place, option: str, *, resume: bool, origin: bool = False) -> Path:
        if isinstance(where, Path):
            return where
        if where.suffix.lower() not in TABLE_SUFFIXES:
            fix = f"give a file that ends in {', '.join(TABLE_SUFFIXES)}"
            raise ConfigError(f"{where}: {option}: of an unknown type; {fix}")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = cache / "torchpose" / hashlib.sha256(str(where).encode()).hexdigest()[:16]
        path = folder / where.name
        pairs = [
            (path, where),
            *([(path.with_name(path.name + _ORIGIN), where.parent / (where.name + _ORIGIN))] * origin),
        ]
        self._sent += [(own, there, option) for own, there in pairs]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not path.with_name(f"{path.name}.partial").exists():  # else it knows better than what was sent
                for own, there in pairs:
                    own.unlink(missing_ok=True)
                    if resume and there.kind() == "file":
                        own.write_bytes(there.read(_MOST))
            where.check_bucket()
        except OSError as error:
            raise ConfigError(f"{folder}: {option}: cannot be written ({error.strerror}); set XDG_CACHE_HOME") from None
        except StorageError as error:
            raise refused(error, where, option) from None
        return path

    def send(self) -> None:
        """Sends what is whole, and keeps no copy. ConfigError: the store refuses; the copy is kept then."""
        for own, there, option in self._sent:
            try:
                there.write(own.read_bytes())
            except StorageError as error:
                fix = f"the table is kept in {own}"
                raise ConfigError(f"{there}: {option}: {error.problem}; {error.fix}; {fix}") from None
        for own, _, _ in self._sent:
            with suppress(OSError):
                own.unlink()
