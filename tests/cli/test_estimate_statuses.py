"""``torchpose estimate``: every method on every kind of frame, alone in its batch and beside the others."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from torchpose.camera import Camera
from torchpose.cli import options
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.pipeline import Method
from torchpose.sim import add_noise, render
from torchpose.target import Target

Image = NDArray[np.uint8]
METHODS: tuple[str, ...] = get_args(Method)
WIDTH, HEIGHT = 400, 320
CAMERA = Camera.ideal(WIDTH, HEIGHT, 700.0)
DARK = 128

# kind of frame: the status of its row
KINDS = {
    "good": "ok",
    "black": "no_target",
    "white": "no_target",
    "noise": "no_target",
    "one_marker": "too_few_markers",
    "two_markers": "too_few_markers",
    "unreadable": "unreadable",
    "small": "wrong_size",
}
WITH_MARKERS = ("good", "one_marker", "two_markers")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with camera.yaml and a file KIND.png for each of the kinds."""
    folder = tmp_path_factory.mktemp("kinds")
    CAMERA.save(folder / "camera.yaml")
    target = Target.load("quad40")
    R = rotations.exp(torch.tensor([[0.2, -0.3, 0.4]], dtype=torch.float64))
    t = torch.tensor([[2.0, -1.0, 180.0]], dtype=torch.float64)
    good: Image = add_noise(render(CAMERA, target, R, t), 1.0).numpy()[0]
    places = CAMERA.project(target.centers @ R[0].T + t[0]).round().int().tolist()

    def without(count: int) -> Image:
        picture = good.copy()
        for u, v in places[:count]:
            picture[v - 40 : v + 40, u - 40 : u + 40] = 220
        return picture

    frames = {
        "good": good,
        "black": np.zeros_like(good),
        "white": np.full_like(good, 255),
        "noise": np.random.default_rng(0).integers(0, 256, good.shape).astype(np.uint8),
        "one_marker": without(3),
        "two_markers": without(2),
        "small": good[:100],
    }
    for kind, picture in frames.items():
        assert cv2.imwrite(str(folder / f"{kind}.png"), picture)
    (folder / "unreadable.png").write_bytes((folder / "good.png").read_bytes()[:2000])
    return folder


@pytest.fixture
def statuses(files: Path, tmp_path: Path) -> Callable[..., tuple[int, dict[str, str]]]:
    """Runs the command on some of the kinds; gives the exit code and the status of each row."""

    def run(method: str, *kinds: str, batch: int = 16) -> tuple[int, dict[str, str]]:
        out = tmp_path / "poses.csv"
        words = [*(files / f"{kind}.png" for kind in kinds), "--camera", files / "camera.yaml", "--target", "quad40"]
        words += ["--out", out, "--method", method, "--batch", batch, "--threads", 1]
        with pytest.raises(SystemExit) as end:
            main(["estimate", *map(str, words)])
        assert isinstance(end.value.code, int)
        if not out.exists():
            return end.value.code, {}
        with out.open(newline="") as file:
            return end.value.code, {row["frame"].removesuffix(".png"): row["status"] for row in csv.DictReader(file)}

    return run


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_alone_in_its_batch(statuses: Callable[..., tuple[int, dict[str, str]]], method: str, kind: str) -> None:
    assert statuses(method, kind) == (int(kind == "unreadable"), {kind: KINDS[kind]})


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("batch", [1, 3, 16])
def test_beside_the_others(statuses: Callable[..., tuple[int, dict[str, str]]], method: str, batch: int) -> None:
    assert statuses(method, *KINDS, batch=batch) == (1, KINDS)


@pytest.mark.parametrize("method", METHODS)
def test_no_frame_of_the_batch_has_a_target(statuses: Callable[..., tuple[int, dict[str, str]]], method: str) -> None:
    kinds = [kind for kind in KINDS if kind != "good"]
    assert statuses(method, *kinds) == (1, {kind: KINDS[kind] for kind in kinds})


def test_the_help_names_all_methods() -> None:
    assert tuple(options.METHODS.split("|")) == METHODS
