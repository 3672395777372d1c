"""`torch.compile` of the inner functions of this package, on request only: without it nothing needs a C++ compiler."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from typing import Any

import torch

from torchpose.errors import ConfigError


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
        _mark(args)
        # one graph for every number of points, dtype and kind of weights in use
        with torch._dynamo.config.patch(recompile_limit=64, automatic_dynamic_shapes=False):
            return fast(*args)

    return call


def _mark(value: Any) -> None:
    if isinstance(value, torch.Tensor):
        if value.ndim and value.shape[-1] > 3:
            torch._dynamo.maybe_mark_dynamic(value, value.ndim - 1)
    elif isinstance(value, tuple):
        for item in value:
            _mark(item)
