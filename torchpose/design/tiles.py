"""A print sheet on office paper: on one page where it fits, else in tiles that are cut and joined at marks.

Every page has two bars to verify its scale and marks where its tile ends. Ink goes on a little beyond them: one page of
two that meet is cut at its marks and laid on the other's. Joints avoid rings where the paper leaves a choice: what is
joined by hand is off by what the hand is off, and within a ring the measurement would take that for its shape.
"""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

from torchpose.design.drawing import Circle, Line, Page, Shape, Text, Window, pdf_of
from torchpose.design.sheet import Sheet
from torchpose.errors import ConfigError
from torchpose.geometry.arguments import checked
from torchpose.io.writers import atomic_path, make_folder_of

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
"""Width and height in mm, upright."""
_MARGIN = 17.0  # mm (convention): what printers leave white is less, and marks and bars fit in
_BLEED = 3.0  # mm of ink beyond the marks (convention)
_MARK = 6.0  # length of a mark, mm
_CLEAR = 1.0  # mm between a joint and a ring (convention)
_BAR = 100.0  # mm, or as many whole centimetres as the tile has


@checked
def tile_sheet(sheet: Sheet, paper: str) -> list[Page]:
    """Pages of a paper, ``a4`` or ``letter``, upright or across, whichever takes fewer. ConfigError: another paper."""
    if paper not in PAPERS:
        raise ConfigError(f"--paper: {paper!r} is not known; choose one of {', '.join(PAPERS)}")
    width, height = PAPERS[paper]
    ways = [_tiles(sheet, size) for size in ((width, height), (height, width))]
    return min(ways, key=len)


@checked
def save_tiles(sheet: Sheet, paper: str, folder: Path, name: str) -> Path:
    """Writes ``name``_PAPER.pdf; its path. ConfigError: another paper, or the folder cannot be written."""
    path = folder / f"{name}_{paper}.pdf"
    data = pdf_of(tile_sheet(sheet, paper))
    make_folder_of(path, "--out")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def _tiles(sheet: Sheet, size: tuple[float, float]) -> list[Page]:
    """The pages, row by row, of a width and height."""
    whole = sheet.page
    rings = [shape for shape in whole.shapes if isinstance(shape, Circle)]
    across = _joints(whole.width, size[0] - 2 * _MARGIN, [(ring.x, ring.radius) for ring in rings])
    down = _joints(whole.height, size[1] - 2 * _MARGIN, [(ring.y, ring.radius) for ring in rings])
    columns, rows = list(itertools.pairwise(across)), list(itertools.pairwise(down))
    pages: list[Page] = []
    for row, (top, bottom) in enumerate(rows, 1):
        for column, (left, right) in enumerate(columns, 1):
            number, count = len(pages) + 1, len(rows) * len(columns)
            told = (
                f"{whole.title}: page {number} of {count}, row {row} of {len(rows)}, column {column} of {len(columns)}"
            )
            pages.append(_page(whole, size, (left, top, right - left, bottom - top), told))
    return pages


def _joints(length: float, most: float, rings: Sequence[tuple[float, float]]) -> list[float]:
    """Where tiles end along an axis, from 0 to ``length``: as few as there may be, as even as rings allow.

    Args:
        length: of the sheet.
        most: of a tile.
        rings: middle and radius of each.
    """
    count = math.ceil(length / most - 1e-9)
    edges = [middle + side * (radius + _CLEAR) for middle, radius in rings for side in (-1, 1)]
    ends = [0.0]
    for left in range(count - 1, 0, -1):
        even = ends[-1] + (length - ends[-1]) / (left + 1)
        first, last = length - left * most, ends[-1] + most
        free = [
            end
            for end in [even, *edges]
            if first <= end <= last and all(abs(end - m) > r + _CLEAR - 1e-6 for m, r in rings)
        ]
        ends.append(min(free, key=lambda end: abs(end - even), default=even))
    return [*ends, length]


def _page(whole: Page, size: tuple[float, float], part: tuple[float, float, float, float], told: str) -> Page:
    """The page that shows ``part`` (x, y, width, height) of the sheet."""
    left, top, width, height = part
    x, y = _MARGIN, _MARGIN
    window = Window(
        *(x - _BLEED, y - _BLEED, width + 2 * _BLEED, height + 2 * _BLEED), x - left, y - top, list(whole.shapes)
    )
    shapes: list[Shape] = [window]
    for column in (x, x + width):
        for start, step in ((y - _BLEED - 1, -_MARK), (y + height + _BLEED + 1, _MARK)):
            shapes.append(Line(column, start, column, start + step))
    for row in (y, y + height):
        for start, step in ((x - _BLEED - 1, -_MARK), (x + width + _BLEED + 1, _MARK)):
            shapes.append(Line(start, row, start + step, row))
    bottom = y + height + _BLEED + 4
    along, upright = (min(_BAR, 10.0 * ((side - 10.0) // 10.0)) for side in (width, height))
    shapes += _bar(x + 5, bottom, along, upright=False)
    shapes += _bar(x - _BLEED - 4, y + 5, upright, upright=True)
    shapes.append(Text(x + 5, bottom + 6, 2.5, f"{told}. Print at 100 %; bars {along:g} and {upright:g} mm."))
    return Page(whole.title, *size, (x, y, width, height), shapes)


def _bar(x: float, y: float, length: float, *, upright: bool) -> list[Shape]:
    """A bar with ticks whose middles count, as those of the sheet."""
    if length <= 0:
        return []
    ends = [(x, y, x, y + length)] if upright else [(x, y, x + length, y)]
    for place in (0.0, length / 2, length):
        ends.append((x - 2, y + place, x, y + place) if upright else (x + place, y, x + place, y + 2))
    return [Line(*one, 0.15) for one in ends]
