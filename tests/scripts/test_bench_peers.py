"""The benchmark beside other targets: what is printed is right, and every peer measures it."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose.sim import render

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))  # as Python does where a script is started
import bench_peers  # noqa: E402
import peer_boards  # noqa: E402
from corruptions import F64, tilted  # noqa: E402

APRILTAG = importlib.util.find_spec("pupil_apriltags") is not None
PEERS = 8 if APRILTAG else 7


def test_a_print_is_as_supersampled() -> None:
    """Rays through 8 x 8 points of every pixel, looked up in the raster, blurred by OpenCV."""
    finer, sigma, cell = 8, 0.8, 9.0
    raster = np.random.default_rng(1).random((5, 6)) < 0.5
    camera = tp.Camera.ideal(200, 180, 400.0)
    turn, place = tilted(0.6, 1.0, 0.3), torch.tensor([2.0, -1.0, 170.0], dtype=F64)
    image = render(
        camera, peer_boards.cells(raster, cell, (3.0, -2.0)), turn[None], place[None], psf_sigma=sigma, light=220.0
    )[0].numpy()
    axes = [(np.arange(finer * n) + 0.5) / finer - 0.5 for n in (camera.width, camera.height)]
    pixel = torch.from_numpy(np.stack(np.meshgrid(*axes), -1))
    ray = torch.nn.functional.pad(camera.undistort_points(pixel), (0, 1), value=1.0)
    normal = turn[:, 2]
    point = (ray * (place @ normal / (ray @ normal))[..., None] - place) @ turn
    column = ((point[..., 0] - 3.0) / cell + 3.0).floor().long().numpy()
    row = ((point[..., 1] + 2.0) / cell + 2.5).floor().long().numpy()
    inside = (column >= 0) & (column < 6) & (row >= 0) & (row < 5)
    black = inside & raster[row.clip(0, 4), column.clip(0, 5)]
    fine = cv2.GaussianBlur(np.where(black, peer_boards.DARK, 220.0), (0, 0), finer * sigma)
    witness = fine.reshape(camera.height, finer, camera.width, finer).mean((1, 3))
    edge = slice(6, -6)  # OpenCV's border is another one
    difference = (image - witness)[edge, edge]
    assert difference.std() < 0.15
    assert abs(difference).max() < 2.0


def test_every_peer_measures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_peers.main(["--frames", "1", "--only", "even", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "peers.json").read_text(encoding="utf-8"))
    assert len(rows) == PEERS
    for row in rows:
        assert (row["right"], row["wrong"]) == (1, 0), row
        # a pixel is 140 um; half of one, where corners are counted from elsewhere, would be 70
        assert row["lateral_um"] < (60 if row["peer"] == "ArUco" else 30), row
        assert row["cpu_ms"] > 1
    assert (tmp_path / "peers.png").stat().st_size > 10_000
    short = capsys.readouterr().out.split("\n\n")[-1].splitlines()
    assert len(short) == 2 + PEERS
    assert short[2].startswith("| torchpose photometric | 1 of 1 | 0 | 0.")


@pytest.mark.skipif(not APRILTAG, reason="pupil-apriltags is not installed")
def test_corners_of_apriltag_are_where_they_are_printed() -> None:
    """Without bias: AprilTag's pixels are half a pixel beside OpenCV's."""
    camera = tp.Camera.load(bench_peers.CAMERA)
    shot = bench_peers.view(camera, peer_boards.prints()["apriltag"], bench_peers.Point("", ""), 0, 1)
    frame = bench_peers.shoot(shot, bench_peers.CORRUPTIONS["none"], 0.0, 1)[1].numpy()
    off = []
    for tag in peer_boards.apriltag_detector().detect(frame):
        points = torch.from_numpy(peer_boards.tag_corners(tag.tag_id, peer_boards.TAG_MM))
        off.append(tag.corners[[1, 0, 3, 2]] - 0.5 - camera.project(points @ shot.R.mT + shot.t).numpy())
    assert len(off) == 4
    assert np.abs(off).max() < 0.4
    assert np.abs(np.mean(off, (0, 1))).max() < 0.05


def test_ratios(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--ratios", "--small", "--frames", "1", "--rounds", "1", "--only", "clean", "--out", str(tmp_path)]
    assert bench_peers.main(options) == 0
    (row,) = json.loads((tmp_path / "ratios.json").read_text(encoding="utf-8"))
    assert row["torchpose"] > row["aruco"] > 1
    assert row["allowed"] >= 6 * row["aruco"]
    assert capsys.readouterr().out.splitlines()[-1].startswith("| clean | ")


def test_tray_has_48_plates() -> None:
    camera = tp.Camera.load(bench_peers.CAMERA)
    frame = bench_peers.tray(camera)[1]
    _, _, stats, _ = cv2.connectedComponentsWithStats((frame > 150).astype(np.uint8))
    plates = stats[1:][stats[1:, cv2.CC_STAT_AREA] > 1000]
    assert len(plates) == 48
    assert 130 < np.median(plates[:, cv2.CC_STAT_WIDTH]) < 150


def test_without_apriltag_one_line_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(peer_boards, "has_apriltag", lambda: False)
    names = [c.name for c in peer_boards.contenders(tp.Camera.load(bench_peers.CAMERA))]
    assert "AprilTag 3" not in names
    assert len(names) == 7
    assert capsys.readouterr().out == peer_boards.NO_APRILTAG + "\n"
