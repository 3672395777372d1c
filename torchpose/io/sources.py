"""From what the user names (files, folders, manifests) to the list of frames, each with its name in the results."""

import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchpose.config import real
from torchpose.errors import ConfigError
from torchpose.io import images, remote
from torchpose.io.films import FILM_SUFFIXES, Film, frames_of_film
from torchpose.io.lists import common_folder
from torchpose.io.manifest import read_manifest
from torchpose.io.storage import Listed, Place, StorageError, refused

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")
MANIFEST_SUFFIX = ".jsonl"
_STACKS = (".tif", ".tiff")  # that may have several pages
FRAME_SUFFIXES = (*IMAGE_SUFFIXES, *FILM_SUFFIXES)
# pictures in a folder that are not read, so that a user is told: raw files of cameras among them
OTHERS = frozenset(
    (  # noqa: SIM905  # a list would be five times as long
        ".apng .arw .avif .cr2 .cr3 .dib .dng .exr .fit .fits .gif .hdr .heic .heif .ico .j2c .j2k .jfif "
        ".jif .jng .jp2 .jpc .jpe .jpf .jpx .jxl .jxr .mpg .nef .npy .npz .orf .pam .pbm .pcx .pfm "
        ".pgx .pic .pnm .ppm .psd .raf .ras .raw .rw2 .sr .svg .tga .webp .wmv"
    ).split()
)
_STORED_FILMS = "films, which are read from a disk alone"
_PIPE = "is a pipe or a device, no file"
_DIGITS = re.compile(r"(\d+)", re.ASCII)


@dataclass(frozen=True)
class Source:
    """One frame to be read.

    Attributes:
        name: what the rows call it: path relative to its INPUT, forward slashes.
        path: where the image lies, on a disk or in a store.
        root: the folder that ``name`` is relative to, resolved.
        robot_pose: tool in the robot base, mm and rad, if a manifest recorded it.
        directory: of a TIFF file with several pages, see `images.pages`; the number of a film's frame, from 0.
        listed: size in bytes and time of change in ns, where a store has told them.
        film: that the frame is of.
    """

    name: str
    path: Path | Place
    root: Path | Place
    robot_pose: tuple[float, ...] | None = None
    directory: int = 0
    listed: tuple[int, int] | None = None
    film: Film | None = None

    def decode(self, *, threads: int = 1, size: tuple[int, int] | None = None) -> np.ndarray:
        """Grey values, see `images.decode` and `Film.decode`."""
        if self.film is not None:
            return self.film.decode(self.directory, threads=threads, size=size)
        decode = images.decode if isinstance(self.path, Path) else remote.decode
        return decode(self.path, threads=threads, directory=self.directory, size=size)  # type: ignore[arg-type]

    def likely_encoded(self) -> bool:
        """See `images.likely_encoded`; films are."""
        of = self.path
        if self.film is not None:
            return True
        return images.likely_encoded(of) if isinstance(of, Path) else remote.likely_encoded(of)

    def stamp(self) -> list[int] | None:
        """Size of the file in bytes and its time of change in ns; None where there is none."""
        if self.listed is not None or not isinstance(self.path, Path):
            return None if self.listed is None else [*self.listed]
        try:
            found = self.path.stat()
        except (OSError, ValueError):
            return None
        return [found.st_size, found.st_mtime_ns]


def _silent(line: str) -> None:
    pass


def natural_key(name: str) -> tuple[tuple[tuple[str | int, ...], ...], str]:
    """Sort key of a relative path: folder by folder, numbers by value, so that ``2.png`` precedes ``10.png``."""
    parts = tuple(
        tuple(int(piece) if i % 2 else piece.casefold() for i, piece in enumerate(_DIGITS.split(part)))
        for part in name.split("/")
    )
    return parts, name


def find_sources(
    inputs: Sequence[Path | Place], tell: Callable[[str], None] = _silent, *, more: Sequence[Path] = ()
) -> list[Source]:
    """Frames of image files, folders (searched recursively, in natural order), films and manifests, input by input.

    In folders, hidden files and folders and everything without an image's suffix are passed over. A file with an
    image's suffix is listed whatever it holds: that it cannot be read is a result of its own. Every page of a TIFF file
    is a frame; from the second on ``#2``, ``#3``, ... stands behind the file's name. So is every frame of a film, from
    ``#1`` on. A manifest has one frame a record.

    Args:
        inputs: files, folders and manifests.
        tell: is given a line for pictures that are passed over.
        more: further inputs; files among them are called by their place below the folder that holds all of them.

    Raises:
        ConfigError: an input is missing, holds no image or is of another kind, or two frames have the same name.
    """
    sources: list[Source] = []
    seen: dict[str, Source] = {}
    below = common_folder(more) if more else None
    for given, root in [*((one, None) for one in inputs), *((one, below) for one in more)]:
        passed: Counter[str] = Counter()  # what, and how many of it
        found = list(_sources_of(given, passed, root))
        read = ", ".join(FRAME_SUFFIXES if isinstance(given, Path) else IMAGE_SUFFIXES)
        if not found:
            also = f" but {_summary(passed)}" if passed.total() else ""
            if given.suffix.lower() == MANIFEST_SUFFIX:
                read = 'a line {"record": "frame", "id": 1, "image": "a.png"} for each'
                raise ConfigError(f"{given}: INPUT: has no frame with an image{also}; write {read}")
            raise ConfigError(f"{given}: INPUT: holds no image{also}; give files that end in {read}")
        if passed.total():
            tell(f"{_text(str(given))}: passed over {_summary(passed)}; what is read ends in {read}")
        for source in found:
            twin = seen.setdefault(source.name, source)
            if twin is not source:
                if (
                    isinstance(source.path, Path)
                    and isinstance(twin.path, Path)
                    and real(source.path) == real(twin.path)
                ):
                    raise ConfigError(f"{source.path}: INPUT: is given twice; name it once")
                raise ConfigError(
                    f"{source.path}: INPUT: has the same name in the results, {source.name!r}, as {twin.path}; "
                    "give a common parent folder or run them one by one"
                )
        sources += found
    return sources


def _summary(passed: Counter[str]) -> str:
    kinds = sorted(passed.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {kind}" for kind, count in kinds if count)


def _sources_of(given: Path | Place, passed: Counter[str], below: Path | None) -> Iterator[Source]:
    """Frames of an input, files called by their place ``below``; what is not read is counted in ``passed``."""
    if isinstance(given, Place):
        yield from _stored(given, passed)
        return
    if _state(given) == "folder":
        root = real(given)
        pairs = [(_text(path.relative_to(given).as_posix()), path) for path in _walk(given, passed)]
        for name, path in sorted(pairs, key=lambda pair: natural_key(pair[0])):
            yield from sources_of_file(name, path, root)
        return
    name, _, camera = given.name.partition(f"{MANIFEST_SUFFIX}#")  # FILE#CAMERA
    path = given.with_name(f"{name}{MANIFEST_SUFFIX}") if camera else given
    state, suffixes = _state(path), (*FRAME_SUFFIXES, MANIFEST_SUFFIX)
    if path.suffix.lower() not in suffixes and state in ("file", _PIPE):
        why = "of a kind that is not read" if path.suffix.lower() in OTHERS else "of an unknown kind"
        raise ConfigError(f"{given}: INPUT: {why}; give a folder or a file that ends in {', '.join(suffixes)}")
    if state != "file":
        raise ConfigError(f"{path}: INPUT: {state}; give image files, folders or a capture manifest")
    if path.suffix.lower() == MANIFEST_SUFFIX:
        yield from _recorded(path, camera or None, passed)
    else:
        name = given.name if below is None else Path(os.path.relpath(given, below)).as_posix()
        yield from sources_of_file(_text(name), given, real(below or given.parent))


def _stored(given: Place, passed: Counter[str]) -> Iterator[Source]:
    """The same of a file, a folder or a manifest in a store."""
    try:
        if given.suffix.lower() == MANIFEST_SUFFIX:
            yield from _recorded_in_store(given.parent / given.name, given.fragment or None, passed)
        elif given.suffix.lower() in IMAGE_SUFFIXES and given.kind() == "file":
            yield from sources_of_file(given.name, given, given.parent, _stamp(given.stat()))
        elif given.suffix.lower() in FILM_SUFFIXES and given.kind() == "file":
            raise ConfigError(f"{given}: INPUT: a film, which is read from a disk alone; copy it to this machine")
        else:
            for one in sorted(given.listed(), key=lambda one: natural_key(one.name)):
                suffix = Path(one.name).suffix.lower()
                if suffix not in OTHERS.union(FRAME_SUFFIXES) or any(p.startswith(".") for p in one.name.split("/")):
                    continue
                if suffix in OTHERS or suffix in FILM_SUFFIXES:
                    passed[suffix if suffix in OTHERS else _STORED_FILMS] += 1
                else:
                    yield from sources_of_file(one.name, given / one.name, given, _stamp(one))
    except StorageError as error:
        raise refused(error, given, "INPUT") from None


def _stamp(one: Listed) -> tuple[int, int]:
    return one.size, one.time


def _recorded_in_store(manifest: Place, camera: str | None, passed: Counter[str]) -> Iterator[Source]:
    for frame in remote.manifest_frames(manifest, camera):
        pages = list(sources_of_file(frame.image, manifest.parent / frame.image, manifest.parent))
        passed["pages behind the first"] += len(pages) - 1
        yield replace(pages[0], robot_pose=frame.robot_pose)


def _recorded(manifest: Path, camera: str | None, passed: Counter[str]) -> Iterator[Source]:
    """The frames of a manifest: one a record, so what a file holds behind its first page is passed over."""
    root = real(manifest.parent)
    for frame in read_manifest(manifest, camera):
        path = manifest.parent / frame.image
        pages = list(sources_of_file(frame.image, path, root))
        passed["pages behind the first"] += len(pages) - 1
        yield replace(pages[0], robot_pose=frame.robot_pose)


def sources_of_file(
    name: str, path: Path | Place, root: Path | Place, listed: tuple[int, int] | None = None
) -> Iterator[Source]:
    """The frames of a file that is called ``name`` below ``root``."""
    if path.suffix.lower() in FILM_SUFFIXES and isinstance(path, Path):
        yield from _film(name, path, root)
        return
    places = [0]
    if path.suffix.lower() in _STACKS:
        places = images.pages(path) if isinstance(path, Path) else remote.pages(path)
    for number, place in enumerate(places, start=1):
        yield Source(name if number == 1 else f"{name}#{number}", path, root, directory=place, listed=listed)


def _film(name: str, path: Path, root: Path | Place) -> Iterator[Source]:
    """The frames of a film, and one more where it was to have more."""
    count, broken = frames_of_film(path)
    film = Film(path, count)
    for number in range(count + broken):
        yield Source(f"{name}#{number + 1}" if count else name, path, root, directory=number, film=film)


def _state(path: Path) -> str:
    """``folder``, ``file``, or what is in the way of reading."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return "does not exist"
    except OSError as error:  # a loop of links, a name that is too long, no permission
        return f"cannot be read ({error.strerror})"
    if stat.S_ISDIR(mode):
        return "folder"
    return "file" if stat.S_ISREG(mode) else _PIPE


def _walk(folder: Path, passed: Counter[str]) -> Iterator[Path]:
    """Files below a folder that end like images. Linked folders are followed, each real folder once.

    A link to nothing is a frame that cannot be read; pipes and devices are none.
    """

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
            suffix = path.suffix.lower()
            if file.startswith(".") or suffix not in OTHERS.union(FRAME_SUFFIXES):
                continue
            if suffix in OTHERS:
                passed[suffix] += 1
            elif _state(path) == _PIPE:
                passed["pipes or devices"] += 1
            else:
                yield path


def _text(name: str) -> str:
    """The name as valid Unicode: bytes of the file system that are not UTF-8 are written as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
