"""Stage: rings, both circles of each measured to sub-pixels in candidates or where they are predicted."""

from torchpose.rings.measure import Rings, ideal_pixels, measure_predicted, measure_rings

__all__ = ["Rings", "ideal_pixels", "measure_predicted", "measure_rings"]
