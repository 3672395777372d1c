"""Stage: refinement of poses beyond the marker centres."""

from torchpose.refine.photometric import Refined, refine_photometric

__all__ = ["Refined", "refine_photometric"]
