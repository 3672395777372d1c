"""Stage: which ring is which marker of which copy, and a second look for those that were not found."""

from torchpose.identify.alike import indistinguishable
from torchpose.identify.boards import identify_boards
from torchpose.identify.by_codes import by_codes
from torchpose.identify.company import beside_another, in_company, named
from torchpose.identify.copies import MIN_MARKERS
from torchpose.identify.markers import Identified, identify
from torchpose.identify.near import confirmed, find_near, outlines
from torchpose.identify.scene import MarkerTable, Scene, drawn_radii
from torchpose.identify.second_look import Views, look_again

__all__ = [
    "MIN_MARKERS",
    "Identified",
    "MarkerTable",
    "Scene",
    "Views",
    "beside_another",
    "by_codes",
    "confirmed",
    "drawn_radii",
    "find_near",
    "identify",
    "identify_boards",
    "in_company",
    "indistinguishable",
    "look_again",
    "named",
    "outlines",
]
