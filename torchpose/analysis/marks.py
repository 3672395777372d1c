"""Marks of five shapes on an equal area of the plate: how they are drawn, outlined and localised (paper, Fig. 5)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpose.analysis import localisers
from torchpose.camera import Camera
from torchpose.rings import ideal_pixels
from torchpose.sim import shapes
from torchpose.sim.shapes import Shapes

Place = tuple[float, float]
RING_RATIO = 0.5
_CORNER = 0.12  # of a straight edge, left out at either end: the corner rounds it


@dataclass(frozen=True)
class Mark:
    """A shape about the origin of the plane z = 0.

    Attributes:
        name: what it is.
        draw: grey level and place (x, y) mm to shapes.
        edges: (E, S, 2) mm, S points along each of the E edges that give its centre.
        locate: frames (B, H, W), rough outline (B, E, S, 2) px, start (B, 2) px, blur px and a camera or None to
            centres (B, 2) px, of the undistorted frame where there is a camera.
    """

    name: str
    draw: Callable[[float, Place], Shapes]
    edges: Tensor
    locate: Callable[[Tensor, Tensor, Tensor, float, Camera | None], Tensor]


def marks(area: float, samples: int = 150) -> list[Mark]:
    """Chessboard vertex, disc, ring, square and cross, each with a convex hull of ``area`` mm^2.

    The bars of the cross are half its extent wide. The hull of the chessboard vertex is that of its four fields.
    """
    side, radius = math.sqrt(area), math.sqrt(area / math.pi)
    return [
        vertex(side, samples),
        circles("filled circle", (radius,), samples),
        circles("concentric rings", (radius, RING_RATIO * radius), samples),
        square(side, samples),
        cross(area, 0.5, samples),
    ]


def vertex(side: float, samples: int) -> Mark:
    half = side / 2
    ends = [((0.0, 0.0), at) for at in ((half, 0.0), (0.0, half), (-half, 0.0), (0.0, -half))]

    def locate(frames: Tensor, outline: Tensor, start: Tensor, blur: float, camera: Camera | None) -> Tensor:
        # as large a window as the fields allow
        room = float((outline[:, :, -1] - outline[:, :, 0]).norm(dim=-1).amin())
        found = localisers.by_corner(frames, start, max(2, int(0.5 * room)))
        return found if camera is None else ideal_pixels(camera, found)

    def draw(level: float, at: Place) -> Shapes:
        return shapes.chessboard_corner(at, side, 0, level)

    return Mark("chessboard vertex", draw, _lines(ends, samples, 0.0), locate)


def circles(name: str, radii: tuple[float, ...], samples: int) -> Mark:
    angle = torch.linspace(0, 2 * math.pi, samples, dtype=torch.float64)
    unit = torch.stack([angle.cos(), angle.sin()], -1)
    edges = torch.stack([radius * unit for radius in radii])

    def locate(frames: Tensor, outline: Tensor, start: Tensor, blur: float, camera: Camera | None) -> Tensor:
        edges = localisers.edge_points(frames, outline, blur, camera)
        return localisers.by_circles(edges, outline if camera is None else ideal_pixels(camera, outline), radii)

    inner = radii[1] if len(radii) > 1 else 0.0
    return Mark(name, lambda level, at: shapes.ring(at, radii[0], inner, level), edges, locate)


def square(side: float, samples: int) -> Mark:
    h = side / 2
    corners = [(-h, -h), (h, -h), (h, h), (-h, h)]
    edges = _lines(list(zip(corners, corners[1:] + corners[:1], strict=True)), samples, _CORNER)

    def locate(frames: Tensor, outline: Tensor, start: Tensor, blur: float, camera: Camera | None) -> Tensor:
        return localisers.by_diagonals(localisers.edge_points(frames, outline, blur, camera))

    return Mark("rectangle", lambda level, at: shapes.rectangle(at, side, side, 0, level), edges, locate)


def cross(area: float, bar: float, samples: int) -> Mark:
    """A cross whose bars are ``bar`` of its extent wide, with a convex hull of ``area`` mm^2."""
    extent = cross_extent(area, bar)
    b, a = extent / 2, bar * extent / 2
    quarter = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
    # the line y = -a, on both arms, and the end y = -b of the bar; then their turns by 90 degrees
    arms = _lines([((-b, -a), (-a, -a)), ((a, -a), (b, -a))], samples // 2, 2 * _CORNER)
    side, end = arms.flatten(0, 1), _lines([((-a, -b), (a, -b))], 2 * (samples // 2), _CORNER)[0]
    edges = torch.stack([x @ torch.linalg.matrix_power(quarter, k).T for x in (side, end) for k in range(4)])

    def locate(frames: Tensor, outline: Tensor, start: Tensor, blur: float, camera: Camera | None) -> Tensor:
        return localisers.by_cross(localisers.edge_points(frames, outline, blur, camera), bar)

    return Mark("cross", lambda level, at: shapes.cross(at, extent, bar * extent, 0, level), edges, locate)


def cross_extent(area: float, bar: float) -> float:
    """Extent of a cross with bars of ``bar`` times it and a convex hull of ``area``."""
    return math.sqrt(area / (1 - (1 - bar) ** 2 / 2))


def ink(bar: float) -> float:
    """Part of its bounding square that a cross covers."""
    return 2 * bar - bar * bar


def _lines(ends: list[tuple[tuple[float, float], tuple[float, float]]], samples: int, short: float) -> Tensor:
    """Points (E, samples, 2) along lines, without the part ``short`` at either end."""
    along = torch.linspace(short, 1 - short, samples, dtype=torch.float64)[:, None]
    pair = torch.tensor(ends, dtype=torch.float64)
    return pair[:, :1] + along * (pair[:, 1:] - pair[:, :1])
