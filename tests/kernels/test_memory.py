"""Freed memory that is kept: a process faults its pages in once."""

import platform
import subprocess
import sys

import pytest

_LOOP = """
import resource, torch
{keep}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def work():
    parts = [torch.ones(megabytes << 20, dtype=torch.uint8) for megabytes in (3, 9, 20) for _ in range(3)]
work()
work()
before = faults()
for _ in range(10):
    work()
print(faults() - before)
"""
_KEEP = "from torchpose.kernels.memory import keep_memory\nkeep_memory()\nkeep_memory()"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of GNU's C library")
def test_what_is_freed_is_kept() -> None:
    """96 MB are allocated ten times over, which are 245,760 pages."""
    kept, usual = (
        int(subprocess.run([sys.executable, "-c", _LOOP.format(keep=keep)], capture_output=True, check=True).stdout)
        for keep in (_KEEP, "")
    )
    assert kept < 2_000
    assert kept < 0.2 * usual
