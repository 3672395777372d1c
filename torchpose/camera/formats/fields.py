"""Numbers, sizes and tables of camera files; what is wrong with them ends in one line."""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

import torch
from torch import Tensor

from torchpose.errors import ConfigError

_SHOWN = 40  # characters of a wrong value in a message
_PRINTED = 128  # bits of an integer in a message; Python refuses to print very long ones
_CHANNELS = re.compile(r"1?[ucwsifdh]")  # OpenCV's `dt` of a matrix of one channel


def shown(value: Any) -> str:
    """A value as messages show it: in one line, and not all of a long one."""
    if isinstance(value, int) and value.bit_length() > _PRINTED:
        return f"an integer of {value.bit_length()} bits"
    # of a container only what it is: to print one that YAML's aliases have folded may take for ever
    text = f"a {type(value).__name__} of {len(value)}" if isinstance(value, list | Mapping) else repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def number(value: Any, field: str) -> float:
    """
    Raises:
        ConfigError: it is no number, or one that no float64 holds.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{field}: is {shown(value)}; write a number")
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ConfigError(f"{field}: holds NaN or infinity; calibrate again or correct the entry")
    return value


def size(value: Any, field: str) -> int:
    """A number of pixels."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
        raise ConfigError(f"{field}: is {shown(value)}; give the frame size as a positive integer, in px")
    if value >= 1 << 31:
        raise ConfigError(f"{field}: is {shown(value)}; give the frame size in px")
    return value


def matrix(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """The pinhole matrix (3, 3)."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def from_corner(center: float) -> float:
    """A coordinate that counts from the corner of the first pixel, as ours; in decimals, so that it costs no digit."""
    return float(Decimal(repr(center)) - Decimal("0.5"))


def numbers(value: Any, field: str) -> Tensor:
    """Float64 tensor of nested lists, or of a mapping with rows, cols and data or with sizes and data."""
    shape = None
    if isinstance(value, Mapping):
        shape, value = _shape(value, field), value["data"]
    if not isinstance(value, list):
        raise ConfigError(f"{field}: is {shown(value)}; write a list of numbers")
    rows = [row if isinstance(row, list) else [row] for row in value]
    for entry in (e for row in rows for e in row):
        if isinstance(entry, bool) or not isinstance(entry, int | float):
            raise ConfigError(f"{field}: {shown(entry)} is not a number; write numbers only")
    if len({len(row) for row in rows}) > 1 or len({isinstance(row, list) for row in value}) > 1:
        raise ConfigError(f"{field}: rows differ in length; write equally long rows of numbers")
    try:
        tensor = torch.tensor(value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise ConfigError(f"{field}: holds a number beyond 1e308; correct the entry") from None
    if shape is not None:
        if tensor.numel() != math.prod(shape):
            wanted = " x ".join(map(str, shape))
            raise ConfigError(f"{field}: {tensor.numel()} numbers for {wanted}; correct the size or data")
        tensor = tensor.reshape(shape)
    return tensor


def _shape(value: Mapping[str, Any], field: str) -> list[int]:
    """The size that a mapping of OpenCV or ROS says it has."""
    several = (
        "sizes" in value and "rows" not in value
    )  # what OpenCV 5 writes, and any version for other than 2 dimensions
    keys = ("sizes",) if several else ("rows", "cols")
    if missing := [key for key in (*keys, "data") if key not in value]:
        raise ConfigError(f"{field}.{missing[0]}: is missing; a matrix has rows, cols and data")
    sizes = value["sizes"] if several else [value["rows"], value["cols"]]
    sizes = sizes if isinstance(sizes, list) else [sizes]
    if not all(isinstance(n, int) and not isinstance(n, bool) and 0 <= n < 1 << 31 for n in sizes):
        raise ConfigError(f"{field}: its size is {shown(sizes)}; write {' and '.join(keys)} as integers")
    kind = value.get("dt", "d")
    if not (isinstance(kind, str) and _CHANNELS.fullmatch(kind)):
        raise ConfigError(f"{field}.dt: is {shown(kind)}; write a matrix of one channel")
    return sizes


def listed(entry: Mapping[str, Any], names: Sequence[str], prefix: str = "") -> list[float]:
    """Numbers that stand under keys of their own, all of which are needed."""
    for name in names:
        if name not in entry:
            raise ConfigError(f"{prefix}{name}: is missing; add it")
    return [number(entry[name], prefix + name) for name in names]


def mapping(value: Any, field: str) -> Mapping[str, Any]:
    """A mapping with names for keys."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"{field}: is {shown(value)}; write it as `key: value` lines")
    return {str(key): entry for key, entry in value.items()}
