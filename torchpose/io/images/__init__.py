"""Decoding of one picture file to grey values, or the reason why it cannot be."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import SEEK_END, BufferedReader, BytesIO, FileIO
from pathlib import Path

import numpy as np

from torchpose.io.images import jpeg, plain, png, tiff
from torchpose.io.images.header import Header, UnreadableImageError, WrongSizeError, check_size, memory_told
from torchpose.io.images.native import by_opencv

__all__ = [
    "UnreadableImageError",
    "WrongSizeError",
    "decode",
    "decode_open",
    "likely_encoded",
    "likely_encoded_open",
    "pages",
    "pages_open",
]

Open = FileIO | BufferedReader | BytesIO
"""What is read from: a file, or what a store gives."""

_HEAD = 64  # bytes that tell of what kind a file is
_MOST_BYTES = 1 << 31  # of a file other than TIFF, which is read by pages: 16-bit colour of the largest picture


def decode(path: Path, *, threads: int = 1, directory: int = 0, size: tuple[int, int] | None = None) -> np.ndarray:
    """Grey values (H, W) of an image file, uint8 or uint16 as stored. Colour is reduced to luma, alpha is ignored.

    Args:
        path: of the file.
        threads: that decode side by side.
        directory: of `pages`, for TIFF files; 0 is the first.
        size: width and height that the picture has to have, if known.

    Raises:
        UnreadableImageError: with the reason. A file that ends early or is damaged is refused, never filled up.
        WrongSizeError: its header states another size. No memory is taken for its pixels.
    """
    with _opened(path) as file:
        return decode_open(file, threads=threads, directory=directory, size=size)


def decode_open(file: Open, *, threads: int = 1, directory: int = 0, size: tuple[int, int] | None = None) -> np.ndarray:
    """The same of a file that is open, at its beginning."""
    with memory_told():
        head = file.read(_HEAD)
        if head.startswith(tiff.MAGIC):
            return tiff.TiffFile(file).decode(directory, size)
        if not head.startswith((png.MAGIC, jpeg.MAGIC, plain.BMP, *plain.PGM)):
            raise UnreadableImageError("not_an_image" if head else "empty")
        if file.seek(0, SEEK_END) > _MOST_BYTES:
            raise UnreadableImageError("too_large")
        file.seek(0)
        return _decode(file.read(), threads, size)


def _decode(data: bytes, threads: int, size: tuple[int, int] | None) -> np.ndarray:
    """The same of the bytes of a file other than TIFF."""
    header: Header
    if data.startswith(png.MAGIC):
        header = png.read_header(data)
        check_size(header, size)
        image = png.decode(data, header, threads)
    elif data.startswith(jpeg.MAGIC):
        check_size(header := jpeg.read_header(data), size)
        image = jpeg.decode(data, header)
    else:
        check_size(header := (plain.read_bmp if data.startswith(plain.BMP) else plain.read_pgm)(data), size)
        image = by_opencv(data)
    if image.shape != (header.height, header.width):
        raise UnreadableImageError("corrupt")
    return image


def pages(path: Path) -> list[int]:
    """What to give `decode` as ``directory`` for each picture of a file: one number, or more for a TIFF file.

    A file that cannot be read has one, too: decoding it tells the reason.
    """
    try:
        with _opened(path) as file:
            return pages_open(file)
    except UnreadableImageError:
        return [0]


def pages_open(file: Open) -> list[int]:
    """The same of a file that is open, at its beginning. UnreadableImageError: it ends early."""
    return tiff.TiffFile(file).pages() if file.read(4) in tiff.MAGIC else [0]


def likely_encoded(path: Path) -> bool:
    """Whether a file is of a kind that mostly holds values bent by a tone curve: JPEG, or colour (PNG, BMP)."""
    try:
        with _opened(path) as file:
            return likely_encoded_open(file)
    except UnreadableImageError:
        return False


def likely_encoded_open(file: Open) -> bool:
    """The same of a file that is open, at its beginning."""
    head = file.read(_HEAD)
    if head.startswith(png.MAGIC):
        return png.is_colour(head)
    if head.startswith(plain.BMP):
        return len(head) > 29 and int.from_bytes(head[28:30], "little") > 8
    return head.startswith(jpeg.MAGIC)


@contextmanager
def _opened(path: Path) -> Iterator[FileIO]:
    """A regular file to read from. UnreadableImageError: there is none.

    Opened without waiting: a pipe or a device would keep the reader for ever.
    """
    try:
        file = FileIO(path, opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)))
    except (FileNotFoundError, ValueError):  # a name with zeros or lone surrogates is none that a file can have
        raise UnreadableImageError("missing") from None
    except IsADirectoryError:
        raise UnreadableImageError("not_a_file") from None
    except OSError:
        raise UnreadableImageError("unreadable_file") from None
    with file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise UnreadableImageError("not_a_file")
        try:
            yield file
        except OSError:
            raise UnreadableImageError("unreadable_file") from None
