"""Stage: which ring is which marker, and a second look for those that were not found."""

from torchpose.identify.markers import Identified, identify
from torchpose.identify.scene import MarkerTable, Scene
from torchpose.identify.second_look import look_again

__all__ = ["Identified", "MarkerTable", "Scene", "identify", "look_again"]
