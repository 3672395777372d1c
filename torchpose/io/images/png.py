"""PNG: every chunk's checksum holds, then kornia_rs or OpenCV decodes.

Plain grey files go through kornia_rs, in a third to a half of OpenCV's time and bit for bit the same (docs/kornia.md),
all others through OpenCV, which also has the last word on a file that kornia_rs refuses.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from torchpose.io.images.header import Header, UnreadableImageError
from torchpose.io.images.native import by_kornia, by_opencv

MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">2I5B")  # width, height, bits, colour, compression, filter, interlacing
# Chunks that leave the grey values as they are in both decoders. Of others (transparency, background) OpenCV has a view
# of its own.
_NEUTRAL = frozenset(b"IHDR IDAT IEND tEXt zTXt iTXt tIME pHYs gAMA cHRM sRGB iCCP sBIT".split())
# kornia_rs holds the interpreter while it decodes, OpenCV does not: more threads than these decode sooner with OpenCV
_HOLDERS = 2
_DEFLATE = 1032  # largest ratio of deflate
_COLOUR = 25  # where a file has its type of colour: 2 and 6 are colour, 3 a palette


@dataclass(frozen=True)
class PngHeader(Header):
    """Also bits a value, and whether the file is grey values and nothing else."""

    bits: int
    plain: bool


def read_header(data: bytes) -> PngHeader:
    """The header of a file whose chunks are all whole, up to its end.

    Raises:
        UnreadableImageError: ``truncated``, ``corrupt`` where a checksum is wrong, ``unsupported`` for animations.
    """
    view, position, kinds = memoryview(data), len(MAGIC), []
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(view[position : position + 4], "big")
        kind = bytes(view[position + 4 : position + 8])
        if end + 4 > len(data):
            break
        if zlib.crc32(view[position + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise UnreadableImageError("corrupt")
        if kind == b"acTL" and bytes(view[position + 8 : position + 12]) > b"\0\0\0\1":
            raise UnreadableImageError("unsupported")  # pictures behind the first would be dropped
        kinds.append(kind)
        if kind == b"IEND":
            return _checked(data, kinds)
        position = end + 4
    raise UnreadableImageError("truncated")


def _checked(data: bytes, kinds: list[bytes]) -> PngHeader:
    """The header, where the first chunk is one."""
    if kinds[0] != b"IHDR" or data[8:12] != b"\0\0\0\r":
        raise UnreadableImageError("corrupt")
    width, height, bits, *rest = _HEADER.unpack_from(data, 16)
    plain = rest == [0, 0, 0, 0] and bits in (8, 16) and _NEUTRAL.issuperset(kinds)
    return PngHeader(width, height, 8 * _DEFLATE * len(data) / max(bits, 1), bits, plain)


def decode(data: bytes, header: PngHeader, threads: int) -> np.ndarray:
    """Grey values (H, W).

    kornia_rs never checks the sum of the zlib stream (Adler-32): those of the chunks tell what a disk or a cable did to
    the file, but not a fault within the program that wrote it.
    """
    image = None
    if header.plain and threads <= _HOLDERS:
        image = by_kornia(f"decode_image_png_u{header.bits}", data, (header.height, header.width), "mono")
    return by_opencv(data) if image is None else image


def is_colour(head: bytes) -> bool:
    """Whether a file that begins so holds colour."""
    return len(head) > _COLOUR and head[_COLOUR] in (2, 3, 6)
