"""Lists of files, as ``find`` and ``ls`` print them: one a line, or with zeros between them (``find -print0``)."""

import codecs
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from torchpose.config import MOST_TABLE_BYTES, check_regular
from torchpose.errors import ConfigError
from torchpose.io.storage import is_url
from torchpose.io.stream import is_standard


def read_list(path: Path) -> list[Path]:
    """The files that a list names, relative ones from the working directory.

    Args:
        path: of the list; ``-`` is standard input.

    Raises:
        ConfigError: the list cannot be read, is too large or names nothing.
    """
    try:
        if is_standard(path):
            data = sys.stdin.buffer.read(MOST_TABLE_BYTES + 1)
        else:
            check_regular(path, most=MOST_TABLE_BYTES)
            data = path.read_bytes()
    except (OSError, ValueError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or "not a file that can be read"
        raise ConfigError(f"{path}: --files-from: {reason}; give a list of files") from None
    if len(data) > MOST_TABLE_BYTES:
        raise ConfigError(f"{path}: --files-from: has more than {MOST_TABLE_BYTES >> 20} MB; give shorter lists")
    data = data.removeprefix(codecs.BOM_UTF8)
    names = data.split(b"\0") if b"\0" in data else data.splitlines()
    found = [Path(os.fsdecode(name)) for name in names if name.strip()]
    if not found:
        raise ConfigError(f"{path}: --files-from: names no file; write one a line")
    if stored := next((name for name in names if is_url(os.fsdecode(name))), None):
        raise ConfigError(f"{os.fsdecode(stored)}: --files-from: is a URL; lists name files, give it as INPUT")
    return found


def common_folder(paths: Sequence[Path]) -> Path:
    """The deepest folder that holds all of the files; links are folders like others."""
    folders = {os.path.dirname(os.path.abspath(path)) for path in paths}
    return Path(os.path.commonpath(folders))
