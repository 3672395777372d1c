"""Text files: read within bounds, written whole or not at all."""

import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchpose.config.documents import parse_mapping
from torchpose.config.models import within
from torchpose.errors import ConfigError

MOST_BYTES = 4 << 20  # of a configuration file (convention): `documents.MOST_VALUES` numbers in full
MOST_TABLE_BYTES = 128 << 20  # of a table that is read as a whole (convention): half a million rows


def check_regular(path: Path, *, most: int | None = None) -> None:
    """Refuses what is no file of bounded size: a device or pipe may have no end, or never begin.

    Raises:
        ConfigError: naming ``file``.
        OSError: there is nothing, or it cannot be reached.
        ValueError: the name is none.
    """
    found = path.stat()
    if stat.S_ISDIR(found.st_mode):
        raise ConfigError(f"{path}: file: is a folder; name a file in it")
    if not stat.S_ISREG(found.st_mode):
        raise ConfigError(f"{path}: file: is a device or pipe; give a file")
    if most is not None and found.st_size > most:
        raise ConfigError(f"{path}: file: has {found.st_size / 1e6:.0f} MB; at most {most / 1e6:.0f} MB are read")


def real(path: Path) -> Path:
    """The path with all links and ``..`` followed as far as they can be; what is not there counts as named.

    pathlib's own `resolve` fails at links in a loop, its `is_dir` and `exists` at names that are too long: paths that a
    user gives are asked by `os.path`.
    """
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError):  # a name that no file can have
        return path.absolute()


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder once all links and ``..`` are followed."""
    return real(path).is_relative_to(real(folder))


def read_text(path: str | os.PathLike[str], *, most: int = MOST_BYTES) -> str:
    """The text of a file.

    Args:
        path: of the file.
        most: bytes that it may have.

    Raises:
        ConfigError: it is missing, a folder, a device, unreadable, too large, empty or not text.
    """
    try:
        check_regular(Path(path), most=most)
        text = Path(path).read_bytes().decode("utf-8-sig")
        problem = "is not text in UTF-8; save it so, as YAML or JSON" if "\0" in text else ""
        if not text.strip():
            problem = "is empty; write the fields into it"
    except FileNotFoundError:
        problem = "does not exist; check the path"
    except UnicodeDecodeError:
        problem = "is not text in UTF-8; save it so, as YAML or JSON"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        problem = f"cannot be read ({reason}); check the path and its permissions"
    if problem:
        raise ConfigError(f"{path}: file: {problem}")
    return text


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML or JSON file.

    Raises:
        ConfigError: as `read_text` and `parse_mapping`.
    """
    text = read_text(path)
    with within(f"{path}: "):
        return parse_mapping(text)


def beside(path: Path, name: str) -> str:
    """What the configuration file ``path`` calls ``name``: relative to it, or else a name of its own (built-in)."""
    file = path.parent / name
    there = os.path.exists(file.with_name(file.name.split("#")[0]))  # False, too, of a name that no file can have
    return str(file) if there or "/" in name else name


def format_number(value: float) -> str:
    """Shortest text that reads back as the same float64, with a dot, so that every YAML reader sees a number."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def format_list(values: Iterable[float]) -> str:
    """``[a, b, ...]`` of `format_number`."""
    return "[" + ", ".join(map(format_number, values)) + "]"


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a whole file or nothing: into a temporary file beside it, which then takes its name.

    Raises:
        ConfigError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ConfigError(f"{path}: file: cannot be written ({error.strerror}); check the folder") from None


def quoted(text: str) -> str:
    """A string as YAML reads it back, whatever is in it."""
    double = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() or c == " " else f"\\U{ord(c):08x}" for c in double)
