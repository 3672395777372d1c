"""Camera models and their files."""

from torchpose.camera.model import Camera

__all__ = ["Camera"]
