"""JPEG: what libjpeg warns of is damage.

OpenCV prints libjpeg's warnings and hands on what came out: rows shifted by a block, or grey from the damage on.
kornia_rs decodes with the same library to the same grey values in the same time and refuses the file instead
(docs/decisions/0089-damaged-pictures.md).
"""

import numpy as np

from torchpose.io.images.header import Header, UnreadableImageError
from torchpose.io.images.jpeg_scan import is_whole, with_row_below
from torchpose.io.images.native import by_kornia

MAGIC = b"\xff\xd8"
_DCT = (0xC0, 0xC1, 0xC2)  # start of a frame, coded by Huffman: baseline, extended, progressive
_STARTS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # of any frame; the three define tables
_BLOCK = 64  # px whose coefficients take one bit at least
_SCAN, _END = 0xDA, b"\xff\xd9"


def read_header(data: bytes) -> Header:
    """The size that the first frame header states.

    The segments before the first scan are skipped by their length, because a preview in them has headers and an end of
    its own. An end marker has to follow; inside a scan its two bytes cannot occur.

    Raises:
        UnreadableImageError: ``truncated``, ``corrupt``, or ``unsupported`` for arithmetic coding, lossless frames, 12
            bits and four colours.
    """
    position, frame = len(MAGIC), None
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _SCAN:
            if data.find(_END, position) < 0:
                break
            return _checked(frame, len(data))
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker in _STARTS and frame is None:
            frame = data[position + 1 : position + 2 + length]
        position += 2 + length
    raise UnreadableImageError("truncated")


def _checked(frame: bytes | None, size: int) -> Header:
    """The header of a frame segment: marker, length, bits, height, width, number of colours."""
    if frame is None or len(frame) < 9:
        raise UnreadableImageError("corrupt")
    height, width = int.from_bytes(frame[4:6], "big"), int.from_bytes(frame[6:8], "big")
    if frame[0] not in _DCT or frame[3] != 8 or frame[8] not in (1, 3):
        raise UnreadableImageError("unsupported")
    return Header(width, height, 8 * _BLOCK * size)


def decode(data: bytes, header: Header) -> np.ndarray:
    """Grey values (H, W); colour by its luma, as the file has it.

    Raises:
        UnreadableImageError: libjpeg warns or refuses, or the scan has more blocks than the picture.
    """
    plain = None  # the picture without a row, where it is needed
    for longer, last in with_row_below(data):
        image = _strict(longer)
        if image is not None and is_whole(image[-1], last):
            return image[: header.height]
        if plain is None and (plain := _strict(data)) is None:
            raise UnreadableImageError("corrupt")
    # none of the places did: the scan has other blocks than the picture. Or there was no row to begin with.
    image = _strict(data) if plain is None else None
    if image is None:
        raise UnreadableImageError("corrupt")
    return image


def _strict(data: bytes) -> np.ndarray | None:
    """Grey values; None where libjpeg warns or refuses."""
    return by_kornia("decode_image_jpegturbo", data, "mono")
