"""Decoding: every format bit by bit, and no file that ends early is ever measured."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from torchpose.io.images import UnreadableImageError, decode
from torchpose.io.images import png as png_reader

RAMP = (np.add.outer(np.arange(61) * 3, np.arange(83)) % 256).astype(np.uint8)
RAMP16 = RAMP.astype(np.uint16) * 257 + 3


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def from_pil(image: Image.Image, kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def tiff(image: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer, image, photometric="minisblack", **options
    )  # its directory precedes the pixels, OpenCV's follows
    return buffer.getvalue()


LOSSLESS: dict[str, tuple[bytes, np.ndarray]] = {
    "png8": (encoded(".png", RAMP), RAMP),
    "png16": (encoded(".png", RAMP16), RAMP16),
    "tiff8": (encoded(".tiff", RAMP), RAMP),
    "tiff16": (encoded(".tiff", RAMP16), RAMP16),
    "tiff16 directory first": (tiff(RAMP16), RAMP16),
    "bigtiff16": (tiff(RAMP16, bigtiff=True, byteorder=">"), RAMP16),
    "bmp": (encoded(".bmp", RAMP), RAMP),
    "pgm8": (encoded(".pgm", RAMP), RAMP),
    "pgm16": (encoded(".pgm", RAMP16), RAMP16),
    "png colour with alpha": (encoded(".png", np.dstack([RAMP] * 3 + [RAMP[::-1]])), RAMP),
    "png 16 bit colour": (encoded(".png", np.dstack([RAMP16] * 3)), RAMP16),
    "png grey with alpha": (from_pil(Image.fromarray(np.dstack([RAMP, RAMP[::-1]]), "LA"), "PNG"), RAMP),
    "png palette": (from_pil(Image.fromarray(RAMP).convert("P"), "PNG"), RAMP),
    "bmp colour": (encoded(".bmp", np.dstack([RAMP] * 3)), RAMP),
}


@pytest.mark.parametrize("kind", LOSSLESS)
def test_lossless_formats_come_out_bit_by_bit_in_their_own_depth(tmp_path: Path, kind: str) -> None:
    data, expected = LOSSLESS[kind]
    path = tmp_path / "f"
    path.write_bytes(data)
    image = decode(path)
    assert image.dtype == expected.dtype
    np.testing.assert_array_equal(image, expected)


def test_colour_is_reduced_to_luma(tmp_path: Path) -> None:
    bgr = np.random.default_rng(0).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    (tmp_path / "f").write_bytes(encoded(".png", bgr))
    luma = bgr @ np.array([0.114, 0.587, 0.299])  # ITU-R BT.601
    assert np.abs(decode(tmp_path / "f") - luma).max() < 1.1  # libpng rounds down, in fixed point


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_does_not_turn_the_sensor(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    colour = Image.fromarray(cv2.GaussianBlur(RAMP // 4 + 90, (0, 0), 3)).convert("RGB")
    path = tmp_path / "f.jpg"
    path.write_bytes(from_pil(colour, "JPEG", quality=95, exif=exif))
    image = decode(path)
    assert image.shape == RAMP.shape
    assert np.abs(image.astype(int) - np.asarray(colour)[..., 0]).max() < 12


def jpeg_with_preview() -> bytes:
    """A JPEG whose EXIF segment holds a whole JPEG, end marker included, as cameras write it."""
    data, preview = encoded(".jpg", RAMP), encoded(".jpg", RAMP[:16, :16])
    body = b"Exif\0\0" + preview
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]


TRUNCATABLE = {kind: data for kind, (data, _) in LOSSLESS.items()} | {
    "jpeg": encoded(".jpg", RAMP),
    "jpeg progressive": from_pil(Image.fromarray(RAMP), "JPEG", progressive=True),
    "jpeg with preview": jpeg_with_preview(),
}


@pytest.mark.parametrize("kind", TRUNCATABLE)
@pytest.mark.parametrize("share", [0.01, 0.2, 0.5, 0.9, 0.99, "all but one byte"])
def test_a_file_that_ends_early_is_refused(tmp_path: Path, kind: str, share: float | str) -> None:
    data = TRUNCATABLE[kind]
    kept = len(data) - 1 if share == "all but one byte" else int(len(data) * share)
    path = tmp_path / "f"
    path.write_bytes(data)
    assert decode(path).shape == RAMP.shape  # the whole file is good
    path.write_bytes(data[:kept])
    with pytest.raises(UnreadableImageError):
        decode(path)


@pytest.mark.parametrize("kind", ["png8", "png16"])
def test_a_flipped_bit_in_a_png_is_refused(tmp_path: Path, kind: str) -> None:
    data = bytearray(LOSSLESS[kind][0])
    data[len(data) // 2] ^= 4
    (tmp_path / "f").write_bytes(data)
    with pytest.raises(UnreadableImageError):
        decode(tmp_path / "f")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (None, "missing"),
        (b"", "empty"),
        (b"these are words, not pixels", "not_an_image"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "corrupt"),
        (encoded(".tiff", RAMP.astype(np.float32)), "unsupported_depth"),
        (encoded(".png", RAMP)[:-20], "truncated"),
        (b"BM" + bytes(100), "corrupt"),
    ],
)
def test_the_reason_says_what_is_wrong(tmp_path: Path, data: bytes | None, reason: str) -> None:
    path = tmp_path / "f.png"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(UnreadableImageError) as caught:
        decode(path)
    assert caught.value.reason == reason


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(
    image: np.ndarray,
    *,
    extra: bytes = b"",
    filters: int = 0,
    damage: Callable[[bytes], bytes] = lambda stream: stream,
    chunks: int = 1,
    header: tuple[int, ...] = (0, 0, 0, 0),
    size: tuple[int, ...] | None = None,
) -> bytes:
    """A grey PNG file written by hand: rows with the filter types given, chunks before the pixels, damaged stream."""
    rows = image.astype(">u2" if image.dtype == np.uint16 else np.uint8)
    raw = b"".join(bytes([filters]) + row.tobytes() for row in rows)
    stream = damage(zlib.compress(raw))
    step = -(-len(stream) // chunks) or 1
    bits = 16 if image.dtype == np.uint16 else 8
    start = struct.pack(">IIBBBBB", *(size or image.shape[::-1]), bits, *header)
    pixels = b"".join(chunk(b"IDAT", stream[i : i + step]) for i in range(0, len(stream), step))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + extra + pixels + chunk(b"IEND", b"")


def outcome(path: Path, threads: int) -> np.ndarray | str:
    """Grey values as decoded by kornia_rs (few threads) or by OpenCV alone (many), or the reason."""
    try:
        return decode(path, threads=threads)
    except UnreadableImageError as error:
        return error.reason


def assert_same_as_opencv(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    ours, opencv = outcome(path, 1), outcome(path, 99)
    if isinstance(ours, str) or isinstance(opencv, str):
        assert isinstance(ours, str)
        assert ours == opencv
    else:
        assert ours.dtype == opencv.dtype
        np.testing.assert_array_equal(ours, opencv)


def from_pil_raw(mode: str, **options: Any) -> bytes:
    return from_pil(Image.fromarray(RAMP).convert(mode), "PNG", **options)


ODD_PNG = {
    "1 bit": from_pil_raw("1"),
    "4 bit palette": from_pil(Image.fromarray(RAMP % 16).convert("P"), "PNG", bits=4),
    "palette": from_pil_raw("P"),
    "palette with transparency": from_pil_raw("P", transparency=3),
    "grey with alpha": from_pil_raw("LA"),
    "grey with a transparent level": from_pil_raw("L", transparency=7),
    "colour": from_pil_raw("RGB"),
    "colour with alpha": from_pil_raw("RGBA"),
    "many chunks": png(RAMP, chunks=40),
    "every filter, 8 bit": png(RAMP, filters=4),
    "average filter, 16 bit": png(RAMP16, filters=3),
    "up filter, 16 bit": png(RAMP16, filters=2),
    "text and gamma": png(RAMP, extra=chunk(b"gAMA", struct.pack(">I", 45455)) + chunk(b"tEXt", b"a\0b")),
    "significant bits": png(RAMP16, extra=chunk(b"sBIT", b"\x0c")),
    "background": png(RAMP, extra=chunk(b"bKGD", b"\0\7")),
    "background of a wrong length": png(RAMP, extra=chunk(b"bKGD", b"\0\7zzz")),
    "animation": png(RAMP, extra=chunk(b"acTL", struct.pack(">II", 2, 0))),
    "unknown critical chunk": png(RAMP, extra=chunk(b"ABCD", b"x")),
    "second header": png(RAMP, extra=chunk(b"IHDR", struct.pack(">IIBBBBB", 83, 61, 8, 0, 0, 0, 0))),
    "said to be interlaced": png(RAMP, header=(0, 0, 0, 1)),
    "unknown compression": png(RAMP, header=(0, 1, 0, 0)),
    "filter that does not exist": png(RAMP, filters=9),
    "too few rows": png(RAMP, damage=lambda stream: zlib.compress(zlib.decompress(stream)[:-100])),
    "too many rows": png(RAMP, damage=lambda stream: zlib.compress(zlib.decompress(stream) + bytes(500))),
    "stream cut": png(RAMP, damage=lambda stream: stream[:-40]),
    "bytes behind the stream": png(RAMP, damage=lambda stream: stream + b"junk"),
    "bytes behind the end": png(RAMP) + b"trailing" * 9,
    "no pixels": png(RAMP, damage=lambda stream: b""),
    "more pixels than deflate can hold": png(RAMP, size=(9000, 9000)),
}


@pytest.mark.parametrize("kind", ODD_PNG)
def test_odd_png_files_decode_as_by_opencv(tmp_path: Path, kind: str) -> None:
    assert_same_as_opencv(tmp_path / "f", ODD_PNG[kind])


@pytest.mark.parametrize("image", [RAMP, RAMP16, RAMP[:1, :1], RAMP16[:, :1]], ids=["8", "16", "1 px", "16 bit column"])
def test_every_flipped_byte_is_judged_as_by_opencv(tmp_path: Path, image: np.ndarray) -> None:
    """Damage anywhere in a file, its last checksum and its end included, of which kornia_rs itself reads nothing."""
    data = png(image[:9, :9], chunks=2)
    for position in range(8, len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x55
        assert_same_as_opencv(tmp_path / "f", bytes(damaged))


def test_plain_files_go_to_kornia_and_are_equal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Filters, depths and compressions: kornia_rs decodes them, no OpenCV behind it."""
    monkeypatch.delattr(png_reader, "by_opencv")
    noise = np.random.default_rng(0).integers(0, 65536, (57, 91)).astype(np.uint16)
    for image in (RAMP, RAMP16, noise, (noise >> 8).astype(np.uint8)):
        for level in (0, 1, 6, 9):
            data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()
            ours = png_reader.decode(data, png_reader.read_header(data), threads=1)
            assert ours.dtype == image.dtype
            np.testing.assert_array_equal(ours, image)


def test_a_panic_of_the_decoder_leaves_the_file_to_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        pass

    def panic(*_: object) -> None:
        raise PanicException("index out of bounds")

    monkeypatch.setattr("kornia_rs.io.decode_image_png_u8", panic)
    (tmp_path / "f").write_bytes(png(RAMP))
    np.testing.assert_array_equal(decode(tmp_path / "f"), RAMP)
    monkeypatch.setattr("kornia_rs.io.decode_image_png_u8", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        decode(tmp_path / "f")


def test_what_the_checksum_of_the_zlib_stream_alone_would_tell_is_not_seen(tmp_path: Path) -> None:
    """The one difference to OpenCV (docs/decisions): no storage or transport leaves the chunks' sums right."""
    path = tmp_path / "f"
    path.write_bytes(png(RAMP, damage=lambda stream: stream[:-4] + bytes(4)))
    np.testing.assert_array_equal(decode(path), RAMP)
    with pytest.raises(UnreadableImageError, match="corrupt"):
        decode(path, threads=99)
