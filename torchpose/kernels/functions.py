"""`compiled`, `repeated` and `mapped`: functions of tensors, run as one loop over the problems of a batch in C++."""

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import TreeSpec, tree_map, tree_unflatten

from torchpose.errors import ConfigError
from torchpose.kernels.build import Kernel, build, find_compiler, has_compiler
from torchpose.kernels.program import Layout

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
    results: list[Layout]
    structure: TreeSpec | None


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, compiled at the first call with arguments of a kind; the next ones of this kind take microseconds.

    Arguments are tensors (..., B) or (..., 1), the latter shared by all problems; floats, and dataclasses, the tensors
    of which are shared by all problems, whatever their shape; tuples of arguments; and anything else, compiled in.
    Every problem must be worked on by itself, by operations that `trace` knows, and without a look at numbers; a float
    arrives as a tensor () in float64. Results are tensors (..., B), in nested tuples, and have no gradients. Tensors
    that are only written to, as a whole, are so by the compiled code; a function that returns None does nothing else.

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


@cache
def mapped(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of small tensors with the problems first, `compiled` where that is possible.

    Arguments are those of `compiled`, but for tensors (N, ...) or (1, ...) and no tuples; results are tensors (N, ...),
    one or nested tuples of them. Where there is no compiler, an operation is unknown or a tensor is on another device
    than the CPU, ``function`` itself is called, and a warning says so once; without one where gradients are wanted or N
    is 0. LAPACK's errors are none here: the solution of a singular system is not finite. Eigenvectors may have other
    signs.
    """
    last = compiled(_problems_last(function)) if has_compiler() else None
    refused = "" if last else "needs a C++ compiler and found none; install g++ or clang++"

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal refused
        tensors = [v for v in args if isinstance(v, Tensor)]
        count = max((len(v) for v in tensors), default=0)
        if count == 0 or (torch.is_grad_enabled() and any(v.requires_grad for v in tensors)):
            return function(*args)
        elsewhere = next((f"a tensor is on {v.device}" for v in tensors if v.device.type != "cpu"), "")
        if last is not None and not (refused or elsewhere):
            try:
                result = last(*(_prepared(v, count) if isinstance(v, Tensor) else v for v in args))
                return _problems_first(result, count)
            except (NotImplementedError, ConfigError) as error:
                refused = str(error).splitlines()[0]
        _say_once(f"{function.__name__} is not compiled: {refused or elsewhere}")
        return function(*args)

    return call


@cache
def _say_once(text: str) -> None:
    warnings.warn(text, stacklevel=3)


def _problems_last(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def last(*args: Any) -> Any:
        first = (v.movedim(-1, 0) if isinstance(v, Tensor) and v.ndim else v for v in args)
        return tree_map(lambda v: v.movedim(0, -1), function(*first))

    return last


def _problems_first(result: Any, count: int) -> Any:
    if isinstance(result, Tensor):
        return result.movedim(-1, 0)[:count]
    return tree_map(lambda v: v.movedim(-1, 0)[:count], result)


def _prepared(value: Tensor, count: int) -> Tensor:
    """(..., N) of (N, ...), filled up to `LEAST`; in memory as it would be of any caller, so that one kernel does."""
    if count < LEAST and len(value) == count:
        value = torch.cat([value, value[:1].expand(LEAST - count, *value.shape[1:])])
    return value.contiguous().movedim(0, -1)


def _call(
    function: Callable[..., Any], made: dict[Any, _Made], args: tuple[Any, ...], rounds: int | None = None
) -> Any:
    tensors: list[Tensor] = []
    kind: list[Any] = [torch.get_default_dtype()]
    rebuild = _take_apart(args, tensors, kind)
    batch = max(t.shape[-1] for t in tensors)
    if batch < LEAST:
        raise ValueError(f"{batch} problems; a compiled function needs {LEAST}")
    for t in tensors:  # what is not there would be read all the same
        if t.shape[-1] not in (1, batch) or t.device.type != "cpu":
            raise ValueError(f"a tensor {tuple(t.shape)} on {t.device}; expected (..., {batch}) or (..., 1) on the CPU")
    state = None if rounds is None else args[0]
    if (key := tuple(kind)) not in made:
        with _one_at_a_time:
            if key not in made:
                layouts = [part for part in kind if isinstance(part, Layout)]
                made[key] = _make(lambda *new: function(*rebuild(iter(new))), layouts, len(state or ()))
    kernel, results, structure = made[key]
    out = [torch.empty((*layout.shape, batch), dtype=layout.dtype) for layout in results]
    name = f"compiled {function.__module__}.{function.__name__}"
    with torch.profiler.record_function(name) if torch.autograd._profiler_enabled() else nullcontext():
        kernel([*tensors, *out], batch, rounds or 1)
    if state is not None:
        return _take_apart(state, [], [])(iter(out))
    return None if structure is None else tree_unflatten(out, structure)


def _make(function: Callable[..., Any], inputs: list[Layout], state: int) -> _Made:
    from torchpose.kernels.trace import trace  # torch's tracer brings sympy: half a second that few calls need

    _thread.tracing = True
    try:
        program, results, structure = trace(function, inputs, state)
    finally:
        _thread.tracing = False
    return _Made(build(program.source()), results, structure)


def _take_apart(value: Any, tensors: list[Tensor], kind: list[Any]) -> Callable[[Iterator[Tensor]], Any]:
    """Appends the tensors (..., B | 1), and all that a kernel depends on; what puts others together the same way."""
    if isinstance(value, Tensor):
        *shape, batch = value.shape
        tensors.append(value)
        kind.append(Layout(tuple(shape), value.dtype, batch == 1, batch > 1 and value.stride(-1) != 1))
        return next
    if isinstance(value, float):
        kind.append(float)
        return _take_apart_shared(torch.tensor(value, dtype=torch.float64), tensors, kind)
    if isinstance(value, tuple):
        kind.append((type(value), len(value)))
        items = [_take_apart(item, tensors, kind) for item in value]
        make = getattr(type(value), "_make", tuple)
        return lambda new: make([item(new) for item in items])
    if is_dataclass(value):
        kind.append(type(value))
        parts = {f.name: _take_apart_shared(getattr(value, f.name), tensors, kind) for f in fields(value)}

        def copy(new: Iterator[Tensor]) -> Any:
            made = object.__new__(type(value))  # what it checks when it is made are numbers
            for name, part in parts.items():
                object.__setattr__(made, name, part(new))
            return made

        return copy
    kind.append((type(value), value))
    return lambda _: value


def _take_apart_shared(value: Any, tensors: list[Tensor], kind: list[Any]) -> Callable[[Iterator[Tensor]], Any]:
    if not isinstance(value, Tensor):
        return _take_apart(value, tensors, kind)
    whole = _take_apart(value[..., None], tensors, kind)
    return lambda new: whole(new)[..., 0]
