"""Stage: refinement of poses beyond the marker centres."""

from torchpose.refine.centers import refine_centers
from torchpose.refine.decide import decide, decide_on_grey
from torchpose.refine.edges.fit import refine_edges
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.result import Refined

__all__ = ["Refined", "decide", "decide_on_grey", "refine_centers", "refine_edges", "refine_photometric"]
