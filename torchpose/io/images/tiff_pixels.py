"""TIFF: from the bytes of strips or tiles to grey values."""

import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchpose.io.images.header import UnreadableImageError
from torchpose.io.images.native import by_kornia

NONE, LZW, JPEG, DEFLATE, OLD_DEFLATE, PACKBITS = 1, 5, 7, 8, 32946, 32773
COMPRESSIONS = (NONE, LZW, JPEG, DEFLATE, OLD_DEFLATE, PACKBITS)
PREDICTED = (LZW, DEFLATE, OLD_DEFLATE)  # values of these may be differences along the row
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, YCBCR = 0, 1, 2, 3, 6


@dataclass(frozen=True)
class Layout:
    """How the pixels of a picture are stored.

    Attributes:
        width: of the picture, px.
        height: of the picture, px.
        bits: of a value.
        samples: values of a pixel.
        planes: that these are stored in, 1 or one a sample.
        compression: of a strip or tile.
        photometric: what the values mean.
        predicted: whether values are differences along the row.
        rows: of a strip or tile.
        columns: of a strip or tile.
        tiled: tiles are whole, a last strip is only as high as the picture.
        order: of bytes, < or >.
        colours: of a palette: all red, green and blue values, 16 bits.
    """

    width: int
    height: int
    bits: int
    samples: int
    planes: int
    compression: int
    photometric: int
    predicted: bool
    rows: int
    columns: int
    tiled: bool
    order: str
    colours: np.ndarray

    @property
    def down(self) -> int:
        """Strips or tiles from top to bottom."""
        return -(-self.height // self.rows)

    @property
    def across(self) -> int:
        """Tiles from left to right."""
        return -(-self.width // self.columns)

    @property
    def together(self) -> int:
        """Values of a pixel that are stored together."""
        return self.samples // self.planes

    @property
    def line(self) -> int:
        """Bytes of a row of a strip or tile."""
        return (self.columns * self.together * self.bits + 7) // 8

    @property
    def block_size(self) -> int:
        """Bytes of a whole strip or tile."""
        return self.rows * self.line

    @property
    def sizes(self) -> list[int]:
        """Bytes that each strip or tile decodes to."""
        last = self.block_size if self.tiled else (self.height - (self.down - 1) * self.rows) * self.line
        return ([self.block_size] * (self.down - 1) * self.across + [last] * self.across) * self.planes


def decode_blocks(blocks: Sequence[bytes], layout: Layout, tables: bytes) -> np.ndarray:
    """Grey values (H, W), uint8 or uint16, of compressed strips or tiles; ``tables`` are those that JPEG shares.

    Raises:
        UnreadableImageError: one does not decode to just the bytes that it should hold.
    """
    sizes = layout.sizes
    if layout.compression == NONE:
        if any(len(block) < size for block, size in zip(blocks, sizes, strict=True)):
            raise UnreadableImageError("truncated")
        parts = [block[:size] for block, size in zip(blocks, sizes, strict=True)]
    elif layout.compression == JPEG:
        rows = [size // layout.line for size in sizes]
        parts = [_grey_jpeg(block, tables, n, layout.columns) for block, n in zip(blocks, rows, strict=True)]
        layout = replace(layout, samples=1, photometric=BLACK_IS_ZERO)
    elif layout.compression in PREDICTED[1:]:
        parts = [_inflated(block, size) for block, size in zip(blocks, sizes, strict=True)]
    else:
        parts = _by_libtiff(blocks, sizes, layout.compression)
    return _grey(b"".join(part.ljust(layout.block_size, b"\0") for part in parts), layout)


def _inflated(block: bytes, size: int) -> bytes:
    """Decompressed bytes, their checksum included."""
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(block, size)
        rest = stream.decompress(stream.unconsumed_tail, 1)
    except zlib.error:
        raise UnreadableImageError("corrupt") from None
    if len(data) != size or rest or not stream.eof:
        raise UnreadableImageError("corrupt")
    return data


def _grey_jpeg(block: bytes, tables: bytes, rows: int, columns: int) -> bytes:
    """Luma of a strip or tile that is a JPEG file of its own but for tables that all share."""
    image = by_kornia("decode_image_jpegturbo", tables[:-2] + block[2:] if tables else block, "mono")
    if image is None or image.shape != (rows, columns):
        raise UnreadableImageError("corrupt")
    return image.tobytes()


def _by_libtiff(blocks: Sequence[bytes], sizes: Sequence[int], compression: int) -> list[bytes]:
    """Bytes by libtiff in Pillow, which stops at what it cannot decode.

    It is given files with one strip a row, which hold nothing but what is to be decoded: all strips of a size as the
    rows of one picture.
    """
    decoded: dict[int, bytes] = {}
    for size in set(sizes):
        mine = [i for i, other in enumerate(sizes) if other == size]
        data = _pillow(_file_of_rows([blocks[i] for i in mine], size, compression))
        if len(data) != size * len(mine):
            raise UnreadableImageError("corrupt")
        decoded |= {i: data[k * size : (k + 1) * size] for k, i in enumerate(mine)}
    return [decoded[i] for i in range(len(blocks))]


def _pillow(data: bytes) -> bytes:
    from PIL.TiffImagePlugin import TiffImageFile

    try:
        return TiffImageFile(io.BytesIO(data)).tobytes()
    except (OSError, ValueError, SyntaxError):
        raise UnreadableImageError("corrupt") from None


def _file_of_rows(rows: Sequence[bytes], width: int, compression: int) -> bytes:
    """A TIFF file of 8-bit grey values whose rows are the strips given."""
    count, place = len(rows), 8
    counts = np.array([len(row) for row in rows], "<u4")
    places = place + np.concatenate([[0], np.cumsum(counts[:-1])]).astype("<u4")
    body = b"".join(rows)
    body += bytes(-len(body) % 4)
    after = place + len(body)
    lists = (after, after + 4 * count) if count > 1 else (place, int(counts[0]))
    numbers = [(256, width), (257, count), (258, 8), (259, compression), (262, BLACK_IS_ZERO), (273, lists[0])]
    numbers += [(277, 1), (278, 1), (279, lists[1])]
    amounts = {273: count, 279: count}
    directory = np.array([(tag, 4, amounts.get(tag, 1), n) for tag, n in numbers], "<u2,<u2,<u4,<u4").tobytes()
    start = b"II*\0" + np.array([after + 8 * count], "<u4").tobytes()
    return b"".join([start, body, places.tobytes(), counts.tobytes(), bytes([len(numbers), 0]), directory, bytes(4)])


def _grey(raw: bytes, layout: Layout) -> np.ndarray:
    """Grey values (H, W) of decompressed strips or tiles, all filled up to the same size."""
    shape = (layout.planes, layout.down, layout.across, layout.rows)
    values = _values(np.frombuffer(raw, np.uint8).reshape(*shape, layout.line), layout)
    pixels = values.reshape(*shape, layout.columns, layout.together)
    if layout.predicted:
        pixels = np.cumsum(pixels, axis=-2, dtype=pixels.dtype)
    whole = pixels.transpose(0, 5, 1, 3, 2, 4).reshape(
        layout.samples, layout.down * layout.rows, layout.across * layout.columns
    )[:, : layout.height, : layout.width]
    return np.ascontiguousarray(_luma(whole, layout))


def _values(lines: np.ndarray, layout: Layout) -> np.ndarray:
    """The numbers (..., columns x samples) that lines of bytes hold."""
    if layout.bits == 8:
        return lines
    if layout.bits == 16:
        return lines.view(f"{layout.order}u2").astype(np.uint16, copy=False)
    count = layout.columns * layout.together
    bits = np.unpackbits(lines, axis=-1)[..., : count * layout.bits].reshape(*lines.shape[:-1], count, layout.bits)
    places = (1 << np.arange(layout.bits - 1, -1, -1)).astype(np.uint16)
    return (bits @ places).astype(np.uint8 if layout.bits < 8 else np.uint16)


def _luma(samples: np.ndarray, layout: Layout) -> np.ndarray:
    """Grey values (H, W) of samples (S, H, W), to the whole range of uint8 or uint16."""
    if layout.photometric == PALETTE:
        colours = (layout.colours.reshape(3, -1) >> 8).astype(np.uint8)
        return cv2.cvtColor(colours.T[samples[0]], cv2.COLOR_RGB2GRAY)
    if layout.photometric == RGB:
        return cv2.cvtColor(np.ascontiguousarray(samples[:3].transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    grey, top = samples[0], (1 << layout.bits) - 1
    if layout.photometric == WHITE_IS_ZERO:
        grey = top - grey
    if layout.bits < 8:
        return grey * (255 // top)
    return grey << (16 - layout.bits) if 8 < layout.bits < 16 else grey
