"""``torchpose estimate`` on frames that are not linear: what it is told, and what it takes where it is not."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2
import pytest
import torch

import torchpose as tp
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
CAMERA = tp.Camera(912, 608, [[751.0, 0, 453], [0, 750, 306], [0, 0, 1]], [])


def ratios(folder: Path, *options: str) -> list[float]:
    """Measured ratios of the radii, in the order of the table."""
    out, markers = folder / "poses.csv", folder / "markers.csv"
    given = ["--camera", str(folder / "camera.yaml"), "--target", "hexa50", "--out", str(out)]
    with pytest.raises(SystemExit) as end:
        main(["estimate", str(folder / "frames"), *given, "--detections", str(markers), "--quiet", *options])
    assert end.value.code == 0
    with markers.open() as file:
        axes = ("inner_a", "inner_b", "outer_a", "outer_b")
        rows = [[float(row[axis]) for axis in axes] for row in csv.DictReader(file)]
    return [math.sqrt(a * b / (c * d)) for a, b, c, d in rows]


def test_jpeg_files_are_judged_by_their_rings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    azimuth = 2 * math.pi * torch.arange(6, dtype=F64) / 6
    r = rotations.exp(0.5 * torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], -1))
    t = torch.stack([0 * azimuth, 0 * azimuth, torch.linspace(140, 200, 6, dtype=F64)], -1)
    (tmp_path / "frames").mkdir()
    for k, frame in enumerate(add_noise(render(CAMERA, tp.Target.load("hexa50"), r, t), 1.0, gamma=2.2)):
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.jpg"), frame.numpy(), [cv2.IMWRITE_JPEG_QUALITY, 95])
    CAMERA.save(tmp_path / "camera.yaml")
    judged = ratios(tmp_path)
    said = capsys.readouterr().err
    assert "0.jpg: JPEG, film or colour" in said
    assert "taken as srgb" in said or "taken as gamma: 2" in said
    linear, told = ratios(tmp_path, "--tone", "linear"), ratios(tmp_path, "--tone", "gamma:2.2")
    assert capsys.readouterr().err == ""
    off = [max(abs(a - b) for a, b in zip(one, told, strict=True)) for one in (judged, linear)]
    assert off[0] < 0.003 < 0.01 < off[1]
