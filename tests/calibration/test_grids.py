"""Boards of discs and rings against rendered truth and OpenCV's order."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.calibration import board_scenes as boards
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration.grids import Grid, Marks, find_marks, measure_marks
from torchpose.calibration.session import parse_board
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render
from torchpose.sim.shapes import rectangle

F64 = torch.float64
CAMERA = scenes.camera([-0.2, 0.05, 2e-4, -1.5e-4], scale=0.5)
ROUGH = tp.Camera.ideal(CAMERA.width, CAMERA.height, CAMERA.width)


def board(text: str) -> Grid:
    found = parse_board(text)
    assert isinstance(found, Grid)
    return found


def tilted(count: int, *, aside: tuple[float, float] = (0.0, 0.0), tilt: float = 35.0) -> tuple[Tensor, Tensor]:
    """Poses about upright, so that rows point to the right; ``aside`` mm."""
    azimuth = 2 * torch.pi * torch.arange(count, dtype=F64) / count
    R = rotations.exp(np.deg2rad(tilt) * torch.stack([azimuth.cos(), azimuth.sin(), 0.4 * azimuth.sin()], -1))
    return R, torch.tensor([[*aside, 165.0]], dtype=F64).repeat(count, 1)


def names(count: int) -> list[str]:
    return [f"{k}.png" for k in range(count)]


def check_numbers(marks: Marks, seen: Tensor) -> None:
    """Every mark has the number of the mark that it is."""
    away = torch.linalg.vector_norm(marks.center - seen[marks.view, marks.point], dim=-1)
    assert float(away.max()) < 1.0


@pytest.mark.parametrize(
    ("text", "outer", "inner"),
    [("circles:9x7:8mm", 2.5, 0.0), ("acircles:4x11:5", 2.0, 0.0), ("rings:9x7:8mm:3mm:1.5mm", 3.0, 1.5)],
)
@pytest.mark.parametrize(("level", "paper"), [(30.0, 220.0), (220.0, 30.0)])
def test_whole_boards(text: str, outer: float, inner: float, level: float, paper: float) -> None:
    grid = board(text)
    R, t = tilted(3)
    frames = boards.photographs(CAMERA, boards.shapes(grid, outer, inner, level), R, t, paper=paper)
    marks = find_marks(names(3), frames, grid, ROUGH)
    seen = boards.centers(CAMERA, grid, R, t)
    assert torch.bincount(marks.view).tolist() == [len(grid.points)] * 3
    check_numbers(marks, seen)
    views = measure_marks(names(3), frames, marks, grid, CAMERA)
    assert torch.bincount(views.view).tolist() == [len(grid.points)] * 3
    error = views.pixels - seen[views.view, views.point]
    chi2 = (error * torch.linalg.solve(views.covariance, error)).sum(-1)
    # mean of K chi-squared of 2: 2 +- 2 / sqrt(K), five of these and a fifth for the model
    assert abs(float(chi2.mean()) / 2 - 1) < 5 / len(chi2) ** 0.5 + 0.2
    assert float(error.square().sum(-1).mean().sqrt()) < 0.006


def test_opencv_orders_the_asymmetric_grid_the_same_way() -> None:
    grid = board("acircles:4x11:5mm")
    R, t = tilted(1, tilt=20)
    frames = boards.photographs(CAMERA, boards.shapes(grid, 2.0), R, t)
    marks = find_marks(names(1), frames, grid, ROUGH)
    found, centers = cv2.findCirclesGrid(frames[0].numpy(), (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    assert marks.point.tolist() == list(range(44))
    assert float(np.abs(centers.reshape(-1, 2) - marks.center.numpy()).max()) < 0.5
    # OpenCV's tutorial: ((2 j + i % 2) pitch, i pitch)
    assert grid.points[[0, 1, 4, 43], :2].tolist() == [[0, 0], [10, 0], [5, 5], [30, 50]]


@pytest.mark.parametrize("text", ["circles:9x7:8mm", "acircles:4x11:5mm"])
@pytest.mark.parametrize("aside", [(-95.0, 0.0), (80.0, 55.0)])
def test_boards_that_the_border_cuts(text: str, aside: tuple[float, float]) -> None:
    grid = board(text)
    R, t = tilted(3, aside=aside)
    frames = boards.photographs(CAMERA, boards.shapes(grid, 2.0), R, t)
    marks = find_marks(names(3), frames, grid, ROUGH)
    assert 18 <= len(marks) < 3 * len(grid.points)
    check_numbers(marks, boards.centers(CAMERA, grid, R, t))


def test_boards_of_which_a_row_is_covered() -> None:
    """A row in the middle hides nothing that is not known; a first row might as well be missing as a last one."""
    grid = board("circles:9x7:8mm")
    R, t = tilted(2, tilt=10)
    for y, clear in ((0.0, True), (-24.0, False)):
        cover = rectangle((0.0, y), 90, 7, level=120)
        drawn = boards.shapes(grid, 2.5)
        frames = torch.cat([render(CAMERA, drawn, R[k : k + 1], t[k : k + 1], covers=cover) for k in range(2)])
        marks = find_marks(names(2), add_noise(frames, 1.0), grid, ROUGH)
        assert len(marks) == (2 * 54 if clear else 0)
        if clear:
            check_numbers(marks, boards.centers(CAMERA, grid, R, t))


@pytest.mark.parametrize("diameter", [5.3, 6.0, 7.0])
def test_small_dots_of_large_frames(diameter: float) -> None:
    """Frames of 2 megapixels are reduced by 2 before the search: such dots are lost, and looked for again."""
    camera = scenes.camera([-0.2, 0.05, 2e-4, -1.5e-4])
    grid = board("circles:9x7:4mm")
    R, t = tilted(2, tilt=15)
    frames = boards.photographs(camera, boards.shapes(grid, diameter / 2 * 165 / 1500), R, t)
    marks = find_marks(names(2), frames, grid, tp.Camera.ideal(camera.width, camera.height, camera.width))
    seen = boards.centers(camera, grid, R, t)
    check_numbers(marks, seen)
    views = measure_marks(names(2), frames, marks, grid, camera)
    # of a dot as small as this the grey values hardly tell size from contrast, and one fit may wander off
    assert len(views.view) >= 2 * 63 - 1
    assert float((views.pixels - seen[views.view, views.point]).norm(dim=-1).max()) < 0.07


def test_symmetries() -> None:
    assert board("acircles:4x11:5mm").symmetries.tolist() == [True, False, False, False]
    assert board("acircles:4x10:5mm").symmetries.tolist() == [True, False, True, False]
    assert board("circles:9x7:8mm").symmetries.tolist() == [True, False, True, False]
    assert board("circles:7x7:8mm").symmetries.tolist() == [True] * 4


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("circles:9x7", "is no grid"),
        ("circles:9x7:8:3:1", "is no grid"),
        ("rings:9x7:8mm", "is no grid"),
        ("rings:9x7:8:5:2", "below half the pitch"),
        ("rings:9x7:8:2:3", "smaller inner one"),
        ("circles:2x7:8", "3 x 3 marks"),
        ("dots:9x7:8", "is no board"),
    ],
)
def test_bad_boards(text: str, word: str) -> None:
    with pytest.raises(tp.ConfigError, match=word):
        parse_board(text)
