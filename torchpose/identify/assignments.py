"""Rings taken for markers by their code alone."""

from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.rows import Rows
from torchpose.identify.scene import MarkerTable
from torchpose.rings import Rings

Ratio = TypeVar("Ratio", float, Tensor)

_RATIO_TOLERANCE = 0.02  # of the ratio of radii, for a large ring
_RATIO_TOLERANCE_PX = 0.35  # over the semi-minor axis of the outer ellipse: what edge offsets do to a small ring


@dataclass(frozen=True, eq=False)
class Assignments(Rows):
    """Rings taken for markers, A of them, sorted by row (frame and target, frame-major).

    Attributes:
        row: frame and target.
        target: of the row.
        marker: number of the marker in the target.
        ring: index into the rings.
        number: of the ring, another one for every target: targets may claim the same ring.
        mismatch: of the code, 1 at its tolerance.
        ellipse: of the ring's outer circle, ideal px.
        radius: of the marker's outer circle, mm.
        place: both centres (A, 2, 3) that a circle of this image can have, mm, camera frame.
        axis: the normals (A, 2, 3) that belong to them, away from the camera.
    """

    row: Tensor
    target: Tensor
    marker: Tensor
    ring: Tensor
    number: Tensor
    mismatch: Tensor
    ellipse: Tensor
    radius: Tensor
    place: Tensor
    axis: Tensor


def ratio_tolerance(semi_minor: Ratio, blur: Ratio | float = 1.0) -> Ratio:
    """Largest error of a ring's inner/outer ratio with which its code is read.

    Args:
        semi_minor: of the outer ellipse, px.
        blur: standard deviation, px; edges of a wider one are off in proportion, whatever its shape is.
    """
    return _RATIO_TOLERANCE + _RATIO_TOLERANCE_PX * blur / semi_minor


def tolerance_of(rings: Rings) -> Tensor:
    """`ratio_tolerance` (K,) of measured rings."""
    return ratio_tolerance(rings.outer.params[:, 3], blurs.axes(rings.blur)[1].sqrt().clamp_min(1.0))


def propose(rings: Rings, table: MarkerTable, matrix: Tensor) -> Assignments:
    """Every marker whose code a ring has."""
    outer = rings.outer.params
    expected = table.radii[..., 1] / table.radii[..., 0]
    mismatch = (rings.ratio[:, None, None] - expected).abs() / tolerance_of(rings)[:, None, None]
    fits = (mismatch < 1) & table.valid & (rings.polarity[:, None, None] == table.polarity[:, None])
    ring, target, marker = fits.nonzero().unbind(-1)
    row = rings.frame[ring] * len(table) + target
    order = torch.argsort(row, stable=True)
    ring, target, marker, row = ring[order], target[order], marker[order], row[order]
    ellipse, radius = outer[ring], table.radii[target, marker, 0]
    # every ring alone has two poses of its plane
    conic = matrix.T @ conics.to_matrix(conics.conic_from_ellipse(ellipse)) @ matrix
    place, axis = conics.circle_poses(conic, radius)
    number, off = target * len(rings) + ring, mismatch[ring, target, marker]
    return Assignments(row, target, marker, ring, number, off, ellipse, radius, place, axis)
