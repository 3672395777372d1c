"""Chunks of a batch, one after the other; torch's own threads share the work inside of each.

Threads of Python that took a chunk each gained nothing: an operation on a chunk that fits the cache takes some
microseconds, and handing Python's lock over takes longer (decision 0004).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeVar

import torch

_T = TypeVar("_T")
_Rows = TypeVar("_Rows")
# bytes; the most that glibc lets the threshold grow to is 32 MiB
_KEPT = 30 << 20


def each(function: Callable[[_Rows], _T], chunks: Sequence[_Rows]) -> list[_T]:
    """The function of every chunk."""
    _keep_memory()
    return [function(rows) for rows in chunks]


@cache
def _keep_memory() -> None:
    """glibc gives freed memory above a threshold back to the system, and every chunk would fault it in again: twice the
    time. Freeing one large block raises that threshold to its size for good; not touched, it costs nothing."""
    torch.empty(_KEPT, dtype=torch.uint8)
