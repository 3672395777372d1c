"""A board measured and then used as a target, as a user types it."""

import csv
from pathlib import Path

import cv2
import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.calibration import board_scenes as boards
from tests.calibration import calibration_scenes as scenes
from torchpose.calibration.plate import free_plate, motions
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.grids import Grid
from torchpose.sim.shapes import Shapes, ring

F64 = torch.float64
CAMERA = scenes.camera([-0.2, 0.05, 2e-4, -1.5e-4], scale=0.4)
VIEWS = 7
NUMBERS = ("tx", "ty", "tz", "rx", "ry", "rz", "sx", "sy", "sz", "nx", "ny", "nz")


def run(command: str, *arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([command, *map(str, arguments)])
    assert isinstance(end.value.code, int)
    return end.value.code


def poses(count: int) -> tuple[Tensor, Tensor]:
    azimuth = 2 * torch.pi * torch.arange(count, dtype=F64) / count
    R = rotations.exp(0.5 * torch.stack([azimuth.cos(), azimuth.sin(), 0.3 * azimuth.sin()], -1))
    return R, torch.tensor([0.0, 0, 120], dtype=F64) + torch.stack([2 * azimuth.sin(), azimuth.cos(), 0 * azimuth], -1)


def printed(grid: Grid) -> Tensor:
    """Places (P, 3) of the print."""
    off = 0.03 * torch.randn(len(grid.points), 3, dtype=F64, generator=torch.Generator().manual_seed(2))
    off[:, 2] = 0
    return grid.points + off


@pytest.mark.parametrize(
    ("text", "radii"), [("rings:5x4:8mm:3mm:1.5mm", (3.02, 1.48)), ("acircles:3x7:5mm", (2.0, 0.0))]
)
def test_a_board_is_measured_and_then_a_target(tmp_path: Path, text: str, radii: tuple[float, float]) -> None:
    grid = Grid.parse(text)
    assert grid is not None
    R, t = poses(VIEWS)
    places = printed(grid)
    middle = boards.middle(grid)
    drawn = Shapes.cat([ring((x, y), *radii) for x, y, _ in (places - middle).tolist()])
    (tmp_path / "views").mkdir()
    for k, frame in enumerate(boards.photographs(CAMERA, drawn, R, t)):
        cv2.imwrite(str(tmp_path / "views" / f"{k}.png"), frame.numpy())
    CAMERA.save(tmp_path / "camera.yaml")
    known = ("--camera", tmp_path / "camera.yaml")
    assert run("calibrate", tmp_path / "views", "--board", text, *known, "--measure-target", tmp_path / "b.yaml") == 0

    target = tp.Target.load(tmp_path / "b.yaml")
    assert str(target.grid) == text
    assert target.covariance is not None
    gauge = torch.linalg.qr(motions(grid.points)).Q
    off = (places - grid.points).flatten()
    error = (target.centers - grid.points).flatten() - (off - gauge @ (gauge.mT @ off))
    sigma = target.covariance.diagonal()[:-1].sqrt()
    assert float(sigma.max()) < 2e-3
    assert float((error / sigma).abs().max()) < 5
    outer, inner = target.printed_radii.mean(0).tolist()
    assert outer == pytest.approx(radii[0], rel=2e-3)
    assert inner == pytest.approx(radii[1], rel=2e-3, abs=1e-12)

    target_and_table = ("--target", tmp_path / "b.yaml", "--out", tmp_path / "p.csv")
    assert run("estimate", tmp_path / "views", *known, *target_and_table) == 0
    with (tmp_path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * VIEWS  # measured places tell which way round
    numbers = torch.tensor([[float(row[name]) for name in NUMBERS] for row in rows], dtype=F64)
    place, seen, everything, noise = numbers[:, :3], rotations.exp(numbers[:, 3:6]), numbers[:, 6:9], numbers[:, 9:]
    # the frame of the measured board is turned against that of the nominal one, and larger by what no view tells
    turns = rotations.log(seen @ seen[0].mT @ R[0] @ R.mT)
    assert float(turns.norm(dim=-1).max()) < 1e-4
    assert float((place + seen @ middle - t).norm(dim=-1).max()) < 0.04
    assert bool((everything > noise).all() & (noise > 0).all())


def test_the_plate_of_discs_has_no_gain() -> None:
    places, normals = torch.randn(5, 3, dtype=F64), torch.tensor([[0.0, 0, 1]], dtype=F64).repeat(5, 1)
    ids = torch.arange(5)
    rings, discs = free_plate(ids, places, normals), free_plate(ids, places, normals, discs=True)
    assert len(discs) == len(rings) - 1
    assert not discs.gain.any()
    assert discs.rims
    torch.testing.assert_close(discs.sizes[:, discs.sizes.any(0)], torch.eye(5, dtype=F64))


def test_boards_of_squares_are_not_measured(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), torch.zeros(20, 20, dtype=torch.uint8).numpy())
    CAMERA.save(tmp_path / "camera.yaml")
    arguments = ("--board", "chessboard:9x6:5mm", "--camera", tmp_path / "camera.yaml")
    assert run("calibrate", tmp_path, *arguments, "--measure-target", tmp_path / "b.yaml") == 2


def test_a_distance_on_a_board() -> None:
    from torchpose.calibration.measured import Distance

    grid = Grid.parse("circles:5x4:8mm")
    assert grid is not None
    Distance(0, 4, 32.01).check(grid)
    with pytest.raises(ConfigError, match="are 32 mm apart"):
        Distance(0, 4, 3.2).check(grid)
    with pytest.raises(ConfigError, match="has no marker 20"):
        Distance(0, 20, 32.0).check(grid)
