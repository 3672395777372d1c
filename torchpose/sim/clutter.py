"""Random clutter and covers for stress sets: a function of the seed and of the frame's number alone."""

import math
from collections.abc import Sequence

import numpy as np

from torchpose.sim import shapes
from torchpose.sim.shapes import Shapes
from torchpose.target import Target

_WORDS = ("0815", "REV B", "LOT 42", "M3x8", "OK", "PN 7731", "+24V", "QC")


def random_clutter(target: Target, count: int, seed: int, frames: Sequence[int]) -> Shapes:
    """Rectangles, crosses, discs, washers, wrong rings and words between and around the markers, in their plane z = 0.

    They lie on the cells of a lattice over three times the target's extent, none of which touches a marker, so that
    they overlap neither the markers nor each other.

    Args:
        target: of whose rings the wrong rings have the sizes, with other ring codes.
        count: shapes a frame; fewer where the lattice has fewer cells.
        seed: of the data set.
        frames: numbers of the frames; the shapes carry their positions in it.
    """
    centers, radii = target.centers[:, :2].numpy(), target.radii[:, 0].numpy()
    largest = float(radii.max())
    cell = 2.4 * largest
    reach = 1.5 * float(np.ptp(centers, axis=0).max()) + largest
    axis = np.arange(-reach, reach + cell / 2, cell)
    lattice = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2) + centers.mean(0)
    free = lattice[(np.linalg.norm(lattice[:, None] - centers, axis=2) > radii + 1.5 * largest).all(1)]
    ratios = _foreign_ratios(target)
    out = []
    for position, frame in enumerate(frames):
        rng = np.random.default_rng([seed % 2**32, frame, 1])
        for place in rng.permutation(len(free))[:count]:
            out.append(_one(rng, free[place], largest, ratios, position))
    return shapes.cat(out)


def random_covers(target: Target, fraction: float, seed: int, frames: Sequence[int]) -> Shapes:
    """Rectangles that cover a half or so of each marker with the probability ``fraction``.

    Other arguments as in `random_clutter`. Covers of neighbouring markers do not meet where these are two outer
    diameters apart.
    """
    out = []
    for position, frame in enumerate(frames):
        rng = np.random.default_rng([seed % 2**32, frame, 2])
        for (x, y, _), (radius, _) in zip(target.centers.tolist(), target.radii.tolist(), strict=True):
            chosen, direction = rng.random(), rng.uniform(0, 2 * math.pi)
            turn, grey = rng.random(), rng.uniform(20, 235)
            if chosen < fraction:
                at = (x + radius * math.cos(direction), y + radius * math.sin(direction))
                out.append(shapes.rectangle(at, 1.6 * radius, 2.5 * radius, math.pi * turn, grey, position))
    return shapes.cat(out)


def _one(rng: np.random.Generator, at: np.ndarray, size: float, ratios: np.ndarray, frame: int) -> Shapes:
    """One shape within the circle of the radius 1.1 ``size`` about ``at``."""
    kind, turn = rng.integers(7), rng.uniform(0, 2 * math.pi)
    level, scale = rng.uniform(15, 240), size * rng.uniform(0.4, 1.0)
    place = (float(at[0]), float(at[1]))
    if kind == 0:
        return shapes.rectangle(place, 1.5 * scale, scale, turn, level, frame)
    if kind == 1:
        return shapes.cross(place, 1.5 * scale, 0.4 * scale, turn, level, frame)
    if kind == 2:
        return shapes.ring(place, scale, 0.0, level, frame)
    if kind == 3:  # a washer: bright and thin
        return shapes.ring(place, scale, 0.55 * scale, rng.uniform(160, 240), frame)
    if kind == 4:
        return shapes.ring(place, scale, float(rng.choice(ratios)) * scale, rng.uniform(15, 60), frame)
    if kind == 5:
        corners = [[scale * math.cos(turn + a), scale * math.sin(turn + a)] for a in (0.0, 2.1, 4.2)]
        return shapes.polygon([np.array(corners) + at], level, frame)
    return shapes.text(str(rng.choice(_WORDS)), place, 0.3 * scale, turn, rng.uniform(15, 80), frame)


def _foreign_ratios(target: Target) -> np.ndarray:
    """Ratios inner/outer that are as far from those of the target as its own are from each other at the least."""
    own = (target.radii[:, 1] / target.radii[:, 0]).numpy()
    ratios = np.linspace(0.2, 0.85, 66)
    distance: np.ndarray = abs(ratios[:, None] - own).min(1)
    chosen: np.ndarray = ratios[distance >= 0.5 * distance.max()]
    return chosen
