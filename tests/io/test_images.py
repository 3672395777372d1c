"""Decoding: every format bit by bit, and no file that ends early is ever measured."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from torchpose.io.images import UnreadableImageError, decode

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
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "truncated"),
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
