"""The rows of a run, safe against being killed at any moment.

While a run goes on, each finished batch is appended to a journal beside the output (``poses.csv.partial``): one JSON
line a frame with its rows and its detections, a batch in one write, then fsync. The first line says what the rows were
made from. At the end the tables are written whole and moved into place, what they were made from is kept beside them
(``poses.csv.run.json``), and the journal is removed. A killed run therefore leaves the journal, with at most its last
line torn; a resumed one drops that line and goes on. A finished table is resumed by turning it into a journal again.
"""

import contextlib
import errno
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from io import FileIO
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, BinaryIO

from filelock import lock_descriptor
from pydantic import BaseModel, Field, ValidationError

from torchpose.errors import ConfigError
from torchpose.io.misfits import Misfits
from torchpose.io.rows import DETECTION_SCHEMA, NEWER, Row, Schema
from torchpose.io.writers import atomic_path, check_table_path, read_rows, write_rows

_UNSAID = {"--instances": 1}  # in what older runs were made from
Origin = Mapping[str, Any]
"""What rows are made from (versions, digests of the files, inputs), as JSON values by name."""


class _Record(BaseModel):
    """A line of a journal behind the first, as `ResultStore.append` takes it."""

    frame: str
    rows: Annotated[list[dict[str, Any]], Field(min_length=1)]
    detections: list[dict[str, Any]]


class ResultStore:
    """Collects the rows of a run frame by frame and writes its tables.

    Args:
        out: table of the poses.
        detections: table of the markers, or None.
        schema: columns of ``out``.
        targets: that every frame has a row of in ``out``, or several.
        origin: what the rows are made from; a resumed run must agree.
        resume: whether to keep the frames that an earlier run finished, instead of starting over.

    Attributes:
        counts: number of rows by status, those of an earlier run included.
        unreadable: frames that could not be read, with their reason.
        crowded: frames that show more copies of a target than they have rows.
        most: by target, the most copies of it that one of these frames shows.
        misfits: by target, what its rows say together of target and camera file.

    Raises:
        ConfigError: a place cannot be written, another run is writing there, or there is an earlier run that cannot be
            resumed because it was made from something else.
    """

    def __init__(
        self, out: Path, detections: Path | None, *, schema: Schema, targets: int, origin: Origin, resume: bool
    ) -> None:
        check_table_path(out, "--out")
        if detections is not None:
            check_table_path(detections, "--detections")
            if detections.resolve() == out.resolve():
                raise ConfigError(f"{detections}: --detections: is the file of --out too; give another")
        self.counts: Counter[str] = Counter()
        self.unreadable: dict[str, str] = {}
        self.crowded: set[str] = set()
        self.most: dict[str, int] = {}
        self.misfits: dict[str, Misfits] = {}
        self._out, self._detections = out, detections
        self._schema, self._targets = schema, targets
        self._origin = json.loads(json.dumps(origin))
        self._journal_path = out.with_name(out.name + ".partial")
        self._origin_path = out.with_name(out.name + ".run.json")
        self._places: dict[str, tuple[int, int]] = {}  # frame -> offset and length of its line in the journal
        resumable = resume and self._journal_path.exists()
        finished = list(self._finished()) if resume and not resumable and out.exists() else []
        with contextlib.ExitStack() as stack:
            try:
                # unbuffered: what a full disk refuses must not be tried again when the file is closed
                self._journal: FileIO = stack.enter_context(self._journal_path.open("a+b", buffering=0))
                self._lock()
                if not (resumable and self._load()):
                    self._journal.truncate(0)
                    self._write([{"origin": self._origin}])
                    self.append(finished)
            except OSError as error:
                raise self._unwritable(error) from None
            stack.pop_all()  # nothing went wrong: it stays open

    def __contains__(self, frame: str) -> bool:
        return frame in self._places

    def __len__(self) -> int:
        return len(self._places)

    def append(self, records: Sequence[Row]) -> None:
        """Makes finished frames permanent.

        Args:
            records: ``{"frame": name, "rows": [...], "detections": [...]}``, one a frame.

        Raises:
            ConfigError: the disk is full or gone; what was appended before is safe.
        """
        try:
            places = self._write(records)
        except OSError as error:
            raise self._unwritable(error) from None
        for record, place in zip(records, places, strict=True):
            self._note(record, place)

    def finish(self, order: Sequence[str]) -> None:
        """Writes the tables and removes the journal.

        Args:
            order: frames in the order of the rows. Frames of an earlier run that are not in it come first.
        """
        listed = set(order)
        frames = [frame for frame in self._places if frame not in listed] + [f for f in order if f in self._places]
        if self._detections is not None:
            rows = (row for record in self._records(frames) for row in record["detections"])
            write_rows(self._detections, rows, DETECTION_SCHEMA)
        write_rows(self._out, (row for record in self._records(frames) for row in record["rows"]), self._schema)
        with atomic_path(self._origin_path) as path:
            path.write_text(json.dumps(self._origin, indent=2) + "\n", encoding="utf-8")
        self.close()
        self._journal_path.unlink()

    def close(self) -> None:
        """Leaves the journal for a later run with ``resume``."""
        self._journal.close()

    def _unwritable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self._journal_path}: --out: cannot be written ({error.strerror}); free some space or choose another "
            "place, with --resume to keep what is there"
        )

    def _lock(self) -> None:
        """Keeps a second run from writing the same journal; the system releases it however the run ends."""
        try:
            locked = lock_descriptor(self._journal.fileno(), blocking=False)
        except OSError as error:
            if error.errno != errno.ENOSYS:
                raise
            return  # a file system without locks, where this guard is missing
        if not locked:
            raise ConfigError(
                f"{self._journal_path}: --out: another run is writing it; wait for it or choose another file"
            )

    def _reader(self) -> BinaryIO:
        """The journal to read from, by its own descriptor: elsewhere than on POSIX the lock keeps others out."""
        self._journal.seek(0)
        return open(self._journal.fileno(), "rb", closefd=False)

    def _write(self, records: Sequence[Row]) -> list[tuple[int, int]]:
        lines = [json.dumps(record, allow_nan=False).encode() + b"\n" for record in records]
        starts = accumulate(map(len, lines), initial=self._journal.seek(0, os.SEEK_END))
        rest = memoryview(b"".join(lines))
        while rest:
            rest = rest[self._journal.write(rest) :]
        os.fsync(self._journal.fileno())
        return [(start, len(line)) for start, line in zip(starts, lines, strict=False)]

    def _note(self, record: Row, place: tuple[int, int]) -> None:
        self._places[record["frame"]] = place
        self.counts.update(row["status"] for row in record["rows"])
        if record["rows"][0]["status"] == "unreadable":
            self.unreadable[record["frame"]] = record["rows"][0]["reason"]
        rows = Counter(row["target"] for row in record["rows"])
        for row in record["rows"]:
            self.misfits.setdefault(row["target"], Misfits()).add(row)
            if (row.get("copies") or 0) > rows[row["target"]]:
                self.crowded.add(record["frame"])
                self.most[row["target"]] = max(self.most.get(row["target"], 0), row["copies"])

    def _load(self) -> bool:
        """Reads the journal of a killed run and drops a torn end; False if not even its first line is whole."""
        offset = 0
        with self._reader() as lines:
            for line in lines:
                if not line.endswith(b"\n"):
                    break
                try:
                    record = json.loads(line)
                except ValueError:  # a crash of the machine may leave blocks of zeros
                    break
                if offset == 0:
                    self._check_origin(record.get("origin") if isinstance(record, dict) else None, self._journal_path)
                else:
                    try:
                        self._note(_Record.model_validate(record).model_dump(), (offset, len(line)))
                    except (ValidationError, KeyError, TypeError, ValueError):
                        raise self._foreign(self._journal_path) from None
                offset += len(line)
        self._journal.truncate(offset)
        return offset > 0

    def _records(self, frames: Sequence[str]) -> Iterator[Row]:
        with self._reader() as journal:
            for frame in frames:
                offset, length = self._places[frame]
                journal.seek(offset)
                record = json.loads(journal.read(length))
                for part, schema in (("rows", self._schema), ("detections", DETECTION_SCHEMA)):
                    newer = {column: cell for column, cell in NEWER.items() if column in schema}
                    record[part] = [newer | row for row in record[part]]
                yield record

    def _finished(self) -> Iterator[Row]:
        """Records of the tables of a run that was completed."""
        try:
            origin = json.loads(self._origin_path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise ConfigError(
                f"{self._origin_path}: --resume: missing or damaged, so what {self._out.name} was made from is not "
                "known; run without --resume"
            ) from None
        self._check_origin(origin, self._out)
        records: dict[str, Row] = {}
        for row in read_rows(self._out, self._schema):
            record = records.setdefault(row["frame"], {"frame": row["frame"], "rows": [], "detections": []})
            record["rows"].append(row)
        if self._detections is not None:
            for row in read_rows(self._detections, DETECTION_SCHEMA):
                if row["frame"] in records:
                    records[row["frame"]]["detections"].append(row)
        yield from (r for r in records.values() if len({row["target"] for row in r["rows"]}) == self._targets)

    def _foreign(self, path: Path) -> ConfigError:
        return ConfigError(f"{path}: --resume: not written by torchpose; run without --resume")

    def _check_origin(self, origin: Any, path: Path) -> None:
        if not isinstance(origin, dict):
            raise self._foreign(path)
        changed = [name for name in self._origin if origin.get(name, _UNSAID.get(name)) != self._origin[name]]
        if changed:
            raise ConfigError(
                f"{path}: --resume: the rows there were made with another {' and '.join(changed)}; "
                "run without --resume to start over"
            )
