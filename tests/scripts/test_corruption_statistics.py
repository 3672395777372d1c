"""The matrix of corruptions: its blurs are what they say, and a reduced matrix holds."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose.sim import render

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))  # as Python does where a script is started
import corruption_statistics as statistics  # noqa: E402
import corruptions  # noqa: E402
from corruptions import BASE_PSF, BLURS, CORRUPTIONS, F64, Shot  # noqa: E402

FRONTAL = torch.eye(3, dtype=F64)
REDUCED = ("none", "noise", "low contrast", "wires")  # before anything that costs much


def small_shot(picture: np.ndarray | None = None, seed: int = 0) -> Shot:
    """A frontal view of quad40 by a camera without distortion."""
    camera = tp.Camera.ideal(320, 300, 600.0)
    place = torch.tensor([1.3, -0.7, 150.0], dtype=F64)
    rng = np.random.default_rng(seed)
    shot = Shot(camera, tp.Target.load("quad40"), FRONTAL, place, rng, {"dark": 30.0, "light": 220.0})
    return shot if picture is None else shot.seen(picture)


def rendered(shot: Shot, **imaging: Any) -> np.ndarray:
    options = {"psf_sigma": BASE_PSF, **shot.imaging, **imaging}
    return render(shot.camera, shot.target, shot.R[None], shot.t[None], **options)[0].numpy()


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name in BLURS for value in (BLURS[name].values[0], BLURS[name].values[-1])]
)
def test_moments_of_a_blurred_spot(name: str, value: Any) -> None:
    """Variances add: a Gaussian spot keeps its mass and centre and gains the kernel's covariance."""
    v, u = np.mgrid[:240, :260].astype(np.float64)
    u, v, size = u - 130.2, v - 119.6, 4.0
    spot = np.exp(-(u * u + v * v) / (2 * size**2)).astype(np.float32)
    after = BLURS[name].apply(small_shot(spot, seed=3), value)
    weight = after.picture / spot.sum()
    center = (weight * u).sum(), (weight * v).sum()
    uu, uv, vv = (weight * u * u).sum(), (weight * u * v).sum(), (weight * v * v).sum()
    blur = after.blur
    a, b, c = blur.covariance
    a, b, c = a + blur.smear[0] ** 2 / 12, b + blur.smear[0] * blur.smear[1] / 12, c + blur.smear[1] ** 2 / 12
    own = size**2 - BASE_PSF**2 + blur.disc**2 / 4
    assert weight.sum() == pytest.approx(1, abs=1e-4)
    assert center == pytest.approx((0, 0), abs=2e-3)
    assert (uu, uv, vv) == pytest.approx((a + own, b, c + own), abs=0.01)
    assert blur.sigma**2 == pytest.approx((uu + vv) / 2 - size**2 + BASE_PSF**2, abs=0.01)


@pytest.mark.parametrize(
    ("name", "value"), [("motion", 3.0), ("motion", 12.0), ("elliptic blur", (1.0, 3.0)), ("defocus", 5.0)]
)
def test_blurs_are_those_of_the_renderer(name: str, value: Any) -> None:
    """The renderer blurs outlines by quadrature, what the bound is computed with; here whole pictures are filtered."""
    shot = small_shot(seed=5)
    after = BLURS[name].apply(shot.seen(rendered(shot)), value)
    difference = (after.picture - rendered(shot, **after.blur.imaging()))[15:-15, 15:-15]
    assert abs(difference).max() < 2.0  # aliases of edges under BASE_PSF
    assert difference.std() < 0.15


def test_motion_is_that_of_the_renderer() -> None:
    """A frontal plate that moves across: the renderer integrates over the exposure instead."""
    shot = small_shot(seed=5)
    after = corruptions.motion(shot.seen(rendered(shot)), 6.0)
    scale = float(shot.t[2]) / 600.0
    way = torch.tensor([[scale * after.blur.smear[0], scale * after.blur.smear[1], 0, 0, 0, 0]], dtype=F64)
    difference = after.picture - rendered(shot, motion=way)
    assert math.hypot(*after.blur.smear) == pytest.approx(6.0)
    assert abs(difference).max() < 2.0
    assert difference.std() < 0.15


def test_interlaced_rows_are_where_they_should_be() -> None:
    shot = small_shot()
    after = corruptions.interlacing(shot.seen(rendered(shot)), 1.0)
    for parity, shift in ((0, -0.5), (1, 0.5)):
        matrix = shot.camera.matrix.clone()
        matrix[0, 2] += shift
        moved = replace(shot, camera=replace(shot.camera, matrix=matrix))
        difference = (after.picture - rendered(moved))[parity::2, 40:-40]
        assert difference.std() < 0.5  # aliases, as above


def test_equal_frames_from_equal_seeds() -> None:
    camera = tp.Camera.load(statistics.CAMERA)
    frames = []
    for seed in (1, 1, 2):
        shot = corruptions.view(3, seed, camera, "small", "photo")
        frames.append(corruptions.shoot(shot, CORRUPTIONS["drops"], 30.0, seed)[1])
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])
    assert frames[0].shape == (1216, 1824)
    assert frames[0].dtype == torch.uint8


def matrix(tmp_path: Path, *arguments: str) -> list[dict[str, Any]]:
    assert statistics.main([*arguments, "--json", str(tmp_path / "rows.json")]) == 0
    rows: list[dict[str, Any]] = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))
    return rows


def test_reduced_matrix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = matrix(tmp_path, "--frames", "2", "--markdown", "--only", *REDUCED)
    shown = capsys.readouterr().out.splitlines()
    assert len(rows) == sum(len(CORRUPTIONS[name].values) for name in REDUCED)
    assert shown[2].startswith("| none |  | sample | none | photometric | 2 of 2 | ")
    for row in rows:
        assert row["ok"] == 2, row
        assert row["worst"] < 8, row
        assert 0.01 < row["lateral"] < 20, row


@pytest.mark.parametrize("number", [9, 11])
def test_small_rings_out_of_focus_are_named_rightly(number: int) -> None:
    """A disc of 5 px over rings of 12 to 16: with a Gaussian the codes of frame 9 are a step too high."""
    camera = tp.Camera.load(statistics.CAMERA)
    shot = corruptions.view(number, 1, camera, "small", "none")
    row = statistics.measure(
        tp.PoseEstimator(camera, tp.Target.load("quad40")),
        *corruptions.shoot(shot, CORRUPTIONS["defocus"], 5.0, 1_000_003 + number),
    )
    assert row["status"] == "ok"
    assert row["markers"] == 4
    assert max(abs(e) / s for e, s in zip(row["error"], row["claimed"], strict=True)) < 5
    assert max(abs(e) for e in row["error"][:2]) < 0.01


def test_a_frame_without_a_pose_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A black plate in the dark has no rings to find."""
    dark = replace(CORRUPTIONS["under-exposure"], values=(0.0,))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CORRUPTIONS, "under-exposure", dark)
        (row,) = matrix(tmp_path, "--frames", "1", "--only", "under-exposure")
    assert row["ok"] == 0
    line = "under-exposure 0 sample none photometric: frame 0 no_target none, 0 markers"
    assert line in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("background", ["none", "photo"])
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_whole_matrix(tmp_path: Path, name: str, background: str) -> None:
    """Where a person sees the rings, 11 of 12 are found, and none is beyond 8 claimed sigmas."""
    if background == "photo" and CORRUPTIONS[name].own_background:
        pytest.skip("draws its own surroundings")
    for row in matrix(tmp_path, "--only", name, "--background", background, "--target", "sample", "small"):
        if row["note"] != "unseen":
            assert row["ok"] >= 11, statistics.missed(row)
            assert row["note"] == "hidden" or row["worst"] < 8, statistics.missed(row)
