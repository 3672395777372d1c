"""The rows of a run, safe against being killed at any moment.

While a run goes on, each finished batch is appended to a journal beside the output (``poses.csv.partial``): one line a
frame with its rows, its detections, and the size and time of its file, a batch in one write, then fsync. The first line
says what the rows were made from. At the end the tables are written whole and moved into place, what they were made
from and the frames' files are kept beside them (``poses.csv.run.json``), and the journal is removed. A killed run
therefore leaves the journal, with at most its last line torn; a resumed one drops that line and goes on. A finished
table is resumed by turning it into a journal again.

A resumed run keeps the rows of a frame whose file is as it was. It does again what could not be read or had another
size, what was changed since, and what a damaged line of the journal held.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from torchpose.config import parse_json, read_text, real
from torchpose.errors import ConfigError
from torchpose.io.cells import row_check
from torchpose.io.journal import Journal, Place
from torchpose.io.rows import DETECTION_SCHEMA, NEWER, Row, Schema
from torchpose.io.tally import Tally
from torchpose.io.writers import atomic_path, check_table_path, make_folder_of, read_rows, write_rows
from torchpose.results import Status

_UNSAID = {"--instances": 1}  # in what older runs were made from
_FILES = "files"  # in what is kept beside a finished table, with the frames' names
_MOST_ORIGIN = 256 << 20  # bytes of it (convention): three million frames
Origin = Mapping[str, Any]
"""What rows are made from (versions, digests of the files, inputs), as JSON values by name."""
Stamp = Annotated[list[int], Field(min_length=2, max_length=2)]
"""Size of a frame's file in bytes and its time of change in ns: another picture under the same name has another one."""
_STAMPS = TypeAdapter(dict[str, Stamp | None])
_AGAIN = {status.name.lower() for status in (Status.UNREADABLE, Status.WRONG_SIZE)}


class _Record(BaseModel):
    """A line of a journal behind the first, as `ResultStore.append` takes it."""

    frame: str
    rows: Annotated[list[dict[str, Any]], Field(min_length=1)]
    detections: list[dict[str, Any]]
    file: Stamp | None = None


class ResultStore:
    """Collects the rows of a run frame by frame and writes its tables.

    Args:
        out: table of the poses.
        detections: table of the markers, or None.
        schema: columns of ``out``.
        targets: that every frame has a row of in ``out``, or several.
        origin: what the rows are made from; a resumed run must agree.
        resume: whether to keep the frames that an earlier run finished, instead of starting over.
        files: stamps of the frames that there are now, by name. Of an earlier run's frames that are not among them all
            rows are kept, of the others those that were made from the same file.

    Attributes:
        marks: columns of ``detections``.
        tally: of all rows, those of an earlier run included.
        damaged: lines of the journal that were not as they had been written.

    Raises:
        ConfigError: a place cannot be written, another run is writing there, or there is an earlier run that cannot be
            resumed because it was made from something else.
    """

    marks: Schema = DETECTION_SCHEMA

    def __init__(
        self,
        out: Path,
        detections: Path | None,
        *,
        schema: Schema,
        targets: int,
        origin: Origin,
        resume: bool,
        files: Mapping[str, Stamp | None] | None = None,
    ) -> None:
        check_table_path(out, "--out")
        if detections is not None:
            check_table_path(detections, "--detections")
            if real(detections) == real(out):
                raise ConfigError(f"{detections}: --detections: is the file of --out too; give another")
        self.damaged = 0
        self._out, self._detections = out, detections
        self._schema, self._targets = schema, targets
        self._origin = json.loads(json.dumps(origin))
        self._files = dict(files or {})
        self._origin_path = out.with_name(out.name + ".run.json")
        self._forget()
        make_folder_of(out, "--out")
        try:
            self._journal = Journal(out.with_name(out.name + ".partial"))
            try:
                self._begin(resume)
            except BaseException:
                self._journal.remove() if self._journal.empty else self._journal.close()
                raise
        except OSError as error:
            raise self._unwritable(error) from None

    def _forget(self) -> None:
        """No frame is done."""
        self.tally = Tally()
        self._places: dict[str, Place] = {}
        self._made_from: dict[str, Stamp | None] = {}

    def _begin(self, resume: bool) -> None:
        """Takes over what an earlier run has left, or starts over."""
        if resume and self._load():
            return
        finished = list(self._finished()) if resume and os.path.exists(self._out) else []
        self._journal.clear()
        self._journal.append([{"origin": self._origin}])
        self._keep(finished)

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
        self._keep([record | {"file": self._files.get(record["frame"])} for record in records])

    def _keep(self, records: Sequence[Row]) -> None:
        """Appends records that say which files they are of."""
        try:
            places = self._journal.append(records)
        except OSError as error:
            raise self._unwritable(error) from None
        for record, place in zip(records, places, strict=True):
            self._places[record["frame"]] = place
            self._note(record)

    def finish(self, order: Sequence[str]) -> None:
        """Writes the tables and removes the journal.

        Args:
            order: frames in the order of the rows. Frames of an earlier run that are not in it come first.
        """
        listed = set(order)
        frames = [frame for frame in self._places if frame not in listed] + [f for f in order if f in self._places]
        if self._detections is not None:
            rows = (row for record in self._records(frames) for row in record["detections"])
            write_rows(self._detections, rows, self.marks)
        write_rows(self._out, (row for record in self._records(frames) for row in record["rows"]), self._schema)
        files = {frame: self._made_from[frame] for frame in frames if self._made_from[frame] is not None}
        with atomic_path(self._origin_path) as path:
            path.write_text(json.dumps(self._origin | ({_FILES: files} if files else {}), indent=1) + "\n")
        self._journal.remove()

    def close(self) -> None:
        """Leaves the journal for a later run with ``resume``."""
        self._journal.close()

    def _unwritable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self._out}.partial: --out: cannot be written ({error.strerror}); free some space or choose another "
            "place, with --resume to keep what is there"
        )

    def _note(self, record: Row) -> None:
        """Counts what a record says."""
        self._made_from[record["frame"]] = record["file"]
        self.tally.add(record["frame"], record["rows"])

    def _load(self) -> bool:
        """Reads the journal of a killed run; False if not even its first line is whole."""
        check, lines = self._record_check(), self._journal.lines()
        _, head = next(lines, (None, {}))
        if head == {}:
            return False
        self._check_origin(head and head.get("origin"), self._journal.path)
        again = False  # whether a frame has several lines, of which the last counts
        for place, line in lines:
            if line is None:
                self.damaged += 1
                continue
            try:
                record = check(line)
            except ValueError:
                raise self._foreign(self._journal.path) from None
            again = again or record["frame"] in self._places
            if self._is_fresh(record):
                self._places[record["frame"]] = place
                self._note(record)
            else:
                self._places.pop(record["frame"], None)
        if again:
            places = self._places
            self._forget()
            self._places = places
            for record in self._journal.read(list(places.values())):
                self._note(self._completed(record))
        return True

    def _is_fresh(self, record: Row) -> bool:
        """Whether the rows of an earlier run are those that this one would make."""
        if record["frame"] not in self._files:
            return True
        known = record["file"]
        return known == self._files[record["frame"]] and not any(row["status"] in _AGAIN for row in record["rows"])

    def _record_check(self) -> Callable[[Any], Row]:
        """Refuses, by a ValueError, records that `append` did not write."""
        rows, detections = row_check(self._schema), row_check(self.marks)

        def check(line: Any) -> Row:
            try:
                record = _Record.model_validate(line, strict=True).model_dump()
            except ValidationError:
                raise ValueError("no record") from None
            for part, checked in (("rows", rows), ("detections", detections)):
                record[part] = [checked(row) for row in record[part]]
                if any(row["frame"] != record["frame"] for row in record[part]):
                    raise ValueError("rows of another frame")
            return record

        return check

    def _records(self, frames: Sequence[str]) -> Iterator[Row]:
        yield from map(self._completed, self._journal.read([self._places[frame] for frame in frames]))

    def _completed(self, record: Row) -> Row:
        """A record of the journal with all columns: one that a row lacks is empty, as its check has it."""
        for part, schema in (("rows", self._schema), ("detections", self.marks)):
            empty: Row = {column: NEWER.get(column) for column in schema}
            record[part] = [empty | row for row in record[part]]
        return record

    def _finished(self) -> Iterator[Row]:
        """Records of the tables of a run that was completed."""
        try:
            origin = parse_json(read_text(self._origin_path, most=_MOST_ORIGIN))
            files = _STAMPS.validate_python(origin.get(_FILES, {}), strict=True)
        except (ConfigError, ValueError, AttributeError):
            raise ConfigError(
                f"{self._origin_path}: --resume: missing or damaged, so what {self._out.name} was made from is not "
                "known; run without --resume"
            ) from None
        self._check_origin(origin, self._out)
        records: dict[str, Row] = {}
        for row in read_rows(self._out, self._schema):
            empty: Row = {"frame": row["frame"], "rows": [], "detections": [], "file": files.get(row["frame"])}
            records.setdefault(row["frame"], empty)["rows"].append(row)
        if self._detections is not None:
            for row in read_rows(self._detections, self.marks):
                if row["frame"] in records:
                    records[row["frame"]]["detections"].append(row)
        whole = (r for r in records.values() if len({row["target"] for row in r["rows"]}) == self._targets)
        yield from (record for record in whole if self._is_fresh(record))

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
