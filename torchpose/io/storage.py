"""Files in object stores and on disks by URL, through the file systems of Arrow and fsspec.

Credentials come from the environment and the usual files of each store alone; a URL that holds some is refused. What a
store answers is retried as its own library does.
"""

import errno
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from inspect import signature
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from torchpose.config import real
from torchpose.errors import ConfigError

if TYPE_CHECKING:
    from pyarrow import fs

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")  # of two letters at least: C:// is a drive
_NATIVE = ("s3", "gs", "gcs", "hdfs", "abfs", "abfss")  # that Arrow serves itself
_PIECE = 1 << 16  # bytes (convention)
_BUCKETS = ("s3", "gs", "gcs")
_OPTIONS = ("endpoint_override", "region", "scheme")  # of an S3 URL; others could hold secrets
REQUESTS = 4  # of a process to a store at once (convention): they wait for answers, not for its core
_TRIES, _CONNECT, _ANSWER = 5, 10.0, 60.0  # of S3 (convention): tries, seconds to connect and to answer
# what S3 and its kin say, in words; the rest is told as a store that does not answer
_ANSWERS = {
    "NO_SUCH_BUCKET": ("the bucket does not exist", "check its name"),
    "ACCESS_DENIED": ("access is denied", "set the store's credentials in the environment or its usual files"),
    "INVALID_ACCESS_KEY": ("access is denied", "set the store's credentials in the environment or its usual files"),
    "SIGNATURE_DOES_NOT_MATCH": ("access is denied", "set the store's credentials in the environment"),
    "403": ("access is denied", "set the store's credentials in the environment or its usual files"),
    "NO_SUCH_KEY": ("does not exist", "check the URL"),
    "404": ("does not exist", "check the URL"),
}


class StorageError(Exception):
    """A store refuses or does not answer; `problem` and `fix` as error messages say them."""

    def __init__(self, problem: str, fix: str) -> None:
        super().__init__(problem, fix)  # so it can be pickled
        self.problem, self.fix = problem, fix

    def __str__(self) -> str:
        return f"{self.problem}; {self.fix}"


@dataclass(frozen=True)
class Listed:
    """A file of a folder: its path below it with forward slashes, bytes, and time of change in ns (0: not told)."""

    name: str
    size: int
    time: int


@dataclass(frozen=True)
class Place:
    """A file or folder by its URL.

    Raises:
        ConfigError: the URL holds credentials, or is of a kind that nothing here reads.
    """

    url: str

    def __str__(self) -> str:
        return self._path if self.url.startswith("file:") else self.url

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.username or parts.password:
            raise ConfigError(
                f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}: URL: holds credentials; set them in the "
                "environment or in the store's usual files"
            )
        unknown = [name for name, _ in parse_qsl(parts.query) if name not in _OPTIONS]
        if unknown:
            plain = parts._replace(query="").geturl()
            raise ConfigError(f"{plain}: URL: {unknown[0]} is not known; what may follow ? is {', '.join(_OPTIONS)}")

    @property
    def name(self) -> str:
        return self._path.rpartition("/")[2]

    @property
    def fragment(self) -> str:
        """What stands behind ``#``, which no file has in its URL."""
        return urlsplit(self.url).fragment

    @property
    def suffix(self) -> str:
        return Path(self.name).suffix

    @property
    def parent(self) -> "Place":
        parts = urlsplit(self.url)
        return Place(parts._replace(path=parts.path.rstrip("/").rpartition("/")[0], fragment="").geturl())

    def __truediv__(self, name: str) -> "Place":
        parts = urlsplit(self.url)
        return Place(parts._replace(path=f"{parts.path.rstrip('/')}/{quote(name)}", fragment="").geturl())

    @property
    def _path(self) -> str:
        """As the file system has it."""
        parts = urlsplit(self.url)
        below = unquote(parts.path)
        return (below if parts.scheme == "file" else f"{parts.netloc}{below}").rstrip("/")

    @property
    def _files(self) -> "fs.FileSystem":
        parts = urlsplit(self.url)
        return _file_system(parts.scheme.lower(), parts.netloc, parts.query)

    def kind(self) -> str:
        """``file``, ``folder`` or ``nothing``. StorageError."""
        from pyarrow import fs

        with _told():
            found = self._files.get_file_info(self._path).type
        return {fs.FileType.File: "file", fs.FileType.Directory: "folder"}.get(found, "nothing")

    def check_bucket(self) -> None:
        """StorageError: the bucket that the file would go to does not exist, as far as the store tells.

        ConfigError: nothing here writes URLs of this kind.
        """
        parts = urlsplit(self.url)
        if parts.scheme not in _NATIVE:
            _ = self._files
        if parts.scheme in _BUCKETS and Place(f"{parts.scheme}://{parts.netloc}?{parts.query}").kind() == "nothing":
            raise StorageError(*_ANSWERS["NO_SUCH_BUCKET"])

    def listed(self) -> Iterator[Listed]:
        """The files of the folder and of those below it, as the store lists them. StorageError."""
        from pyarrow import fs

        base = self._path
        with _told():
            found = self._files.get_file_info(fs.FileSelector(base, recursive=True))
        for info in found:
            if info.type == fs.FileType.File:
                name = info.path.lstrip("/").removeprefix(base.lstrip("/")).lstrip("/")
                yield Listed(name, info.size or 0, info.mtime_ns or 0)

    def stat(self) -> Listed:
        """The file. StorageError."""
        with _told():
            info = self._files.get_file_info(self._path)
        return Listed(self.name, info.size or 0, info.mtime_ns or 0)

    def open(self) -> BufferedReader:
        """To read from at random. OSError.

        In pieces of `_PIECE`: Arrow does not try again where an answer that says why is longer than what was asked for.
        """
        raw: Any = self._files.open_input_file(self._path)
        return BufferedReader(raw, _PIECE)

    def contents(self, most: int) -> bytes:
        """The whole of a file of up to so many bytes. OSError."""
        with self._files.open_input_file(self._path) as file:
            if file.size() > most:
                raise OSError(errno.EFBIG, f"it has more than {most} bytes")
            data: bytes = file.read()
        return data

    def read(self, most: int) -> bytes:
        """The same. StorageError."""
        with _told():
            return self.contents(most)

    def write(self, data: bytes) -> None:
        """Writes the file; it is there as a whole or as it was. StorageError."""
        from pyarrow import fs

        files = self._files
        local = isinstance(files, fs.LocalFileSystem)
        folder, _, name = self._path.rpartition("/")
        # a store takes a file only when it is closed; on a disk it is moved into place
        target = f"{folder}/.{name}.{os.getpid()}.tmp" if local else self._path
        with _told():
            if local:
                files.create_dir(folder)
            with files.open_output_stream(target) as stream:
                stream.write(data)
            if local:
                files.move(target, self._path)

    def remove(self) -> None:
        """Removes the file, if it is there. StorageError."""
        with _told():
            if self.kind() == "file":
                self._files.delete_file(self._path)


def is_url(text: str) -> bool:
    """Whether a text is a URL, rather than the path of a file."""
    return _URL.match(text) is not None


def place_of(text: str) -> Path | Place:
    """What a user names: a path, or a place in a store. ConfigError: a URL that cannot be used."""
    if not is_url(text):
        return Path(text)
    if urlsplit(text).scheme == "file":
        return Path(unquote(urlsplit(text).path))
    return Place(text)


def as_place(where: Path | Place) -> Place:
    """The same as a place."""
    return where if isinstance(where, Place) else Place(real(where).as_uri())


def refused(error: StorageError, where: object, field: str) -> ConfigError:
    """The error of a command."""
    return ConfigError(f"{where}: {field}: {error.problem}; {error.fix}")


class _told:  # used as a statement
    """Turns what file systems raise into `StorageError`."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, OSError | ValueError) or type(error).__module__.startswith("pyarrow"):
            raise told(error) from None


def told(error: BaseException | None) -> StorageError:
    """What a file system raised, in words."""
    text = str(error)
    if isinstance(error, FileNotFoundError):
        return StorageError(*_ANSWERS["NO_SUCH_BUCKET" if "BUCKET" in text else "NO_SUCH_KEY"])
    if isinstance(error, PermissionError):
        return StorageError(*_ANSWERS["ACCESS_DENIED"])
    for word, answer in _ANSWERS.items():
        if re.search(rf"AWS Error {word}|HTTP.{{0,20}}{word}|\b{word}\b", text):
            return StorageError(*answer)
    reason = getattr(error, "strerror", None) or (text.splitlines() or [type(error).__name__])[0]
    return StorageError(f"the store does not answer ({reason[:160]})", "check the network and the URL, and run again")


@lru_cache(maxsize=64)
def _file_system(scheme: str, netloc: str, query: str) -> "fs.FileSystem":
    """The file system of a URL, one for all that a process reads of it."""
    from pyarrow import fs

    if scheme == "file":
        return fs.LocalFileSystem()
    if scheme == "s3":
        given = dict(parse_qsl(query))
        given.setdefault("region", os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION", ""))
        given["endpoint_override"] = (
            given.get("endpoint_override")
            or os.environ.get("AWS_ENDPOINT_URL_S3")
            or (os.environ.get("AWS_ENDPOINT_URL", ""))
        )
        if not given["region"] and not given["endpoint_override"]:
            with _told():
                given["region"] = fs.resolve_s3_region(netloc)
        # AWS's standard strategy has 500 tokens and takes five for a try; Arrow gives none back, so after a hundred
        # failures in a process nothing would be tried again
        retry = fs.AwsDefaultS3RetryStrategy(max_attempts=_TRIES)
        named = {name: value for name, value in given.items() if value}
        # a small file is sent in one request rather than in three
        how = {"background_writes": False, "allow_delayed_open": True}
        return fs.S3FileSystem(**named, retry_strategy=retry, connect_timeout=_CONNECT, request_timeout=_ANSWER, **how)
    if scheme in _NATIVE:
        with _told():
            return fs.FileSystem.from_uri(f"{scheme}://{netloc}/")[0]
    try:
        return _by_fsspec(scheme)
    except Exception as error:  # each of fsspec's kinds has its own
        reason = " ".join(str(error).split())[:160]
        raise ConfigError(
            f"{scheme}://{netloc}: URL: cannot be used ({reason}); use s3://, gs:// or file://, or install what fsspec "
            f"needs for {scheme}://"
        ) from None


def _by_fsspec(scheme: str) -> "fs.FileSystem":
    import fsspec
    from pyarrow import fs

    kind = fsspec.get_filesystem_class(scheme)
    wanted = [
        one.name
        for one in list(signature(kind.__init__).parameters.values())[1:]
        if one.default is one.empty and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    if wanted:  # such as a host and a password, which no URL should hold
        raise ValueError(f"it wants {', '.join(wanted)} besides")
    return fs.PyFileSystem(fs.FSSpecHandler(kind()))
