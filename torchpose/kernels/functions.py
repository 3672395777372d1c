"""`compiled` and `repeated`: functions of tensors with the batch last, run as one loop in C++."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import TreeSpec, tree_leaves, tree_unflatten

from torchpose.kernels.build import Kernel, build, find_compiler
from torchpose.kernels.program import Rows
from torchpose.kernels.trace import trace

# problems that a call needs: the lanes of the widest vectors there are
LEAST = 8
_thread = threading.local()
_one_at_a_time = threading.Lock()  # torch's tracer keeps its state for the whole process


def tracing() -> bool:
    """Is the function under way being compiled? It has one problem then, and no numbers to decide by."""
    return getattr(_thread, "tracing", False)


def padded(index: Tensor) -> Tensor:
    """An index of problems, the first one repeated where there are too few of them for a compiled function."""
    count = len(index)
    return index if count == 0 or count >= LEAST else torch.cat([index, index[:1].expand(LEAST - count)])


class _Made(NamedTuple):
    kernel: Kernel
    results: list[Rows]
    structure: TreeSpec | None


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, compiled at the first call with arguments of a kind; the next ones of this kind take microseconds.

    Arguments are tensors (..., B) or (..., 1), the latter shared by all problems; tuples of arguments; dataclasses, the
    tensors of which are shared by all problems, whatever their shape; and anything else, compiled in. Every problem
    must be worked on by itself, by operations that `trace` knows, and without a look at numbers. Results are tensors
    (..., B), in nested tuples, and have no gradients. Tensors that are only written to, as a whole, are so by the
    compiled code; a function that returns None does nothing else.

    Raises:
        ConfigError: there is no C++ compiler.
        ValueError: fewer than `LEAST` problems, different numbers of them, or tensors that are not on the CPU.
        NotImplementedError: an operation or a dtype that `trace` does not know.
    """
    find_compiler()
    made: dict[tuple[Any, ...], _Made] = {}

    def call(*args: Any) -> Any:
        return _call(function, made, args)

    return call


@cache
def repeated(function: Callable[..., Any]) -> Callable[..., Any]:
    """A loop of ``function``, compiled as by `compiled`: of rounds, limit, and the state and all else that it takes.

    The function returns the next state, a tuple of tensors, and (B,) bool, which problems go on. It must not change
    those that do not: rounds are made until none of the problems goes on that share a vector, or up to the limit.
    """
    find_compiler()
    made: dict[tuple[Any, ...], _Made] = {}

    def call(limit: int, state: Any, *args: Any) -> Any:
        return _call(function, made, (state, *args), limit)

    return call


def _call(
    function: Callable[..., Any], made: dict[Any, _Made], args: tuple[Any, ...], rounds: int | None = None
) -> Any:
    tensors: list[Tensor] = []
    kind: list[Any] = [torch.get_default_dtype()]
    _take_apart(args, tensors, kind)
    batch = max(t.shape[-1] for t in tensors)
    if batch < LEAST:
        raise ValueError(f"{batch} problems; a compiled function needs {LEAST}")
    for t in tensors:  # what is not there would be read all the same
        if t.shape[-1] not in (1, batch) or t.device.type != "cpu":
            raise ValueError(f"a tensor {tuple(t.shape)} on {t.device}; expected (..., {batch}) or (..., 1) on the CPU")
    if (key := tuple(kind)) not in made:
        with _one_at_a_time:
            if key not in made:
                rows = [part for part in kind if isinstance(part, Rows)]
                made[key] = _make(function, args, rows, rounds is not None)
    kernel, results, structure = made[key]
    out = [torch.empty((*rows.shape, batch), dtype=rows.dtype) for rows in results]
    name = f"compiled {function.__module__}.{function.__name__}"
    with torch.profiler.record_function(name) if torch.autograd._profiler_enabled() else nullcontext():
        kernel([*tensors, *out], batch, rounds or 1)
    if rounds is not None:
        return _put_together(args[0], out)
    return None if structure is None else tree_unflatten(out, structure)


def _make(function: Callable[..., Any], args: tuple[Any, ...], inputs: list[Rows], loop: bool) -> _Made:
    def flat(*values: Tensor) -> Any:
        return function(*_put_together(args, list(values)))

    _thread.tracing = True
    try:
        program, results, structure = trace(flat, inputs, len(tree_leaves(args[0])) if loop else 0)
    finally:
        _thread.tracing = False
    return _Made(build(program.source()), results, structure)


def _take_apart(value: Any, tensors: list[Tensor], kind: list[Any]) -> None:
    """Appends the tensors (..., B | 1), and all that a kernel depends on."""
    if isinstance(value, Tensor):
        *shape, batch = value.shape
        tensors.append(value)
        kind.append(Rows(tuple(shape), value.dtype, batch == 1, batch > 1 and value.stride(-1) != 1))
    elif isinstance(value, tuple):
        kind.append((type(value), len(value)))
        for item in value:
            _take_apart(item, tensors, kind)
    elif is_dataclass(value):
        kind.append(type(value))
        for field in fields(value):
            item = getattr(value, field.name)
            _take_apart(item[..., None] if isinstance(item, Tensor) else item, tensors, kind)
    else:
        kind.append((type(value), value))


def _put_together(value: Any, tensors: list[Tensor]) -> Any:
    """The same value with other tensors, which are taken off the list."""
    if isinstance(value, Tensor):
        return tensors.pop(0)
    if isinstance(value, tuple):
        items = [_put_together(item, tensors) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    if is_dataclass(value):
        copy = object.__new__(type(value))  # what it checks when it is made are numbers
        for field in fields(value):
            item = getattr(value, field.name)
            new = tensors.pop(0)[..., 0] if isinstance(item, Tensor) else _put_together(item, tensors)
            object.__setattr__(copy, field.name, new)
        return copy
    return value
