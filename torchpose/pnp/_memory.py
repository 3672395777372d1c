"""Memory that chunks reuse."""

from __future__ import annotations

from functools import cache

import torch

# bytes; the most that glibc lets the threshold grow to is 32 MiB
_KEPT = 30 << 20


@cache
def keep_memory() -> None:
    """Lets the process keep what chunks free.

    glibc gives freed memory above a threshold back to the system, and every chunk would fault it in again, which takes
    as long as its arithmetic. Freeing one large block raises that threshold to its size for good; not touched, the
    block costs nothing.
    """
    torch.empty(_KEPT, dtype=torch.uint8)
