"""Marks of a grid in whole frames: found, ordered, numbered. Their centres are those of their ellipses, still rough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.calibration.views import Views
from torchpose.camera import Camera
from torchpose.detect import Candidates, find_candidates
from torchpose.detect.reduce import reduction_factor
from torchpose.geometry import blur as blurs
from torchpose.geometry.rows import Rows, shared
from torchpose.geometry.segments import marked, near_pairs
from torchpose.grids import Grid, order_marks, place_patches
from torchpose.pose import common_center, raw_centers
from torchpose.rings import measure_rings

_RATIO = 1.5  # of the radii, measured over nominal or the other way: dot gain and blur change it, another shape more
_ROUGH = 0.1  # px, of the centres of small ellipses
_START_BLUR = 0.8  # px, of discs, whose edges nothing has told yet


@dataclass(frozen=True, eq=False)
class Marks(Rows):
    """K numbered marks in N views.

    Attributes:
        view: index of the view.
        point: number on the board.
        ellipse: outer circle, raw px.
        ratio: of the inner to the outer circle; 0 of a disc, NaN where it is not known.
        polarity: +1 dark on light, -1 light on dark.
        blur: px^2, see `geometry.blur`.
        center: px; of a ring the common centre of both circles, of a disc that of the ellipse.
        covariance: of the centre, px^2; zero where it is not known.
        names: of the N views.
    """

    view: Int[Tensor, " K"]
    point: Int[Tensor, " K"]
    ellipse: Float[Tensor, "K 5"]
    ratio: Float[Tensor, " K"]
    polarity: Float[Tensor, " K"]
    blur: Float[Tensor, "K 3"]
    center: Float[Tensor, "K 2"]
    covariance: Float[Tensor, "K 2 2"]
    names: tuple[str, ...] = shared()

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The views of all parts."""
        names = tuple(name for part in parts for name in part.names)
        first = accumulate((len(part.names) for part in parts), initial=0)
        return super().cat(
            [replace(part, names=names, view=part.view + start) for part, start in zip(parts, first, strict=False)]
        )

    def of_names(self, names: Sequence[str]) -> Self:
        """Those of some of the views, numbered anew."""
        number = {name: i for i, name in enumerate(names)}
        new = torch.tensor([number.get(name, -1) for name in self.names], device=self.view.device)
        some = self[new[self.view] >= 0]
        return replace(some, names=tuple(names), view=new[some.view])

    def views(self, grid: Grid) -> Views:
        """Their centres, to calibrate with."""
        points = grid.points.to(self.center)[self.point]
        return Views(self.view, self.point, points, self.center, self.covariance, self.names)


@dataclass(frozen=True, eq=False)
class _Shapes(Rows):
    """What may be a mark: as `Marks`, without a number."""

    frame: Int[Tensor, " M"]
    ellipse: Float[Tensor, "M 5"]
    ratio: Float[Tensor, " M"]
    polarity: Float[Tensor, " M"]
    blur: Float[Tensor, "M 3"]
    center: Float[Tensor, "M 2"]
    covariance: Float[Tensor, "M 2 2"]


def find_marks(names: Sequence[str], frames: Tensor, grid: Grid, camera: Camera) -> Marks:
    """The marks of a grid in every frame, as far as it is clear which they are.

    Frames in which the board is not whole are searched again at finer scales, down to their own pixels.

    Args:
        names: of the B frames.
        frames: (B, H, W) uint8 or uint16.
        grid: the board.
        camera: a rough guess.
    """
    factor = reduction_factor(*frames.shape[-2:])
    best = _found(frames, grid, camera, factor)
    while factor > 1:
        factor //= 2
        count = torch.bincount(best[1].frame, minlength=len(frames))
        rest = (count < len(grid)).nonzero()[:, 0]
        if rest.numel() == 0:
            break
        number, shapes = _found(frames[rest], grid, camera, factor)
        shapes = replace(shapes, frame=rest[shapes.frame])
        more = torch.bincount(shapes.frame, minlength=len(frames)) > count
        old, new = ~more[best[1].frame], more[shapes.frame]
        best = torch.cat([best[0][old], number[new]]), _Shapes.cat([best[1][old], shapes[new]])
    number, shapes = best
    order = torch.argsort(shapes.frame * len(grid.points) + number)
    number, one = number[order], shapes[order]
    parts = (one.ellipse, one.ratio, one.polarity, one.blur, one.center, one.covariance)
    return Marks(one.frame, number, *parts, tuple(names))


def _found(frames: Tensor, grid: Grid, camera: Camera, factor: int) -> tuple[Tensor, _Shapes]:
    """Marks found at one scale, and their numbers."""
    candidates = find_candidates(frames, factor)
    shapes = _discs(candidates) if grid.discs else _rings(frames, candidates, grid, camera)
    spacing = None if grid.discs or grid.radii is None else grid.spacing / grid.radii[0]
    lattice = order_marks(shapes.frame, shapes.ellipse, shapes.polarity, spacing)
    height, width = frames.shape[-2:]
    number, _ = place_patches(lattice, shapes.center[lattice.mark], grid, (width, height), len(frames))
    placed = number >= 0
    return number[placed], shapes[lattice.mark[placed]]


def _discs(candidates: Candidates) -> _Shapes:
    ellipse = candidates.ellipse
    none = torch.zeros_like(ellipse[:, 0])
    blur, unknown = blurs.isotropic(none + _START_BLUR), none[:, None, None].expand(-1, 2, 2)
    return _Shapes(candidates.frame, ellipse, none, candidates.polarity, blur, ellipse[:, :2], unknown)


def _rings(frames: Tensor, candidates: Candidates, grid: Grid, camera: Camera) -> _Shapes:
    assert grid.radii is not None  # the caller chose by it
    rings = measure_rings(frames, candidates, camera)
    ratio, nominal = rings.ratio, grid.radii[1] / grid.radii[0]
    rings = rings[(ratio < _RATIO * nominal) & (ratio > nominal / _RATIO)]
    ratio = rings.ratio
    center, covariance = common_center(rings.outer, rings.inner, torch.stack([torch.ones_like(ratio), ratio], -1))
    center, covariance = raw_centers(camera, center, covariance)
    found = _Shapes(rings.frame, rings.outer_raw, ratio, rings.polarity, rings.blur, center, covariance)
    # what is refused as a ring, by its size first of all, is one if it has its place in the lattice
    outer, reach = candidates.ellipse[:, :2], 0.5 * candidates.ellipse[:, 3]
    near, ring = near_pairs(outer, found.ellipse[:, :2], reach, (candidates.frame, found.frame))
    near = near[torch.linalg.vector_norm(outer[near] - found.ellipse[ring, :2], dim=-1) < reach[near]]
    rest = _discs(candidates[~marked(near, len(candidates))])
    rough = _ROUGH**2 * torch.eye(2).to(rest.covariance).expand_as(rest.covariance)
    return _Shapes.cat([found, replace(rest, ratio=torch.full_like(rest.ratio, torch.nan), covariance=rough)])
