"""Decoding of one image file to grey values, or the reason why it cannot be.

Plain grey PNG files go through kornia_rs, in a third to a half of OpenCV's time and bit for bit the same
(docs/kornia.md), everything else through OpenCV, which also has the last word on a file that kornia_rs refuses.
"""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # little and big endian; + is BigTIFF
_KNOWN = (_PNG, _JPEG, *_TIFF, b"BM", b"P2", b"P5")
# A camera file describes the sensor's rows and columns: the orientation that a phone notes in EXIF must not turn them.
_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
# Chunks of a PNG file that leave its grey values as they are in both decoders. Of others (animation, transparency,
# background) OpenCV has a view of its own.
_NEUTRAL = frozenset(b"IHDR IDAT IEND tEXt zTXt iTXt tIME pHYs gAMA cHRM sRGB iCCP sBIT".split())
# kornia_rs holds the interpreter while it decodes, OpenCV does not: more threads than these decode sooner with OpenCV
_HOLDERS = 2
_MOST_PIXELS = 1 << 28  # that kornia_rs is asked for; OpenCV has limits of its own
_PNG_COLOUR = 25  # where the header of a PNG file has its type of colour: 2 and 6 are colour, 3 a palette
_DEFLATE = 1032  # largest ratio of deflate: a header that promises more pixels is wrong, no memory is taken for it


class UnreadableImageError(Exception):
    """An image cannot be decoded; `reason` is one word for the results.

    ``missing``, ``unreadable_file``, ``empty``, ``not_an_image``, ``truncated``, ``corrupt`` or ``unsupported_depth``.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def decode(path: Path, *, threads: int = 1) -> np.ndarray:
    """Grey values (H, W) of an image file, uint8 or uint16 as stored. Colour is reduced to luma, alpha is ignored.

    Of a file with several pages the first is read.

    Args:
        path: of the file.
        threads: that decode side by side.

    Raises:
        UnreadableImageError: with the reason. A file that ends early is refused, never filled up.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UnreadableImageError("missing") from None
    except OSError:
        raise UnreadableImageError("unreadable_file") from None
    if not data:
        raise UnreadableImageError("empty")
    if not data.startswith(_KNOWN):
        raise UnreadableImageError("not_an_image")
    if not next((ends(data) for start, ends in _ENDS if data.startswith(start)), True):
        raise UnreadableImageError("truncated")
    image = _plain_png(data) if threads <= _HOLDERS and data.startswith(_PNG) else None
    if image is not None:
        return image
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
    except cv2.error:  # more pixels than OpenCV accepts, or a header that contradicts itself
        image = None
    if image is None:
        raise UnreadableImageError("corrupt")
    if image.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError("unsupported_depth")
    return image


def likely_encoded(path: Path) -> bool:
    """Whether a file is of a kind that mostly holds values bent by a tone curve: JPEG, or colour (PNG, BMP)."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError:
        return False
    if head.startswith(_PNG):
        return len(head) > _PNG_COLOUR and head[_PNG_COLOUR] in (2, 3, 6)
    if head.startswith(b"BM"):
        return len(head) > 29 and int.from_bytes(head[28:30], "little") > 8
    return head.startswith(_JPEG)


def _plain_png(data: bytes) -> np.ndarray | None:
    """Grey values of a grey PNG file of 8 or 16 bits, not interlaced, by kornia_rs; None where OpenCV is to decide.

    kornia_rs stops at the last pixel and checks neither the sum of the last chunk nor that there is an end, so the
    chunks are checked here. It never checks the sum of the zlib stream: those of the chunks tell what a disk or a cable
    did to the file, but not a fault within the program that wrote it.
    """
    header = _plain_header(data)
    if header is None:
        return None
    from kornia_rs import io

    read, width, height = (io.decode_image_png_u8 if header[2] == 8 else io.decode_image_png_u16), *header[:2]
    try:
        image: np.ndarray = read(data, (height, width), "mono")
    except BaseException as error:
        # a panic of the Rust code is no Exception, nor can its type be imported
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            return None
        raise
    return image[..., 0]


def _plain_header(data: bytes) -> tuple[int, int, int] | None:
    """Width, height and bits of a PNG file whose chunks are whole and say nothing but grey values; else None."""
    kind, *rest = struct.unpack_from(">4s2I5B", data, len(_PNG) + 4) if len(data) > 45 else (b"",)
    if kind != b"IHDR" or rest[3:] != [0, 0, 0, 0] or rest[2] not in (8, 16):
        return None
    width, height, bits = rest[:3]
    if not 0 < width * height <= min(_MOST_PIXELS, _DEFLATE * len(data) * 8 // bits):
        return None
    view, position = memoryview(data), len(_PNG)
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(view[position : position + 4], "big")
        kind = bytes(view[position + 4 : position + 8])
        if kind not in _NEUTRAL or zlib.crc32(view[position + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return None
        if kind == b"IEND":
            return width, height, bits
        position = end + 4
    return None


def _png_ends(data: bytes) -> bool:
    """Whether the chunks of a PNG file lead to its IEND chunk. Their checksums are the decoder's business."""
    position = len(_PNG)
    while position + 12 <= len(data):
        if data[position + 4 : position + 8] == b"IEND":
            return True
        position += 12 + int.from_bytes(data[position : position + 4], "big")
    return False


def _jpeg_ends(data: bytes) -> bool:
    """Whether an end marker follows the first scan of a JPEG file.

    Decoders fill the missing rest of a scan with grey. The segments before it are skipped by their length, because a
    preview in them has an end marker of its own; inside a scan the marker's two bytes cannot occur.
    """
    position = len(_JPEG)
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
        elif marker == 0xDA:
            return data.find(b"\xff\xd9", position) >= 0
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return False


def _tiff_ends(data: bytes) -> bool:
    """Whether the first directory of a TIFF file lies within it.

    libtiff goes on without the entries that are cut off. Pixels that are cut off it reports.
    """
    order: Literal["little", "big"] = "little" if data.startswith(b"II") else "big"
    big = data[2:4] in (b"+\0", b"\0+")
    at, offset_size, count_size, entry_size = (8, 8, 8, 20) if big else (4, 4, 2, 12)
    directory = int.from_bytes(data[at : at + offset_size], order)
    entries = int.from_bytes(data[directory : directory + count_size], order)
    return directory > 0 and directory + count_size + entries * entry_size + offset_size <= len(data)


_ENDS: tuple[tuple[bytes | tuple[bytes, ...], Callable[[bytes], bool]], ...] = (
    (_PNG, _png_ends),
    (_JPEG, _jpeg_ends),
    (_TIFF, _tiff_ends),
)
