"""JPEG: refused where libjpeg warns, equal to OpenCV where it does not."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from torchpose.io.images import UnreadableImageError, decode
from torchpose.io.images.native import FLAGS

SAMPLE = Path(__file__).parents[2] / "data" / "sample" / "frames" / "005.png"
FRAME = np.asarray(cv2.imread(str(SAMPLE), cv2.IMREAD_GRAYSCALE))[300:620, 500:980]
COLOUR = np.dstack([FRAME, FRAME // 2, 255 - FRAME])


def by_pillow(image: np.ndarray, mode: str | None = None, **options: Any) -> bytes:
    buffer = io.BytesIO()
    picture = Image.fromarray(image)
    picture.convert(mode or picture.mode).save(buffer, "JPEG", **options)
    return buffer.getvalue()


KINDS = {
    "baseline": cv2.imencode(".jpg", FRAME)[1].tobytes(),
    "own tables": by_pillow(FRAME, quality=90, optimize=True),
    "progressive": by_pillow(FRAME, quality=90, progressive=True),
    "restart markers": cv2.imencode(".jpg", FRAME, [cv2.IMWRITE_JPEG_RST_INTERVAL, 8])[1].tobytes(),
    "colour 4:2:0": cv2.imencode(".jpg", COLOUR)[1].tobytes(),
    "colour 4:4:4, progressive": by_pillow(COLOUR, quality=90, subsampling=0, progressive=True),
    "red, green, blue": by_pillow(COLOUR, quality=90, keep_rgb=True),
}


def by_opencv(data: bytes) -> np.ndarray | None:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), FLAGS)
    return None if image is None else np.asarray(image)


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_refused_where_libjpeg_warns_and_only_there(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str
) -> None:
    """What libjpeg tells in OpenCV, on stderr, is the witness. It does not tell of every bit: see docs/decisions."""
    data, path, refused = KINDS[kind], tmp_path / "f.jpg", 0
    np.testing.assert_array_equal(decode_bytes(data, path), by_opencv(data))
    start = data.find(b"\xff\xda") + 14
    for position, bit in np.random.default_rng(0).integers((start, 0), (len(data) - 2, 8), (60, 2)).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 1 << bit
        expected = by_opencv(bytes(damaged))
        warned = bool(capfd.readouterr().err) or expected is None
        try:
            image = decode_bytes(bytes(damaged), path)
        except UnreadableImageError as error:
            assert warned or error.reason == "truncated", (position, bit)  # an end marker came about, or went
            refused += 1
            continue
        assert not warned, (position, bit)
        np.testing.assert_array_equal(image, expected)
    assert refused >= 10


def decode_bytes(data: bytes, path: Path) -> np.ndarray:
    path.write_bytes(data)
    return decode(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data.replace(b"\xff\xc0", b"\xff\xc9", 1), "unsupported"),  # arithmetic coding
        (lambda data: data.replace(b"\xff\xc0", b"\xff\xc3", 1), "unsupported"),  # lossless
        (lambda data: data.replace(b"\xff\xc0\x00\x0b\x08", b"\xff\xc0\x00\x0b\x0c", 1), "unsupported"),  # 12 bits
        (lambda data: data.replace(b"\xff\xc0", b"\xff\xef", 1), "corrupt"),  # no frame header at all
        (lambda data: by_pillow(COLOUR, "CMYK"), "unsupported"),
        (lambda data: data[:-2], "truncated"),
        (lambda data: data[:2] + data[-2:], "truncated"),
    ],
    ids=["arithmetic", "lossless", "12 bits", "no header", "four colours", "no end", "no scan"],
)
def test_other_kinds_of_jpeg_are_refused_by_name(tmp_path: Path, change: Any, reason: str) -> None:
    with pytest.raises(UnreadableImageError, match=f"^{reason}$"):
        decode_bytes(change(KINDS["baseline"]), tmp_path / "f.jpg")
