"""A table in parts: a folder, on a disk or in a store, of Parquet files that are there whole or not at all.

``part-FIRST-DIGEST.parquet`` holds the rows of one block of frames. Its name follows from the block, so that a block
that was done twice, because the worker that did it first was lost, has one file. The file keeps the stamps of its
pictures. ``_torchpose.json`` says what the rows were made from, and ``_SUCCESS`` lists the parts once all are there.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchpose.config import parse_json
from torchpose.errors import ConfigError
from torchpose.io.rows import Row, Schema
from torchpose.io.sources import Source
from torchpose.io.storage import Place, StorageError, as_place, refused
from torchpose.io.store import Stamp
from torchpose.io.writers import parquet_bytes

_ORIGIN, _SUCCESS, _PART = "_torchpose.json", "_SUCCESS", "part-"
_KEY = b"torchpose"  # of a part's metadata
_MOST_ORIGIN = 1 << 24  # bytes (convention)
_AGAIN = ("unreadable", "wrong_size")


@dataclass(frozen=True)
class Part:
    """What a part says: its file's name, its rows, and the stamps of their pictures by frame."""

    name: str
    rows: list[Row]
    files: dict[str, Stamp | None]

    def is_fresh(self, files: Mapping[str, Stamp | None]) -> bool:
        """Whether its rows are those that would be made now of these pictures."""
        changed = any(files.get(frame, stamp) != stamp for frame, stamp in self.files.items())
        return not changed and not any(row["status"] in _AGAIN for row in self.rows)


def part_name(first: int, sources: Sequence[Source]) -> str:
    """Of the block of frames that begins with the frame of this number."""
    names = "\0".join(source.name for source in sources)
    return f"{_PART}{first:09d}-{hashlib.sha256(names.encode()).hexdigest()[:12]}.parquet"


@dataclass(frozen=True)
class Parts:
    """The folder of a table in parts.

    Attributes:
        folder: where it lies.
        schema: columns of the rows.
        option: of the command line, for error messages.
    """

    folder: Place
    schema: Schema
    option: str = "--out"

    @classmethod
    def at(cls, where: Path | Place, schema: Schema, option: str = "--out") -> "Parts":
        """ConfigError: no folder of Parquet files can be there."""
        if where.suffix.lower() != ".parquet":
            raise ConfigError(
                f"{where}: {option}: of an unknown type; --engine ray writes a folder that ends in .parquet"
            )
        if isinstance(where, Path) and where.is_file():
            raise ConfigError(f"{where}: {option}: is a file; --engine ray writes a folder, choose another place")
        return cls(as_place(where), schema, option)

    def begin(self, origin: Mapping[str, Any], *, resume: bool) -> None:
        """Takes the folder for rows that are made from this. ConfigError: it holds others."""
        try:
            there = any(True for _ in self._names())
            if there and not resume:
                raise ConfigError(
                    f"{self.folder}: {self.option}: holds rows; add --resume to go on with them or choose another place"
                )
            if there:
                self._check_origin(origin)
            (self.folder / _SUCCESS).remove()
            (self.folder / _ORIGIN).write(json.dumps(origin, indent=1).encode() + b"\n")
        except StorageError as error:
            raise refused(error, self.folder, self.option) from None

    def _check_origin(self, origin: Mapping[str, Any]) -> None:
        try:
            before = parse_json((self.folder / _ORIGIN).read(_MOST_ORIGIN))
            changed = [name for name, value in parse_json(json.dumps(origin)).items() if before.get(name) != value]
        except (StorageError, ValueError, AttributeError):
            raise ConfigError(
                f"{self.folder / _ORIGIN}: --resume: missing or damaged, so what the rows were made from is not known; "
                "choose another place"
            ) from None
        if changed:
            raise ConfigError(
                f"{self.folder}: --resume: the rows there were made with another {' and '.join(changed)}; "
                "choose another place"
            )

    def _names(self) -> Iterator[str]:
        for one in self.folder.listed() if self.folder.kind() == "folder" else ():
            if one.name.startswith(_PART) and one.name.endswith(".parquet"):
                yield one.name

    def written(self) -> Iterator[Part]:
        """The parts that are there, in order. One that cannot be read is removed: its frames are done again."""
        for name in sorted(self._names()):
            part = self._read(name)
            if part is None:
                self.remove(name)
            else:
                yield part

    def _read(self, name: str) -> Part | None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with (self.folder / name).open() as opened, pq.ParquetFile(opened) as file:
                files = parse_json((file.schema_arrow.metadata or {})[_KEY])["files"]
                rows = [row for group in file.iter_batches() for row in group.to_pylist()]
        except (OSError, KeyError, TypeError, ValueError, pa.ArrowException):
            return None
        return Part(name, rows, files)

    def write(self, name: str, rows: Iterable[Row], files: Mapping[str, Stamp | None]) -> None:
        """Writes a part whole. StorageError."""
        (self.folder / name).write(parquet_bytes(rows, self.schema, {_KEY: json.dumps({"files": files}).encode()}))

    def remove(self, name: str) -> None:
        """Removes a part."""
        (self.folder / name).remove()

    def finish(self) -> None:
        """Says that all parts are there. ConfigError: the place cannot be written."""
        try:
            names = sorted(self._names())
            (self.folder / _SUCCESS).write(json.dumps({"parts": names}, indent=1).encode() + b"\n")
        except StorageError as error:
            raise refused(error, self.folder, self.option) from None
