"""torchpose: the pose of concentric-ring targets from one camera image, batched, with covariance."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpose import analysis, calibration, design, detect, ellipse, pnp, sim
    from torchpose.camera import Camera, CameraRig
    from torchpose.errors import ArgumentError, ConfigError, FrameError, TorchposeError
    from torchpose.handeye import HandEye
    from torchpose.pipeline import PoseEstimator
    from torchpose.pose import centers
    from torchpose.results import Detections, Misfit, Motions, Poses, Reason, Status
    from torchpose.rings import zernike
    from torchpose.target import Target
    from torchpose.tracking import Tracker

__all__ = [
    "ArgumentError",
    "Camera",
    "CameraRig",
    "ConfigError",
    "Detections",
    "FrameError",
    "HandEye",
    "Misfit",
    "Motions",
    "PoseEstimator",
    "Poses",
    "Reason",
    "Status",
    "Target",
    "TorchposeError",
    "Tracker",
    "analysis",
    "calibration",
    "centers",
    "design",
    "detect",
    "ellipse",
    "pnp",
    "sim",
    "zernike",
]
__version__ = "0.2.0.dev0"

_HOME = {
    "ArgumentError": "errors",
    "Camera": "camera",
    "CameraRig": "camera",
    "ConfigError": "errors",
    "Detections": "results",
    "FrameError": "errors",
    "HandEye": "handeye",
    "PoseEstimator": "pipeline",
    "Misfit": "results",
    "Motions": "results",
    "Poses": "results",
    "Reason": "results",
    "Status": "results",
    "Target": "target",
    "TorchposeError": "errors",
    "Tracker": "tracking",
}
_MODULES = {"centers": "pose.centers", "zernike": "rings.zernike"}


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use: processes that need no torch (the help, the rig's) start in a moment."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in _HOME:
        return import_module(f"{__name__}.{_MODULES.get(name, name)}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
