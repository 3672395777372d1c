"""Finds tensors that are made without regard to where the inputs are."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors

import torchpose

_PACKAGE = Path(torchpose.__file__).parent


class DeviceNamed(TorchFunctionMode):
    """Within, code of the given rooms may not call a factory (`torch.zeros`, `torch.arange`, ...) without a device."""

    def __init__(self, *rooms: str) -> None:
        super().__init__()
        self.rooms = tuple(str(_PACKAGE / room) for room in rooms)

    def __torch_function__(
        self, func: Callable[..., Any], types: Sequence[type], args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in _device_constructors() and kwargs.get("device") is None:
            caller = sys._getframe(1)
            place = f"{caller.f_code.co_filename}:{caller.f_lineno}"
            assert not place.startswith(self.rooms), f"{place}: {func.__name__} without a device"
        return func(*args, **kwargs)
