"""Frames in, rows out: streaming readers, tables that survive a killed run, and the stage for other pipelines."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpose.io.stages import FrameDataset, PoseStage

__all__ = ["FrameDataset", "PoseStage"]


def __getattr__(name: str) -> Any:
    """Imported when they are used: they need the whole pipeline, which readers of files do not."""
    if name in __all__:
        return getattr(import_module("torchpose.io.stages"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
