"""Stage: rings, both circles of each measured to sub-pixels, in candidates or where they are predicted."""

from torchpose.rings.lens import ideal_pixels, mapped
from torchpose.rings.measure import Rings, measure_predicted, measure_rings

__all__ = ["Rings", "ideal_pixels", "mapped", "measure_predicted", "measure_rings"]
