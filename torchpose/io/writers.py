"""Result tables as CSV, JSON lines or Parquet, by suffix: written beside their place, then moved there whole."""

import contextlib
import csv
import hashlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from torchpose.config import check_regular, parse_json
from torchpose.errors import ConfigError
from torchpose.io.cells import CellError, row_check
from torchpose.io.rows import NEWER, POSE, STD, Row, Schema

TABLE_SUFFIXES = (".csv", ".jsonl", ".parquet")
_WITH_POSE = ("ok", "ambiguous")
# what the readers raise of files that are damaged: text that is none, another nesting, sizes that no memory holds
_UNREADABLE = (ValueError, KeyError, TypeError, NotImplementedError, OSError, MemoryError, csv.Error)
_LONG_NAME = 240  # bytes; file systems end at 255
_LONGEST_LINE = 1 << 20  # bytes (convention): a row with the covariances of thousands of markers
_ROW_GROUP = 4096


def check_table_path(path: Path, option: str) -> None:
    """Raises ConfigError unless a table can be written to ``path``, the argument of ``option``."""
    if path.suffix.lower() not in TABLE_SUFFIXES:
        raise ConfigError(f"{path}: {option}: of an unknown type; give a file that ends in {', '.join(TABLE_SUFFIXES)}")
    if os.path.isdir(path):
        raise ConfigError(f"{path}: {option}: is a folder; give a file")
    check_folder_of(path, option)
    longest = path.with_name(f"{path.name}.run.json")  # of what a run writes
    if not os.path.isdir(path.parent):  # `make_folder_of` makes it once there is something to write
        longest = Path(_there(path), longest.name)
    probe = longest.with_name(f".torchpose.{os.getpid()}.tmp")  # not what another run is writing at this moment
    try:
        with contextlib.suppress(FileNotFoundError):
            longest.lstat()  # the name may be too long
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"{path}: {option}: cannot be written ({error.strerror}); choose another place") from None


def check_folder_of(path: Path, option: str) -> None:
    """Raises ConfigError where the folder of ``path``, the argument of ``option``, cannot be made or is no folder."""
    there = _there(path)
    problem = "" if os.path.isdir(there) else "is no folder"
    if not problem and not os.path.isdir(path.parent):
        probe = there / path.absolute().relative_to(there).parts[0]
        try:
            probe.mkdir()
            probe.rmdir()
        except (OSError, ValueError) as error:
            problem = f"cannot be written ({getattr(error, 'strerror', None) or error})"
    if problem:
        raise ConfigError(f"{path}: {option}: {there} {problem}; choose another place")


def make_folder_of(path: Path, option: str) -> None:
    """Makes the folder of ``path``, the argument of ``option``, and those above it. ConfigError: it cannot be made."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"{path}: {option}: folder {path.parent} cannot be made ({reason}); choose another place"
        ) from None


def _there(path: Path) -> Path:
    """The nearest of the places above ``path`` that exists."""
    return next((one for one in path.absolute().parents if os.path.lexists(one)), Path(os.sep))


def write_rows(path: Path, rows: Iterable[Row], schema: Schema) -> None:
    """Writes a table; ``path`` holds either what it held before or all of the rows.

    CSV and Parquet have the columns of the schema (CSV without those of type list), JSON lines the same as keys.

    Raises:
        ConfigError: the place cannot be written, for example because the disk is full.
    """
    make_folder_of(path, "--out")
    with atomic_path(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, rows, schema)


def json_line(row: Row, schema: Schema) -> str:
    """A row as a line of JSON, its end included."""
    return json.dumps({column: row.get(column) for column in schema}, allow_nan=False) + "\n"


def csv_lines(rows: Iterable[Row], schema: Schema, *, head: bool) -> str:
    """Rows as lines of CSV, with or without the line of the columns."""
    text = io.StringIO(newline="")
    _to_csv(text, rows, schema, head=head)
    return text.getvalue()


def read_rows(path: Path, schema: Schema) -> Iterator[Row]:
    """Rows of a table that `write_rows` wrote, before there were the columns of `NEWER` too.

    Raises:
        ConfigError: the file is not such a table.
    """
    text = path.suffix.lower() == ".csv"
    columns = _cells(schema) if text else list(schema)
    check = row_check({column: schema[column] for column in columns}, text=text)
    try:
        for row in _READERS[path.suffix.lower()](path):
            if list(row) != [column for column in columns if column in row or column not in NEWER]:
                raise ValueError("columns")
            yield check(row)
    except _UNREADABLE:
        raise ConfigError(
            f"{path}: --resume: not a table that torchpose wrote for these options; run without --resume"
        ) from None


def read_table(path: Path, schema: Schema, needed: Sequence[str]) -> list[Row]:
    """Rows of the POSES table of a command, with the columns of the schema; None where there is none.

    Args:
        path: of the table.
        schema: which columns are wanted.
        needed: of these, those that the table must have.

    Raises:
        ConfigError: the file cannot be read, is of another kind, or has a cell of another kind.
    """
    if path.suffix not in _READERS:
        raise ConfigError(f"{path}: POSES: of an unknown type; give .csv, .jsonl or .parquet")
    check, number = row_check(schema, text=path.suffix == ".csv"), 0
    rows: list[Row] = []
    try:
        if not (path.is_dir() and path.suffix == ".parquet"):
            check_regular(path)
        for number, row in enumerate(_READERS[path.suffix](path), 1):  # noqa: B007  # counts on behind the loop
            if missing := [name for name in needed if name not in row]:
                raise ConfigError(f"{path}: {missing[0]}: column is missing; give what torchpose estimate wrote")
            rows.append(check(row))
            _check_whole(rows[-1])
    except ConfigError as error:
        raise ConfigError(str(error).replace(": file: ", ": POSES: ", 1)) from None
    except CellError as error:
        raise ConfigError(f"{path}: row {number}: {error}") from None
    except _UNREADABLE as error:
        detail = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{path}: POSES: cannot be read ({detail}); give what torchpose estimate wrote") from None
    return rows


def _check_whole(row: Row) -> None:
    """Raises CellError for half a pose, and for a status that promises one where there is none."""
    for names in (POSE, STD):
        empty = [name for name in names if row.get(name) is None]
        if empty and (len(empty) < len(names) or (row.get("status") in _WITH_POSE and empty[0] in row)):
            raise CellError(f"{empty[0]}: is empty; a pose has all of {', '.join(names)}")


@contextlib.contextmanager
def atomic_path(
    path: Path, *, option: str = "", fix: str = "free some space or choose another", sync: bool = True
) -> Iterator[Path]:
    """A place beside ``path`` to write to. It is moved to ``path`` when the block ends, removed when it fails.

    With ``sync`` it survives a crash of the machine. An operating-system error is a ConfigError with ``option`` (such
    as ``--out: ``) and ``fix``.
    """
    # the journal's lock keeps others from a run's tables; pictures of one folder may be those of two runs
    temporary = _temporary(path, "" if sync else f".{os.getpid()}")
    try:
        yield temporary
        if sync:
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: {option}cannot be written ({error.strerror}); {fix}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _temporary(path: Path, own: str) -> Path:
    """A hidden name beside ``path``; a long one is cut, as there must be room for more.

    Without ``own`` that of all processes, so that one which is killed leaves no more than one.
    """
    stem = path.name if len(os.fsencode(path.name)) < _LONG_NAME else hashlib.sha256(os.fsencode(path.name)).hexdigest()
    return path.with_name(f".{stem}{own}.tmp")


def _cells(schema: Schema) -> list[str]:
    return [column for column, kind in schema.items() if kind is not list]


def _write_csv(path: Path, rows: Iterable[Row], schema: Schema) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        _to_csv(file, rows, schema, head=True)


def _to_csv(file: io.TextIOBase, rows: Iterable[Row], schema: Schema, *, head: bool) -> None:
    columns = _cells(schema)
    writer = csv.writer(file, lineterminator="\n")  # floats are written by repr, which reads back to the same bits
    if head:
        writer.writerow(columns)
    writer.writerows([row.get(column) for column in columns] for row in rows)


def _read_csv(path: Path) -> Iterator[Row]:
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if None in row or None in row.values():
                raise ValueError("a row has another number of cells than the header")
            yield {column: cell or None for column, cell in row.items()}


def _write_jsonl(path: Path, rows: Iterable[Row], schema: Schema) -> None:
    with path.open("w", encoding="utf-8") as file:
        file.writelines(json_line(row, schema) for row in rows)


def _read_jsonl(path: Path) -> Iterator[Row]:
    with path.open("rb") as file:
        while line := file.readline(_LONGEST_LINE + 1):
            if len(line) > _LONGEST_LINE:
                raise ValueError(f"a line has more than {_LONGEST_LINE} bytes")
            if not isinstance(row := parse_json(line), dict):
                raise ValueError("a line is not an object")
            yield row


def _write_parquet(path: Path, rows: Iterable[Row], schema: Schema) -> None:
    # opened here: pyarrow takes no path whose bytes are not UTF-8
    with path.open("wb") as file:
        _write_groups(file, rows, schema, {})


def parquet_bytes(rows: Iterable[Row], schema: Schema, metadata: Mapping[bytes, bytes]) -> bytes:
    """A Parquet file of rows, with entries of its own in the metadata."""
    file = io.BytesIO()
    _write_groups(file, rows, schema, metadata)
    return file.getvalue()


def _write_groups(file: BinaryIO, rows: Iterable[Row], schema: Schema, metadata: Mapping[bytes, bytes]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    number = pa.float64()
    parts = {"translation": pa.list_(number, 3), "rotation": pa.list_(number, 3), "quaternion": pa.list_(number, 4)}
    matrices = ("covariance", "noise_covariance", "systematic", "place", "base_covariance")
    nested = dict.fromkeys(matrices, pa.list_(pa.list_(number))) | {
        "quaternion": pa.list_(number),
        "shares": pa.list_(pa.struct({"camera": pa.string(), "share": number})),
        "solutions": pa.list_(pa.struct(parts | {"rms_px": number, "chi2": number})),
    }
    plain = {str: pa.string(), int: pa.int64(), float: number}
    columns = {c: nested[c] if kind is list else plain[kind] for c, kind in schema.items()}
    arrow = pa.schema(columns, metadata=dict(metadata) or None)
    remaining = iter(rows)
    with pq.ParquetWriter(file, arrow) as writer:
        while group := list(islice(remaining, _ROW_GROUP)):
            writer.write_table(pa.Table.from_pylist(group, arrow))


def _read_parquet(path: Path) -> Iterator[Row]:
    """Rows of a file, or of all the parts of a folder in the order of their names."""
    import pyarrow.parquet as pq

    for one in sorted(path.glob("*.parquet")) if path.is_dir() else [path]:
        with one.open("rb") as opened, pq.ParquetFile(opened) as file:
            for group in file.iter_batches(_ROW_GROUP):
                yield from group.to_pylist()


_WRITERS: dict[str, Callable[[Path, Iterable[Row], Schema], None]] = {
    ".csv": _write_csv,
    ".jsonl": _write_jsonl,
    ".parquet": _write_parquet,
}
_READERS: dict[str, Callable[[Path], Iterator[Row]]] = {
    ".csv": _read_csv,
    ".jsonl": _read_jsonl,
    ".parquet": _read_parquet,
}
