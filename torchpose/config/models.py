"""Data of a file as a model, with one-line errors that name the field."""

import difflib
import os
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from torchpose.errors import ConfigError

ModelT = TypeVar("ModelT", bound=BaseModel)
_LONGEST = 80  # characters of a value in a message (convention)


@contextmanager
def within(prefix: str, names: Mapping[str, str] | None = None, other: str | None = None) -> Iterator[None]:
    """Says in front of a `ConfigError` where its field stands.

    Args:
        prefix: such as ``FILE: `` or ``cam0.``.
        names: what the file calls a field.
        other: what it calls those that are not in ``names``; None leaves them as they are.
    """
    try:
        yield
    except ConfigError as error:
        field, _, problem = str(error).partition(": ")
        raise ConfigError(f"{prefix}{(names or {}).get(field, other or field)}: {problem}") from None


def _one_line(text: str) -> str:
    return " ".join(text.split())


def suggest(key: str, allowed: Iterable[str]) -> str:
    """The fix for an unknown name: the nearest of the allowed ones, or all of them."""
    allowed = list(allowed)
    near = difflib.get_close_matches(key, allowed, n=1)
    return f"did you mean {near[0]}?" if near else f"known are {', '.join(allowed)}"


def _nested_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_nested_model, typing.get_args(annotation)) if m is not None), None)


def _known_keys(model: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    current: type[BaseModel] | None = model
    for part in location:
        if isinstance(part, str) and current is not None and part in current.model_fields:
            current = _nested_model(current.model_fields[part].annotation)
    return list(current.model_fields) if current else []


_LIMITS = {
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
    "greater_than": ("more than", "gt"),
    "greater_than_equal": ("at least", "ge"),
}
_FIX = {
    "missing": "is missing; add it",
    "float_type": "is not a number; write a number without quotes",
    "finite_number": "is not finite; write a finite number",
    "int_type": "is not an integer; write an integer without quotes",
    "int_from_float": "is not an integer; write an integer without quotes",
    "bool_type": "is neither true nor false; write one of them without quotes",
    "bool_parsing": "is neither true nor false; write one of them without quotes",
    "string_type": "is not text; put it in quotes",
    "list_type": "is not a list; write [a, b, c]",
    "model_type": "is not a mapping; write it as `key: value` lines",
    "model_attributes_type": "is not a mapping; write it as `key: value` lines",
}


def problem_of(caught: ValidationError, model: type[BaseModel]) -> tuple[str, str]:
    """The field of the first error, a mistyped key before the field that it leaves missing, and what is wrong there."""
    errors = caught.errors(include_url=False)
    error = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    location = error["loc"]
    field = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in location).lstrip(".") or "file"
    if error["type"] == "extra_forbidden":
        problem = f"unknown key; {suggest(str(location[-1]), _known_keys(model, location[:-1]))}"
    elif error["type"] == "value_error":
        problem = str(error["ctx"]["error"])
    elif error["type"] in ("too_short", "too_long"):
        limits = error["ctx"]
        wanted = limits.get("min_length", limits.get("max_length"))
        least = "at least " if "min_length" in limits else ""
        problem = f"has {limits['actual_length']} entries; give {wanted}"
        if limits["actual_length"] == 0:
            problem = f"is empty; give {least}{wanted}"
    elif error["type"] == "literal_error":
        problem = f"is {shown(error['input'])}; write {error['ctx']['expected']}"
    elif error["type"] in _LIMITS:
        word, key = _LIMITS[error["type"]]
        problem = f"is {shown(error['input'])}; give {word} {error['ctx'][key]:g}"
    else:
        problem = _FIX.get(error["type"]) or f"{error['msg']}; correct it"
    return field, problem + (f" (and {len(errors) - 1} more)" if len(errors) > 1 else "")


def shown(value: Any) -> str:
    """A value of a file as messages have it, in a few words however long it is."""
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def validate(model: type[ModelT], data: Any, path: str | os.PathLike[str]) -> ModelT:
    """``data`` as an instance of the pydantic ``model``.

    Args:
        model: its validators may raise `ValueError` with the text ``what is wrong; the fix``.
        data: what was read.
        path: file named in messages.

    Raises:
        ConfigError: the first error, and how many more there are.
    """
    try:
        return model.model_validate(data, strict=True)
    except ValidationError as caught:
        field, problem = problem_of(caught, model)
    raise ConfigError(_one_line(f"{path}: {field}: {problem}"))
