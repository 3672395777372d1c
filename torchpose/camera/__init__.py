"""Camera models and their files."""

from torchpose.camera.model import Camera
from torchpose.camera.rig import CameraRig
from torchpose.camera.tone import LINEAR, Tone

__all__ = ["LINEAR", "Camera", "CameraRig", "Tone"]
