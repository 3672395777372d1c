"""Tensor rows: frozen dataclasses whose fields share their first dimension, one row an item of a flat batch.

Every stage hands its results on as such rows. What is done to rows is done here once: selecting, joining, replacing,
moving to a device. A field may be a tensor, other rows, a tuple of these, or None; `shared` fields belong to all rows.
"""

from collections.abc import Callable, Sequence
from dataclasses import MISSING, field, fields, replace
from typing import Any, Self

import torch
from torch import Tensor


def shared(default: Any = MISSING) -> Any:
    """A dataclass field that belongs to all rows together: selecting rows leaves it alone, `Rows.to` moves it."""
    return field(default=default, metadata={"shared": True})


class Rows:
    """Base of frozen dataclasses of tensors that share their first dimension; the first field has it for certain."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, index: Any) -> Self:
        """The rows selected by a mask, a slice or an index tensor."""
        return self._each(lambda value: value[index])

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, one after the other. Raises ValueError where their shared fields differ."""
        return parts[0]._each(
            lambda *values: values[0].cat(values) if isinstance(values[0], Rows) else torch.cat(values), *parts[1:]
        )

    def replaced(self, index: Tensor, other: Self) -> Self:
        """These rows, with the rows ``index`` (K,) int64 taken from ``other``, which has K."""
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

    def cpu(self) -> Self:
        return self.to("cpu")

    def _each(self, change: Callable[..., Any], *others: Self, with_shared: bool = False) -> Self:
        """These rows with every field changed, given the same field of the others."""
        changed = {}
        for f in fields(self):  # type: ignore[arg-type]
            values = [getattr(rows, f.name) for rows in (self, *others)]
            if f.metadata.get("shared") and not with_shared:
                if not all(_same(value, values[0]) for value in values):
                    raise ValueError(
                        f"{type(self).__name__}.{f.name} belongs to all rows and differs between the parts"
                    )
            elif isinstance(values[0], tuple) and all(isinstance(item, (Tensor, Rows)) for item in values[0]):
                changed[f.name] = tuple(change(*items) for items in zip(*values, strict=True))
            elif isinstance(values[0], (Tensor, Rows)):
                changed[f.name] = change(*values)
            elif values[0] is not None and not f.metadata.get("shared"):
                raise TypeError(f"{type(self).__name__}.{f.name} is no tensor and no rows; mark it as shared")
        return replace(self, **changed)  # type: ignore[type-var]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if a is b or not (isinstance(a, Tensor) and isinstance(b, Tensor)):
        return a is b
    return a.device == b.device and torch.equal(a, b)
