"""Folders that are written file by file, on a disk or in a store: each file is there as a whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from torchpose.config import read_text
from torchpose.errors import ConfigError
from torchpose.io.storage import Place, StorageError, refused
from torchpose.io.writers import atomic_path

_MOST_TEXT = 1 << 30  # bytes (convention)


@dataclass(frozen=True)
class Folder:
    """Where a command puts its files.

    Attributes:
        where: a path, or a place in a store.
        option: of the command line, for error messages.
    """

    where: Path | Place
    option: str = "--out"

    def __truediv__(self, name: str) -> Folder:
        return Folder(self.where / name, self.option)

    def __str__(self) -> str:
        return str(self.where)

    def absolute(self) -> Folder:
        """The same for a process that works elsewhere."""
        return Folder(self.where.absolute() if isinstance(self.where, Path) else self.where, self.option)

    def make(self) -> None:
        """Makes the folder; in a store, where there are none, looks for the bucket. ConfigError: it cannot be."""
        try:
            if isinstance(self.where, Place):
                self.where.check_bucket()
            else:
                self.where.mkdir(parents=True, exist_ok=True)
        except StorageError as error:
            raise refused(error, self.where, self.option) from None
        except OSError as error:
            raise ConfigError(
                f"{self.where}: {self.option}: cannot be made ({error.strerror}); choose another folder"
            ) from None

    def names(self) -> set[str]:
        """Files of the folder; none where it is not there. ConfigError: a store refuses."""
        if isinstance(self.where, Path):
            return {path.name for path in self.where.iterdir()} if self.where.is_dir() else set()
        try:
            return {one.name for one in self.where.listed()} if self.where.kind() == "folder" else set()
        except StorageError as error:
            raise refused(error, self.where, self.option) from None

    def text(self, name: str) -> str:
        """What a file holds. ConfigError: it cannot be read; ValueError: it is no text."""
        place = self.where / name
        if isinstance(place, Path):
            return read_text(place)
        try:
            return place.read(_MOST_TEXT).decode()
        except StorageError as error:
            raise refused(error, place, self.option) from None

    def save(self, name: str, write: Callable[[Path], None]) -> None:
        """Has a file written to a path, and sent from there where this is a store. ConfigError: it cannot be."""
        if isinstance(self.where, Path):
            write(self.where / name)
            return
        with TemporaryDirectory() as folder:
            write(Path(folder, name))
            self.write(name, Path(folder, name).read_bytes())

    def write(self, name: str, data: bytes) -> None:
        """Writes a file of which there are many: it need not survive a crash of the machine. ConfigError."""
        place = self.where / name
        if isinstance(place, Path):
            fix = "free some space and go on with --resume"
            with atomic_path(place, option=f"{self.option}: ", fix=fix, sync=False) as temporary:
                temporary.write_bytes(data)
            return
        try:
            place.write(data)
        except StorageError as error:
            raise ConfigError(f"{place}: {self.option}: {error.problem}; {error.fix}; add --resume to go on") from None
