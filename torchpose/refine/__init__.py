"""Stage: refinement of poses beyond the marker centres."""

from torchpose.refine.centers import refine_centers
from torchpose.refine.edges import refine_edges
from torchpose.refine.photometric import refine_photometric
from torchpose.refine.result import Refined
from torchpose.refine.two_solutions import decide, decide_on_grey

__all__ = ["Refined", "decide", "decide_on_grey", "refine_centers", "refine_edges", "refine_photometric"]
