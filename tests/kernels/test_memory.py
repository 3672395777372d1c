"""Freed memory that is kept: a process faults its pages in once."""

import platform
import subprocess
import sys

import pytest

_WORK = """
import resource, torch
from torchpose.kernels.memory import keep_memory
torch.set_num_threads(1)

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def work():
    parts = [torch.ones(megabytes << 20, dtype=torch.uint8) for megabytes in (3, 9, 20) for _ in range(3)]

for keep in (lambda: None, keep_memory):
    keep()
    work()
    work()
    before = faults()
    for _ in range(10):
        work()
    print(faults() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of GNU's C library")
def test_what_is_freed_is_kept() -> None:
    """96 MB are allocated ten times over, which are 245,760 pages."""
    found = subprocess.run([sys.executable, "-c", _WORK], capture_output=True, check=True)
    usual, kept = map(int, found.stdout.split())
    assert kept < 10_000
    assert kept <= usual
