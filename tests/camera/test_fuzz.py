"""Damaged camera files of every format: a camera or one clear line, whatever was done to them."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.camera.test_conventions import FILES, INFO
from tests.camera.test_formats import COLMAP, KALIBR, OLD_OPENCV, PLAIN, PLAIN_JSON, ROS, ROS_MESSAGE
from torchpose.camera import Camera
from torchpose.errors import ConfigError

TEXTS = [text for text, _ in FILES.values()] + [
    COLMAP,
    KALIBR,
    OLD_OPENCV,
    PLAIN,
    PLAIN_JSON,
    ROS,
    ROS_MESSAGE,
    str(INFO),
]
TOKENS = (
    *("nan", ".nan", "-.inf", "1e999", "9" * 400, "1e-400", "-1", "0", "1", "2147483648", "1e17", "true", "null", '""'),
    *(
        "'",
        '"',
        "{",
        "}",
        "[",
        "]",
        ":",
        ",",
        "\n",
        "\t",
        "#",
        "<",
        ">",
        "&a ",
        "*a",
        "!!binary ",
        "<<: ",
        "---\n",
        "\u0661",
    ),
    *(
        "[" * 300,
        "{a: " * 300,
        "<a>" * 300,
        "(" * 300,
        "[1, [2, 3]]",
        "{}",
        "[]",
        "0x1F",
        "1_000",
        "12:30:45",
        "2024-01-01",
    ),
    *(
        "fisheye",
        "xi: 1\n",
        "model: omni\n",
        "\x85",
        "\u2028",
        "\ud7ff",
        "\x0c",
        "<![CDATA[",
        "&#0;",
        "b'\\x00'",
        "__import__('os')",
    ),
)


def mutated(seed: int) -> str:
    """A text with some spans deleted, doubled, moved, or replaced by what is known to hurt."""
    choose = random.Random(seed)
    text = choose.choice(TEXTS)
    for _ in range(choose.choice((1, 1, 2, 3, 6))):
        a = choose.randrange(len(text) + 1)
        b = min(len(text), a + choose.choice((0, 1, 1, 3, 10, 60)))
        if choose.random() < 0.4:  # a whole number or word instead
            while a > 0 and (text[a - 1].isalnum() or text[a - 1] in ".-+_"):
                a -= 1
            b = a
            while b < len(text) and (text[b].isalnum() or text[b] in ".-+_"):
                b += 1
        middle = choose.choice(
            ("", text[a:b] * 2, choose.choice(TOKENS), choose.choice(TOKENS), choose.choice(TEXTS)[a:b])
        )
        text = text[:a] + middle + text[b:]
    return text


def check(path: Path, seed: int) -> None:
    path.write_bytes(mutated(seed).encode())
    start = time.process_time()
    try:
        camera = Camera.load(path)
    except ConfigError as error:
        message = str(error)
        assert len(message.splitlines()) == 1, message
        assert message.startswith(f"{path}: "), message
        assert len(message) < 1000, message
    else:
        assert camera.matrix.isfinite().all()
        assert camera.matrix.dtype == torch.float64
    assert time.process_time() - start < 1.0


@given(st.integers(0, 2**32))
@settings(deadline=None, max_examples=300, database=None)
@pytest.mark.filterwarnings("ignore::torchpose.camera.formats.CameraWarning")
def test_damaged_files_end_in_one_line(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    check(tmp_path_factory.getbasetemp() / "damaged.any", seed)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchpose.camera.formats.CameraWarning")
def test_a_hundred_thousand_damaged_files(tmp_path: Path) -> None:
    for seed in range(100_000):
        check(tmp_path / "damaged.any", seed)
