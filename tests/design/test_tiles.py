"""Print sheets on office paper: the tiles, joined at their marks, are the sheet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchpose.cli.main import main
from torchpose.design import PAPERS, Sheet, make_sheet, plate_around, save_tiles, tile_sheet
from torchpose.design.drawing import Circle, Line, Window
from torchpose.errors import ConfigError
from torchpose.target import Target

DPI = 127  # five pixels a mm
PX = 5


def scaled(name: str, factor: float) -> Target:
    target = Target.load(name)
    return replace(target, centers=factor * target.centers, radii=factor * target.radii)


def sheet_of(factor: float, name: str = "quad40") -> Sheet:
    target = scaled(name, factor)
    return make_sheet(target, plate_around(target))


def raster(path: Path) -> list[np.ndarray]:
    pdfium = pytest.importorskip("pypdfium2")
    document = pdfium.PdfDocument(path)
    pages = [page.render(scale=DPI / 72, grayscale=True).to_numpy() for page in document]
    document.close()
    return [page.reshape(page.shape[:2]) for page in pages]


@pytest.mark.parametrize(("paper", "factor"), [("a4", 6.0), ("letter", 4.0), ("a4", 1.0)])
def test_tiles_joined_at_their_marks_are_the_sheet(paper: str, factor: float, tmp_path: Path) -> None:
    sheet = sheet_of(factor)
    (tmp_path / "whole.pdf").write_bytes(sheet.page.pdf())
    (whole,) = raster(tmp_path / "whole.pdf")
    pages = tile_sheet(sheet, paper)
    assert (len(pages) == 1) == (factor == 1.0)
    joined = np.full_like(whole, 127)
    for page, picture in zip(pages, raster(save_tiles(sheet, paper, tmp_path, "t")), strict=True):
        assert sorted((page.width, page.height)) == sorted(PAPERS[paper])
        assert picture.shape == (round(PX * page.height), round(PX * page.width))
        x, y, width, height = page.trim
        window = next(shape for shape in page.shapes if isinstance(shape, Window))
        left, top = x - window.dx, y - window.dy  # on the sheet
        # the resampling of a shift by parts of a pixel is compared away from the edges of ink
        rows = np.clip(np.round(PX * (top + np.array([0, height]))).astype(int), 0, len(whole))
        columns = np.clip(np.round(PX * (left + np.array([0, width]))).astype(int), 0, whole.shape[1])
        y0, x0 = round(PX * (y - top)), round(PX * (x - left))
        part = picture[rows[0] + y0 : rows[1] + y0, columns[0] + x0 : columns[1] + x0]
        joined[rows[0] : rows[1], columns[0] : columns[1]] = part
    apart = np.abs(joined.astype(int) - whole)
    ink = np.abs(np.gradient(whole.astype(float))).max(0) > 0
    near = np.max([np.roll(ink, (dy, dx), (0, 1)) for dy in (-2, 0, 2) for dx in (-2, 0, 2)], axis=0)
    near[-1], near[:, -1] = True, True  # the raster is rounded up to whole pixels
    assert (apart[~near] == 0).all()
    assert (~near).mean() > 0.5


@pytest.mark.parametrize("paper", PAPERS)
def test_joints_avoid_rings_and_pages_verify_their_scale(paper: str) -> None:
    sheet = sheet_of(6.0)
    circles = [shape for shape in sheet.page.shapes if isinstance(shape, Circle)]
    for page in tile_sheet(sheet, paper):
        x, y, width, height = page.trim
        window = next(shape for shape in page.shapes if isinstance(shape, Window))
        for circle in circles:
            for middle, start, side in (
                (circle.x + window.dx, x, width),
                (circle.y + window.dy, y, height),
            ):
                assert not any(abs(middle - end) < circle.radius for end in (start, start + side))
        bars = [one for one in page.shapes if isinstance(one, Line) and one.width == 0.15]
        assert max(abs(one.x2 - one.x1) for one in bars) >= 50
        assert max(abs(one.y2 - one.y1) for one in bars) >= 50
        marks = [one for one in page.shapes if isinstance(one, Line) and one.width != 0.15]
        ends = {(one.x1, one.x2) for one in marks if one.x1 == one.x2}
        assert ends == {(x, x), (x + width, x + width)}
        # within what printers print, and beside what is printed
        for one in (*bars, *marks):
            assert min(one.x1, one.x2, one.y1, one.y2) > 5
            assert max(one.x1, one.x2) < page.width - 5
            assert max(one.y1, one.y2) < page.height - 5


def test_the_command_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["design", "-t", "quad40", "-o", str(tmp_path / "out"), "--paper", "a4"])
    assert end.value.code == 0
    assert str(tmp_path / "out" / "quad40_a4.pdf") in capsys.readouterr().out
    assert (tmp_path / "out" / "quad40_a4.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(ConfigError, match="--paper: 'a0' is not known"):
        tile_sheet(sheet_of(1.0), "a0")
