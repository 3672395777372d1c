"""What every fault of the rig has in common: a reason that the manifest and the exit line name."""

from __future__ import annotations

from enum import StrEnum

from torchpose.errors import TorchposeError


class RigFault(TorchposeError):
    """A part of the rig cannot go on. The message is one line with the fix; `reason` names the kind."""

    def __init__(self, reason: StrEnum, message: str) -> None:
        super().__init__(message)
        self.reason = reason
