"""Streaming: order, faults, mixed depths, bounded work ahead."""

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchpose.io import images
from torchpose.io.reader import Fault, FrameReader, default_batch, in_batches
from torchpose.io.sources import find_sources
from torchpose.results import Status

SIZE = (20, 30)


def image(number: int, dtype: type[np.uint16 | np.uint8] = np.uint8) -> np.ndarray:
    return np.full(SIZE, number, dtype)


def read(folder: Path, batch: int, threads: int = 3) -> tuple[dict[str, np.ndarray], dict[str, Fault], list[int]]:
    """Every frame by name, copied, with the size of each batch."""
    frames: dict[str, np.ndarray] = {}
    faults: dict[str, Fault] = {}
    sizes = []
    for step in FrameReader(in_batches(find_sources([folder]), batch), SIZE[1], SIZE[0], threads=threads):
        sizes.append(len(step.sources))
        faults |= {step.sources[i].name: fault for i, fault in step.faults.items()}
        for positions, tensor in step.groups:
            frames |= {step.sources[p].name: tensor[i].numpy().copy() for i, p in enumerate(positions)}
    return frames, faults, sizes


@pytest.mark.parametrize("batch", [1, 3, 7, 100])
@pytest.mark.parametrize("threads", [1, 4])
def test_every_frame_arrives_once_with_its_own_pixels(tmp_path: Path, batch: int, threads: int) -> None:
    for i in range(20):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image(i))
    frames, faults, sizes = read(tmp_path, batch, threads)
    assert list(frames) == [f"{i}.png" for i in range(20)]
    assert all((frames[f"{i}.png"] == i).all() for i in range(20))
    assert not faults
    assert sum(sizes) == 20
    assert max(sizes) <= batch


def test_depths_are_kept_and_groups_are_of_one_depth(tmp_path: Path) -> None:
    for i in range(9):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image(1000 + i, np.uint16) if i % 3 else image(i))
    (step,) = FrameReader([find_sources([tmp_path])], SIZE[1], SIZE[0], threads=2)
    groups = {tensor.dtype: (positions, tensor) for positions, tensor in step.groups}
    assert groups[torch.uint8][0] == [0, 3, 6]
    assert groups[torch.uint16][0] == [1, 2, 4, 5, 7, 8]
    assert groups[torch.uint8][1][:, 0, 0].tolist() == [0, 3, 6]
    assert groups[torch.uint16][1][:, 5, 5].tolist() == [1001, 1002, 1004, 1005, 1007, 1008]


def test_faults_stand_beside_the_good_frames(tmp_path: Path) -> None:
    for i in range(6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image(i))
    (tmp_path / "1.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "4.png"), np.zeros((30, 20), np.uint8))
    frames, faults, _ = read(tmp_path, batch=4)
    assert [int(frame[0, 0]) for frame in frames.values()] == [0, 2, 3, 5]
    assert (faults["1.png"].status, faults["1.png"].reason) == (Status.UNREADABLE, "empty")
    assert (faults["4.png"].status, faults["4.png"].reason) == (Status.WRONG_SIZE, "20x30")


def test_decoding_runs_one_batch_ahead_and_no_further(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(30):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image(i))
    started = threading.Semaphore(0)
    count = 0
    lock = threading.Lock()
    decode = images.decode

    def counting(path: Path, **options: Any) -> np.ndarray:
        nonlocal count
        with lock:
            count += 1
        started.release()
        return decode(path, **options)

    monkeypatch.setattr(images, "decode", counting)
    steps = iter(FrameReader(in_batches(find_sources([tmp_path]), 5), SIZE[1], SIZE[0], threads=2))
    for done in range(1, 4):
        next(steps)
        while started.acquire(timeout=0.2):  # until no further decode starts by itself
            pass
        assert count == 5 * (done + 1)
    steps.close()  # type: ignore[attr-defined]  # an iterator is promised, it is a generator
    assert count == 20


def test_default_batch_bounds_the_pixels_of_a_batch() -> None:
    assert default_batch(640, 480) == 16
    assert default_batch(5472, 3648) == 4
    assert default_batch(20000, 20000) == 1
