"""Every public function names the argument that is wrong, in an error of the project."""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import pytest
import torch
from jaxtyping import AbstractArray, Float, Int
from torch import Tensor

import torchpose as tp
from torchpose.geometry import arguments
from torchpose.geometry.arguments import checked, own_calls

ROOMS = (
    "analysis", "calibration", "design", "detect", "ellipse", "identify", "pose", "refine", "rings", "sim",
    "rings.zernike",
)  # fmt: skip
PLAIN = {"kernels"}  # of numbers alone, and kept by a cache


def public() -> Iterator[Any]:
    """Functions that packages export; all without an underscore of the modules that are public as such."""
    for room in ROOMS:
        module = import_module(f"torchpose.{room}")
        names = getattr(module, "__all__", None) or [
            n
            for n, v in vars(module).items()
            if not n.startswith("_") and getattr(v, "__module__", "") == module.__name__
        ]
        for name in names:
            value = getattr(module, name)
            if isinstance(value, types.FunctionType) and name not in PLAIN:
                yield pytest.param(value, id=f"{room}.{name}")


def hints_of(function: Any) -> dict[str, Any]:
    inner = inspect.unwrap(function)
    parameters = inspect.signature(inner).parameters.values()
    named = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    return {n: arguments._resolved(function.__annotations__.get(n, Any), inner) for n in named}


def good(hint: Any) -> Any:
    """Something that fits an annotation: of tensors one of every dimension's length."""
    option = get_args(hint)[0] if get_origin(hint) in (Union, types.UnionType) else hint
    if get_origin(option) is Literal:
        return get_args(option)[0]
    if get_origin(option) is tuple:
        return tuple(good(part) for part in get_args(option) if part is not Ellipsis)
    if isinstance(option, type) and issubclass(option, AbstractArray):
        sizes = [int(d) if d.isdigit() else 1 for d in option.dim_str.split() if not d.startswith(("*", "..."))]
        dtypes = getattr(option, "dtypes", ["float64"])
        listed = list(dtypes) if isinstance(dtypes, list | tuple) else ["float64"]
        name = next(d for d in ("float64", "int64", "bool") if d in listed)
        return torch.zeros(*sizes, dtype=getattr(torch, name))
    if option in (int, float, bool, str):
        return option()
    if get_origin(option) in (list, Callable):
        return [] if get_origin(option) is list else len
    if option is Path:
        return Path()
    if option is Tensor:
        return torch.zeros(1)
    if isinstance(option, type) and issubclass(option, tuple):
        return tuple.__new__(option, (None,) * len(option._fields))  # type: ignore[attr-defined]
    return object.__new__(option) if isinstance(option, type) and option.__module__.startswith("torchpose") else None


def wrong(hint: Any) -> list[Any]:
    """What does not fit it, none where anything fits."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    tensors = [o for o in options if isinstance(o, type) and issubclass(o, AbstractArray)]
    if any(o is Any or not (isinstance(o, type) or get_origin(o)) for o in options):
        return []
    if any(getattr(o, "_is_protocol", False) for o in options):
        return []
    bad: list[Any] = [object()]
    if tensors and len(tensors) == len([o for o in options if o is not type(None)]):
        bad += [good(tensors[0])[None].expand(2, 3, *good(tensors[0]).shape).to(torch.complex64), "text"]
    return bad


@pytest.mark.parametrize("function", list(public()))
def test_wrong_arguments_are_named(function: Callable[..., Any]) -> None:
    assert getattr(function, "checks_arguments", False), "a public function checks what it is given"
    hints = hints_of(function)
    fits = {name: good(hint) for name, hint in hints.items()}
    for name, hint in hints.items():
        for value in wrong(hint):
            with pytest.raises(tp.TorchposeError, match=rf"^{re.escape(name)}\b"):
                function(**{**fits, name: value})


@checked
def paired(
    points: Float[Tensor, "N 2"], index: Int[Tensor, " N"], scale: float = 1.0, kind: Literal["a", "b"] = "a"
) -> float:
    """Two tensors of one length."""
    return float(points.sum()) * scale


def test_messages_say_what_was_given_and_what_is_wanted() -> None:
    points, index = torch.ones(3, 2), torch.zeros(3, dtype=torch.int64)
    assert paired(points, index, 2) == 12
    assert paired(np.ones((3, 2)), np.zeros(3, dtype=int)) == 6, "NumPy arrays are taken"  # type: ignore[arg-type]
    for given, message in (
        ((points[:, 0], index), r"points: has shape \(3,\) and dtype float32; give a tensor \(N, 2\) of float numbers"),
        ((points, index[:2]), r"index: has shape \(2,\) .* with N = 3"),
        ((points, index.double()), "index: .* dtype float64; give a tensor .* of integer numbers"),
        ((points, index.to("meta")), "index: is on meta, but points on cpu"),
        ((points, index, "much"), "scale: is 'much'; give a number"),
        ((points, index, 1.0, "c"), "kind: is 'c'; give one of a, b"),
        ((points,), "paired: missing a required argument: 'index'"),
    ):
        with pytest.raises(tp.ArgumentError, match=message):
            paired(*given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": torch.full((9,), 2)}, "index: goes from 2 to 2; give integers from 0 to 1"),
        ({"index": torch.full((9,), -1)}, "index: goes from -1"),
        ({"weights": -torch.ones(9)}, "weights: is negative"),
        ({"weights": torch.ones(8)}, "weights: has shape"),
        ({"points": torch.ones(9, 3)}, "points: has shape"),
        ({"count": -1}, "count: is negative"),
        ({"method": "magic"}, "method: is 'magic'"),
    ],
)
def test_ranges_of_ellipse_fits(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"points": torch.rand(9, 2), "index": torch.zeros(9, dtype=torch.int64), "count": 2}
    tp.ellipse.fit(**good)
    with pytest.raises(tp.ArgumentError, match=message):
        tp.ellipse.fit(**{**good, **change})


def test_windows_that_leave_the_frame_are_refused() -> None:
    frames, frame = torch.rand(2, 20, 30), torch.zeros(1, dtype=torch.int64)
    tp.zernike.locate(frames, frame, torch.tensor([[26, 16]]))
    for pixel in ([2, 5], [27, 5], [5, 17]):
        with pytest.raises(tp.ArgumentError, match="pixels: go from"):
            tp.zernike.locate(frames, frame, torch.tensor([pixel]))
    with pytest.raises(tp.ArgumentError, match="frame: goes from 2"):
        tp.zernike.locate(frames, frame + 2, torch.tensor([[5, 5]]))


def test_own_calls_are_not_checked() -> None:
    """Within a pipeline nothing is asked; outside of it again, after an error too, and in other threads always."""

    @checked
    def length(x: Float[Tensor, " N"]) -> int:
        return x.ndim

    square = torch.zeros(2, 2)
    with own_calls():
        assert length.__wrapped__(square) == 2  # type: ignore[attr-defined]
        assert length(square) == 2
        with ThreadPoolExecutor(1) as other, pytest.raises(tp.ArgumentError):
            other.submit(length, square).result()
        with own_calls():
            pass
        assert length(square) == 2
    with pytest.raises(tp.ArgumentError):
        length(square)
    with pytest.raises(ValueError, match="inside"), own_calls():
        raise ValueError("inside")
    with pytest.raises(tp.ArgumentError):
        length(square)
