"""Tensor rows: frozen dataclasses whose fields share their first dimension, one row an item of a flat batch.

Every stage hands its results on as such rows. What is done to rows is done here once: selecting, joining, replacing,
moving to a device. A field may be a tensor, other rows, a tuple of these, or None; `shared` fields belong to all rows.
"""

from collections.abc import Callable, Sequence
from dataclasses import MISSING, field, fields
from functools import cache
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchpose.geometry.segments import as_array, positions

_Kind = TypeVar("_Kind")


def shared(default: Any = MISSING) -> Any:
    """A dataclass field that belongs to all rows together: selecting rows leaves it alone, `Rows.to` moves it."""
    return field(default=default, metadata={"shared": True})


def replace(rows: _Kind, /, **changes: Any) -> _Kind:
    """As `dataclasses.replace` of a class that checks nothing, in a fifth of the time."""
    made = object.__new__(type(rows))
    made.__dict__.update((name, getattr(rows, name)) for name, _ in _fields(type(rows)))  # type: ignore[arg-type]
    made.__dict__.update(changes)
    return made


class Rows:
    """Base of frozen dataclasses of tensors that share their first dimension; the first field has it for certain."""

    def __len__(self) -> int:
        first = getattr(self, _fields(type(self))[0][0])  # type: ignore[arg-type]  # classes are hashable
        # torch's own length of a tensor takes ten times as long, and it is asked for some hundred times a frame
        return first.shape[0] if isinstance(first, Tensor) else len(first)

    def __getitem__(self, index: Any) -> Self:
        """The rows selected by a mask, a slice or an index tensor."""
        count = len(self)
        if isinstance(index, Tensor) and (rows := _rows(index, count)) is not None:
            return self if _all_of(rows, count) else self._at(rows)
        return self._each(lambda value: value[index])

    def _at(self, rows: Tensor) -> Self:
        """As `self[rows]`, (K,) int64 from 0, in a third of the time for each field."""
        return self._each(lambda value: value._at(rows) if isinstance(value, Rows) else value.index_select(0, rows))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, one after the other. Raises ValueError where the shared fields of those that have any
        rows differ."""
        parts = [part for part in parts if len(part)] or parts[:1]
        if len(parts) == 1:
            return parts[0]
        return parts[0]._each(
            lambda *values: values[0].cat(values) if isinstance(values[0], Rows) else torch.cat(values), *parts[1:]
        )

    def replaced(self, index: Tensor, other: Self) -> Self:
        """These rows, with the rows ``index`` (K,) int64 taken from ``other``, which has K."""
        if _all_of(index, len(self)):
            return other
        return self._each(
            lambda a, b: a.replaced(index, b) if isinstance(a, Rows) else a.index_copy(0, index, b), other
        )

    def where(self, condition: Tensor, other: Self) -> Self:
        """These rows where the condition (N,) bool holds, those of ``other`` elsewhere."""

        def chosen(a: Any, b: Any) -> Any:
            if isinstance(a, Rows):
                return a.where(condition, b)
            return torch.where(condition.view(-1, *[1] * (a.ndim - 1)), a, b)

        return self._each(chosen, other)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """As `Tensor.to` on every tensor; those that are no floats keep their dtype."""

        def moved(value: Any) -> Any:
            if isinstance(value, Rows):
                return value.to(*args, **kwargs)
            # integers go to the device only: a large id would not survive the way through a float
            return (
                value.to(*args, **kwargs) if value.is_floating_point() else value.to(value.to(*args, **kwargs).device)
            )

        return self._each(moved, with_shared=True)

    def clone(self) -> Self:
        """Copies of every tensor; outside of inference mode they are ordinary ones, whatever these are."""
        return self._each(lambda value: value.clone(), with_shared=True)

    def cpu(self) -> Self:
        return self.to("cpu")

    def _each(self, change: Callable[..., Any], *others: Self, with_shared: bool = False) -> Self:
        """These rows with every field changed, given the same field of the others."""
        changed = {}
        for name, common in _fields(type(self)):  # type: ignore[arg-type]
            values = [getattr(rows, name) for rows in (self, *others)]
            changed[name] = first = values[0]
            if common and not with_shared:
                if not all(_same(value, first) for value in values):
                    raise ValueError(f"{type(self).__name__}.{name} belongs to all rows and differs between the parts")
            elif isinstance(first, (Tensor, Rows)):
                changed[name] = change(*values)
            elif isinstance(first, tuple) and all(isinstance(item, (Tensor, Rows)) for item in first):
                changed[name] = tuple(change(*items) for items in zip(*values, strict=True))
            elif first is not None and not common:
                raise TypeError(f"{type(self).__name__}.{name} is no tensor and no rows; mark it as shared")
        # rows are made of rows some hundred times a frame: without the frozen class's own way, which takes most of it
        made = object.__new__(type(self))
        made.__dict__.update(changed)
        return made


@cache
def _fields(kind: type) -> tuple[tuple[str, bool], ...]:
    """Names of the fields of such rows, and whether each belongs to all rows."""
    return tuple((f.name, bool(f.metadata.get("shared"))) for f in fields(kind))


def _rows(index: Tensor, count: int) -> Tensor | None:
    """The rows that a mask or index means, of ``count``; None for what is neither, or goes by torch's own rules."""
    if index.ndim != 1:
        return None
    if index.dtype == torch.bool:  # where it is True is asked once, not for every field
        return positions(index) if index.shape[0] == count else None
    known = as_array(index) if index.dtype == torch.int64 else None
    return index if known is not None and (known.size == 0 or known.min() >= 0) else None


def _all_of(rows: Tensor, count: int) -> bool:
    """Whether these are all of ``count`` rows in their order: of few frames every row is often right."""
    known = as_array(rows) if rows.shape[0] == count else None
    return known is not None and bool((known == np.arange(count)).all())


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if a is b or not (isinstance(a, Tensor) and isinstance(b, Tensor)):
        return a is b
    return a.device == b.device and torch.equal(a, b)
