"""Where rings can lie on a plate, how large they can be, and which codes they can carry."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.camera import Camera
from torchpose.detect.reduce import reduction_factor
from torchpose.identify.markers import ratio_tolerance
from torchpose.target import MIN_RATIO_GAP

Size = tuple[float, float]
"""Width and height, mm."""
# columns, rows (columns along the longer side) and whether the places within the rim are used
ARRANGEMENTS = {
    4: (2, 2, True),
    6: (3, 2, True),
    8: (3, 3, False),
    9: (3, 3, True),
    10: (4, 3, False),
    12: (4, 3, True),
}

_RATIO_RANGE = (0.2, 0.8)  # inner/outer: beyond, spread of ink changes a code most
_LEAST_OUTER = (12.0, 5.0)  # px; px of the frame that the detector looks at
_LEAST_INNER = (4.0, 1.5)  # below, an edge mask fills the circle
_LEAST_WIDTH_PX = 7.0  # of a ring: two bands of the refinement
_QUIET = 0.3  # of the outer radius
_QUIET_PX = 8.0  # band of the refinement and reach of the blur
_SHUFFLES = 3000  # orders of codes tried where all are too many


@dataclass(frozen=True)
class Limits:
    """What the stages need of a ring, for one camera, in px of its semi-minor axis in the worst view."""

    outer: float  # least semi-minor axis
    inner: float  # the same of the inner circle
    width: float  # least difference of both
    scale: float  # px a mm in the worst view
    gain: float = 0.0  # most dot gain of the print either way, mm

    @classmethod
    def of(cls, camera: Camera, scale: float, gain: float = 0.0) -> Limits:
        factor = reduction_factor(camera.height, camera.width)
        outer, inner = (max(px, reduced * factor) for px, reduced in (_LEAST_OUTER, _LEAST_INNER))
        return cls(outer, inner, _LEAST_WIDTH_PX, scale, gain)

    def quiet(self, radius: float) -> float:
        """Width in mm of the zone around a ring of ``radius`` mm that stays free."""
        return max(_QUIET * radius, _QUIET_PX / self.scale)

    def ratios(self, count: int, radius: float) -> Float[Tensor, " count"] | None:
        """Inner/outer ratios, rising, as far apart as the ring allows; None where it cannot hold so many.

        Neighbours differ by at least twice the tolerance of `torchpose.identify.markers` and twice what the dot gain
        makes of a code, so that a reading within the tolerance of one code is outside that of every other. The limits
        hold for the ring as it is printed, whatever the gain is.
        """
        semi_minor, gain = radius * self.scale, self.gain * self.scale
        if semi_minor - gain < self.outer:
            return None
        low = max(_RATIO_RANGE[0], (self.inner + gain) / semi_minor)
        high = min(_RATIO_RANGE[1], 1 - (self.width + 2 * gain) / semi_minor)
        gap = (high - low) / (count - 1)
        moved = gain * (1 + high) / (semi_minor - gain)  # of a ratio q, by radii r - g and q r + g
        if gap < max(MIN_RATIO_GAP, 2 * (ratio_tolerance(semi_minor) + moved)):
            return None
        return torch.linspace(low, high, count, dtype=torch.float64, device="cpu")

    def largest_radius(self, count: int, plate: Size) -> float:
        """Largest outer radius in mm that leaves the quiet zones of ``count`` rings on a plate; 0 where none does."""

        def fits(radius: float) -> bool:
            quiet = self.quiet(radius)
            apart = torch.pdist(self.places(count, plate, radius)).min()
            return min(plate) / 2 - quiet - radius > 0 and bool(apart >= 2 * radius + quiet)

        return largest(fits, min(plate) / 2)

    def places(self, count: int, plate: Size, radius: float) -> Float[Tensor, "count 2"]:
        """Centres in mm: the outermost rings leave just their quiet zone to the plate's rim."""
        columns, rows, whole = ARRANGEMENTS[count]
        if plate[1] > plate[0]:
            columns, rows = rows, columns
        half = [side / 2 - self.quiet(radius) - radius for side in plate]
        grid = [
            (half[0] * (2 * i / (columns - 1) - 1), half[1] * (2 * k / (rows - 1) - 1))
            for k in range(rows)
            for i in range(columns)
            if whole or i in (0, columns - 1) or k in (0, rows - 1)
        ]
        return torch.tensor(grid, dtype=torch.float64, device="cpu")


def largest(fits: Callable[[float], bool], most: float) -> float:
    """Largest number from 0 to ``most`` that fits, where all below it do."""
    low, high = 0.0, most
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def assign_codes(places: Float[Tensor, "M 2"], ratios: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """Ratios by place: the order that differs most from itself under every symmetry of the places.

    Codes that rise along a row would look alike in a target turned or mirrored: each ring would show its neighbour's.
    The score of an order is the mean difference of codes between a place and its image, for the worst symmetry.
    """
    images = _symmetries(places)
    count = len(places)
    if math.factorial(count) <= _SHUFFLES:
        orders = torch.tensor(list(itertools.permutations(range(count))), device=ratios.device)
    else:
        draw = torch.rand(_SHUFFLES, count, generator=torch.Generator().manual_seed(count), device="cpu")
        orders = draw.argsort(1).to(ratios.device)
    by_order = ratios[orders]  # (P, M)
    if not images:
        return by_order[0]
    score = torch.stack([(by_order - by_order[:, image]).abs().mean(1) for image in images]).amin(0)
    return by_order[score.argmax()]


def _symmetries(places: Tensor) -> list[Tensor]:
    """Permutations (M,) of the places by the turns and mirror images of the plane that map them onto themselves."""
    found, still = [], torch.arange(len(places), device=places.device)
    for swap, *signs in itertools.product((False, True), (1.0, -1.0), (1.0, -1.0)):
        image = (places.flip(1) if swap else places) * places.new_tensor(signs)
        distance, index = torch.cdist(image, places).min(1)
        if bool((distance < 1e-6 * places.abs().max()).all()) and not torch.equal(index, still):
            found.append(index)
    return found
