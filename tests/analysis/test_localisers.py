"""Localisers of marks on exact geometry, and on rendered frames against the bound."""

from __future__ import annotations

import math

import pytest
import torch

from torchpose.analysis import localisers
from torchpose.analysis.marks import circles, cross, cross_extent, ink, marks
from torchpose.geometry import rotations
from torchpose.sim import render
from torchpose.sim.shapes import cat
from torchpose.studies import fig05_recognition as recognition
from torchpose.studies import fig05_shapes as study
from torchpose.studies.fig05_shapes import AREA_MM2, Condition
from torchpose.target import Target

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")
F64 = torch.float64


def test_the_diagonals_of_a_square_in_perspective_meet_in_its_centre() -> None:
    corner = torch.tensor([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], dtype=F64)
    x = corner @ rotations.exp(torch.tensor([0.6, 0.3, 0.2], dtype=F64)).T + torch.tensor([1.0, 2, 40], dtype=F64)
    image = 800 * x[:, :2] / x[:, 2:]
    points = torch.nn.functional.pad(image, (0, 1), value=1.0)
    sides = torch.linalg.cross(points, points.roll(-1, 0))
    assert localisers.diagonals(sides[None])[0].tolist() == pytest.approx([800 / 40, 1600 / 40])
    assert (image.mean(0) - localisers.diagonals(sides)).norm() > 0.1


def test_lines_are_fitted_through_outliers() -> None:
    g = torch.Generator().manual_seed(0)
    u = torch.linspace(0, 40, 60, dtype=F64)
    points = torch.stack([u, 3 + 0.2 * u + 0.02 * torch.randn(60, generator=g, dtype=F64)], -1)
    points[::10, 1] += 1.8
    edges = localisers.EdgePoints(points, torch.zeros(60, dtype=torch.int64), 2)
    line, weight = localisers.fit_lines(edges)
    assert float(-line[0, 0] / line[0, 1]) == pytest.approx(0.2, abs=1e-3)
    assert float(-line[0, 2] / line[0, 1]) == pytest.approx(3, abs=0.02)
    assert 50 < weight[0] < 57
    assert line[1].isnan().all()


def test_the_convex_hulls_have_equal_areas_and_a_cross_of_half_bars_covers_three_quarters() -> None:
    for bar in (0.1, 0.5, 0.9):
        extent = cross_extent(AREA_MM2, bar)
        corner = extent * (1 - bar) / 2
        assert extent**2 - 2 * corner**2 == pytest.approx(AREA_MM2)
    assert ink(0.5) == 0.75
    by = {mark.name: mark.edges for mark in marks(AREA_MM2)}
    radius = by["filled circle"].norm(dim=-1).amax()
    side = by["rectangle"].abs().amax() * 2
    assert math.pi * float(radius) ** 2 == pytest.approx(float(side) ** 2) == pytest.approx(AREA_MM2)


def test_the_bound_of_a_circle_is_known() -> None:
    angle = torch.linspace(0, 2 * math.pi, 400, dtype=F64)
    outline = 30 * torch.stack([angle.cos(), angle.sin()], -1)[None, None]
    assert float(localisers.centre_bound(outline, 0.1)) == pytest.approx(0.1 / math.sqrt(math.pi * 30), rel=1e-3)


@pytest.mark.parametrize("index", range(5))
def test_every_mark_is_found_without_tilt(index: int) -> None:
    mark = marks(AREA_MM2)[index]
    found = study.accuracy(mark, Condition(), 6, 0)
    assert found["lost"] == 0
    assert found["bound_px"] < 0.003
    assert found["bound_px"] * 0.5 < found["rms_px"] < 0.03


def test_tilt_moves_the_centre_of_a_circle_but_not_those_of_rings_and_squares() -> None:
    by = {mark.name: study.accuracy(mark, Condition(tilt=40), 6, 1)["rms_px"] for mark in marks(AREA_MM2)[1:4]}
    assert by["filled circle"] > 0.1
    assert by["concentric rings"] < 0.03
    assert by["rectangle"] < 0.03


def test_distortion_that_is_not_taken_off_moves_centres() -> None:
    disc = marks(AREA_MM2)[1]
    assert study.accuracy(disc, Condition(distortion=-0.1, corrected=False), 4, 1)["rms_px"] > 0.05
    assert study.accuracy(disc, Condition(distortion=-0.1), 4, 1)["rms_px"] < 0.02


def test_the_centroid_of_a_cross_is_found() -> None:
    row = study.bar_row(0.5, 6, 0)
    assert row["ink_over_square"] == 0.75
    assert row["centroid_rms_px"] < 0.02
    assert row["edges_rms_px"] < 0.05


@pytest.mark.parametrize("name", ["concentric rings", "cross"])
def test_codes_are_read_at_a_tilt(name: str) -> None:
    code = 0.4
    mark = cross(AREA_MM2, code, 150)
    read = recognition.read_cross
    if name == "concentric rings":
        mark, read = (
            circles("rings", (recognition.RADIUS_MM, code * recognition.RADIUS_MM), 150),
            recognition.read_rings,
        )
    seen = study.view(Condition(tilt=25), 4, 0)
    frames = study.pictures(mark, Condition(), seen, 0)
    outline, _ = study.outlines(mark, seen)
    value = read(localisers.edge_points(frames, outline, 0.7), outline)
    assert (value - code).abs().max() < 0.01


def test_marks_without_clutter_are_recognised_and_nothing_else() -> None:
    target = Target.load("quad40")
    camera = recognition.frame_camera()
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 160]], dtype=F64)
    find = recognition.RECOGNISERS
    for mark in marks(recognition.AREA_MM2):
        drawn = cat([mark.draw(30.0, (x, y)) for x, y, _ in target.centers.tolist()])
        images = render(camera, drawn, R, t).round().to(torch.uint8)
        found = find[mark.name](images, camera)[0]
        truth = camera.project(target.centers + t)
        assert len(found) == 4, mark.name
        assert (torch.cdist(truth, found.double()).amin(1) < 2).all(), mark.name


def test_capacity_counts_the_codes_that_fit() -> None:
    rows = {(row["mark"], row["noise"]): row for row in recognition.capacities(2, 0)}
    ring = rows["concentric rings", 2.0]
    assert ring["codes"] == 1 + int(0.75 / (6 * ring["rms"]))
    assert ring["codes"] > rows["rectangle", 2.0]["codes"] > rows["filled circle", 2.0]["codes"] == 1
