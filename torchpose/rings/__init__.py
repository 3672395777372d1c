"""Stage: rings, both circles of each measured to sub-pixels, in candidates or where they are predicted."""

from torchpose.rings.lens import ideal_pixels, mapped
from torchpose.rings.measure import (
    LARGE,
    Circles,
    Rings,
    find_circles,
    measure_circles,
    measure_exactly,
    measure_predicted,
    measure_rings,
    rough_rings,
)

__all__ = [
    "LARGE",
    "Circles",
    "Rings",
    "find_circles",
    "ideal_pixels",
    "mapped",
    "measure_circles",
    "measure_exactly",
    "measure_predicted",
    "measure_rings",
    "rough_rings",
]
