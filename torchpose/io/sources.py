"""From what the user names (files, folders, manifests) to the list of frames, each with its name in the results."""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchpose.errors import ConfigError
from torchpose.io.manifest import read_manifest

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")
MANIFEST_SUFFIX = ".jsonl"

_DIGITS = re.compile(r"(\d+)", re.ASCII)


@dataclass(frozen=True)
class Source:
    """One frame to be read.

    Attributes:
        name: what the rows call it: path relative to its INPUT, forward slashes.
        path: where the image lies.
        root: the folder that ``name`` is relative to, resolved.
        robot_pose: tool in the robot base, mm and rad, if a manifest recorded it.
    """

    name: str
    path: Path
    root: Path
    robot_pose: tuple[float, ...] | None = None


def natural_key(name: str) -> tuple[tuple[tuple[str | int, ...], ...], str]:
    """Sort key of a relative path: folder by folder, numbers by value, so that ``2.png`` precedes ``10.png``."""
    parts = tuple(
        tuple(int(piece) if i % 2 else piece.casefold() for i, piece in enumerate(_DIGITS.split(part)))
        for part in name.split("/")
    )
    return parts, name


def find_sources(inputs: Sequence[Path]) -> list[Source]:
    """Frames of image files, folders (searched recursively, in natural order) and capture manifests, input by input.

    In folders, hidden files and folders and everything without an image's suffix are passed over. A file with an
    image's suffix is listed whatever it holds: that it cannot be read is a result of its own.

    Raises:
        ConfigError: an input is missing, holds no image or is of another kind, or two frames have the same name.
    """
    sources: list[Source] = []
    seen: dict[str, Source] = {}
    for given in inputs:
        found = list(_sources_of(given))
        if not found:
            raise ConfigError(f"{given}: INPUT: holds no image; give files that end in {', '.join(IMAGE_SUFFIXES)}")
        for source in found:
            twin = seen.setdefault(source.name, source)
            if twin is not source:
                raise ConfigError(
                    f"{source.path}: INPUT: has the same name in the results, {source.name!r}, as {twin.path}; "
                    "give a common parent folder or run them one by one"
                )
        sources += found
    return sources


def _sources_of(given: Path) -> Iterator[Source]:
    if given.is_dir():
        root = given.resolve()
        pairs = [(_text(path.relative_to(given).as_posix()), path) for path in _walk(given)]
        yield from (Source(name, path, root) for name, path in sorted(pairs, key=lambda pair: natural_key(pair[0])))
        return
    name, _, camera = given.name.partition(f"{MANIFEST_SUFFIX}#")  # FILE#CAMERA
    path = given.with_name(f"{name}{MANIFEST_SUFFIX}") if camera else given
    if not path.exists():
        raise ConfigError(f"{path}: INPUT: does not exist; give image files, folders or a capture manifest")
    if path.suffix.lower() == MANIFEST_SUFFIX:
        root = given.parent.resolve()
        for frame in read_manifest(path, camera or None):
            yield Source(frame.image, given.parent / frame.image, root, frame.robot_pose)
    elif given.suffix.lower() in IMAGE_SUFFIXES:
        yield Source(_text(given.name), given, given.parent.resolve())
    else:
        known = ", ".join((*IMAGE_SUFFIXES, MANIFEST_SUFFIX))
        raise ConfigError(f"{given}: INPUT: of an unknown kind; give a folder or a file that ends in {known}")


def _walk(folder: Path) -> Iterator[Path]:
    """Regular files below a folder that end like images. Linked folders are followed, each real folder once."""

    def refuse(error: OSError) -> None:
        raise ConfigError(f"{error.filename}: INPUT: {error.strerror}; make the folder readable")

    visited: set[str] = set()
    for base, folders, files in os.walk(folder, followlinks=True, onerror=refuse):
        real = os.path.realpath(base)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for file in files:
            path = Path(base, file)
            if file.startswith(".") or path.suffix.lower() not in IMAGE_SUFFIXES:
                continue
            if path.is_file() or not path.exists():  # a dangling link is a frame that cannot be read; a pipe is none
                yield path


def _text(name: str) -> str:
    """The name as valid Unicode: bytes of the file system that are not UTF-8 are written as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
