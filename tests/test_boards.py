"""Boards of equal rings and discs as targets of the estimator: poses against rendered truth, and which way round."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.calibration import board_scenes as boards
from tests.calibration import calibration_scenes as scenes
from torchpose.geometry import rotations
from torchpose.grids import Grid
from torchpose.pose.sizes import sizes_beyond
from torchpose.sim.shapes import Shapes, ring

F64 = torch.float64
CAMERA = scenes.camera([-0.2, 0.05, 2e-4, -1.5e-4], scale=0.4)
RINGS = "rings:5x4:8mm:3mm:1.5mm"


def views(count: int, *, turned: float = 0.0) -> tuple[Tensor, Tensor]:
    """Poses of the board's middle, tilted by 30 degrees, ``turned`` in its plane, degrees."""
    azimuth = 2 * torch.pi * torch.arange(count, dtype=F64) / count + 0.3
    tilt = rotations.exp(np.deg2rad(30) * torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], -1))
    turn = rotations.exp(torch.tensor([0.0, 0.0, np.deg2rad(turned)], dtype=F64))
    return tilt @ turn, torch.tensor([[2.0, -3.0, 120.0]], dtype=F64).repeat(count, 1)


def taken(target: tp.Target, R: Tensor, t: Tensor) -> Tensor:
    """Frames of the board whose marks are where the target has them."""
    assert target.grid is not None
    middle = boards.middle(target.grid)
    marks = zip((target.centers - middle).tolist(), target.radii.tolist(), strict=True)
    drawn = Shapes.cat([ring((x, y), outer, inner) for (x, y, _), (outer, inner) in marks])
    return boards.photographs(CAMERA, drawn, R, t)


def errors(poses: tp.Poses, grid: Grid, R: Tensor, t: Tensor) -> Tensor:
    """(N, 6): translation of the board's origin, mm, and rotation."""
    return torch.cat([poses.t - (t - R @ boards.middle(grid)), rotations.log(poses.R @ R.mT)], -1)


@pytest.mark.parametrize(
    ("text", "status"),
    [
        (RINGS, tp.Status.AMBIGUOUS),
        ("circles:5x4:8mm:2.5mm", tp.Status.AMBIGUOUS),
        ("acircles:3x6:6mm:2mm", tp.Status.AMBIGUOUS),  # an even number of rows looks the same after half a turn
        ("acircles:3x7:5mm:2mm", tp.Status.OK),
    ],
)
def test_poses_of_boards(text: str, status: tp.Status) -> None:
    target = tp.Target.load(text)
    grid = target.grid
    assert grid is not None
    R, t = views(3)
    poses = tp.PoseEstimator(CAMERA, target)(taken(target, R, t))
    assert poses.status.tolist() == [status] * 3
    assert poses.markers.tolist() == [len(grid)] * 3
    error = errors(poses, grid, R, t)
    chi2 = (error * torch.linalg.solve(poses.covariance, error)).sum(-1)
    assert float(chi2.sum()) < 18 + 4 * 36**0.5
    assert float(error[:, :3].norm(dim=-1).max()) < 5e-3
    # noise alone: the file and the camera claim to be exact
    torch.testing.assert_close(poses.noise, poses.covariance)
    if status == tp.Status.AMBIGUOUS:  # the other pose has the board turned by half about its middle
        turned = poses.R @ torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=F64))
        torch.testing.assert_close(poses.R_alt, turned)
        middle = boards.middle(grid)
        torch.testing.assert_close(poses.R_alt @ middle + poses.t_alt, poses.R @ middle + poses.t)
    upright = tp.PoseEstimator(CAMERA, target.upright())(taken(target, R, t))
    assert upright.status.tolist() == [tp.Status.OK] * 3
    torch.testing.assert_close(upright.R, poses.R)


@pytest.mark.parametrize("larger", [0.94, 1.06])
def test_discs_of_another_size_than_the_file_s(larger: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit begins on the right side, near the truth, and ends there: grey values and not centres alone tell."""
    target = tp.Target.load("acircles:3x7:5mm:2mm")
    assert target.grid is not None
    starts: list[Tensor] = []

    def recorded(*args: Tensor) -> tuple[Tensor, Tensor]:
        starts.append(sizes_beyond(*args)[1])  # type: ignore[arg-type]
        return sizes_beyond(*args)  # type: ignore[arg-type]

    monkeypatch.setattr("torchpose.pose.solve.sizes_beyond", recorded)
    R, t = views(2)
    poses = tp.PoseEstimator(CAMERA, target)(taken(replace(target, radii=larger * target.radii), R, t))
    off = 2.0 * (larger - 1)
    torch.testing.assert_close(starts[0], torch.full((2,), off, dtype=F64), rtol=0.2, atol=0)
    # of a disc the gain is a size
    edges = poses.place[..., 3:].sum(-1)
    torch.testing.assert_close(edges, torch.full_like(edges, off), rtol=0.02, atol=0)
    error = errors(poses, target.grid, R, t)
    assert float((error * torch.linalg.solve(poses.covariance, error)).sum()) < 12 + 4 * 24**0.5
    assert float(poses.std[:, 2].max()) < 5e-3


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_one_mark_that_is_missing_tells_which_way_round(turned: float) -> None:
    target = tp.Target.load(RINGS).of_markers(torch.arange(20) != 3)
    grid = target.grid
    assert grid is not None
    R, t = views(2, turned=turned)
    poses = tp.PoseEstimator(CAMERA, target)(taken(target, R, t))
    assert poses.status.tolist() == [tp.Status.OK] * 2
    assert float(errors(poses, grid, R, t)[:, :3].norm(dim=-1).max()) < 5e-3


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_measured_places_tell_which_way_round(turned: float) -> None:
    nominal = tp.Target.load(RINGS)
    grid = nominal.grid
    assert grid is not None
    off = 0.03 * torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    off[:, 2] = 0
    known = torch.diag(torch.tensor([1e-3] * 60 + [0.0], dtype=F64).square())
    printed = replace(nominal, centers=nominal.centers + off)
    R, t = views(2, turned=turned)
    frames = taken(printed, R, t)
    poses = tp.PoseEstimator(CAMERA, replace(printed, covariance=known))(frames)
    assert poses.status.tolist() == [tp.Status.OK] * 2
    assert float(errors(poses, grid, R, t)[:, :3].norm(dim=-1).max()) < 5e-3
    assert (poses.covariance - poses.noise).diagonal(dim1=-2, dim2=-1).min() > 0  # the places are part of it
    # places that are known no better than they are off tell nothing
    vague = replace(nominal, covariance=torch.diag(torch.tensor([0.1] * 60 + [0.0], dtype=F64).square()))
    assert tp.PoseEstimator(CAMERA, vague)(frames).status.tolist() == [tp.Status.AMBIGUOUS] * 2


def test_a_board_beside_a_coded_target() -> None:
    coded = tp.Target.load("quad8")
    board = tp.Target.load("rings:3x4:5mm:2mm:1mm")
    assert board.grid is not None
    R, t = views(1)
    moved = board.centers - boards.middle(board.grid) + torch.tensor([14.0, 0, 0], dtype=F64)
    coded_marks = zip(coded.centers.tolist(), coded.radii.tolist(), strict=True)
    coded_marks = zip(coded.centers.tolist(), coded.radii.tolist(), strict=True)
    marks = [*zip(moved.tolist(), board.radii.tolist(), strict=True)]
    marks += [((x - 14, y, z), radii) for (x, y, z), radii in coded_marks]
    drawn = Shapes.cat([ring((x, y), outer, inner) for (x, y, _), (outer, inner) in marks])
    frames = boards.photographs(CAMERA, drawn, R, t)
    poses = tp.PoseEstimator(CAMERA, [coded, board.upright()])(frames)
    assert poses.status.tolist() == [tp.Status.OK] * 2
    seen = (poses.R @ torch.stack([coded.centers[0], board.centers[0]])[..., None])[..., 0] + poses.t
    true = torch.stack([coded.centers[0] - torch.tensor([14.0, 0, 0], dtype=F64), moved[0]]) @ R[0].T + t
    assert float((seen - true).norm(dim=-1).max()) < 0.03


def test_no_board_in_view() -> None:
    frames = torch.full((1, CAMERA.height, CAMERA.width), 200, dtype=torch.uint8)
    poses = tp.PoseEstimator(CAMERA, tp.Target.load(RINGS))(frames)
    assert poses.status.tolist() == [tp.Status.NO_TARGET]


@pytest.mark.parametrize("text", [RINGS, "circles:5x4:8mm:2.5mm", "acircles:3x7:5mm:2mm"])
def test_files_of_boards(tmp_path: Path, text: str) -> None:
    target = tp.Target.load(text).of_markers(torch.arange(20 if "3x7" not in text else 21) != 7)
    target.save(tmp_path / "board.yaml")
    again = tp.Target.load(tmp_path / "board.yaml")
    assert again.grid == target.grid
    assert str(again.grid) == text
    assert again.ids.tolist() == [k for k in range(len(target) + 1) if k != 7]
    torch.testing.assert_close(again.radii, target.radii, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("rings:5x4", "rings:4x4", "id 19 is not on the board rings:4x4"),
        ("rings:5x4", "discs:5x4", "is no grid"),
        ("{id: 3,", "{id: 4,", "given twice"),
    ],
)
def test_files_that_are_no_boards(tmp_path: Path, old: str, new: str, says: str) -> None:
    tp.Target.load(RINGS).save(tmp_path / "board.yaml")
    text = (tmp_path / "board.yaml").read_text()
    assert old in text
    (tmp_path / "board.yaml").write_text(text.replace(old, new))
    with pytest.raises(tp.ConfigError, match=says):
        tp.Target.load(tmp_path / "board.yaml")


def test_what_boards_cannot_do() -> None:
    with pytest.raises(tp.ConfigError, match="the radius of its discs"):
        tp.Target.load("circles:5x4:8mm")
    discs = tp.Target.load("circles:5x4:8mm:2.5mm")
    with pytest.raises(tp.ConfigError, match="use photometric"):
        tp.PoseEstimator(CAMERA, discs, method="edges")
    with pytest.raises(tp.ConfigError, match="looked for once"):
        tp.PoseEstimator(CAMERA, discs, instances=2)


def test_turns_are_those_of_the_places() -> None:
    for text in ("circles:5x4:8mm", "circles:4x4:8mm", "acircles:3x6:6mm"):
        grid = Grid.parse(text)
        assert grid is not None
        arm = grid.points - boards.middle(grid)
        for numbers in grid.turns:
            turned = arm[numbers]
            angle = torch.atan2(*(arm[0, 0] * turned[0, 1] - arm[0, 1] * turned[0, 0], (arm[0] * turned[0]).sum()))
            turn = rotations.exp(torch.stack([0 * angle, 0 * angle, angle]))
            torch.testing.assert_close(arm @ turn.T, turned)
