"""Reading of result tables by their suffix: rows as dictionaries."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from torchpose.errors import ConfigError


def read_table(path: Path) -> list[dict[str, Any]]:
    """Rows of the POSES table of a command, .csv, .jsonl or .parquet; the cells of a CSV are text, None where empty.

    Raises:
        ConfigError: the file cannot be read or is of another kind.
    """
    try:
        if path.suffix == ".csv":
            with path.open(newline="", encoding="utf-8") as file:
                return [{name: cell or None for name, cell in row.items()} for row in csv.DictReader(file)]
        if path.suffix == ".jsonl":
            rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            if not all(isinstance(row, dict) for row in rows):
                raise ValueError("a line is not an object")
            return rows
        if path.suffix == ".parquet":
            import pyarrow.parquet as pq

            return pq.read_table(path).to_pylist()
    except (OSError, ValueError, TypeError) as error:
        detail = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise ConfigError(f"{path}: POSES: cannot be read ({detail}); give what torchpose estimate wrote") from None
    raise ConfigError(f"{path}: POSES: of an unknown type; give .csv, .jsonl or .parquet")
