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

    known: set[tuple[Any, ...]] = set()

    def call(*args: Any) -> Any:
        kind: list[Any] = [torch.is_inference_mode_enabled(), torch.get_default_dtype()]
        size = _describe(args, kind)
        if size <= _SPECIAL:
            return function(*args)
        if (key := tuple(kind)) in known:  # few poses feel what the rest costs at every call
            return fast(*args)
        _mark(args)
        # one graph for every number of points, dtype and kind of weights in use
        with torch._dynamo.config.patch(recompile_limit=64, automatic_dynamic_shapes=False):
            result = fast(*args)
        known.add(key)
        return result

    return call


def padded(index: torch.Tensor) -> torch.Tensor:
    """An index of poses, the first one repeated where there are too few of them to be compiled."""
    count = len(index)
    return index if count == 0 or count > _SPECIAL else torch.cat([index, index[:1].expand(_SPECIAL + 1 - count)])


def _describe(value: Any, kind: list[Any]) -> int:
    """Appends all that a graph depends on but the batch, the last dimension of every tensor; returns its size."""
    if isinstance(value, torch.Tensor):
        *shape, size = value.shape or (0,)
        kind.append((*shape, min(size, _SPECIAL + 1), value.dtype, value.device))
        return size
    if isinstance(value, tuple):
        return max((_describe(item, kind) for item in value), default=0)
    kind.append(value)
    return 0


def _mark(value: Any) -> None:
    """Marks the batch as dynamic."""
    if isinstance(value, torch.Tensor):
        if value.ndim and value.shape[-1] > _SPECIAL:
            torch._dynamo.maybe_mark_dynamic(value, value.ndim - 1)
    elif isinstance(value, tuple):
        for item in value:
            _mark(item)
