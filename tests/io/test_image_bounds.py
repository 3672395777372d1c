"""Files that claim too much, are none, or that anything has happened to: an array or a reason, in bounded memory."""

import os
import resource
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from tests.io.test_images import LOSSLESS, RAMP, png
from tests.io.test_jpeg import KINDS as JPEGS
from tests.io.test_tiff import FILES as TIFFS
from tests.io.test_tiff import STRIPS, with_tag, written
from torchpose.io import images
from torchpose.io.images import UnreadableImageError, WrongSizeError, decode

SIZE = (RAMP.shape[1], RAMP.shape[0])


def patched(data: bytes, place: int, form: str, *numbers: int) -> bytes:
    out = bytearray(data)
    struct.pack_into(form, out, place, *numbers)
    return bytes(out)


def giant_png(width: int, height: int) -> bytes:
    data = bytearray(patched(png(RAMP), 16, ">II", width, height))
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def giant_jpeg(width: int, height: int) -> bytes:
    data = cv2.imencode(".jpg", RAMP)[1].tobytes()
    return patched(data, data.find(b"\xff\xc0") + 5, ">HH", height, width)


CLAIMS = {
    "png": giant_png(32767, 32767),
    "png, widest": giant_png(2**31 - 1, 2**31 - 1),
    "jpeg": giant_jpeg(30000, 30000),
    "jpeg, widest": giant_jpeg(65535, 65535),
    "tiff": with_tag(with_tag(written(RAMP), 256, 32767, kind=4), 257, 32767, kind=4),
    "tiff, widest": with_tag(with_tag(written(RAMP), 256, 2**32 - 1, kind=4), 257, 2**32 - 1, kind=4),
    "tiff, deflate": with_tag(with_tag(written(RAMP, compression="zlib"), 256, 32767, kind=4), 257, 32767, kind=4),
    "bmp": patched(cv2.imencode(".bmp", RAMP)[1].tobytes(), 18, "<ii", 32767, 32767),
    "pgm": b"P5 32767 32767 255\n" + bytes(100),
    "pgm, text": b"P2 32767 32767 255\n" + b"1 " * 100,
    "pgm, widest": b"P5 999999999 999999999 65535\n" + bytes(100),
}


@pytest.mark.parametrize("kind", CLAIMS)
def test_a_header_that_claims_too_much_is_of_the_wrong_size_and_takes_no_memory(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "f"
    path.write_bytes(CLAIMS[kind])
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    with pytest.raises(WrongSizeError) as caught:
        decode(path, size=SIZE)
    assert caught.value.width > 30_000 - 1
    with pytest.raises(UnreadableImageError, match=r"too_large|truncated"):
        decode(path)  # where no camera says a size
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB
    assert time.perf_counter() - start < 1


def test_a_tile_far_larger_than_its_picture_takes_no_memory(tmp_path: Path) -> None:
    data = written(RAMP, tile=(64, 96), compression="zlib")
    (tmp_path / "f").write_bytes(with_tag(with_tag(data, 322, 65535, kind=4), 323, 16384, kind=4))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UnreadableImageError):
        decode(tmp_path / "f", size=SIZE)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
from kornia_rs import io
from PIL import TiffImagePlugin
from torchpose.io.images import UnreadableImageError, decode
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 60_000_000,) * 2)
for path in sys.argv[1:]:
    try:
        print(decode(Path(path)).shape)
    except UnreadableImageError as error:
        print(error.reason)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the memory of the process, as Linux tells it")
def test_a_failed_allocation_is_no_damage(tmp_path: Path) -> None:
    """12 megapixels in a process that has memory for a small picture alone."""
    image = np.zeros((3000, 4000), np.uint8)
    paths = [tmp_path / f"f{suffix}" for suffix in (".png", ".jpg", ".tif", ".bmp", ".pgm")]
    for path in paths:
        cv2.imwrite(str(path), image)
    cv2.imwrite(str(tmp_path / "small.png"), RAMP)
    command = [sys.executable, "-c", LITTLE_MEMORY, *map(str, paths), str(tmp_path / "small.png")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.split("\n")[:-1] == ["out_of_memory"] * len(paths) + [str(RAMP.shape)]


def test_what_is_no_file_is_told_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    (tmp_path / "gone.png").symlink_to(tmp_path / "nothing.png")
    (tmp_path / "folder.png").mkdir()
    reasons = {
        tmp_path / "pipe.png": "not_a_file",
        Path("/dev/zero"): "not_a_file",
        tmp_path / "folder.png": "not_a_file",
        tmp_path / "loop.png": "unreadable_file",
        tmp_path / ("a" * 300): "unreadable_file",
        tmp_path / "gone.png": "missing",
        tmp_path / "zero\0.png": "missing",
        tmp_path / "lone \ud800.png": "missing",
    }
    for path, reason in reasons.items():
        with pytest.raises(UnreadableImageError) as caught:
            decode(path)
        assert caught.value.reason == reason, path
        assert images.pages(path) == [0]
        assert not images.likely_encoded(path)


def test_damaged_png_files_are_all_refused(tmp_path: Path) -> None:
    """One to four bytes anywhere behind the signature, 1,500 times."""
    path, random = tmp_path / "f", np.random.default_rng(0)
    for data in (LOSSLESS["png8"][0], LOSSLESS["png16"][0], LOSSLESS["png colour with alpha"][0]):
        path.write_bytes(data)
        for _ in range(500):
            damaged = bytearray(data)
            for position in random.choice(np.arange(8, len(data)), random.integers(1, 5), replace=False):
                damaged[position] ^= int(random.integers(1, 256))
            with path.open("r+b") as file:  # a new file each time would take longer than all the rest
                file.write(damaged)
            with pytest.raises(UnreadableImageError):
                decode(path)


BASES = [
    *(data for data, _ in LOSSLESS.values()),
    *(data for data, _ in TIFFS.values()),
    *STRIPS.values(),
    *(cv2.imencode(".jpg", RAMP, options)[1].tobytes() for options in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])),
    JPEGS["colour 4:4:4, progressive"][:3000] + b"\xff\xd9",
    *CLAIMS.values(),
    b"P2\n# a comment\n2 2\n255\n1 2 3 4\n",
]
EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 63]
MUTATIONS = st.one_of(
    st.tuples(st.just("flip"), st.floats(0, 1), st.integers(0, 7)),
    st.tuples(st.just("head"), st.floats(0, 1), st.integers(0, 255)),
    st.tuples(st.just("number"), st.floats(0, 1), st.sampled_from(EXTREMES)),
    st.tuples(st.just("cut"), st.floats(0, 1), st.just(0)),
    st.tuples(st.just("drop"), st.floats(0, 1), st.integers(1, 64)),
    st.tuples(st.just("double"), st.floats(0, 1), st.integers(1, 64)),
)


def mutated(data: bytes, mutations: list[tuple[str, float, int]]) -> bytes:
    for kind, share, number in mutations:
        at = min(int(share * len(data)), max(len(data) - 1, 0))
        if kind == "flip" and data:
            data = data[:at] + bytes([data[at] ^ 1 << number]) + data[at + 1 :]
        elif kind == "head":  # of the first 128 bytes, where the headers of most files are
            at = min(int(share * 128), max(len(data) - 1, 0))
            data = data[:at] + bytes([number]) + data[at + 1 :]
        elif kind == "number":
            order = "<" if number % 2 else ">"
            width = "B" if number < 256 else "H" if number < 1 << 16 else "I" if number < 1 << 32 else "Q"
            data = data[:at] + struct.pack(order + width, number) + data[at + struct.calcsize(width) :]
        else:
            data = data[:at] + (
                b"" if kind == "cut" else data[at + number :] if kind == "drop" else data[at - number :]
            )
    if data.startswith(b"\x89PNG") and len(data) > 33:  # else hardly one would come behind the checksum of its header
        data = data[:29] + struct.pack(">I", zlib.crc32(data[12:29])) + data[33:]
    return data


def check_outcome(path: Path, data: bytes) -> None:
    """An array or one of the two errors; under a second and 200 MB."""
    with path.open("r+b") as file:  # a new file each time would take longer than all the rest
        file.write(data)
        file.truncate()
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    for size in (SIZE, None):
        for directory in images.pages(path)[:3]:
            try:
                image = decode(path, directory=directory, size=size)
            except (UnreadableImageError, WrongSizeError):
                continue
            assert image.ndim == 2
            assert image.dtype in (np.uint8, np.uint16)
            assert size is None or image.shape == size[::-1]
    assert time.process_time() - start < 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def fuzz(path: Path, count: int, start: int) -> None:
    path.touch()

    @seed(start)
    @settings(max_examples=count, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(st.integers(0, len(BASES) - 1), st.lists(MUTATIONS, min_size=1, max_size=4))
    def check(number: int, mutations: list[tuple[str, float, int]]) -> None:
        check_outcome(path, mutated(BASES[number], mutations))

    check()


def test_whatever_happened_to_a_file_ends_in_an_array_or_a_reason(tmp_path: Path) -> None:
    fuzz(tmp_path / "f", int(os.environ.get("TORCHPOSE_FUZZ", "400")), 0)


@pytest.mark.slow
@pytest.mark.parametrize("start", range(1, 11))
def test_whatever_happened_to_a_file_ten_thousand_times(tmp_path: Path, start: int) -> None:
    fuzz(tmp_path / "f", 10_000, start)
