"""`torch.compile` of the inner functions of this package, on request only: without it nothing needs a C++ compiler."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from typing import Any

import torch

from torchpose.errors import ConfigError

# batches up to this size would have a graph each, and are not compiled
_SPECIAL = 3


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` through torch.compile, specialised on everything but the batch.

    Raises:
        ConfigError: there is no C++ compiler.
    """
    if not any(shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++", "cl") if name):
        raise ConfigError("compile: needs a C++ compiler and found none; install g++ or clang++, or use compile=False")
    # as many threads as torch has at the call, not at the compilation; and no limit to what is fused: a chunk is
    # worked on in few loops, or not in the cache
    fast = torch.compile(function, options={"cpp.dynamic_threads": True, "max_fusion_size": 4096})

    def call(*args: Any) -> Any:
        if _mark(args) <= _SPECIAL:
            return function(*args)
        # one graph for every number of points, dtype and kind of weights in use
        with torch._dynamo.config.patch(recompile_limit=64, automatic_dynamic_shapes=False):
            return fast(*args)

    return call


def padded(index: torch.Tensor) -> torch.Tensor:
    """An index of poses, the first one repeated where there are too few of them to be compiled."""
    count = len(index)
    return index if count == 0 or count > _SPECIAL else torch.cat([index, index[:1].expand(_SPECIAL + 1 - count)])


def _mark(value: Any) -> int:
    """Marks the batch, the last dimension of every tensor, as dynamic; returns its size."""
    if isinstance(value, torch.Tensor):
        size = value.shape[-1] if value.ndim else 0
        if size > _SPECIAL:
            torch._dynamo.maybe_mark_dynamic(value, value.ndim - 1)
        return size
    return max(map(_mark, value), default=0) if isinstance(value, tuple) else 0
