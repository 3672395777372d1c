"""What a measurement can reach, and what it reached."""

from torchpose.analysis.crlb import pose_crlb
from torchpose.analysis.errors import PoseErrors, pose_errors, rms

__all__ = ["PoseErrors", "pose_crlb", "pose_errors", "rms"]
