"""Frames from disk in batches: decoding runs ahead in threads, memory is two batches however many frames there are."""

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from torchpose.camera import LINEAR, Tone
from torchpose.errors import ConfigError
from torchpose.io.films import NoFrameError
from torchpose.io.images import UnreadableImageError, WrongSizeError
from torchpose.io.sources import Source
from torchpose.results import Status

_TORCH_DTYPE = {np.dtype(np.uint8): torch.uint8, np.dtype(np.uint16): torch.uint16}
_BATCH_PIXELS = 80_000_000  # of one batch: 4 frames of 20 megapixels
_BATCH_FRAMES = 16


@dataclass(frozen=True)
class Fault:
    """Why a source gave no frame: `Status.UNREADABLE` or `Status.WRONG_SIZE`, and the reason in a word."""

    status: Status
    reason: str


@dataclass(frozen=True)
class Batch:
    """Consecutive sources, decoded.

    Attributes:
        sources: the sources of the batch, in order.
        faults: position in ``sources`` to fault, for those without a frame.
        groups: positions and their frames, for each pixel type (uint8, uint16) that occurs. Every position is in
            ``faults`` or in exactly one group. The frames are views of a buffer that is overwritten once the
            next-but-one batch is asked for.
    """

    sources: Sequence[Source]
    faults: dict[int, Fault]
    groups: list[tuple[list[int], Shaped[Tensor, "n H W"]]]


def default_batch(width: int, height: int) -> int:
    """Frames a batch: many enough to share the cost of a call, few enough to keep memory small."""
    return max(1, min(_BATCH_FRAMES, _BATCH_PIXELS // (width * height)))


def in_batches(sources: Sequence[Source], size: int) -> list[Sequence[Source]]:
    """The sources in runs of ``size``; the last may be shorter."""
    return [sources[i : i + size] for i in range(0, len(sources), size)]


@dataclass(frozen=True)
class FrameReader:
    """Iterates over `Batch` in the order given.

    Two buffers take turns: while one batch is worked on, threads decode the next one into the other.

    Attributes:
        batches: what to read, see `in_batches`.
        width: of the camera, px. Frames of another size are `Status.WRONG_SIZE`.
        height: of the camera, px.
        threads: decoding threads.
        tone: of the files; frames that are not linear come as linear ones, uint16.
        pinned: in memory that is not swapped, from which a GPU copies by itself.
    """

    batches: Sequence[Sequence[Source]]
    width: int
    height: int
    threads: int = field(kw_only=True)
    tone: Tone = field(default=LINEAR, kw_only=True)
    pinned: bool = field(default=False, kw_only=True)

    def __iter__(self) -> Iterator[Batch]:
        largest = max((len(batch) for batch in self.batches), default=0)
        buffers = [_Buffer(largest, (self.height, self.width), self.threads, self.tone, self.pinned) for _ in range(2)]
        pool = ThreadPoolExecutor(self.threads, thread_name_prefix="decode")

        def submit(number: int) -> list[Future[Fault | np.dtype | None]]:
            buffer = buffers[number % 2]
            return [pool.submit(buffer.load, slot, source) for slot, source in enumerate(self.batches[number])]

        try:
            ahead = submit(0) if self.batches else []
            for number, sources in enumerate(self.batches):
                outcomes = [future.result() for future in ahead]
                if number + 1 < len(self.batches):
                    ahead = submit(number + 1)
                yield buffers[number % 2].batch(sources, outcomes)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def decoded(source: Source, *, threads: int = 1, size: tuple[int, int] | None = None) -> np.ndarray | Fault | None:
    """Grey values (H, W) of a frame, what is wrong with it, or None where its film has ended before.

    Args:
        source: of the frame.
        threads: that decode side by side.
        size: width and height that it has to have, if known.
    """
    try:
        return source.decode(threads=threads, size=size)
    except NoFrameError:
        return None
    except UnreadableImageError as error:
        return Fault(Status.UNREADABLE, error.reason)
    except WrongSizeError as error:
        return Fault(Status.WRONG_SIZE, str(error))


def linear_image(image: np.ndarray, tone: Tone) -> np.ndarray:
    """A decoded frame by its light: as it is where it is linear, else uint16."""
    return image if tone == LINEAR else _table(tone, image.dtype.itemsize)[image]


@lru_cache
def _table(tone: Tone, size: int) -> np.ndarray:
    table: np.ndarray = tone.table(256**size).numpy()
    return table


class _Buffer:
    """Memory of one batch for each pixel type, allocated when the first frame of the type arrives."""

    def __init__(self, frames: int, shape: tuple[int, int], threads: int, tone: Tone, pinned: bool) -> None:
        self._threads, self._pinned = threads, pinned
        self._tone = tone
        self._size = (frames, *shape)
        self._planes: dict[np.dtype, Tensor] = {}
        self._lock = threading.Lock()

    def load(self, slot: int, source: Source) -> Fault | np.dtype | None:
        """Decodes a source into a slot; returns its pixel type, what is wrong with it, or None if there is no frame."""
        image = decoded(source, threads=self._threads, size=(self._size[2], self._size[1]))
        if image is None or isinstance(image, Fault):
            return image
        image = linear_image(image, self._tone)
        with self._lock:
            if image.dtype not in self._planes:
                self._planes[image.dtype] = self._allocated(_TORCH_DTYPE[image.dtype])
        np.copyto(self._planes[image.dtype][slot].numpy(), image)
        return image.dtype

    def _allocated(self, dtype: torch.dtype) -> Tensor:
        """Memory of one batch. ConfigError: there is none."""
        frames, height, width = self._size
        try:
            return torch.empty(self._size, dtype=dtype, pin_memory=self._pinned)
        except RuntimeError:
            fix = "give a smaller --batch" if frames > 1 else "free some memory"
            raise ConfigError(f"--batch: no memory for {frames} frames of {width}x{height}; {fix}") from None

    def batch(self, sources: Sequence[Source], outcomes: Sequence[Fault | np.dtype | None]) -> Batch:
        slots = [slot for slot, outcome in enumerate(outcomes) if outcome is not None]  # films end, and nothing follows
        kept = [outcomes[slot] for slot in slots]
        faults = {i: outcome for i, outcome in enumerate(kept) if isinstance(outcome, Fault)}
        groups = []
        for dtype, plane in self._planes.items():
            positions = [i for i, outcome in enumerate(kept) if i not in faults and outcome == dtype]
            if positions:
                mine = [slots[i] for i in positions]
                contiguous = mine == list(range(len(mine)))
                groups.append((positions, plane[: len(mine)] if contiguous else plane[mine]))
        return Batch([sources[slot] for slot in slots], faults, groups)
