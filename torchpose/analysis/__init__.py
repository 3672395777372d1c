"""What a measurement can reach, and what it reached."""

from torchpose.analysis.crlb import pose_crlb, rig_crlb
from torchpose.analysis.errors import PoseErrors, pose_errors, rms
from torchpose.analysis.monte_carlo import simulate_frames, simulate_points
from torchpose.analysis.placing import second_camera_crlb, with_second
from torchpose.analysis.sensitivity import ErrorBudget, Uncertainty, edge_noise, propagate

__all__ = [
    "ErrorBudget",
    "PoseErrors",
    "Uncertainty",
    "edge_noise",
    "pose_crlb",
    "pose_errors",
    "propagate",
    "rig_crlb",
    "rms",
    "second_camera_crlb",
    "simulate_frames",
    "simulate_points",
    "with_second",
]
