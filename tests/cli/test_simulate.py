"""``torchpose simulate`` as a user types it: frames, truth, resumed runs, one clear line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.datasets.dataset import analytic, plan_truth, simulated_frames
from torchpose.datasets.plan import load_plan
from torchpose.geometry import rotations
from torchpose.io.truth import read_truth
from torchpose.sim import add_noise, render
from torchpose.target import Target

ROOT = Path(__file__).parents[2]
F64 = torch.float64
CAMERA = Camera(
    320, 240, torch.tensor([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]], dtype=F64), torch.zeros(5, dtype=F64)
)
PLAN = {
    "camera": "camera.json",
    "target": "quad40",
    "seed": 4,
    "poses": {"random": {"count": 5, "x": [-5, 5], "y": [-5, 5], "z": [160, 200], "tilt_deg": [0, 40]}},
    "imaging": {"psf_sigma": [0.6, 0.9], "plate": [70, 70]},
    "sensor": {"noise": [0, 3]},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    CAMERA.save(tmp_path / "camera.json")
    return tmp_path


def save(folder: Path, **changes: Any) -> Path:
    """plan.yaml with keys replaced; a key may be a path such as sensor__noise."""
    plan = json.loads(json.dumps(PLAN))
    for name, value in changes.items():
        *parents, last = name.split("__")
        place = plan
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(plan))
    return path


def run(*words: int | Path | str) -> str | int | None:
    with pytest.raises(SystemExit) as end:
        main([*map(str, words), "--quiet"])
    return end.value.code


def frames_of(out: Path) -> dict[str, np.ndarray]:
    paths = sorted((out / "frames").iterdir())
    return {p.name: np.asarray(cv2.imread(str(p), cv2.IMREAD_UNCHANGED)) for p in paths}


def test_frames_are_those_of_the_renderer(folder: Path) -> None:
    out = folder / "set"
    assert run("simulate", save(folder), "--out", out) == 0
    truth = read_truth(out / "truth.csv")
    frames = frames_of(out)
    assert list(frames) == truth.frame == [f"{i:04d}.png" for i in range(5)]
    camera, target = Camera.load(out / "camera.yaml"), Target.load(out / "target.yaml")
    clean = render(camera, target, truth.R, truth.t, psf_sigma=truth.extra["psf_sigma"], plate=(70, 70))
    made = add_noise(clean, truth.extra["noise_sigma"], 4)
    difference = abs(np.stack(list(frames.values())).astype(int) - made.numpy().astype(int))
    # truth.R is the exponential of the logarithm of the pose that was drawn
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-4
    assert (truth.extra["markers_in_view"] == 4).all()
    assert ((truth.t[:, 2] >= 160) & (truth.t[:, 2] <= 200)).all()
    assert (truth.extra["tilt_deg"] <= 40).all()
    assert (truth.extra["sx"] > 0).all()
    assert (truth.extra["sx"] < 0.05).all()


@pytest.mark.parametrize("faults", [{}, {"RandomErasing": {"scale": [0.01, 0.02], "value": 0.3, "p": 0.8}}])
def test_frames_depend_on_the_plan_alone(folder: Path, faults: dict[str, Any]) -> None:
    path = save(folder, bounds=False, faults=faults)
    assert run("simulate", path, "--out", folder / "a", "--batch", 2, "--threads", 2) == 0
    assert run("simulate", path, "--out", folder / "b", "--batch", 5, "--threads", 1) == 0
    (folder / "b" / "frames" / "0003.png").unlink()
    (folder / "b" / "truth.csv").unlink()
    assert run("simulate", path, "--out", folder / "b", "--resume") == 0
    a, b = frames_of(folder / "a"), frames_of(folder / "b")
    assert a.keys() == b.keys()
    for name in a:
        assert (abs(a[name].astype(int) - b[name]) <= 1).all()
        assert (a[name] != b[name]).mean() < 1e-4
    assert (folder / "a" / "truth.csv").read_text() == (folder / "b" / "truth.csv").read_text()


def test_resume_keeps_finished_frames(folder: Path) -> None:
    path, out = save(folder, bounds=False), folder / "set"
    assert run("simulate", path, "--out", out) == 0
    kept = out / "frames" / "0001.png"
    kept.write_bytes(b"kept")
    (out / "frames" / "0002.png").unlink()
    assert run("simulate", path, "--out", out, "--resume") == 0
    assert kept.read_bytes() == b"kept"
    assert (out / "frames" / "0002.png").stat().st_size > 1000


def test_refuses_to_mix_data_sets(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "set"
    assert run("simulate", save(folder, bounds=False), "--out", out) == 0
    assert run("simulate", save(folder, bounds=False), "--out", out) == 2
    assert "--resume" in capsys.readouterr().err
    assert run("simulate", save(folder, bounds=False, seed=5), "--out", out, "--resume") == 2
    assert "another plan" in capsys.readouterr().err


def test_bop_export(folder: Path) -> None:
    out = folder / "set"
    assert run("simulate", save(folder, bounds=False), "--out", out, "--bop") == 0
    scene = out / "bop" / "000000"
    truth = read_truth(out / "truth.csv")
    gt, cameras = (json.loads((scene / f"scene_{n}.json").read_text()) for n in ("gt", "camera"))
    assert set(gt) == set(cameras) == {str(i) for i in range(5)}
    point = torch.tensor([3.0, -4.0, 0.0], dtype=F64)
    for i in range(5):
        pose = gt[str(i)][0]
        R = torch.tensor(pose["cam_R_m2c"], dtype=F64).view(3, 3)
        matrix = torch.tensor(cameras[str(i)]["cam_K"], dtype=F64).view(3, 3)
        pixel = matrix @ (R @ point + torch.tensor(pose["cam_t_m2c"], dtype=F64))
        expected = CAMERA.project(truth.R[i] @ point + truth.t[i])
        torch.testing.assert_close(pixel[:2] / pixel[2], expected, rtol=0, atol=1e-6)
        assert (scene / "gray" / f"{i:06d}.png").read_bytes() == (out / "frames" / truth.frame[i]).read_bytes()


def test_depth_of_the_sensor(folder: Path) -> None:
    assert run("simulate", save(folder, bounds=False, sensor__bits=12), "--out", folder / "set") == 0
    frame = frames_of(folder / "set")["0000.png"]
    assert frame.dtype == np.uint16
    assert 3000 < frame.max() <= 4095


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor__noise": -1.0}, ("sensor.noise", "-1")),
        ({"sensor__noise": [2.0, 1.0]}, ("sensor.noise", "swap")),
        ({"sensor__bits": 9}, ("sensor.bits", "8, 10, 12 or 16")),
        ({"imaging__psf_sigma": 0.0}, ("imaging.psf_sigma",)),
        ({"imaging__psf_ratio": 0.7}, ("imaging.psf_ratio", "1 or more")),
        ({"imaging__smear_px": [-1, 2]}, ("imaging.smear_px", "0 or more")),
        (
            {"imaging__disc_px": 2, "imaging__defocus": {"f_number": 2, "focal_length": 8, "focus_distance": 100}},
            ("imaging", "defocus and disc_px"),
        ),
        ({"imaging__psf_sigmas": 0.7}, ("imaging.psf_sigmas", "did you mean psf_sigma?")),
        ({"noise": 1.0}, ("noise", "unknown key")),
        ({"poses__random__tilt": 1.0}, ("poses.random.tilt", "tilt_deg")),
        ({"poses__grid": {"distance": 160.0, "angles_deg": [0.0]}}, ("poses", "one of")),
        ({"poses__random__count": 0}, ("poses.random.count",)),
        ({"poses__random__z": [15, 20]}, ("poses", "keep the target in view")),
        ({"poses": {"axes": {"start": [0, 0, -160], "translations": [0]}}}, ("poses", "behind the camera")),
        ({"poses": {"axes": {"start": [60, 0, 160], "translations": [0]}}}, ("poses", "out of view")),
        ({"depth_range": [100.0, 150.0]}, ("poses", "depth_range")),
        ({"depth_range": [150.0, 100.0]}, ("depth_range",)),
        ({"imaging__background": "pictures", "imaging__plate": None}, ("imaging", "plate")),
        ({"target": "quad41"}, ("quad41",)),
        ({"faults": {"RandomErase": {}}}, ("faults.RandomErase", "did you mean RandomErasing?")),
        ({"camera": "none.yaml"}, ("none.yaml",)),
        (
            {"imaging__defocus": {"f_number": 0, "focal_length": 8, "focus_distance": 100}},
            ("imaging.defocus.f_number",),
        ),
    ],
)
def test_a_wrong_plan_is_one_clear_line(
    folder: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, float | list[float]], words: tuple[str, str]
) -> None:
    path = save(folder, **changes)
    assert run("simulate", path, "--out", folder / "set") == 2
    message = capsys.readouterr().err
    assert message.startswith("torchpose: error: ")
    assert message.count("\n") == 1
    for word in words:
        assert word in message
    assert not (folder / "set").exists()


def test_marked_frames(folder: Path) -> None:
    # in view, cut by the border, out of the depth range, out of view, behind the camera
    positions = [[0, 0, 0], [45, 0, 0], [0, 0, 80], [300, 0, 0], [0, 0, -360]]
    path = save(
        folder,
        poses={"grid": {"distance": 180, "angles_deg": [0], "positions": positions}},
        out_of_view="mark",
        depth_range=[100.0, 220.0],
    )
    assert run("simulate", path, "--out", folder / "set") == 0
    truth = read_truth(folder / "set" / "truth.csv")
    assert truth.extra["markers_in_view"].tolist() == [4, 2, 4, 0, 0]
    assert truth.extra["in_depth_range"].tolist() == [1, 1, 0, 1, 0]
    assert truth.extra["sx"].isfinite().tolist() == [True, True, True, False, False]
    frames = frames_of(folder / "set")
    assert frames["0000.png"].std() > 20
    assert frames["0004.png"].std() < 5  # nothing but noise


def test_grid_is_that_of_the_paper() -> None:
    plan = load_plan(ROOT / "configs" / "plans" / "paper_grid.yaml")
    assert len(plan) == 875
    assert plan.t.unique(dim=0).tolist() == sorted(
        [[0, 0, 160], [10, 0, 160], [-10, 0, 160], [0, 10, 160], [0, -10, 160], [0, 0, 170], [0, 0, 150]]
    )
    one = plan.R[1 * 25 + 2 * 5 + 4]  # pitch -2.5, yaw 0, roll 5 degrees
    axes = torch.eye(3, dtype=F64)
    expected = rotations.exp(axes[2] * np.deg2rad(5)) @ rotations.exp(axes[0] * np.deg2rad(-2.5))
    torch.testing.assert_close(one, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["random", "single_axis", "stress"])
def test_plans_that_come_with_it(name: str) -> None:
    plan = load_plan(ROOT / "configs" / "plans" / f"{name}.yaml")
    truth = plan_truth(plan)
    if name != "stress":
        assert (plan.seen == 4).all()
    if name == "single_axis":
        moved = (truth.t - truth.t[0]).abs() > 1e-9
        turned = truth.rotation_vector.abs() > 1e-9
        assert (moved.sum(1) + turned.sum(1) <= 1).all()
    if name == "random":
        # an even cover: every quarter of each range has a quarter of the frames, to a tenth
        for column, low, high in ((truth.t[:, 0], -50, 50), (truth.t[:, 2], 140, 200)):
            share = torch.histc(column, 4, low, high) / len(plan)
            assert (share - 0.25).abs().max() < 0.1


def test_stress_frame_has_what_the_plan_says(folder: Path) -> None:
    path = save(
        folder,
        poses__random__count=2,
        imaging__clutter=8,
        imaging__covered=1.0,
        imaging__motion_mm=0.3,
        imaging__defocus={"f_number": 2, "focal_length": 8, "focus_distance": 150},
        imaging__lighting={"gradient": [0.2, 0.0], "vignetting": 4},
        sensor={"noise": 0, "full_well": 10000},
        bounds=False,
    )
    plan = load_plan(path)
    frames = simulated_frames(plan, analytic(plan), torch.arange(2)).float()
    plain = simulated_frames(
        *(lambda p: (p, analytic(p)))(load_plan(save(folder, poses__random__count=2))), torch.arange(2)
    )
    assert ((frames - plain.float()).abs() > 30).flatten(1).sum(1).min() > 300
    again = simulated_frames(plan, analytic(plan), torch.tensor([1]))
    torch.testing.assert_close(again[0].float(), frames[1], rtol=0, atol=1)


def test_background_pictures(folder: Path) -> None:
    pictures = folder / "pictures"
    pictures.mkdir()
    for i, level in enumerate((40, 160)):
        cv2.imwrite(str(pictures / f"{i}.png"), np.full((300, 500), level, np.uint8))
    path = save(folder, imaging__background="pictures", sensor__noise=0, bounds=False)
    assert run("simulate", path, "--out", folder / "set") == 0
    corners = [frame[0, 0] for frame in frames_of(folder / "set").values()]
    assert corners == [40, 160, 40, 160, 40]
