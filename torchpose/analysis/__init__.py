"""What a measurement can reach, and what it reached."""

from torchpose.analysis.crlb import pose_crlb

__all__ = ["pose_crlb"]
