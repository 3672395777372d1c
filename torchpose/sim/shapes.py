"""Flat shapes with exact outlines: what is drawn on the plate, beside it and over it, besides the target's rings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.geometry.rotations import plane_axes
from torchpose.target import Target


@dataclass(frozen=True, eq=False)
class Shapes:
    """S flat shapes, each one grey level and bounded by circles or by polygons, in target coordinates (mm).

    Shapes of one set must not overlap each other: their contributions add up. Sets are drawn one over the other.

    Attributes:
        frame: (S,) int64, pose that a shape belongs to. marker: (S,) int64, index of the marker it is, -1 for others.
        level: (S,) float64, grey level of 0..255.
        center: (S, 3) float64, point whose depth sets the defocus of the whole shape.
        circle_of: (C,) int64, shape of each bounding circle. circle_center: (C, 3). circle_axes: (C, 2, 3), two
            orthogonal radii. circle_sign: (C,) float64, 1 for an outer boundary, -1 for a hole.
        side_of: (E,) int64, shape of each side of a polygon. side: (E, 2, 3), its ends; holes run the other way round.
    """

    frame: Tensor
    marker: Tensor
    level: Tensor
    center: Tensor
    circle_of: Tensor
    circle_center: Tensor
    circle_axes: Tensor
    circle_sign: Tensor
    side_of: Tensor
    side: Tensor

    def __len__(self) -> int:
        return self.frame.shape[0]

    def to(self, *args: Any, **kwargs: Any) -> Shapes:
        """Same as `Tensor.to` on every tensor; indices keep their dtype."""
        moved = {}
        for f in fields(self):
            value = getattr(self, f.name)
            new = value.to(*args, **kwargs)
            moved[f.name] = new if value.is_floating_point() else value.to(new.device)
        return Shapes(**moved)

    def in_frames(self, frame: Tensor) -> Shapes:
        """The set of shapes, all of one frame, drawn in each of the frames (F,) int64."""
        n, f = len(self), len(frame)
        copy = torch.arange(f, device=frame.device)

        def spread(index: Tensor) -> Tensor:
            return (copy[:, None] * n + index).reshape(-1)

        def tile(values: Tensor) -> Tensor:
            return values.expand(f, *values.shape).reshape(-1, *values.shape[1:])

        return Shapes(
            frame=frame.repeat_interleave(n),
            marker=tile(self.marker),
            level=tile(self.level),
            center=tile(self.center),
            circle_of=spread(self.circle_of),
            circle_center=tile(self.circle_center),
            circle_axes=tile(self.circle_axes),
            circle_sign=tile(self.circle_sign),
            side_of=spread(self.side_of),
            side=tile(self.side),
        )

    def of_frames(self, first: int, count: int) -> Shapes:
        """The shapes of ``count`` consecutive frames, which are then numbered from 0."""
        use = (self.frame >= first) & (self.frame < first + count)
        return replace(self, frame=self.frame - first)[use]

    def __getitem__(self, mask: Tensor) -> Shapes:
        """The shapes selected by a mask (S,) bool."""
        new = mask.cumsum(0) - 1
        circles, sides = mask[self.circle_of], mask[self.side_of]
        return Shapes(
            frame=self.frame[mask],
            marker=self.marker[mask],
            level=self.level[mask],
            center=self.center[mask],
            circle_of=new[self.circle_of[circles]],
            circle_center=self.circle_center[circles],
            circle_axes=self.circle_axes[circles],
            circle_sign=self.circle_sign[circles],
            side_of=new[self.side_of[sides]],
            side=self.side[sides],
        )


def cat(sets: Sequence[Shapes]) -> Shapes:
    """One set of all shapes; they keep their frames."""
    if not sets:
        return polygon([], 0.0)[torch.zeros(1, dtype=torch.bool)]
    start = np.cumsum([0, *(len(s) for s in sets)])
    joined = {f.name: torch.cat([getattr(s, f.name) for s in sets]) for f in fields(Shapes)}
    for name in ("circle_of", "side_of"):
        joined[name] = torch.cat([getattr(s, name) + int(a) for s, a in zip(sets, start, strict=False)])
    return Shapes(**joined)


def rings(target: Target) -> Shapes:
    """The rings of a target as shapes of one frame, of level 0."""
    e1, e2 = plane_axes(target.normals)
    m = len(target)
    marker = torch.arange(m, device=target.radii.device)
    axes = torch.stack([e1, e2], 1)[:, None] * target.radii[..., None, None]  # (M, 2, 2, 3)
    return Shapes(
        frame=torch.zeros_like(marker),
        marker=marker,
        level=target.radii.new_zeros(m),
        center=target.centers,
        circle_of=marker.repeat_interleave(2),
        circle_center=target.centers.repeat_interleave(2, 0),
        circle_axes=axes.flatten(0, 1),
        circle_sign=target.radii.new_tensor([1.0, -1.0]).repeat(m),
        side_of=marker[:0],
        side=target.radii.new_zeros(0, 2, 3),
    )


def ring(center: Sequence[float], outer: float, inner: float = 0.0, level: float = 30.0, frame: int = 0) -> Shapes:
    """A disc, or a ring where ``inner`` is above 0, in the plane z = center[2]; (x, y) or (x, y, z) in mm."""
    radii = torch.tensor([outer, inner] if inner > 0 else [outer], dtype=torch.float64)
    at = torch.tensor([*center, 0.0][:3], dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)[:2] * radii[:, None, None]
    zero = torch.zeros(len(radii), dtype=torch.int64)
    return Shapes(
        **_one(level, frame, at),
        circle_of=zero,
        circle_center=at.expand(len(radii), 3),
        circle_axes=axes,
        circle_sign=torch.tensor([1.0, -1.0], dtype=torch.float64)[: len(radii)],
        side_of=zero[:0],
        side=radii.new_zeros(0, 2, 3),
    )


def polygon(loops: Sequence[Any], level: float = 30.0, frame: int = 0) -> Shapes:
    """A polygon in the plane z = 0, of one or more closed loops.

    Args:
        loops: arrays (n, 2) or (n, 3) of corners in mm; holes run the other way round than the outlines.
        level: grey level. frame: pose that it belongs to.
    """
    points = [torch.as_tensor(np.asarray(loop), dtype=torch.float64).reshape(len(loop), -1) for loop in loops]
    points = [torch.nn.functional.pad(p, (0, 3 - p.shape[1])) for p in points]
    side = [torch.stack([p, p.roll(-1, 0)], 1) for p in points]
    sides = torch.cat(side) if side else torch.zeros(0, 2, 3, dtype=torch.float64)
    center = torch.cat(points).mean(0) if points else torch.zeros(3, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.int64)
    return Shapes(
        **_one(level, frame, center),
        circle_of=none,
        circle_center=sides.new_zeros(0, 3),
        circle_axes=sides.new_zeros(0, 2, 3),
        circle_sign=sides.new_zeros(0),
        side_of=torch.zeros(len(sides), dtype=torch.int64),
        side=sides,
    )


def rectangle(
    center: Sequence[float], width: float, height: float, angle: float = 0.0, level: float = 30.0, frame: int = 0
) -> Shapes:
    """A rectangle about ``center`` (x, y) mm, turned by ``angle`` rad from x towards y."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    return polygon([_placed(corners, center, angle)], level, frame)


def cross(
    center: Sequence[float], size: float, bar: float, angle: float = 0.0, level: float = 30.0, frame: int = 0
) -> Shapes:
    """An upright cross of the extent ``size`` with bars of the width ``bar``, mm."""
    a, b = bar / 2, size / 2
    arm = np.array([[-a, -b], [a, -b], [a, -a], [b, -a]])
    turn = np.array([[0, 1], [-1, 0]])
    quarters = [arm[:3] @ np.linalg.matrix_power(turn, k) for k in range(4)]
    return polygon([_placed(np.concatenate(quarters), center, angle)], level, frame)


def chessboard_corner(
    center: Sequence[float], size: float, angle: float = 0.0, level: float = 30.0, frame: int = 0
) -> Shapes:
    """Two squares that meet in ``center``, together of the extent ``size`` mm."""
    s = size / 2
    squares = ([[0, 0], [s, 0], [s, s], [0, s]], [[0, 0], [-s, 0], [-s, -s], [0, -s]])
    return polygon([_placed(np.array(square, dtype=float), center, angle) for square in squares], level, frame)


def text(
    words: str, center: Sequence[float], height: float, angle: float = 0.0, level: float = 30.0, frame: int = 0
) -> Shapes:
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


def _one(level: float, frame: int, center: Tensor) -> dict[str, Tensor]:
    return {
        "frame": torch.tensor([frame]),
        "marker": torch.tensor([-1]),
        "level": torch.tensor([level], dtype=torch.float64),
        "center": center[None],
    }


def _placed(corners: np.ndarray, center: Sequence[float], angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return corners @ np.array([[c, s], [-s, c]]) + np.asarray(center, dtype=float)[:2]
