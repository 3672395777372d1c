"""Print sheets: what is drawn is the target, to scale, in SVG and in PDF."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.design import PRINTS, PrintClass, Sheet, make_sheet, plate_around
from torchpose.design.drawing import Circle, Line, Page, Text
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.pipeline import PoseEstimator
from torchpose.results import Status
from torchpose.target import Target

SVG = "{http://www.w3.org/2000/svg}"
DPI = 1200


def rows_of(target: Target, sheet: Sheet) -> list[list[float]]:
    """Expected centre (x, y) on the page, outer and inner radius of every ring, mm."""
    centers = target.centers[:, :2] + torch.tensor(sheet.origin, dtype=torch.float64)
    return torch.cat([centers, target.radii], 1).tolist()


@pytest.mark.parametrize("name", ["quad8", "quad40", "quad40_dark", "hexa50"])
def test_svg_holds_the_target(name: str) -> None:
    target = Target.load(name)
    sheet = make_sheet(target, plate_around(target))
    root = ElementTree.fromstring(sheet.page.svg())
    # one unit is a mm
    _, _, width, height = root.attrib["viewBox"].split()
    assert root.attrib["width"] == width + "mm"
    assert root.attrib["height"] == height + "mm"
    circles = [tuple(float(c.attrib[k]) for k in ("cx", "cy", "r")) for c in root.iter(f"{SVG}circle")]
    colours = [c.get("fill") for c in root.iter(f"{SVG}circle")]
    expected = [one for x, y, outer, inner in rows_of(target, sheet) for one in ((x, y, outer), (x, y, inner))]
    assert np.allclose(circles, expected, atol=1e-8)
    ink, paper = ("#000000", "#ffffff") if target.background == "light" else ("#ffffff", "#000000")
    assert colours == [ink, paper] * len(target)
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert target.name in texts
    assert [t for t in texts if t and t.isdigit()] == [str(i) for i in target.ids.tolist()]


def test_bars_have_the_length_that_they_say() -> None:
    sheet = make_sheet(Target.load("quad40"), (75.0, 52.0))
    lines = [s for s in sheet.page.shapes if isinstance(s, Line)]
    # the longest line along each axis besides the outline, whose width is another
    bars = [line for line in lines if line.width == 0.15]
    assert max(abs(b.x2 - b.x1) for b in bars) == 70
    assert max(abs(b.y2 - b.y1) for b in bars) == 50
    texts = [s.text for s in sheet.page.shapes if isinstance(s, Text)]
    assert "70 mm" in texts
    assert "50 mm" in texts
    assert any("70 mm (x), 50 mm (y)" in text for text in texts)


def test_the_sheet_says_what_the_print_has_to_hold() -> None:
    def last(target: Target) -> str:
        words = [s for s in make_sheet(target, (75.0, 52.0)).page.shapes if isinstance(s, Text) and "Print:" in s.text]
        # beside the plan of the ids and above the edge of the page
        assert len(words) == 1
        page = make_sheet(target, (75.0, 52.0)).page
        assert words[0].y < page.height - 1
        width = (
            cv2.getTextSize(words[0].text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)[0][0] / 30 * words[0].size
        )  # wider letters
        assert words[0].x + width < page.width - 28
        return words[0].text

    assert last(Target.load("quad40")) == "Print: its file claims it exact; add center_sigma, edge_gain_sigma."
    glass, bent = PRINTS["plotter"], PrintClass(0.02, 0.015, 0.04)
    assert last(glass.stated_by(Target.load("quad40"))) == "Print: centres to 10 um, edges to 15 um, 1 sigma."
    assert "to 20 um (40 along z), edges to 15 um" in last(bent.stated_by(Target.load("quad40")))


@pytest.mark.parametrize("name", ["quad8", "quad40_dark"])
def test_nothing_but_rings_lies_within_the_plate(name: str) -> None:
    target = Target.load(name)
    sheet = make_sheet(target, plate_around(target))
    x, y, width, height = sheet.page.trim
    assert (x + width / 2, y + height / 2) == pytest.approx(sheet.origin)
    for shape in sheet.page.shapes:
        if isinstance(shape, Line):
            inside = all(
                x + 0.01 < (shape.x1 + part * (shape.x2 - shape.x1)) < x + width - 0.01
                and y + 0.01 < (shape.y1 + part * (shape.y2 - shape.y1)) < y + height - 0.01
                for part in (0.25, 0.5, 0.75)
            )
            assert not inside
        elif isinstance(shape, Text):
            assert shape.y - shape.size > y + height or shape.x > x + width or shape.x < x - 5
    # all of it on the page
    for shape in sheet.page.shapes:
        if isinstance(shape, Text):
            assert 0 < shape.x < sheet.page.width
            assert 0 < shape.y < sheet.page.height


def test_pdf_circles_are_round() -> None:
    page = Page("one", 60.0, 60.0, (10.0, 10.0, 40.0, 40.0), [Circle(30.0, 28.0, 7.0, 0.0)])
    content = page.pdf().split(b"stream\n")[1].decode()
    numbers = [float(n) for n in re.findall(r"g ([\d. -]+) m", content)[0].split()]
    at = np.array(numbers)
    worst = 0.0
    curves = re.findall(r"([\d.\- ]+) c\b(?!m)", content)
    assert len(curves) == 8
    for curve in curves:
        p = np.array(curve.split(), float).reshape(3, 2)
        s = np.linspace(0, 1, 21)[:, None]
        points = (1 - s) ** 3 * at + 3 * (1 - s) ** 2 * s * p[0] + 3 * (1 - s) * s**2 * p[1] + s**3 * p[2]
        worst = max(worst, np.abs(np.hypot(points[:, 0] - 30, points[:, 1] - 28) - 7).max())
        at = p[2]
    assert worst < 7 * 5e-6


def test_pdf_is_well_formed() -> None:
    target = replace(Target.load("quad40"), name="a(b) & größer")
    data = make_sheet(target, (70.0, 70.0)).page.pdf()
    assert data.startswith(b"%PDF-1.6")
    start = int(data.split(b"startxref\n")[1].split()[0])
    assert data[start:].startswith(b"xref")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", data), 1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)
    length = int(re.findall(rb"/Length (\d+)", data)[0])
    body = data.split(b"stream\n", 1)[1]
    assert body[length : length + 10] == b"\nendstream"
    assert rb"(a\(b\) & gr\366\337er)".replace(rb"\366", b"\xf6").replace(rb"\337", b"\xdf") in data
    box = [float(n) for n in re.findall(rb"/MediaBox \[([\d. ]+)\]", data)[0].split()]
    page = make_sheet(target, (70.0, 70.0)).page
    assert box == pytest.approx([0, 0, page.width * 72 / 25.4, page.height * 72 / 25.4], abs=1e-3)
    assert b"/PrintScaling /None" in data
    ElementTree.fromstring(page.svg())


@pytest.mark.parametrize(
    ("name", "plate"),
    [("quad40", (70.0, 70.0)), ("quad8", None), pytest.param("quad40_dark", None, marks=pytest.mark.slow)],
)
def test_rasterised_pdf_measures_as_the_target_file(
    name: str, plate: tuple[float, float] | None, tmp_path: Path
) -> None:
    pdfium = pytest.importorskip("pypdfium2")
    target = Target.load(name)
    sheet = make_sheet(target, plate or plate_around(target))
    _, path = sheet.save(tmp_path, name)
    document = pdfium.PdfDocument(path)
    width, height = document[0].get_size()
    assert (width / 72 * 25.4, height / 72 * 25.4) == pytest.approx((sheet.page.width, sheet.page.height), abs=1e-3)
    picture = document[0].render(scale=DPI / 72, grayscale=True).to_numpy()
    document.close()
    picture = picture.reshape(picture.shape[:2])
    assert picture.shape == (round(height / 72 * DPI), round(width / 72 * DPI))
    cv2.imwrite(str(tmp_path / "sheet.png"), picture)
    with pytest.raises(SystemExit) as end:
        main(["detect", str(tmp_path / "sheet.png"), "--out", str(tmp_path / "shapes.csv"), "--quiet"])
    assert end.value.code == 0
    with (tmp_path / "shapes.csv").open(newline="") as file:
        found = [
            [float(row[k]) for k in ("cx", "cy", "a", "b")] for row in csv.DictReader(file) if row["kind"] == "ellipse"
        ]
    ellipses = np.array(found)
    # pixel 0 spans the first 1/1200 inch
    mm = (ellipses + np.array([0.5, 0.5, 0, 0])) * 25.4 / DPI
    for x, y, outer, inner in rows_of(target, sheet):
        near = np.hypot(mm[:, 0] - x, mm[:, 1] - y) < 0.01
        for radius in (outer, inner):
            assert (near & (np.abs(mm[:, 2:] - radius) < 0.01).all(1)).any(), (x, y, radius)


@pytest.mark.parametrize("name", ["quad40", "quad40_dark", "hexa50"])
def test_a_camera_that_faces_the_sheet_reads_its_ids(name: str, tmp_path: Path) -> None:
    pdfium = pytest.importorskip("pypdfium2")
    target, dpi, distance = Target.load(name), 200, 160.0
    sheet = make_sheet(target, plate_around(target))
    _, path = sheet.save(tmp_path, name)
    document = pdfium.PdfDocument(path)
    picture = document[0].render(scale=dpi / 72, grayscale=True).to_numpy()
    document.close()
    # a raster is the frame of a camera of this focal length that faces the page
    height, width = picture.shape[:2]
    middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2, :2] *= distance * dpi / 25.4
    matrix[:2, 2] = middle
    frame = torch.from_numpy(picture.reshape(1, height, width).copy())
    poses = PoseEstimator(Camera(width, height, matrix, torch.zeros(0)), target)(frame)
    assert poses.status.tolist() == [Status.OK]
    assert poses.markers.tolist() == [len(target)]
    expected = [*(torch.tensor(sheet.origin) - (middle + 0.5) * 25.4 / dpi).tolist(), distance]
    assert poses.t[0].tolist() == pytest.approx(expected, abs=0.01)
    assert rotations.log(poses.R)[0].abs().max() < 1e-3


def test_targets_that_are_not_flat_are_refused() -> None:
    target = Target.load("quad40")
    high = replace(target, centers=target.centers + torch.tensor([0, 0, 1.0], dtype=torch.float64))
    away = replace(target, normals=-target.normals)
    for wrong in (high, away):
        with pytest.raises(ConfigError, match="plane z = 0"):
            make_sheet(wrong, (70.0, 70.0))


@pytest.mark.parametrize("plate", [(49.0, 70.0), (70.0, 10.0), (math.nan, 70.0), (math.inf, 70.0)])
def test_plates_that_do_not_hold_the_rings_are_refused(plate: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="does not hold the rings of quad40; give 50 x 50 mm"):
        make_sheet(Target.load("quad40"), plate)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        make_sheet(Target.load("quad8"), (20.0, 20.0)).save(tmp_path / "none", "quad8")
