"""Types and shapes checked while the tests run: every function of the package against its annotations.

jaxtyping's own import hook wraps each call in three others and binds its signature, which made the tests of rings and
of the pipeline take half as long again. Here beartype checks a call in place, and jaxtyping only opens a context for
the names of the dimensions, so that ``N`` is one number within a call.
"""

from __future__ import annotations

import functools
import itertools
import sys
import typing
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import FunctionType, ModuleType
from typing import Any, Literal, Self, get_args, get_origin

import torch
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintPep585DeprecationWarning
from jaxtyping import AbstractArray, jaxtyped

# an int is a float, and so is what stands for a number while a kernel is traced
_NUMBER: Any = float | int | torch.Tensor
_beartype: Any = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({float: _NUMBER})))
OFTEN = 100  # calls of a function after which every tenth is checked
# constructors that take what `torch.as_tensor` takes, and say with the field's name what is wrong with the rest
COERCING = {
    "torchpose.camera.model.Camera.__init__",
    "torchpose.camera.rig.CameraRig.__init__",
    "torchpose.pipeline.PoseEstimator.__init__",
}


def install() -> None:
    """Checks what is imported of the package from now on."""
    sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name.split(".")[0] != "torchpose":
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module.__name__:
                continue  # of another module, which has been through here
            if getattr(value, "checks_arguments", False):
                value.__wrapped__ = checked(
                    value.__wrapped__
                )  # after the function's own checks, whose errors are public
            elif isinstance(value, FunctionType):
                setattr(module, name, checked(value))
            elif isinstance(value, type):
                _check_methods(value)


def _check_methods(owner: type) -> None:
    for name, value in list(vars(owner).items()):
        if isinstance(value, (classmethod, staticmethod)):
            setattr(owner, name, type(value)(checked(value.__func__)))
        elif isinstance(value, FunctionType):
            setattr(owner, name, checked(value))
        elif isinstance(value, property) and isinstance(value.fget, FunctionType):
            setattr(owner, name, property(checked(value.fget), value.fset, value.fdel))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with its arguments and result checked against those annotations that exist at run time."""
    if f"{function.__module__}.{function.__qualname__}" in COERCING:
        return function
    hints = {name: _resolved(hint, function) for name, hint in function.__annotations__.items()}
    if all(hint in (Any, None) for hint in hints.values()):
        return function
    function.__annotations__ = hints
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BeartypeDecorHintPep585DeprecationWarning)
        inner: Callable[..., Any] = _beartype(function)
    parts = [part for hint in hints.values() for part in _parts(hint)]
    if not any(isinstance(part, type) and issubclass(part, AbstractArray) for part in parts):
        return inner

    numbers = itertools.count()

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        number = next(numbers)
        # what is called over and over is not checked each time; and the check is no part of what torch compiles
        if (number > OFTEN and number % 10) or torch.compiler.is_compiling():
            return function(*args, **kwargs)
        with jaxtyped("context"):
            return inner(*args, **kwargs)

    return wrapper


def _resolved(hint: Any, function: Callable[..., Any]) -> Any:
    """The type that an annotation names. Any for what is not to be checked: `Self`, protocols, what is imported for
    mypy alone, and choices of words, whose functions themselves say which ones they know."""

    def holder() -> None: ...

    holder.__annotations__ = {"hint": hint}
    try:
        hint = typing.get_type_hints(holder, function.__globals__, include_extras=True)["hint"]
    except (NameError, TypeError):
        return Any
    parts = _parts(hint)
    unchecked = any(p is Self or get_origin(p) is Literal or getattr(p, "_is_protocol", False) for p in parts)
    return Any if unchecked else hint


def _parts(hint: Any) -> list[Any]:
    """A type and all types that it is made of."""
    return [hint, *(inner for part in get_args(hint) for inner in _parts(part))]
