"""What a process does with memory that its tensors leave."""

import ctypes
import platform
from functools import cache

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT = 2**27  # bytes: what a batch of the command frees, about (measured: decisions/0111)
_MOST_ON_HEAP = 2**25  # bytes of one tensor: more GNU's library does not take (derived)


@cache
def keep_memory() -> None:
    """Has this process keep up to 128 MB of freed memory for what it allocates next, where its C library is GNU's.

    A batch frees its tensors and the next one allocates the same again. Pages that went back to the system in between
    come cleared and are faulted in one by one. The most that a process holds at a time stays the same.
    """
    if platform.libc_ver()[0] == "glibc":
        of_c = ctypes.CDLL(None)
        of_c.mallopt(_M_TRIM_THRESHOLD, _KEPT)
        of_c.mallopt(_M_MMAP_THRESHOLD, _MOST_ON_HEAP)
