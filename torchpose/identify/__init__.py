"""Stage: which ring is which marker, and a second look for those that were not found."""

from torchpose.identify.markers import Identified, MarkerTable, crossed_out, identify
from torchpose.identify.second_look import look_again

__all__ = ["Identified", "MarkerTable", "crossed_out", "identify", "look_again"]
