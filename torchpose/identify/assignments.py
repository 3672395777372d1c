"""Rings taken for markers by their code alone.

A code is the ratio q of inner to outer radius. Where the light side of a ring's edges is clipped, both edges are read
towards the dark side by some d px, so that a dark ring of the outer radius b has the ratio (q b + d) / (b - d), and a
light one (q b - d) / (b + d). How far d is depends on blur and exposure, of which a clipped edge tells neither; but it
is common to the rings of a frame. So the code of a clipped ring is read up to d, and the layout tells d.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.rows import Rows
from torchpose.identify.scene import MarkerTable
from torchpose.rings import Rings

Ratio = TypeVar("Ratio", float, Tensor)

_RATIO_TOLERANCE = 0.02  # of the ratio of radii, for a large ring
# blurs: an edge of which the share f is not clipped is read at its f / 2; at 1 % that is 2.6 deviations of 0.8 px
_MOST_CLIPPING = 2.0
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
        clipping: px, by how far clipping must have moved the ring's edges for the code to be right; NaN for rings that
            are not clipped.
        per_px: mismatch that a px of that makes.
        ellipse: of the ring's outer circle, ideal px; of a clipped one as the code tells it.
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
    clipping: Tensor
    per_px: Tensor
    ellipse: Tensor
    radius: Tensor
    place: Tensor
    axis: Tensor

    def mismatch_under(self, clipping: Tensor) -> Tensor:
        """As `Codes.under`."""
        return Codes(self.mismatch, self.clipping, self.per_px).under(clipping)


def ratio_tolerance(semi_minor: Ratio, blur: Ratio | float = 1.0) -> Ratio:
    """Largest error of a ring's inner/outer ratio with which its code is read.

    Args:
        semi_minor: of the outer ellipse, px.
        blur: standard deviation, px; edges of a wider one are off in proportion, whatever its shape is.
    """
    return _RATIO_TOLERANCE + _RATIO_TOLERANCE_PX * blur / semi_minor


def _tolerance_of(rings: Rings, half_gap: Tensor) -> Tensor:
    """`ratio_tolerance` (K, ...) of measured rings.

    A wide blur widens it no farther than to half of the least difference between codes (K or 1, ...): with more, the
    rings of a symmetric target fit it turned by a quarter.
    """
    each = (-1, *[1] * (half_gap.ndim - 1))
    semi_minor = rings.outer.params[:, 3].view(each)
    blurred = ratio_tolerance(semi_minor, blurs.axes(rings.blur)[1].sqrt().clamp_min(1.0).view(each))
    return ratio_tolerance(semi_minor).maximum(blurred.minimum(half_gap))


class Codes(NamedTuple):
    """Codes of K rings against those of markers, (K, ...) each; see `Assignments`."""

    mismatch: Tensor
    clipping: Tensor
    per_px: Tensor

    @classmethod
    def of(cls, rings: Rings, expected: Tensor, half_gap: Tensor) -> Self:
        """Against the ratios (K or 1, ...) of markers, of targets with codes that far apart."""

        def each(values: Tensor) -> Tensor:
            return values.view(-1, *[1] * (expected.ndim - 1))

        error, tolerance = each(rings.ratio) - expected, _tolerance_of(rings, half_gap)
        radius = each(rings.outer.params[:, 2:4].prod(-1).sqrt())
        if not bool(rings.clipped.any()):
            unknown = torch.full_like(error, torch.nan)
            return cls(error.abs() / tolerance, unknown, unknown)
        clipping = error * each(rings.polarity) * radius / (1 + expected)
        per_px = (1 + expected) / radius / tolerance
        most = _MOST_CLIPPING * each(blurs.axes(rings.blur)[1].sqrt().clamp_min(1.0))
        beyond = (clipping - clipping.clamp(torch.zeros_like(most), most)).abs()
        clipped = each(rings.clipped)
        mismatch = torch.where(clipped, beyond * per_px, error.abs() / tolerance)
        return cls(mismatch, torch.where(clipped, clipping, torch.nan), per_px)

    def under(self, clipping: Tensor) -> Tensor:
        """Mismatches where the edges of all clipped rings are moved by so much, NaN where that is not known."""
        off = (self.clipping - clipping.clamp_min(0)).abs() * self.per_px
        return torch.where(off.isnan(), self.mismatch, off)


def propose(rings: Rings, table: MarkerTable, matrix: Tensor) -> Assignments:
    """Every marker whose code a ring has."""
    outer = rings.outer.params
    codes = Codes.of(rings, (table.radii[..., 1] / table.radii[..., 0])[None], table.half_gap[None, :, None])
    fits = (codes.mismatch < 1) & table.valid & (rings.polarity[:, None, None] == table.polarity[:, None])
    ring, target, marker = fits.nonzero().unbind(-1)
    row = rings.frame[ring] * len(table) + target
    order = torch.argsort(row, stable=True)
    ring, target, marker, row = ring[order], target[order], marker[order], row[order]
    # where a clipped edge would be for the code to be right: one drawn inwards all around looks steeper than it is
    drawn = (rings.polarity[ring] * codes.clipping[ring, target, marker]).nan_to_num(nan=0.0)[:, None]
    ellipse, radius = (
        torch.cat([outer[ring, :2], outer[ring, 2:4] + drawn, outer[ring, 4:]], -1),
        table.radii[target, marker, 0],
    )
    # every ring alone has two poses of its plane
    conic = matrix.T @ conics.to_matrix(conics.conic_from_ellipse(ellipse)) @ matrix
    place, axis = conics.circle_poses(conic, radius)
    number = target * len(rings) + ring
    off, clipping, per_px = (code[ring, target, marker] for code in codes)
    return Assignments(row, target, marker, ring, number, off, clipping, per_px, ellipse, radius, place, axis)
