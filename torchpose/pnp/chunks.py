"""Chunks of a batch, in parallel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_T = TypeVar("_T")
_Rows = TypeVar("_Rows")
# bytes; the most that glibc lets the threshold grow to is 32 MiB
_KEPT = 30 << 20


def each(function: Callable[[_Rows], _T], chunks: Sequence[_Rows], device: torch.device) -> list[_T]:
    """The function of every chunk, in parallel on the CPU; the first one alone, as it may compile."""
    if device.type != "cpu":
        return [function(rows) for rows in chunks]
    # a chunk is made to fit the cache of one core: no threads inside, they would only wait for each other
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if len(chunks) > 1:
            # glibc gives freed memory above a threshold back to the system, and every chunk would fault it in again;
            # freeing one large block raises that threshold to its size. Not touched, it costs nothing.
            torch.empty(_KEPT, dtype=torch.uint8)
        results = [function(rows) for rows in chunks[:1]]
        workers = min(threads, len(chunks) - 1)
        if workers < 2:
            return results + [function(rows) for rows in chunks[1:]]
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            results.extend(pool.map(function, chunks[1:]))
        return results
    finally:
        torch.set_num_threads(threads)
