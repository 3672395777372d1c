"""The print sheet of a target: rings at true scale, bars to verify the print, crop marks, name and ids.

Nothing but the rings lies within the plate. It shows the side that the camera sees, x to the right and y down.
"""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

from torchpose.design.drawing import Circle, Line, Page, Rectangle, Shape, Text
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.io.writers import atomic_path
from torchpose.target import Target

_SIDE, _TOP, _BOTTOM = 20.0, 14.0, 40.0  # mm of page around the plate
_LEAST_PAGE = 120.0  # width in mm that the text takes
_STEP = 6.35  # mm, of which the page is a multiple: a whole number of pixels in a raster of 300 or 1200 dpi
_MARK, _MARK_GAP, _BLEED = 5.0, 3.0, 2.0  # crop marks: length, distance from the plate; ink beyond the plate's rim
_BAR_AWAY = 10.0  # from plate to ruler bar
_KEY = 22.0  # side of the plan of the ids
_QUIET = 0.3  # of the outer radius, around a target that comes without the size of its plate


@dataclass(frozen=True)
class Sheet:
    """A page, and x, y in mm from its upper left corner where the target's origin lies."""

    page: Page
    origin: tuple[float, float]

    def save(self, folder: Path, name: str) -> list[Path]:
        """Writes ``name``.svg and ``name``.pdf; returns their paths.

        Raises:
            ConfigError: the folder cannot be written.
        """
        files = {folder / f"{name}.svg": self.page.svg().encode(), folder / f"{name}.pdf": self.page.pdf()}
        for path, data in files.items():
            with atomic_path(path) as temporary:
                temporary.write_bytes(data)
        return list(files)


@checked
def plate_around(target: Target) -> tuple[float, float]:
    """Width and height in mm of the smallest plate, centred on the origin, that leaves every ring a quiet zone."""
    reach = target.centers[:, :2].abs() + (1 + _QUIET) * target.radii[:, :1]
    width, height = (math.ceil(20 * side) / 10 for side in reach.amax(0).tolist())
    return width, height


@checked
def make_sheet(target: Target, plate: tuple[float, float]) -> Sheet:
    """The print sheet of a target on a plate of the given width and height in mm, centred on the target's origin.

    Raises:
        ConfigError: the rings do not lie in the plane z = 0 and face the camera, or reach beyond the plate.
    """
    facing = target.normals - target.normals.new_tensor([0.0, 0.0, 1.0])
    if bool((target.centers[:, 2].abs() > 1e-6).any()) or bool((facing.abs() > 1e-6).any()):
        raise ConfigError(
            f"{target.name}: markers: not all in the plane z = 0; print the faces as targets of their own"
        )
    beyond = (target.centers[:, :2].abs() + target.radii[:, :1]).amax(0)
    if any(not reach <= side / 2 < math.inf for reach, side in zip(beyond.tolist(), plate, strict=True)):
        needed = " x ".join(f"{2 * reach:.4g}" for reach in beyond.tolist())
        raise ConfigError(
            f"plate: {plate[0]:g} x {plate[1]:g} mm does not hold the rings of {target.name}; give {needed} mm or more"
        )
    page_width = _STEP * math.ceil(max(plate[0] + 2 * _SIDE, _LEAST_PAGE) / _STEP)
    page_height = _STEP * math.ceil((plate[1] + _TOP + _BOTTOM) / _STEP)
    x, y = (page_width - plate[0]) / 2, _TOP
    origin = x + plate[0] / 2, y + plate[1] / 2
    shapes = [
        *_plate(target, x, y, plate),
        *_rings(target, origin),
        *_marks(x, y, plate),
        *_bar(x, y + plate[1] + _BAR_AWAY, _bar_length(plate[0]), upright=False),
        *_bar(x - _BAR_AWAY, y, _bar_length(plate[1]), upright=True),
        *_legend(target, plate, page_width, y + plate[1]),
    ]
    return Sheet(Page(target.name, page_width, page_height, (x, y, *plate), shapes), origin)


def _plate(target: Target, x: float, y: float, plate: tuple[float, float]) -> list[Shape]:
    if target.background == "dark":
        return [Rectangle(x - _BLEED, y - _BLEED, plate[0] + 2 * _BLEED, plate[1] + 2 * _BLEED, 0.0)]
    return _outline(x, y, *plate, grey=0.7)


def _outline(x: float, y: float, width: float, height: float, grey: float = 0.0) -> list[Shape]:
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]
    return [Line(*start, *end, grey=grey) for start, end in itertools.pairwise(corners)]


def _rings(target: Target, origin: tuple[float, float]) -> list[Shape]:
    ink, paper = (0.0, 1.0) if target.background == "light" else (1.0, 0.0)
    shapes: list[Shape] = []
    for (cx, cy, _), (outer, inner) in zip(target.centers.tolist(), target.radii.tolist(), strict=True):
        at = origin[0] + cx, origin[1] + cy
        shapes += [Circle(*at, outer, ink), Circle(*at, inner, paper)]
    return shapes


def _marks(x: float, y: float, plate: tuple[float, float]) -> list[Shape]:
    """Crop marks at the corners, and marks of the axes through the origin at the middle of each side."""
    near, far = _MARK_GAP, _MARK_GAP + _MARK
    right, bottom = x + plate[0], y + plate[1]
    shapes: list[Shape] = []
    for column in (x, (x + right) / 2, right):
        shapes += [Line(column, y - far, column, y - near), Line(column, bottom + near, column, bottom + far)]
    for row in (y, (y + bottom) / 2, bottom):
        shapes += [Line(x - far, row, x - near, row), Line(right + near, row, right + far, row)]
    shapes.append(Text(right + far + 1, (y + bottom) / 2 + 0.9, 2.5, "x"))
    shapes.append(Text((x + right) / 2 + 1, bottom + far, 2.5, "y"))
    return shapes


def _bar_length(side: float) -> float:
    return max(20.0, 10.0 * math.floor(side / 10))


def _bar(x: float, y: float, length: float, *, upright: bool) -> list[Shape]:
    """Ruler from x, y with a tick every 10 mm. The middles of its ticks count, which spreading ink does not move."""

    def line(u1: float, v1: float, u2: float, v2: float) -> Line:
        return Line(x - v1, y + u1, x - v2, y + u2, 0.15) if upright else Line(x + u1, y + v1, x + u2, y + v2, 0.15)

    shapes: list[Shape] = [line(0, 0, length, 0)]
    for k in range(round(length / 10) + 1):
        tall = 3.0 if 10 * k in (0, length) else 1.5
        shapes.append(line(10 * k, 0, 10 * k, tall))
    label = f"{length:g} mm"
    shapes.append(Text(x - 9, y - 1.5, 2.5, label) if upright else Text(x + length + 1.5, y + 2, 2.5, label))
    return shapes


def _needed(target: Target) -> str:
    """What the print has to hold for the accuracy that the target file claims."""
    if target.covariance is None:
        return "Print: its file claims it exact; add center_sigma, edge_gain_sigma."
    deviation = target.covariance.diagonal().sqrt()
    x, y, flat = deviation[:-1].unflatten(0, (-1, 3)).amax(0).tolist()
    off_plane = "" if flat == max(x, y) else f" ({1e3 * flat:.3g} along z)"
    return (
        f"Print: centres to {1e3 * max(x, y):.3g} um{off_plane}, edges to {1e3 * float(deviation[-1]):.3g} um, 1 sigma."
    )


def _legend(target: Target, plate: tuple[float, float], page_width: float, bottom: float) -> list[Shape]:
    """Name and how to print, and a plan of the ids without rings, which a camera would take for markers."""
    left, top = 6.0, bottom + _BAR_AWAY + 8
    bars = f"{_bar_length(plate[0]):g} mm (x), {_bar_length(plate[1]):g} mm (y)"
    ids = target.ids.tolist()
    words = (
        f"plate {plate[0]:g} x {plate[1]:g} mm, {len(ids)} rings, {target.background} background",
        f"ids {' '.join(map(str, ids))}, see the plan (side that the camera sees)",
        f"Print at 100 % (actual size); the bars must be {bars}.",
        _needed(target),
    )
    shapes: list[Shape] = [Text(left, top + 3, 4.0, target.name)]
    shapes += [Text(left, top + 8 + 4 * k, 2.5, line) for k, line in enumerate(words)]
    scale = min((_KEY - 6) / max(plate), 1.0)
    width, height = scale * plate[0], scale * plate[1]
    x, y = page_width - 6 - width, top
    shapes += _outline(x, y, width, height)
    for marker, (cx, cy) in zip(ids, target.centers[:, :2].tolist(), strict=True):
        at = x + width / 2 + scale * cx, y + height / 2 + scale * cy + 0.8
        shapes.append(Text(*at, 2.2, str(marker), number=True))
    return shapes
