"""A table that grows while it is read: rows are appended, and none is ever missing or twice, however a run ends.

Beside the table lies a journal (``poses.jsonl.watch``): what the rows are made from, then a line a batch with its
frames, where its rows lie in the table, and their checksum. Rows are on the disk before their line is. What a killed
run has left in the table behind the last line is cut off, and its frames are done again.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchpose.errors import ConfigError
from torchpose.io.journal import Journal
from torchpose.io.rows import Row, Schema
from torchpose.io.tally import Tally
from torchpose.io.writers import csv_lines, json_line, make_folder_of

GROWING_SUFFIXES = (".csv", ".jsonl")
_Place = Annotated[int, Field(ge=0)]


class _Batch(BaseModel):
    """A line of the journal behind the first."""

    model_config = ConfigDict(extra="forbid", strict=True)

    frames: list[str]
    start: _Place
    end: _Place
    rows: int = Field(ge=0, le=0xFFFFFFFF)  # their CRC-32


class GrowingTable:
    """The table at ``out``, made where it is missing, with the rows of earlier runs.

    Args:
        out: the table, ``.csv`` or ``.jsonl``.
        schema: its columns.
        origin: what the rows are made from, as JSON values; those of an earlier run must agree.

    Attributes:
        tally: of the rows of this run alone.
        tone: that earlier runs have judged; None where there was none.
        earlier: number of frames of earlier runs.

    Raises:
        ConfigError: the place cannot be written, another run is writing there, or what is there was made from something
            else or by another program.
    """

    def __init__(self, out: Path, schema: Schema, origin: Mapping[str, Any]) -> None:
        self.tally = Tally()
        if out.suffix.lower() not in GROWING_SUFFIXES:
            raise ConfigError(f"{out}: --out: cannot grow; give -, or a file that ends in .jsonl or .csv")
        make_folder_of(out, "--out")
        self._out, self._schema = out, schema
        self._done: set[str] = set()
        self.tone: str | None = None
        try:
            self._journal = Journal(out.with_name(out.name + ".watch"))
            try:
                self._file: FileIO = out.open("a+b", buffering=0)
                try:
                    self._end = self._load(dict(origin))
                    self._file.truncate(self._end)
                except BaseException:
                    self._file.close()
                    raise
            except BaseException:
                self._journal.remove() if self._journal.empty else self._journal.close()
                raise
        except OSError as error:
            raise self._unwritable(error) from None
        self.earlier = len(self._done)

    def __contains__(self, frame: str) -> bool:
        return frame in self._done

    def __len__(self) -> int:
        return len(self._done)

    def keep_tone(self, tone: str) -> None:
        """Has later runs take the tone that this one has judged."""
        self._write([{"tone": tone}])
        self.tone = tone

    def append(self, records: Sequence[Row]) -> None:
        """Makes the rows of finished frames permanent.

        Args:
            records: ``{"frame": name, "rows": [...]}``, one a frame.

        Raises:
            ConfigError: the disk is full or gone; what was appended before is safe.
        """
        rows = [row for record in records for row in record["rows"]]
        if not rows:
            return
        self._check_places()
        if self._out.suffix.lower() == ".csv":
            text = csv_lines(rows, self._schema, head=self._end == 0)
        else:
            text = "".join(json_line(row, self._schema) for row in rows)
        data, rest = text.encode(), memoryview(text.encode())
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._unwritable(error) from None
        frames, end = [record["frame"] for record in records], self._end + len(data)
        self._write([{"frames": frames, "start": self._end, "end": end, "rows": zlib.crc32(data)}])
        self._end = end
        self._done.update(frames)
        for record in records:
            self.tally.add(record["frame"], record["rows"])

    def close(self) -> None:
        """Leaves table and journal to the next run."""
        self._file.close()
        self._journal.close()

    def _write(self, records: Sequence[Mapping[str, Any]]) -> None:
        try:
            self._journal.append(records)
        except OSError as error:
            raise self._unwritable(error) from None

    def _check_places(self) -> None:
        """Rows that went into a file without a name would be gone with this process."""
        try:
            there = os.path.samestat(os.stat(self._out), os.fstat(self._file.fileno()))
        except OSError:
            there = False
        if not (there and self._journal.is_at_its_path()):
            raise ConfigError(
                f"{self._out}: --out: it, or {self._journal.path.name}, was moved or removed by another program; move "
                "both away, and start again"
            )

    def _load(self, origin: dict[str, Any]) -> int:
        """Takes over what earlier runs have left; where the table's rows end."""
        last = _Batch(frames=[], start=0, end=0, rows=0)
        lines = self._journal.lines()
        _, head = next(lines, (None, {}))
        if head == {}:
            if self._file.seek(0, os.SEEK_END):
                raise ConfigError(f"{self._out}: --out: has rows that torchpose watch did not write; give another file")
            self._journal.clear()
            self._journal.append([{"origin": origin}])
            return 0
        self._check(origin, head and head.get("origin"))
        for _, line in lines:
            try:
                if line is not None and list(line) == ["tone"]:
                    self.tone = str(line["tone"])
                    continue
                last = _Batch.model_validate(line)
            except ValidationError:
                raise self._foreign() from None
            self._done.update(last.frames)
        self._file.seek(last.start)
        if zlib.crc32(self._file.read(last.end - last.start)) != last.rows:
            raise ConfigError(
                f"{self._out}: --out: was changed by another program since; move it and {self._journal.path.name} away"
            )
        return last.end

    def _check(self, origin: dict[str, Any], earlier: Any) -> None:
        if not isinstance(earlier, dict):
            raise self._foreign()
        changed = [name for name in origin | earlier if origin.get(name) != earlier.get(name)]
        if changed:
            raise ConfigError(
                f"{self._out}: --out: the rows there were made with another {' and '.join(changed)}; give another file"
            )

    def _foreign(self) -> ConfigError:
        return ConfigError(f"{self._journal.path}: --out: damaged; move it and {self._out.name} away to start over")

    def _unwritable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self._out}: --out: cannot be written ({error.strerror}); free some space and start again, no row is lost"
        )
