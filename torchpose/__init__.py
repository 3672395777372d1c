"""torchpose: the pose of concentric-ring targets from one camera image, batched, with covariance."""

from torchpose import ellipse, pnp
from torchpose.camera import Camera
from torchpose.errors import ConfigError, FrameError, TorchposeError
from torchpose.handeye import HandEye
from torchpose.pipeline import PoseEstimator
from torchpose.results import Detections, Poses, Reason, Status
from torchpose.target import Target

__all__ = [
    "Camera",
    "ConfigError",
    "Detections",
    "FrameError",
    "HandEye",
    "PoseEstimator",
    "Poses",
    "Reason",
    "Status",
    "Target",
    "TorchposeError",
    "ellipse",
    "pnp",
]
__version__ = "0.1.0"
