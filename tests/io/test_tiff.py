"""TIFF: layouts and compressions to the bit, against what wrote them; pages, and all that is refused."""

import io
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from torchpose.io.images import UnreadableImageError, decode, pages

RAMP = (np.add.outer(np.arange(61) * 3, np.arange(83)) % 256).astype(np.uint8)
RAMP16 = RAMP.astype(np.uint16) * 257 + 3
COLOUR = np.dstack([RAMP, RAMP[::-1], RAMP[:, ::-1]])


def written(image: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, image, **({"photometric": "minisblack"} | options))
    return buffer.getvalue()


def by_pillow(image: Image.Image, **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "TIFF", **options)
    return buffer.getvalue()


def by_opencv(image: np.ndarray, compression: int) -> bytes:
    return cv2.imencode(".tif", image, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()


def packed(image: np.ndarray, bits: int) -> bytes:
    """A file of rows of numbers of that many bits, one behind the other."""
    places = np.arange(bits - 1, -1, -1)
    lines = np.packbits((image[..., None] >> places & 1).reshape(len(image), -1).astype(np.uint8), axis=1)
    numbers = [(256, image.shape[1]), (257, len(image)), (258, bits), (259, 1), (262, 1), (273, 8), (277, 1)]
    numbers += [(278, len(image)), (279, lines.size)]
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, number) for tag, number in numbers)
    start = b"II*\0" + struct.pack("<I", 8 + lines.size)
    return start + lines.tobytes() + bytes([len(numbers), 0]) + directory + bytes(4)


def with_tag(data: bytes, tag: int, value: int, *, kind: int = 3) -> bytes:
    """The file with another number in a tag of its first directory, little endian; the tag takes the place of one that
    nothing reads if the file has none."""
    out, place = bytearray(data), struct.unpack_from("<I", data, 4)[0]
    entries = [place + 2 + 12 * i for i in range(struct.unpack_from("<H", data, place)[0])]
    unread = {270, 282, 283, 296, 305}
    mine = [e for e in entries if struct.unpack_from("<H", data, e)[0] == tag]
    (entry, *_) = mine or [e for e in entries if struct.unpack_from("<H", data, e)[0] in unread]
    struct.pack_into("<HHII", out, entry, tag, kind, 1, value)
    return bytes(out)


def luma(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


LUMA = luma(COLOUR)
TILES: dict[str, Any] = {"tile": (32, 48)}
FILES: dict[str, tuple[bytes, np.ndarray]] = {
    "8 bit": (written(RAMP), RAMP),
    "16 bit, big endian": (written(RAMP16, byteorder=">"), RAMP16),
    "BigTIFF": (written(RAMP16, bigtiff=True), RAMP16),
    "strips": (written(RAMP16, rowsperstrip=7), RAMP16),
    "tiles": (written(RAMP16, **TILES), RAMP16),
    "tiles, deflate": (written(RAMP, **TILES, compression="zlib"), RAMP),
    "deflate, differences": (written(RAMP16, compression="zlib", predictor=True, rowsperstrip=9), RAMP16),
    "deflate, differences, tiles, big endian": (
        written(RAMP16, **TILES, compression="zlib", predictor=True, byteorder=">"),
        RAMP16,
    ),
    "colour": (written(COLOUR, photometric="rgb"), LUMA),
    "colour of 16 bits": (
        written(COLOUR.astype(np.uint16) * 257, photometric="rgb"),
        luma(COLOUR.astype(np.uint16) * 257),
    ),
    "colour in planes": (
        written(COLOUR.transpose(2, 0, 1), photometric="rgb", planarconfig="separate", rowsperstrip=9),
        LUMA,
    ),
    "colour in planes of tiles": (
        written(COLOUR.transpose(2, 0, 1), photometric="rgb", planarconfig="separate", **TILES),
        LUMA,
    ),
    "LZW, differences, OpenCV": (by_opencv(RAMP, 5), RAMP),
    "LZW, 16 bit, OpenCV": (by_opencv(RAMP16, 5), RAMP16),
    "LZW, colour, OpenCV": (by_opencv(COLOUR[..., ::-1], 5), LUMA),
    "bytes of runs": (by_pillow(Image.fromarray(RAMP), compression="packbits"), RAMP),
    "palette": (by_pillow(Image.fromarray(RAMP).convert("P")), RAMP),
    "1 bit": (by_pillow(Image.fromarray(RAMP > 99)), (RAMP > 99) * np.uint8(255)),
    "4 bits": (packed(RAMP >> 4, 4), (RAMP >> 4) * np.uint8(17)),
    "12 bits": (packed(RAMP16 >> 4, 12), RAMP16 >> 4 << 4),
    "no counts of bytes": (
        with_tag(written(RAMP), 279, 0).replace(struct.pack("<H", 279), struct.pack("<H", 65000), 1),
        RAMP,
    ),
    "white is zero, 8 bit": (written(255 - RAMP, photometric="miniswhite"), RAMP),
    "white is zero, 16 bit": (written(65535 - RAMP16, photometric="miniswhite"), RAMP16),
    "white is zero, 12 bits": (with_tag(packed(4095 - (RAMP16 >> 4), 12), 262, 0), RAMP16 >> 4 << 4),
}


def read(data: bytes, folder: Path, **options: Any) -> np.ndarray:
    (folder / "f.tif").write_bytes(data)
    return decode(folder / "f.tif", **options)


@pytest.mark.parametrize("kind", FILES)
def test_every_layout_comes_out_to_the_bit(tmp_path: Path, kind: str) -> None:
    data, expected = FILES[kind]
    image = read(data, tmp_path)
    assert image.dtype == expected.dtype
    np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("mode", ["L", "YCbCr"])
def test_jpeg_strips_are_the_luma_of_libtiff(tmp_path: Path, mode: str) -> None:
    smooth = Image.fromarray(cv2.GaussianBlur(COLOUR, (0, 0), 4)).convert(mode)
    data = by_pillow(smooth, compression="jpeg", quality=90)
    expected = luma(np.asarray(smooth.convert("RGB")))
    assert np.abs(read(data, tmp_path).astype(int) - expected).max() < 12


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("image", [RAMP, RAMP16], ids=["8 bit", "16 bit"])
def test_the_orientation_tag_does_not_turn_the_sensor(
    tmp_path: Path, image: np.ndarray, compression: str | None
) -> None:
    for orientation in range(1, 9):
        data = written(image, compression=compression, extratags=[(274, 3, 1, orientation, True)])
        np.testing.assert_array_equal(read(data, tmp_path), image)


UNSUPPORTED = {
    "JPEG 2000": with_tag(written(RAMP), 259, 34712),
    "JPEG XL": with_tag(written(RAMP), 259, 50002),
    "WebP": with_tag(written(RAMP), 259, 50001),
    "zstd": with_tag(written(RAMP), 259, 50000),
    "fax": with_tag(written(RAMP), 259, 4),
    "old JPEG": with_tag(written(RAMP), 259, 6),
    "CMYK": written(np.dstack([RAMP] * 4), photometric="separated"),
    "Lab": with_tag(written(COLOUR, photometric="rgb"), 262, 8),
    "bits turned round": with_tag(written(RAMP), 266, 2),
    "predictor of floats": with_tag(written(RAMP, compression="zlib", predictor=True), 317, 3),
}


@pytest.mark.parametrize("kind", UNSUPPORTED)
def test_what_cannot_be_decoded_is_unsupported_not_black(tmp_path: Path, kind: str) -> None:
    with pytest.raises(UnreadableImageError, match=r"^unsupported$"):
        read(UNSUPPORTED[kind], tmp_path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16, np.uint32, np.int8])
def test_other_numbers_are_an_unsupported_depth(tmp_path: Path, dtype: type) -> None:
    with pytest.raises(UnreadableImageError, match="unsupported_depth"):
        read(written(RAMP.astype(dtype)), tmp_path)


STRIPS = {
    "deflate": written(RAMP, compression="zlib", rowsperstrip=7),
    "LZW": by_opencv(np.random.default_rng(0).integers(0, 99, (200, 300)).astype(np.uint8), 5),
    "JPEG": by_pillow(Image.fromarray(RAMP), compression="jpeg", quality=90),
}


@pytest.mark.parametrize("kind", STRIPS)
def test_a_damaged_strip_is_corrupt_not_black(tmp_path: Path, kind: str) -> None:
    """The middle of the pixels is overwritten; no file of these comes out with a gap."""
    data = bytearray(STRIPS[kind])
    with tifffile.TiffFile(io.BytesIO(STRIPS[kind])) as file:
        place, count = file.pages[0].dataoffsets[0], file.pages[0].databytecounts[0]
    for fill in (0, 255):
        data[place + count // 3 : place + count] = bytes([fill]) * (count - count // 3)
        with pytest.raises(UnreadableImageError, match="corrupt"):
            read(bytes(data), tmp_path)


def test_no_flipped_bit_of_deflated_strips_changes_a_pixel(tmp_path: Path) -> None:
    data = STRIPS["deflate"]
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        start = file.pages[0].dataoffsets[0]
        bits = 8 * (file.pages[0].dataoffsets[-1] + file.pages[0].databytecounts[-1] - start)
    for bit in range(0, bits, 97):
        damaged = bytearray(data)
        damaged[start + bit // 8] ^= 1 << bit % 8
        try:
            image = read(bytes(damaged), tmp_path)
        except UnreadableImageError:
            continue
        np.testing.assert_array_equal(image, RAMP)  # bits between the last code and the checksum, which say nothing


def stack(count: int, **options: Any) -> bytes:
    buffer = io.BytesIO()
    with tifffile.TiffWriter(buffer, **options) as file:
        for page in range(count):
            file.write(RAMP + np.uint8(page), photometric="minisblack", metadata=None)
    return buffer.getvalue()


@pytest.mark.parametrize("options", [{}, {"bigtiff": True}, {"byteorder": ">"}], ids=str)
def test_each_page_is_decoded_by_its_directory(tmp_path: Path, options: dict[str, Any]) -> None:
    path = tmp_path / "f.tif"
    path.write_bytes(stack(5, **options))
    places = pages(path)
    assert len(places) == 5
    for page, place in enumerate(places):
        np.testing.assert_array_equal(decode(path, directory=place), RAMP + np.uint8(page))


def test_smaller_copies_and_masks_are_no_pages(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    with tifffile.TiffWriter(path) as file:
        for kind, image in ((1, RAMP[::2, ::2]), (0, RAMP), (1, RAMP[::2, ::2]), (4, RAMP)):
            options: dict[str, Any] = {"photometric": "mask"} if kind == 4 else {"photometric": "minisblack"}
            file.write(image > 9 if kind == 4 else image, subfiletype=kind, metadata=None, **options)
    (place,) = pages(path)
    np.testing.assert_array_equal(decode(path, directory=place), RAMP)


@pytest.mark.parametrize("damage", ["loop", "beyond the end", "cut"])
def test_a_chain_of_pages_that_breaks_off_ends_in_a_page_that_cannot_be_read(tmp_path: Path, damage: str) -> None:
    data, path = bytearray(stack(3)), tmp_path / "f.tif"
    place, links = struct.unpack_from("<I", data, 4)[0], []
    while place:
        links.append(place + 2 + 12 * struct.unpack_from("<H", data, place)[0])
        place = struct.unpack_from("<I", data, links[-1])[0]
    if damage == "cut":
        data = data[: struct.unpack_from("<I", data, links[1])[0] + 3]
    else:
        first = struct.unpack_from("<I", data, 4)[0]
        struct.pack_into("<I", data, links[1], first if damage == "loop" else 1 << 30)
    path.write_bytes(data)
    *good, last = pages(path)
    assert [decode(path, directory=place)[0, 0] for place in good] == [0, 1]
    with pytest.raises(UnreadableImageError):
        decode(path, directory=last)
