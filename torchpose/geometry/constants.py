"""Small tables of numbers, made once for each dtype and device: a tensor of a list costs as much as ten sums.

They are kept for good: for numbers that are written in the code, not for those that are computed anew.
"""

from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchpose.geometry.segments import as_array

_made: dict[tuple[Any, torch.dtype, torch.device], Tensor] = {}
# the same by the identity of the numbers, which are mostly written in the code: to compare them all takes longer
_known: dict[tuple[int, torch.dtype, torch.device], tuple[Any, Tensor]] = {}


def constant(values: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """The tensor of a number or nested tuples of numbers, in the dtype and on the device of another; not to be written
    to."""
    kind = dtype or like.dtype, like.device
    known = _known.get((id(values), *kind))
    if known is not None and known[0] is values:
        return known[1]
    if torch.compiler.is_compiling():  # which keeps what is constant itself
        return torch.tensor(values, dtype=kind[0], device=kind[1])
    if (made := _made.get((values, *kind))) is not None:
        return made
    with torch.inference_mode(False):  # it may be used where gradients are wanted
        fresh = torch.tensor(values, dtype=kind[0])
        lasting = as_array(fresh) is not None  # not where torch traces or transforms functions
        fresh = fresh.to(kind[1])
    if lasting:
        _made[values, *kind], _known[id(values), *kind] = fresh, (values, fresh)
    return fresh


def eye(size: int, like: Tensor, times: float = 1.0) -> Tensor:
    """The identity (n, n), or a multiple of it, likewise."""
    return constant(_diagonal(size, times), like)


@cache
def _diagonal(size: int, value: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(value * (i == k) for k in range(size)) for i in range(size))


def finite(values: Tensor, dim: int | tuple[int, ...], *, keepdim: bool = False) -> Tensor:
    """Whether all values along these dimensions are numbers: then their sum is one. In half of the calls."""
    return 0 * values.sum(dim, keepdim=keepdim) == 0


def either(condition: Tensor, one: Tensor | float, other: Tensor | float) -> Tensor:
    """As `torch.where`, without a tensor made anew of a number that stands beside a tensor it fits."""
    if isinstance(one, Tensor) and not isinstance(other, Tensor):
        other = constant(other, one) if _fits(other, one) else other
    elif isinstance(other, Tensor) and not isinstance(one, Tensor):
        one = constant(one, other) if _fits(one, other) else one
    elif type(one) is int and type(other) is int:
        one, other = (constant(value, condition, torch.int64) for value in (one, other))
    return torch.where(condition, one, other)


def _fits(number: float, values: Tensor) -> bool:
    return values.is_floating_point() or (type(number) is int and values.dtype == torch.int64)


def numbers(values: Tensor) -> Tensor:
    """As `torch.isfinite`, in half the calls: what is none differs from itself."""
    return values - values == 0
