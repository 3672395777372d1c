"""Flat shapes with exact outlines: what is drawn on the plate, beside it and over it, besides the target's rings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Self

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.geometry.rotations import plane_axes
from torchpose.geometry.rows import Rows
from torchpose.target import Target

Place = Sequence[float] | np.ndarray
"""(x, y) mm in the plane z = 0, or (x, y, z) where a function says so."""


@dataclass(frozen=True, eq=False)
class Circles(Rows):
    """Circles that bound shapes: whose they are, centre and two orthogonal radii in mm, 1 or -1 for a hole.

    On a plate that is bent they leave their plane by the vectors ``bend`` times (cos^2, cos sin, sin^2), mm.
    """

    of: Int[Tensor, " C"]
    center: Float[Tensor, "C 3"]
    axes: Float[Tensor, "C 2 3"]
    sign: Float[Tensor, " C"]
    bend: Float[Tensor, "C 3 3"]


@dataclass(frozen=True, eq=False)
class Sides(Rows):
    """Sides of polygons: whose they are, and their ends in mm; holes run the other way round."""

    of: Int[Tensor, " E"]
    ends: Float[Tensor, "E 2 3"]


@dataclass(frozen=True, eq=False)
class Shapes(Rows):
    """S flat shapes, each one grey level and bounded by circles or by polygons, in target coordinates (mm).

    Shapes of one set must not overlap each other: their contributions add up. Sets are drawn one over the other.

    Attributes:
        frame: pose that a shape belongs to.
        marker: index of the marker it is, -1 for others.
        level: grey level of 0..255.
        center: point whose depth sets the defocus of the whole shape.
        circles: outlines of all shapes.
        sides: outlines of all shapes.
    """

    frame: Int[Tensor, " S"]
    marker: Int[Tensor, " S"]
    level: Float[Tensor, " S"]
    center: Float[Tensor, "S 3"]
    circles: Circles
    sides: Sides

    def in_frames(self, frame: Int[Tensor, " F"]) -> Shapes:
        """The set of shapes, all of one frame, drawn in each of the frames."""
        return replace(cat([self] * len(frame)), frame=frame.repeat_interleave(len(self)))

    def of_frames(self, first: int, count: int) -> Shapes:
        """The shapes of ``count`` consecutive frames, which are then numbered from 0."""
        use = (self.frame >= first) & (self.frame < first + count)
        return replace(self, frame=self.frame - first)[use]

    def __getitem__(self, mask: Tensor) -> Self:
        """The shapes selected by a mask (S,) bool."""
        new = mask.cumsum(0) - 1
        circles, sides = self.circles[mask[self.circles.of]], self.sides[mask[self.sides.of]]
        return type(self)(
            self.frame[mask],
            self.marker[mask],
            self.level[mask],
            self.center[mask],
            replace(circles, of=new[circles.of]),
            replace(sides, of=new[sides.of]),
        )

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """One set of all shapes; they keep their frames."""
        first = accumulate(map(len, parts), initial=0)
        return super().cat(
            [
                replace(p, circles=replace(p.circles, of=p.circles.of + a), sides=replace(p.sides, of=p.sides.of + a))
                for p, a in zip(parts, first, strict=False)
            ]
        )


def cat(sets: Sequence[Shapes]) -> Shapes:
    """`Shapes.cat`, of no set as well."""
    return Shapes.cat(sets) if sets else polygon([])[torch.zeros(1, dtype=torch.bool)]


def rings(target: Target) -> Shapes:
    """The rings of a target as shapes of one frame, of level 0."""
    axes = torch.stack(plane_axes(target.normals), 1)[:, None] * target.printed_radii[..., None, None]  # (M, 2, 2, 3)
    marker = torch.arange(len(target), device=target.radii.device)
    circles = Circles(
        marker.repeat_interleave(2),
        target.centers.repeat_interleave(2, 0),
        axes.flatten(0, 1),
        target.radii.new_tensor([1.0, -1.0]).repeat(len(target)),
        axes.new_zeros(2 * len(target), 3, 3),
    )
    sides = Sides(marker[:0], axes.new_zeros(0, 2, 3))
    return Shapes(torch.zeros_like(marker), marker, axes.new_zeros(len(target)), target.centers, circles, sides)


def ring(center: Place, outer: float, inner: float = 0.0, level: float = 30.0, frame: int = 0) -> Shapes:
    """A disc, or a ring where ``inner`` is above 0, in the plane z = center[2]; (x, y) or (x, y, z) in mm."""
    radii = torch.tensor([outer, inner] if inner > 0 else [outer], dtype=torch.float64)
    at = torch.tensor([*center, 0.0][:3], dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)[:2] * radii[:, None, None]
    of = torch.zeros(len(radii), dtype=torch.int64)
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)[: len(radii)]
    circles = Circles(of, at.expand(len(radii), 3), axes, sign, axes.new_zeros(len(radii), 3, 3))
    return _one(level, frame, at, circles, Sides(of[:0], radii.new_zeros(0, 2, 3)))


def polygon(loops: Sequence[Any], level: float = 30.0, frame: int = 0) -> Shapes:
    """A polygon in the plane z = 0, of one or more closed loops.

    Args:
        loops: arrays (n, 2) or (n, 3) of corners in mm; holes run the other way round than the outlines.
        level: grey level.
        frame: pose that it belongs to.
    """
    points = [torch.as_tensor(np.asarray(loop), dtype=torch.float64).reshape(len(loop), -1) for loop in loops]
    points = [torch.nn.functional.pad(p, (0, 3 - p.shape[1])) for p in points]
    none = torch.zeros(0, 2, 3, dtype=torch.float64)
    ends = torch.cat([none, *(torch.stack([p, p.roll(-1, 0)], 1) for p in points)])
    center = torch.cat(points).mean(0) if points else none.new_zeros(3)
    of = torch.zeros(len(ends), dtype=torch.int64)
    circles = Circles(of[:0], none[:, 0], none, none[:, 0, 0], none.new_zeros(0, 3, 3))
    return _one(level, frame, center, circles, Sides(of, ends))


def rectangle(
    center: Place, width: float, height: float, angle: float = 0.0, level: float = 30.0, frame: int = 0
) -> Shapes:
    """A rectangle about ``center`` (x, y) mm, turned by ``angle`` rad from x towards y."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    return polygon([_placed(corners, center, angle)], level, frame)


def cross(center: Place, size: float, bar: float, angle: float = 0.0, level: float = 30.0, frame: int = 0) -> Shapes:
    """An upright cross of the extent ``size`` with bars of the width ``bar``, mm."""
    a, b = bar / 2, size / 2
    arm, turn = np.array([[-a, -b], [a, -b], [a, -a]]), np.array([[0, 1], [-1, 0]])
    quarters = [arm @ np.linalg.matrix_power(turn, k) for k in range(4)]
    return polygon([_placed(np.concatenate(quarters), center, angle)], level, frame)


def chessboard_corner(center: Place, size: float, angle: float = 0.0, level: float = 30.0, frame: int = 0) -> Shapes:
    """Two squares that meet in ``center``, together of the extent ``size`` mm."""
    s = size / 2
    squares = ([[0, 0], [s, 0], [s, s], [0, s]], [[0, 0], [-s, 0], [-s, -s], [0, -s]])
    return polygon([_placed(np.array(square, dtype=float), center, angle) for square in squares], level, frame)


def text(words: str, center: Place, height: float, angle: float = 0.0, level: float = 30.0, frame: int = 0) -> Shapes:
    """Words as polygons, traced from OpenCV's stroke font at 48 steps a letter's height; ``height`` in mm."""
    font, scale, stroke = cv2.FONT_HERSHEY_SIMPLEX, 48 / 22, 6
    (w, h), below = cv2.getTextSize(words, font, scale, stroke)
    picture = np.zeros((h + below + 4 * stroke, w + 4 * stroke), np.uint8)
    cv2.putText(picture, words, (2 * stroke, h + 2 * stroke), font, scale, 255, stroke)
    loops, _ = cv2.findContours(picture, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    # OpenCV runs holes the other way round than outlines
    traced = [cv2.approxPolyDP(loop, 0.7, True)[:, 0].astype(float) for loop in loops]
    middle = np.array([picture.shape[1], picture.shape[0]]) / 2
    return polygon(
        [_placed((loop - middle) * (height / 48), center, angle) for loop in traced if len(loop) > 2], level, frame
    )


def _one(level: float, frame: int, center: Tensor, circles: Circles, sides: Sides) -> Shapes:
    grey = torch.tensor([level], dtype=torch.float64)
    return Shapes(torch.tensor([frame]), torch.tensor([-1]), grey, center[None], circles, sides)


def _placed(corners: np.ndarray, center: Place, angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    placed: np.ndarray = corners @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(center, dtype=float)[:2]
    return placed
