"""Stage: refinement of poses beyond the marker centres, and the decision between two of them."""

from torchpose.refine.centers import refine_centers
from torchpose.refine.decide import decide, decide_on_grey
from torchpose.refine.edges.fit import refine_edges
from torchpose.refine.methods import METHODS, Recipe
from torchpose.refine.photometric.fit import refine_photometric
from torchpose.refine.sight import LEAST_KEPT, Refined, Sight

__all__ = [
    "LEAST_KEPT",
    "METHODS",
    "Recipe",
    "Refined",
    "Sight",
    "decide",
    "decide_on_grey",
    "refine_centers",
    "refine_edges",
    "refine_photometric",
]
