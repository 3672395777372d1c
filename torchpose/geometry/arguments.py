"""Arguments of public functions, checked against the annotations that stand there.

`checked` compares every argument with its annotation (`Float[Tensor, "N 3 3"]`, a class, a choice of words) before the
function sees it, and raises `ArgumentError`, which names the argument, what it was and what it should be. One letter
stands for one number in all arguments of a call, and all tensors lie on one device. NumPy arrays are taken as tensors.
"""

from __future__ import annotations

import functools
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from inspect import signature
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
import torch
from jaxtyping import AbstractArray
from torch import Tensor

from torchpose.errors import ArgumentError

P = ParamSpec("P")
T = TypeVar("T")
_thread = threading.local()


@contextmanager
def own_calls() -> Iterator[None]:
    """Within, nothing is checked in this thread: a pipeline's stages have from each other what they are made for.

    It is a twentieth of what one frame costs.
    """
    before, _thread.own = getattr(_thread, "own", False), True
    try:
        yield
    finally:
        _thread.own = before


def unasked() -> bool:
    """Whether there is nothing to check: nothing from outside, or no numbers."""
    return getattr(_thread, "own", False) or torch.compiler.is_compiling()


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """The function, with its arguments checked. What torch compiles or traces is not: there are no numbers to check."""
    parameters, annotations = signature(function), dict(function.__annotations__)
    hints: dict[str, Any] = {}
    every = parameters.parameters.values()
    positional = [p.name for p in every if p.kind is p.POSITIONAL_OR_KEYWORD]
    known = {p.name for p in every if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    needed = {p.name for p in every if p.default is p.empty and p.name in known}

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        inner: Callable[..., T] = wrapper.__wrapped__  # tests check this one in turn
        if unasked():
            return inner(*args, **kwargs)
        if not hints:
            hints.update({name: _resolved(hint, function) for name, hint in annotations.items()})
        named = {**dict(zip(positional, args, strict=False)), **kwargs}
        # as `bind` does it, in a tenth of the time
        if len(named) == len(args) + len(kwargs) and needed <= named.keys() <= known:
            return inner(**checked_values(named, hints))
        try:
            bound = parameters.bind(*args, **kwargs)
        except TypeError as error:
            raise ArgumentError(f"{function.__name__}: {error}") from None
        bound.arguments.update(checked_values(bound.arguments, hints))
        return inner(*bound.args, **bound.kwargs)

    wrapper.checks_arguments = True  # type: ignore[attr-defined]
    return wrapper


def taking_arrays(function: Callable[P, T]) -> Callable[P, T]:
    """The function, given NumPy arrays, alone or in tuples, as tensors; it checks its arguments itself."""

    def taken(value: Any) -> Any:
        return tuple(map(tensor_of, value)) if type(value) is tuple else tensor_of(value)

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        inner: Callable[..., T] = wrapper.__wrapped__  # as of `checked`
        if unasked():
            return inner(*args, **kwargs)
        return inner(*map(taken, args), **{name: taken(value) for name, value in kwargs.items()})

    wrapper.checks_arguments = True  # type: ignore[attr-defined]
    return wrapper


def checked_values(values: Mapping[str, Any], hints: Mapping[str, Any]) -> dict[str, Any]:
    """The values by name, arrays as tensors; raises ArgumentError where one does not fit its hint."""
    sizes: dict[str, int] = {}
    given = {name: tensor_of(value) if name in hints else value for name, value in values.items()}
    for name, value in given.items():
        if (hint := hints.get(name, Any)) is not Any:
            _check(name, value, hint, sizes)
    one_device(**given)
    return given


def tensor_of(value: Any) -> Any:
    """A NumPy array as a tensor, anything else as it is."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        if value.dtype.kind == "f" and value.dtype.itemsize > np.dtype(np.float64).itemsize:
            value = value.astype(np.float64)  # np.longdouble, which torch has not
        native = np.ascontiguousarray(value.astype(value.dtype.newbyteorder("="), copy=False))
        return torch.from_numpy(native if native.flags.writeable else native.copy())  # torch warns of others
    return value


def one_device(**values: Any) -> None:
    """Raises ArgumentError where tensors lie on several devices."""
    first: tuple[str, Tensor] | None = None
    for name, value in values.items():
        if isinstance(value, Tensor):
            if first is not None and value.device != first[1].device:
                raise ArgumentError(f"{name}: is on {value.device}, but {first[0]} on {first[1].device}; move one")
            first = first or (name, value)


def expect_positive(**values: float) -> None:
    """Raises ArgumentError where a number is not finite and above 0."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise ArgumentError(f"{name}: is {value}; give a number above 0")


def expect_not_negative(**values: float | Tensor) -> None:
    """Raises ArgumentError where a number, or one of a tensor, is negative; NaN is none of them."""
    if unasked():
        return
    for name, value in values.items():
        if bool((value < 0).any()) if isinstance(value, Tensor) else value < 0:
            raise ArgumentError(
                f"{name}: is negative; give {'numbers' if isinstance(value, Tensor) else 'a number'} from 0"
            )


def expect_index(name: str, index: Tensor, count: int) -> None:
    """Raises ArgumentError where an index is negative or not below ``count``."""
    if index.numel() and not unasked():
        low, high = (int(v) for v in index.aminmax())
        if low < 0 or high >= count:
            raise ArgumentError(f"{name}: goes from {low} to {high}; give integers from 0 to {count - 1}")


def _check(name: str, value: Any, hint: Any, sizes: dict[str, int]) -> None:
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    wrong = ""
    for option in options:
        found = dict(sizes)
        wrong = _wrong(value, option, found)
        if not wrong:
            sizes.update(found)
            return
    raise ArgumentError(f"{name}: {_described(value)}; give {' or '.join(map(_name, options))}{wrong}")


def _wrong(value: Any, hint: Any, sizes: dict[str, int]) -> str:
    """Empty where the value fits, otherwise what else there is to say."""
    if hint is Any:
        return ""
    if hint is None or hint is type(None):
        return "" if value is None else " "
    origin = get_origin(hint)
    if origin is Literal:
        return "" if any(value == choice and type(value) is type(choice) for choice in get_args(hint)) else " "
    if origin is tuple:
        parts = get_args(hint)
        if not isinstance(value, tuple | list):
            return " "
        parts = (parts[0],) * len(value) if parts[-1:] == (Ellipsis,) else parts
        return _all_right(value, parts, sizes)
    if isinstance(origin, type):
        return "" if isinstance(value, origin) else " "
    if not isinstance(hint, type):
        return ""
    if issubclass(hint, AbstractArray):
        return _wrong_tensor(value, hint, sizes)
    if hint in (float, int):
        number = isinstance(value, (int, np.integer) if hint is int else (int, float, np.number))
        return "" if (number and not isinstance(value, bool)) or isinstance(value, torch.SymInt) else " "
    if getattr(hint, "_is_protocol", False):
        return ""
    return "" if isinstance(value, hint) else " "


def _all_right(values: Any, hints: tuple[Any, ...], sizes: dict[str, int]) -> str:
    if len(values) != len(hints):
        return f" (has {len(values)} parts)"
    for value, hint in zip(values, hints, strict=True):
        if wrong := _wrong(tensor_of(value), hint, sizes):
            return wrong if wrong.strip() else f" (a part {_described(value)})"
    return ""


def _wrong_tensor(value: Any, hint: Any, sizes: dict[str, int]) -> str:
    if not isinstance(value, Tensor):
        return " "
    dtypes, dtype = getattr(hint, "dtypes", None), str(value.dtype).removeprefix("torch.")
    if isinstance(dtypes, list | tuple) and dtype not in dtypes:
        return " "
    wanted = hint.dim_str.split()
    shape = tuple(value.shape)
    if wanted and (wanted[0] == "..." or wanted[0].startswith("*")):  # any number of dimensions come first
        wanted = wanted[1:]
        shape = shape[max(0, len(shape) - len(wanted)) :]
    if len(shape) != len(wanted):
        return " "
    for size, dim in zip(shape, wanted, strict=True):
        if dim.isdigit() and size != int(dim):
            return " "
        if dim.isidentifier() and dim != "_" and sizes.setdefault(dim, size) != size:
            return f" with {dim} = {sizes[dim]}"
    return ""


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"has shape {tuple(value.shape)} and dtype {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, str | int | float | bool | None):
        return f"is {value!r}"
    return f"is of type {type(value).__name__}"


def _name(hint: Any) -> str:
    if hint is None or hint is type(None):
        return "None"
    if get_origin(hint) is Literal:
        return "one of " + ", ".join(map(str, get_args(hint)))
    if get_origin(hint) is tuple:
        parts = ["..." if part is Ellipsis else _name(part) for part in get_args(hint)]
        return f"a tuple of {', '.join(parts)}"
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        kind = getattr(hint, "dtype", hint).__name__.lower()
        kind = {"shaped": "any", "real": "real", "int": "integer", "bool": "bool"}.get(kind, kind)
        return f"a tensor ({', '.join(hint.dim_str.split())}) of {kind} numbers"
    return {"float": "a number", "int": "an integer"}.get(
        getattr(hint, "__name__", ""), getattr(hint, "__name__", str(hint))
    )


def _resolved(hint: Any, function: Callable[..., Any]) -> Any:
    """What an annotation names; Any for what is imported for mypy alone."""
    if not isinstance(hint, str):
        return hint
    try:
        return eval(hint, function.__globals__)  # the module's own annotation
    except (NameError, TypeError, AttributeError):
        return Any
