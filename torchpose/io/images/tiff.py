"""TIFF: directories and what they say of their pictures, read strictly.

OpenCV reads 8-bit files leniently: strips that libtiff cannot decode stay black, compressions that it does not know
give a black frame, and the orientation tag turns the rows (docs/decisions/0089-damaged-pictures.md). Here every strip
or tile has to lie in the file and to decode to just the bytes that it should hold; what is not known is refused.
Orientation, resolution and all other tags are of no matter.
"""

import io
import struct
from io import BufferedReader, BytesIO, FileIO

import numpy as np

from torchpose.io.images.header import MOST_PIXELS, Header, UnreadableImageError, check_size
from torchpose.io.images.tiff_pixels import (
    BLACK_IS_ZERO,
    COMPRESSIONS,
    JPEG,
    PALETTE,
    PREDICTED,
    RGB,
    WHITE_IS_ZERO,
    YCBCR,
    Layout,
    decode_blocks,
)

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # little and big endian; + is BigTIFF
MOST_PAGES = 1 << 16  # of a file (convention): a chain of directories that is longer leads nowhere
_MOST_NUMBERS = 1 << 18  # of a tag (convention): strips of one row in the tallest of pictures
# tags of TIFF 6.0 and its supplements
_KIND, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _FILL = 254, 256, 257, 258, 259, 262, 266
_STRIPS, _SAMPLES, _ROWS, _STRIP_BYTES, _PLANAR, _PREDICTOR, _COLOURS = 273, 277, 278, 279, 284, 317, 320
_TILE_WIDTH, _TILE_HEIGHT, _TILES, _TILE_BYTES, _FORMAT, _TABLES = 322, 323, 324, 325, 339, 347
_SINGLE = (_KIND, _WIDTH, _HEIGHT, _COMPRESSION, _PHOTOMETRIC, _FILL, _SAMPLES, _ROWS, _PLANAR, _PREDICTOR)
_SINGLES = (*_SINGLE, _TILE_WIDTH, _TILE_HEIGHT)
_READ = frozenset((*_SINGLES, _BITS, _STRIPS, _STRIP_BYTES, _COLOURS, _TILES, _TILE_BYTES, _FORMAT, _TABLES))
_TYPES = {1: "u1", 3: "u2", 4: "u4", 7: "u1", 13: "u4", 16: "u8", 18: "u8"}  # of numbers: bytes, shorts, longs, offsets
_REDUCED, _MASK = 1, 4  # bits of `_KIND`: a smaller copy of another picture, a mask of one
_DENSEST = 1 << 12  # bytes out of one: deflate reaches 1032, LZW half its longest string of 3837, JPEG 512
_COLOUR = 6  # most bytes of a pixel: three colours of 16 bits
_DEPTHS = (1, 2, 4, 8, 10, 12, 14, 16)

Tags = dict[int, np.ndarray]


class TiffFile:
    """Directories and pixels of an open file. Whatever it says is held against its size before it is read."""

    def __init__(self, file: FileIO | BufferedReader | BytesIO) -> None:
        self._file = file
        self._size = file.seek(0, io.SEEK_END)
        head = self._at(0, 4)
        self._order = "<" if head.startswith(b"II") else ">"
        self._big = head in MAGIC[2:]
        self._offset, self._count = ("Q", "Q") if self._big else ("I", "H")

    def pages(self) -> list[int]:
        """Places of the directories that hold pictures, neither smaller copies nor masks of others; one at least.

        Where the chain of directories breaks off, its last place is one whose reading says what is wrong.
        """
        places: list[int] = []
        seen: set[int] = set()
        place = self._first()
        while place:
            if place in seen or len(seen) >= MOST_PAGES:
                return [*places, self._size]
            seen.add(place)
            try:
                tags, following = self._directory(place)
            except UnreadableImageError:
                return [*places, place]
            if not _one(tags, _KIND, 0) & (_REDUCED | _MASK):
                places.append(place)
            if _WIDTH not in tags:
                break
            place = following
        return places or [0]

    def decode(self, directory: int, size: tuple[int, int] | None) -> np.ndarray:
        """Grey values (H, W), uint8 or uint16, of a directory (0: the first), colour by its luma.

        Raises:
            UnreadableImageError: with the reason.
            WrongSizeError: not of the size that is asked for.
        """
        tags, _ = self._directory(directory or self._first())
        width, height = _one(tags, _WIDTH), _one(tags, _HEIGHT)
        check_size(Header(width, height, MOST_PIXELS), size)
        layout = _layout(tags, self._order)
        places, counts = _blocks(tags, layout)
        if sum(layout.sizes) > _DENSEST * sum(counts):
            raise UnreadableImageError("truncated")
        blocks = [self._at(*block) for block in zip(places, counts, strict=True)]
        tables = tags[_TABLES].astype(np.uint8).tobytes() if _TABLES in tags else b""
        return decode_blocks(blocks, layout, tables)

    def _first(self) -> int:
        return self._number(self._offset, self._at(8 if self._big else 4, struct.calcsize(self._offset)))

    def _number(self, kind: str, data: bytes) -> int:
        number: int = struct.unpack(self._order + kind, data)[0]
        return number

    def _at(self, place: int, count: int) -> bytes:
        """The bytes from a place on. UnreadableImageError: the file ends before."""
        if place + count <= self._size:
            self._file.seek(place)
            data = self._file.read(count)
            if len(data) == count:
                return data
        raise UnreadableImageError("truncated")

    def _directory(self, place: int) -> tuple[Tags, int]:
        """Numbers of a directory by tag, and the place of the next directory."""
        offset_size, count_size = struct.calcsize(self._offset), struct.calcsize(self._count)
        entry = struct.Struct(f"{self._order}HH{self._offset}{offset_size}s")
        entries = self._number(self._count, self._at(place, count_size))
        data = self._at(place + count_size, entries * entry.size + offset_size)
        tags: Tags = {}
        for tag, kind, amount, value in entry.iter_unpack(data[:-offset_size]):
            if tag not in _READ or kind not in _TYPES:
                continue
            if not 0 < amount <= _MOST_NUMBERS:
                raise UnreadableImageError("corrupt")
            dtype = np.dtype(self._order + _TYPES[kind])
            size = dtype.itemsize * amount
            stored = value[:size] if size <= offset_size else self._at(self._number(self._offset, value), size)
            tags[tag] = np.frombuffer(stored, dtype)
        return tags, self._number(self._offset, data[-offset_size:])


def _one(tags: Tags, tag: int, default: int | None = None) -> int:
    """The number of a tag. UnreadableImageError: there is none and no default."""
    if tag in tags:
        return int(tags[tag][0])
    if default is None:
        raise UnreadableImageError("corrupt")
    return default


def _layout(tags: Tags, order: str) -> Layout:
    """How the pixels of a directory are stored. UnreadableImageError: not known how to read them so."""
    compression, photometric = _one(tags, _COMPRESSION, 1), _one(tags, _PHOTOMETRIC)
    bits, samples = _one(tags, _BITS, 1), _one(tags, _SAMPLES, 1)
    width, height = _one(tags, _WIDTH), _one(tags, _HEIGHT)
    tiled = _TILES in tags
    rows, columns = (_one(tags, _TILE_HEIGHT), _one(tags, _TILE_WIDTH)) if tiled else (_one(tags, _ROWS, height), width)
    layout = Layout(
        width=width,
        height=height,
        bits=bits,
        samples=samples,
        planes=samples if _one(tags, _PLANAR, 1) == 2 else 1,
        compression=compression,
        photometric=photometric,
        predicted=compression in PREDICTED and _one(tags, _PREDICTOR, 1) == 2,
        rows=rows if tiled else min(rows, height),
        columns=columns,
        tiled=tiled,
        order=order,
        colours=tags.get(_COLOURS, np.zeros(0, np.uint16)).astype(np.uint16),
    )
    if (tags.get(_FORMAT, np.ones(1)) != 1).any() or bits not in _DEPTHS:
        raise UnreadableImageError("unsupported_depth")
    predictor = _one(tags, _PREDICTOR, 1) if compression in PREDICTED else 1
    if not (
        compression in COMPRESSIONS
        and _one(tags, _FILL, 1) == 1
        and (predictor == 1 or (predictor == 2 and bits in (8, 16)))
        and (tags.get(_BITS, np.ones(1)) == bits).all()
        and _colours_known(layout)
    ):
        raise UnreadableImageError("unsupported")
    if min(layout.rows, layout.columns) < 1 or not 0 < layout.block_size <= _COLOUR * MOST_PIXELS:
        raise UnreadableImageError("corrupt")
    return layout


def _colours_known(layout: Layout) -> bool:
    """Whether grey values can be made of the colours."""
    if layout.compression == JPEG:
        kinds = {1: (BLACK_IS_ZERO,), 3: (YCBCR,)}
        return layout.bits == 8 and layout.planes == 1 and layout.photometric in kinds.get(layout.samples, ())
    if layout.photometric == PALETTE:
        return layout.bits <= 8 and layout.samples == 1 and len(layout.colours) == 3 << layout.bits
    if layout.photometric == RGB:
        return layout.bits in (8, 16) and layout.samples in (3, 4)
    return layout.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO) and layout.samples in (1, 2)


def _blocks(tags: Tags, layout: Layout) -> tuple[list[int], list[int]]:
    """Places of the strips or tiles and their bytes. UnreadableImageError: not as many as there should be."""
    where, lengths = (_TILES, _TILE_BYTES) if layout.tiled else (_STRIPS, _STRIP_BYTES)
    places = tags[where].tolist() if where in tags else []
    counts = tags[lengths].tolist() if lengths in tags else layout.sizes  # old files leave them out
    number = layout.planes * layout.down * layout.across
    if not len(places) == len(counts) == number:
        raise UnreadableImageError("corrupt")
    return places, counts
