"""JPEG: refused where libjpeg warns, equal to OpenCV where it does not."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from torchpose.io.images import UnreadableImageError, decode, jpeg
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
def test_a_flipped_bit_is_refused_where_libjpeg_warns(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str
) -> None:
    """What libjpeg tells in OpenCV, on stderr, is the witness. It does not tell of every bit: see docs/decisions."""
    data, path, refused = KINDS[kind], tmp_path / "f.jpg", 0
    clean = by_opencv(data)
    np.testing.assert_array_equal(decode_bytes(data, path), clean)
    start = data.find(b"\xff\xda") + 14
    for position, bit in np.random.default_rng(0).integers((start, 0), (len(data) - 2, 8), (60, 2)).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 1 << bit
        expected = by_opencv(bytes(damaged))
        warned = bool(capfd.readouterr().err) or expected is None
        try:
            image = decode_bytes(bytes(damaged), path)
        except UnreadableImageError:
            assert warned or (np.asarray(expected) != np.asarray(clean)).any(), (position, bit)
            refused += 1
            continue
        assert not warned, (position, bit)
        np.testing.assert_array_equal(image, expected)
    assert refused >= 10


def blocks(image: np.ndarray) -> np.ndarray:
    """Blocks of 8 x 8 px in the order of the scan, each less its mean, which damage may shift for all that follow."""
    found = image.reshape(image.shape[0] // 8, 8, -1, 8).swapaxes(1, 2).reshape(-1, 64).astype(float)
    return found - found.mean(1, keepdims=True)


@pytest.mark.parametrize("kind", ["baseline", "own tables"])
def test_no_picture_is_read_that_is_shifted_by_blocks(tmp_path: Path, kind: str) -> None:
    """libjpeg says nothing of some: the end of what is read fits the undamaged picture best without a shift."""
    data, path, silent = KINDS[kind], tmp_path / "f.jpg", 0
    clean, start = blocks(decode_bytes(data, path)), data.find(b"\xff\xda") + 14
    for position, bit in np.random.default_rng(1).integers((start, 0), (len(data) * 3 // 4, 8), (60, 2)).tolist():
        damaged = bytearray(data)
        damaged[position] ^= 1 << bit
        picture = by_opencv(bytes(damaged))
        assert picture is not None
        ends = {k: np.abs(blocks(picture)[-400:-4] - clean[-400 + k : len(clean) - 4 + k]).mean() for k in range(-4, 5)}
        if min(ends, key=lambda k: ends[k]) == 0:
            continue
        silent += _warns_not(bytes(damaged))
        with pytest.raises(UnreadableImageError, match="corrupt"):
            decode_bytes(bytes(damaged), path)
    assert silent or kind != "own tables"


def _warns_not(data: bytes) -> bool:
    return jpeg._strict(data) is not None


@pytest.mark.parametrize("quality", [10, 75, 100])
@pytest.mark.parametrize("noise", [0, 2, 60])
def test_no_whole_file_is_refused(tmp_path: Path, quality: int, noise: float) -> None:
    """Sizes, tables, subsampling, last blocks of every kind: equal to libjpeg without a row below."""
    random = np.random.default_rng(quality)
    for number in range(40):
        height, width = random.integers(1, 70, 2)
        image = np.clip(random.normal(128, noise, (height, width)), 0, 255).astype(np.uint8)
        options: dict[str, Any] = {"quality": quality, "optimize": number % 2 == 0}
        if number % 3 == 0:
            image, options = np.dstack([image, image[::-1], 255 - image]), options | {"subsampling": number % 9 // 3}
        data = by_pillow(image, **options)
        np.testing.assert_array_equal(decode_bytes(data, tmp_path / "f.jpg"), by_opencv(data))


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
