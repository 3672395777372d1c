"""torchpose: the pose of concentric-ring targets from one camera image, batched, with covariance."""

from torchpose.errors import ConfigError, FrameError, TorchposeError
from torchpose.results import Detections, Poses, Reason, Status

__all__ = ["ConfigError", "Detections", "FrameError", "Poses", "Reason", "Status", "TorchposeError"]
__version__ = "0.1.0"
