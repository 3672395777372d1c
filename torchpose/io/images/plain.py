"""BMP and PGM: no checksums, so at least their headers have to agree with the bytes that follow."""

import re
import struct

from torchpose.io.images.header import Header, UnreadableImageError

BMP, PGM = b"BM", (b"P2", b"P5")
_DIB = 14  # where the second header of a BMP file begins
_UNPACKED = (0, 3)  # compression of a BMP file: none, none with masks
_PGM = re.compile(rb"P[25]((?:\s|#[^\n]*\n)+\d{1,9}){3}\s")
_NUMBERS = re.compile(rb"#[^\n]*\n|(\d+)")


def read_bmp(data: bytes) -> Header:
    """Header of a BMP file.

    Raises:
        UnreadableImageError: ``truncated``, ``corrupt`` where the pixels are said to lie in the headers,
            ``unsupported`` for run lengths, in which damage would not be told.
    """
    if len(data) < _DIB + 26:
        raise UnreadableImageError("truncated")
    start, size = struct.unpack_from("<II", data, 10)
    old = size == 12  # OS/2
    width, height, _, bits = struct.unpack_from("<HHHH" if old else "<iiHH", data, _DIB + 4)
    packing, colours = (0, 0) if old else struct.unpack_from("<I12xI", data + bytes(24), _DIB + 16)
    if packing not in _UNPACKED:
        raise UnreadableImageError("unsupported")
    palette = (3 if old else 4) * (colours or 1 << bits) if bits <= 8 else 0
    if size < 12 or start < _DIB + size + palette or bits not in (1, 4, 8, 16, 24, 32):
        raise UnreadableImageError("corrupt")
    line = (width * bits + 31) // 32 * 4
    return Header(width, abs(height), width * max(0, (len(data) - start) // line) if line > 0 else 0)


def read_pgm(data: bytes) -> Header:
    """Header of a PGM file.

    Raises:
        UnreadableImageError: ``truncated``, ``corrupt``, ``unsupported`` where another picture follows.
    """
    match = _PGM.match(data)
    if match is None:
        raise UnreadableImageError("corrupt" if len(data) > 64 else "truncated")
    width, height, top = (int(number) for number in _NUMBERS.findall(match[0][2:]) if number)
    if not 0 < top < 1 << 16:
        raise UnreadableImageError("corrupt")
    rest = len(data) - match.end()
    if data.startswith(b"P2"):
        return Header(width, height, (rest + 1) // 2)  # a digit and a space each
    value = 1 if top < 256 else 2
    behind = data[match.end() + width * height * value :].strip()
    if behind:
        raise UnreadableImageError("unsupported" if behind.startswith(PGM) else "corrupt")
    return Header(width, height, rest // value)
