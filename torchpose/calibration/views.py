"""What a calibration is computed from: known points seen in N views, flat."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, compress
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import rank_in_group


@dataclass(frozen=True, eq=False)
class Rims(Rows):
    """What the two circles of K rings tell beside their centres.

    Attributes:
        depth: logarithm of the distance along the optical axis, mm, at which the ring of the file looks so large.
        gain: apparent edge gain beyond that of the file: every edge lies outwards by so much, mm.
        covariance: of u, v (px), depth and gain.
    """

    depth: Float[Tensor, " K"]
    gain: Float[Tensor, " K"]
    covariance: Float[Tensor, "K 4 4"]


@dataclass(frozen=True, eq=False)
class Views(Rows):
    """K points seen in N views of one camera. Indexing selects points, `len` is the number of views.

    Attributes:
        view: index of the view.
        point: id of the marker, or number of the board's corner.
        points: in the frame of the target, mm.
        pixels: raw (distorted) px.
        covariance: px^2; zero where it is not known, see `torchpose.calibration.intrinsics.calibrate_intrinsics`.
        names: of the N views (of the frames).
        rims: of the rings, where they were measured.
    """

    view: Int[Tensor, " K"]
    point: Int[Tensor, " K"]
    points: Float[Tensor, "K 3"]
    pixels: Float[Tensor, "K 2"]
    covariance: Float[Tensor, "K 2 2"]
    names: tuple[str, ...] = shared()
    rims: Rims | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def counts(self) -> Int[Tensor, " N"]:
        """Number of points in each view."""
        return torch.bincount(self.view, minlength=len(self))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The views of all parts."""
        names = tuple(name for part in parts for name in part.names)
        first = accumulate(map(len, parts), initial=0)
        return super().cat(
            [replace(part, names=names, view=part.view + start) for part, start in zip(parts, first, strict=False)]
        )

    def of_views(self, keep: Tensor) -> Self:
        """Some of the views, a mask (N,), numbered anew."""
        rest = self[keep[self.view]]
        return replace(rest, names=tuple(compress(self.names, keep.tolist())), view=(keep.cumsum(0) - 1)[rest.view])

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """By view: points (N, M, 3), pixels (N, M, 2) and mask (N, M), M the most points of a view."""
        place = (self.view, rank_in_group(self.view, len(self)))
        shape = (len(self), int(self.counts.max()))

        def laid(values: Tensor) -> Tensor:
            return values.new_zeros(*shape, *values.shape[1:]).index_put(place, values)

        return laid(self.points), laid(self.pixels), laid(torch.ones_like(self.view, dtype=torch.bool))
