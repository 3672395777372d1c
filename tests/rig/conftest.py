"""Loopback addresses that no other test, and no other run on this machine, uses: the controller's ports are fixed."""

from __future__ import annotations

import itertools
import os

import pytest

_numbers = itertools.count(1)


@pytest.fixture
def loopback() -> str:
    """An address in 127.0.0.0/8 of this test's own."""
    process = os.getpid() % 60000 + 256
    return f"127.{process // 256}.{process % 256}.{next(_numbers) % 250 + 2}"
