"""What a calibration is computed from: known points seen in N views, flat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Views:
    """K points seen in N views of one camera.

    Attributes:
        names: of the N views (of the frames).
        view: (K,) int64, index of the view. point: (K,) int64, id of the marker, or number of the board's corner.
        points: (K, 3) float64, in the frame of the target, mm.
        pixels: (K, 2) float64, raw (distorted) px. covariance: (K, 2, 2) px^2; zero where it is not known, see
            `torchpose.calibration.intrinsics.calibrate_intrinsics`.
    """

    names: tuple[str, ...]
    view: Tensor
    point: Tensor
    points: Tensor
    pixels: Tensor
    covariance: Tensor

    def __len__(self) -> int:
        return len(self.names)

    @property
    def counts(self) -> Tensor:
        """(N,) number of points in each view."""
        return torch.bincount(self.view, minlength=len(self))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The views of all parts."""
        start = [0]
        for part in parts:
            start.append(start[-1] + len(part))

        def joined(name: str) -> Tensor:
            return torch.cat([getattr(part, name) for part in parts])

        view = torch.cat([part.view + first for part, first in zip(parts, start, strict=False)])
        names = tuple(name for part in parts for name in part.names)
        return cls(names, view, joined("point"), joined("points"), joined("pixels"), joined("covariance"))

    def of_points(self, keep: Tensor) -> Self:
        """The same views with some of the points, a mask (K,)."""
        rest = (getattr(self, n)[keep] for n in ("view", "point", "points", "pixels", "covariance"))
        return type(self)(self.names, *rest)

    def of_views(self, keep: Tensor) -> Self:
        """Some of the views, a mask (N,), numbered anew."""
        number = keep.cumsum(0) - 1
        rest = self.of_points(keep[self.view])
        names = tuple(name for name, kept in zip(self.names, keep.tolist(), strict=True) if kept)
        return type(self)(names, number[rest.view], rest.point, rest.points, rest.pixels, rest.covariance)

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """By view: points (N, M, 3), pixels (N, M, 2) and mask (N, M), M the most points of a view."""
        most = int(self.counts.max())
        order = torch.argsort(self.view, stable=True)
        view = self.view[order]
        first = self.counts.cumsum(0) - self.counts
        place = view * most + torch.arange(len(view)) - first[view]
        points = self.points.new_zeros(len(self) * most, 3).index_copy(0, place, self.points[order])
        pixels = self.points.new_zeros(len(self) * most, 2).index_copy(0, place, self.pixels[order])
        mask = torch.zeros(len(self) * most, dtype=torch.bool).index_fill(0, place, True)
        return points.view(len(self), most, 3), pixels.view(len(self), most, 2), mask.view(len(self), most)
