"""Rings taken for markers by their code alone.

A code is the ratio q of inner to outer radius. A print moves every edge of the dark areas outwards by some gain g mm,
so that a dark ring of the outer radius b has the ratio (q b - g) / (b + g), and a light one (q b + g) / (b - g). The
gain is common to the rings of a plate. So a code is read up to a gain, and the layout tells it: with the edges the
rings' sizes move, and no longer suit their distances under another gain.

Where the light side of a ring's edges is clipped, both edges are read towards the dark side by some d px, which is a
gain of the other sign. How far d is depends on blur and exposure, of which a clipped edge tells neither; but it is
common to the rings of a frame. So the code of a clipped ring is read up to d beside the gain.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from torchpose.geometry import blur as blurs
from torchpose.geometry import conics
from torchpose.geometry.constants import either
from torchpose.geometry.rows import Rows
from torchpose.identify.scene import MOST_GAIN, MarkerTable
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
        clipped: of the ring.
        moved: by how far its edges must have moved for the code to be right: px towards the dark side for a clipped
            ring, else mm of the plate's gain.
        per_unit: mismatch that a px or mm of that makes.
        likely: of that, by this ring alone: what may be common to the rings beside it.
        ellipse: of the ring's outer circle, ideal px; of a clipped one as the code tells it.
        radius: of the marker's outer circle, mm, printed with that gain.
        place: both centres (A, 2, 3) that a circle of this image can have, mm, camera frame.
        axis: the normals (A, 2, 3) that belong to them, away from the camera.
    """

    row: Tensor
    target: Tensor
    marker: Tensor
    ring: Tensor
    number: Tensor
    mismatch: Tensor
    clipped: Tensor
    moved: Tensor
    per_unit: Tensor
    likely: Tensor
    ellipse: Tensor
    radius: Tensor
    place: Tensor
    axis: Tensor

    def codes_of(self, index: Tensor | slice = slice(None)) -> "Codes":
        """Codes of the rings of some."""
        return Codes(*(value[index] for value in (self.mismatch, self.moved, self.per_unit, self.likely)))

    def common(self, origin: Tensor, member: Tensor) -> Tensor:
        """By how far edges of ``member`` (S,) are moved where those of ``origin`` (S,) are: NaN if one is clipped."""
        return either(self.clipped[origin] == self.clipped[member], self.likely[origin], torch.nan)


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


class Marks(NamedTuple):
    """Markers that codes are read against, (K or 1, ...) each: radii in mm; see `MarkerTable`."""

    outer: Tensor
    inner: Tensor
    half_gap: Tensor
    gain_scale: Tensor

    @classmethod
    def of(cls, table: MarkerTable, target: Tensor, marker: Tensor) -> Self:
        """Those (P,) of targets (P,) and numbers (P,)."""
        outer, inner = table.radii[target, marker].unbind(-1)
        return cls(outer, inner, table.half_gap[target], table.gain_scale[target])


class Codes(NamedTuple):
    """Codes of K rings against those of markers, (K, ...) each; see `Assignments`."""

    mismatch: Tensor
    moved: Tensor
    per_unit: Tensor
    likely: Tensor

    @classmethod
    def of(cls, rings: Rings, marks: Marks) -> Self:
        """Of every ring against the markers."""

        def each(values: Tensor) -> Tensor:
            return values.view(-1, *[1] * (marks.outer.ndim - 1))

        ratio, expected, most_gain = each(rings.ratio), marks.inner / marks.outer, MOST_GAIN * marks.gain_scale
        error, tolerance = ratio - expected, _tolerance_of(rings, marks.half_gap)
        # a ring whose edges moved by g mm: q b - g = ratio (b + g)
        gain = -error * each(rings.polarity) * marks.outer / (1 + ratio)
        per_mm = (1 + ratio) / marks.outer / tolerance
        beyond = (gain.abs() - most_gain).clamp_min(0)
        # the error of reading and the gain share the difference by their variances; the tolerance is the largest error
        share = (most_gain * per_mm).square()
        likely = gain * share / (1 + share)
        if not bool(rings.clipped.any()):
            return cls(beyond * per_mm, gain, per_mm, likely)
        radius, clipped = each(rings.outer.params[:, 2:4].prod(-1).sqrt()), each(rings.clipped)
        clipping = error * each(rings.polarity) * radius / (1 + expected)
        per_px = (1 + expected) / radius / tolerance
        most = _MOST_CLIPPING * each(blurs.axes(rings.blur)[1].sqrt().clamp_min(1.0))
        printed = most_gain * radius / marks.outer
        past = (clipping - clipping.clamp(-printed, most + printed)).abs()
        return cls(
            torch.where(clipped, past * per_px, beyond * per_mm),
            torch.where(clipped, clipping, gain),
            torch.where(clipped, per_px, per_mm),
            torch.where(clipped, clipping.maximum(-printed), likely),
        )

    def under(self, common: Tensor) -> Tensor:
        """Mismatches where the edges of all rings are moved by so much, px or mm as in ``moved``; NaN: not known."""
        off = (self.moved - common).abs() * self.per_unit
        return torch.where(off.isnan(), self.mismatch, off)


def propose(rings: Rings, table: MarkerTable, matrix: Tensor) -> Assignments:
    """Every marker whose code a ring has."""
    outer = rings.outer.params
    outer_mm, inner_mm = table.radii.unbind(-1)
    marks = Marks(outer_mm[None], inner_mm[None], table.half_gap[None, :, None], table.gain_scale[None, :, None])
    codes = Codes.of(rings, marks)
    fits = (
        (codes.mismatch < 1)
        & (table.valid & table.coded[:, None])
        & (rings.polarity[:, None, None] == table.polarity[:, None])
    )
    ring, target, marker = fits.nonzero().unbind(-1)
    row = rings.frame[ring] * len(table) + target
    order = torch.argsort(row, stable=True)
    ring, target, marker, row = ring[order], target[order], marker[order], row[order]
    codes = Codes(*(code[ring, target, marker] for code in codes))
    clipped, side = rings.clipped[ring], rings.polarity[ring]
    # where a clipped edge would be for the code to be right: one drawn inwards all around looks steeper than it is
    drawn = either(clipped, side * codes.moved, 0.0)[:, None]
    ellipse = torch.cat([outer[ring, :2], outer[ring, 2:4] + drawn, outer[ring, 4:]], -1)
    radius = table.radii[target, marker, 0] + either(clipped, 0.0, side * codes.likely)
    # every ring alone has two poses of its plane
    conic = matrix.T @ conics.to_matrix(conics.conic_from_ellipse(ellipse)) @ matrix
    place, axis = conics.circle_poses(conic, radius)
    number = target * len(rings) + ring
    of_code = (codes.mismatch, clipped, codes.moved, codes.per_unit, codes.likely)
    return Assignments(row, target, marker, ring, number, *of_code, ellipse, radius, place, axis)
