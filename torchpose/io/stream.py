"""Rows on standard output, as JSON lines: each batch as soon as it is done. What a pipe has taken cannot be resumed."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from torchpose.io.rows import Row, Schema
from torchpose.io.tally import Tally
from torchpose.io.writers import json_line

STANDARD = "-"
"""As a path: standard output, or standard input."""


def is_standard(path: Path) -> bool:
    """Whether standard output (or input) is meant, not a file."""
    return os.fspath(path) == STANDARD


def print_rows(rows: Sequence[Row], schema: Schema) -> None:
    """Rows on standard output, at once. BrokenPipeError: nobody reads on."""
    try:
        sys.stdout.write("".join(json_line(row, schema) for row in rows))
        sys.stdout.flush()
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)  # for what Python would try again to write at its end
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        raise


class StreamedRows:
    """Takes the rows of a run as `ResultStore` does, and hands them on.

    Args:
        schema: columns of the rows.

    Attributes:
        tally: of all rows.
    """

    damaged = 0

    def __init__(self, schema: Schema) -> None:
        self.tally = Tally()
        self._schema = schema
        self._frames = 0

    def __contains__(self, frame: str) -> bool:
        return False

    def __len__(self) -> int:
        return self._frames

    def append(self, records: Sequence[Row]) -> None:
        """Hands on finished frames. BrokenPipeError: nobody reads on."""
        for record in records:
            self.tally.add(record["frame"], record["rows"])
        self._frames += len(records)
        print_rows([row for record in records for row in record["rows"]], self._schema)

    def finish(self, order: Sequence[str]) -> None:
        """All is out already."""

    def close(self) -> None:
        """Nothing is left behind."""
