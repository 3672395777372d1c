"""Plans as rows, and data sets on disk, beside what tests/cli/test_simulate.py shows of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from torchpose.analysis import rig_crlb
from torchpose.camera import Camera, CameraRig
from torchpose.datasets.dataset import (
    analytic,
    bounds,
    plan_truth,
    simulated_frames,
    write_bop,
    write_dataset,
    write_rig_dataset,
)
from torchpose.datasets.plan import Plan, load_plan
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.images import decode
from torchpose.io.rows import Schema
from torchpose.io.truth import read_truth
from torchpose.io.writers import read_table
from torchpose.sim import render
from torchpose.target import Target

F64 = torch.float64
NUMBERS = ("x", "y", "z", "nx", "ny", "nz", "outer_radius", "inner_radius")
PRINTS: Schema = {"frame": str, "id": int} | dict.fromkeys(NUMBERS, float)


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """Four frames of 160 x 120, each with its own conditions."""
    matrix = torch.tensor([[250.0, 0, 79.5], [0, 250.0, 59.5], [0, 0, 1]], dtype=F64)
    Camera(160, 120, matrix, torch.tensor([-0.1, 0.02, 0.0, 0.0], dtype=F64)).save(tmp_path / "camera.json")
    text = {
        "camera": "camera.json",
        "target": "quad40",
        "poses": {"random": {"count": 4, "x": [-5, 5], "y": [-5, 5], "z": [160, 200]}},
        "imaging": {"psf_sigma": [0.6, 0.9], "dark": [20, 40], "plate": [70, 70], "motion_mm": [0, 0.3]},
        "bounds": False,
    }
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(text))
    return load_plan(tmp_path / "plan.yaml")


def test_rows_of_a_plan_are_its_frames(plan: Plan) -> None:
    which = torch.tensor([3, 1])
    part = plan[which]
    assert len(part) == 2
    assert part.names == ["0000.png", "0001.png"]
    assert part.camera is plan.camera
    assert torch.equal(part.conditions.psf_sigma, plan.conditions.psf_sigma[which])
    frames = analytic(plan)(which)
    torch.testing.assert_close(analytic(part)(torch.arange(2)), frames, rtol=0, atol=1e-3)


def test_blur_with_a_direction_is_drawn_and_recorded(plan: Plan) -> None:
    look = plan.file.imaging.model_copy(
        update={"psf_ratio": [1.0, 2.0], "psf_deg": [30.0, 30.0], "smear_px": [4.0, 4.0], "smear_deg": [0.0, 90.0]}
    )
    file = plan.file.model_copy(update={"imaging": look})
    plan.path.with_name("other.yaml").write_text(yaml.safe_dump(file.model_dump(exclude_none=True)))
    other = load_plan(plan.path.with_name("other.yaml"))
    # what a plan drew before it knew of directions stays as it was
    assert torch.equal(other.motion, plan.motion)
    assert torch.equal(other.conditions.dark, plan.conditions.dark)
    truth, blur = plan_truth(other).extra, other.conditions.blur
    assert ((truth["psf_ratio"] > 1) & (truth["psf_ratio"] < 2)).all()
    major, minor = truth["psf_sigma"] * truth["psf_ratio"], truth["psf_sigma"]
    values, vectors = torch.linalg.eigh(blur["psf_sigma"])
    torch.testing.assert_close(values.sqrt(), torch.stack([minor, major], 1))
    torch.testing.assert_close((vectors[:, 1, 1] / vectors[:, 0, 1]).atan().rad2deg(), truth["psf_deg"])
    torch.testing.assert_close(blur["smear"].norm(dim=1), truth["smear_px"])
    every = torch.arange(4)
    drawn = render(
        other.camera, other.target, other.R, other.t, **blur, dark=truth["dark"], light=truth["light"],
        plate=(70, 70), motion=other.motion,
    )  # fmt: skip
    torch.testing.assert_close(analytic(other)(every), drawn, rtol=0, atol=1e-3)
    # the bound knows that blur: 4 px of smear leave less of edges in their direction
    assert (bounds(other, every) > bounds(plan, every)).all()


def with_keys(plan: Plan, name: str, **keys: object) -> Plan:
    """The plan with other sections, from a file of its own."""
    text = yaml.safe_load(plan.path.read_text()) | keys
    path = plan.path.with_name(name)
    path.write_text(yaml.safe_dump(text))
    return load_plan(path)


def test_one_print_is_that_of_all_frames(plan: Plan, tmp_path: Path) -> None:
    wanted = {
        "seed": 4,
        "center_sigma": [0.1, 0.1, 0.2],
        "gain": [0.1, 0.2],
        "scale": 0.01,
        "warp": 0.1,
        "warp_deg": 30,
    }
    other = with_keys(plan, "print.yaml", print=wanted)
    assert torch.equal(other.R, plan.R)
    assert torch.equal(other.motion, plan.motion)
    # a plan of another seed and other frames shows the same print
    again = with_keys(plan, "again.yaml", print=wanted, seed=9)
    assert other.prints is not None
    assert again.prints is not None
    assert not torch.equal(again.R, other.R)
    assert torch.equal(again.prints.centers, other.prints.centers)
    out = tmp_path / "set"
    write_dataset(other, out)
    made, meant = Target.load(out / "print.yaml"), Target.load(out / "target.yaml")
    gain = read_truth(out / "truth.csv").extra["edge_gain"]
    assert (gain == gain[0]).all()
    assert 0.1 <= gain[0] <= 0.2
    assert made.edge_gain == gain[0]
    torch.testing.assert_close(made.printed_radii[:, 0], 1.01 * meant.radii[:, 0] + gain[0])
    torch.testing.assert_close(made.printed_radii[:, 1], 1.01 * meant.radii[:, 1] - gain[0])
    assert 0.05 < float((made.centers - 1.01 * meant.centers).square().mean().sqrt()) < 0.4
    rows = read_table(out / "prints.csv", PRINTS, ())
    assert [(row["frame"], row["id"]) for row in rows[3:5]] == [("0000.png", 3), ("0001.png", 0)]
    for number, row in enumerate(rows):
        assert [row[name] for name in "xyz"] == made.centers[number % 4].tolist()
        assert row["inner_radius"] == pytest.approx(float(made.printed_radii[number % 4, 1]), rel=1e-12)
    # the frames show it: bent rings and all
    frames = analytic(other)(torch.arange(4))
    look = plan_truth(other).extra
    shown = render(
        other.camera, made, other.R, other.t, psf_sigma=look["psf_sigma"], dark=look["dark"], light=look["light"],
        plate=(70, 70), motion=other.motion,
    )  # fmt: skip
    assert float((frames - shown).abs().mean()) < 0.05 * float((frames - analytic(plan)(torch.arange(4))).abs().mean())


def test_every_frame_may_have_a_print(plan: Plan, tmp_path: Path) -> None:
    other = with_keys(plan, "prints.yaml", print={"each": "frame", "center_sigma": 0.05, "gain": [-0.1, 0.1]})
    assert other.prints is not None
    assert len(other.prints.gain.unique()) == 4
    write_dataset(other, tmp_path / "set")
    assert not (tmp_path / "set" / "print.yaml").exists()
    rows = read_table(tmp_path / "set" / "prints.csv", PRINTS, ())
    assert [row["x"] for row in rows] == other.prints.centers[..., 0].flatten().tolist()
    part = other[torch.tensor([2])]
    torch.testing.assert_close(analytic(part)(torch.tensor([0])), analytic(other)(torch.tensor([2])), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"center_sigma": -0.1}, r"print\.center_sigma"),
        ({"center_sigma": [0.1, 0.1]}, r"print\.center_sigma: has 2 entries; give a number or"),
        ({"warp": [-0.1, 0.1]}, r"print\.warp: is -0.1; give half of the plate's height"),
        ({"warp_shape": "bowl"}, r"print\.warp_shape"),
        ({"center_sigma": [20.0, 20.0, 0.0], "seed": 14}, r"print\.markers.*overlap"),
        ({"gain": -3.0}, r"print\.gain: leaves nothing of a ring"),
        ({"bow": 1}, r"print\.bow"),
    ],
)
def test_a_wrong_print_is_one_clear_line(plan: Plan, wanted: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        with_keys(plan, "wrong.yaml", print=wanted)
    assert "\n" not in str(caught.value)


FAULTS: dict[str, dict[str, object]] = {
    "coma": {"imaging": {"coma_px": 2.0}},
    "haze": {"imaging": {"haze_px": 0.3, "haze_length": 20}},
    "ghost": {"imaging": {"ghost": [10, 20]}},
    "speckle": {"imaging": {"speckle": 0.05}},
    "flicker": {"imaging": {"flicker": [0.03, 0.05], "flicker_px": 30}},
    "texture": {"print": {"texture": {"share": 0.05, "length": 1.0}}},
    "prnu": {"sensor": {"prnu": 0.02}},
    "columns": {"sensor": {"column_noise": 3}},
    "jitter": {"sensor": {"line_jitter": 0.3}},
    "srgb": {"sensor": {"gamma": "srgb"}},
    "bayer": {"processing": {"bayer": True}},
    "denoise": {"processing": {"denoise": 10}},
    "sharpen": {"processing": {"sharpen": 1.0}},
    "jpeg": {"processing": {"jpeg": 60}},
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_in_the_frames_in_any_batch(plan: Plan, name: str) -> None:
    other = with_keys(plan, f"{name}.yaml", **FAULTS[name])
    clean = with_keys(plan, "clean.yaml", **{section: {} for section in FAULTS[name]})
    whole = simulated_frames(other, analytic(other), torch.arange(4))
    assert whole.dtype == torch.uint8
    without = simulated_frames(clean, analytic(clean), torch.arange(4))
    assert (whole.float() - without.float()).abs().flatten(1).amax(1).min() > 4
    some = torch.tensor([3, 1])
    # to rounding: a grey value in ten thousand lies on its edge
    again = simulated_frames(other, analytic(other), some).float() - whole[some].float()
    assert again.abs().max() <= (1 if name != "jpeg" else 12)
    assert float((again != 0).double().mean()) < 1e-3


def test_a_sensor_keeps_its_pattern(plan: Plan) -> None:
    look = {"imaging": {"dark": 100, "light": 100, "plate": None}, "bounds": False}
    flat = [
        with_keys(plan, f"{n}.yaml", seed=n, sensor={"prnu": 0.05, "noise": 0, "seed": sensor}, **look)
        for n, sensor in ((1, 8), (2, 8), (3, 9))
    ]
    frames = [simulated_frames(each, analytic(each), torch.arange(1))[0] for each in flat]
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])


def test_faults_are_in_the_truth(plan: Plan) -> None:
    other = with_keys(plan, "f.yaml", imaging={"haze_px": [0.1, 0.2], "coma_px": 1.5, "coma_deg": 40})
    extra = plan_truth(other).extra
    assert ((extra["haze_px"] >= 0.1) & (extra["haze_px"] <= 0.2)).all()
    assert len(extra["haze_px"].unique()) == 4
    assert (extra["coma_px"] == 1.5).all()
    assert (extra["coma_deg"] == 40).all()
    assert (extra["ghost"] == 0).all()


@pytest.mark.parametrize(
    ("section", "wanted", "words"),
    [
        ("imaging", {"haze_px": -0.1}, r"imaging\.haze_px: is -0.1; give px, 0 or more"),
        ("imaging", {"speckle": [0.1, 1.5]}, r"imaging\.speckle: is 1.5; give a share"),
        ("imaging", {"haze_length": 0.5}, r"imaging\.haze_length"),
        ("processing", {"sharpen": 1, "sharpen_px": 100000.0}, r"processing\.sharpen_px"),
        ("print", {"texture": {"share": 0.02}}, r"print\.texture\.length"),
        ("sensor", {"prnu": -1}, r"sensor\.prnu"),
        ("sensor", {"gamma": "sRGB"}, r"sensor\.gamma"),
        ("processing", {"jpeg": 0}, r"processing\.jpeg"),
        ("processing", {"jpg": 80}, r"processing\.jpg"),
    ],
)
def test_a_wrong_fault_is_one_clear_line(plan: Plan, section: str, wanted: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        with_keys(plan, "wrong.yaml", **{section: wanted})
    assert "\n" not in str(caught.value)


def test_jpeg_of_twelve_bits_is_refused(plan: Plan) -> None:
    with pytest.raises(ConfigError, match=r"processing\.jpeg: holds 8 bits and sensor\.bits is 12"):
        with_keys(plan, "wrong.yaml", processing={"jpeg": 80}, sensor={"bits": 12})


def test_bop_is_that_of_the_folder(plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "set"
    assert write_dataset(plan, out) == 4
    write_bop(out)
    about = json.loads((out / "bop" / "camera.json").read_text())
    assert about == {
        "cx": 79.5, "cy": 59.5, "fx": 250.0, "fy": 250.0, "depth_scale": 1.0,
        "width": 160, "height": 120, "distortion": plan.camera.distortion.tolist(),
    }  # fmt: skip
    assert json.loads((out / "bop" / "targets.json").read_text()) == {"1": "quad40"}
    poses = json.loads((out / "bop" / "000000" / "scene_gt.json").read_text())
    assert [poses[str(i)][0]["cam_t_m2c"] for i in range(4)] == plan.t.tolist()


@pytest.mark.parametrize("text", ["{", "[1]", "3"])
def test_a_damaged_origin_is_one_clear_line(plan: Plan, tmp_path: Path, text: str) -> None:
    out = tmp_path / "set"
    write_dataset(plan, out)
    (out / "plan.json").write_text(text)
    with pytest.raises(ConfigError, match=r"plan\.json: --resume: missing or damaged; choose another folder"):
        write_dataset(plan, out, resume=True)


def test_a_plan_of_two_cameras_writes_a_folder_a_camera_and_the_truth_in_the_first(plan: Plan, tmp_path: Path) -> None:
    """The same plate at the same moments, as each camera sees it; noise of its own in each."""
    turn = rotations.exp(torch.tensor([0.0, 0.35, 0.0], dtype=torch.float64))
    middle = plan.t.mean(0)
    R, t = torch.stack([torch.eye(3).to(turn), turn]), torch.stack([0 * middle, middle - turn @ middle])
    rig = CameraRig([plan.camera, replace(plan.camera, width=plan.camera.width - 40)], R, t, names=["left", "right"])
    rig.save(plan.path.with_name("rig.yaml"))
    text = {key: value for key, value in yaml.safe_load(plan.path.read_text()).items() if key != "camera"}
    file = plan.path.with_name("several.yaml")
    file.write_text(yaml.safe_dump(text | {"cameras": "rig.yaml", "out_of_view": "mark", "bounds": True}))
    several, out = load_plan(file), tmp_path / "several"
    assert write_rig_dataset(several, out) == 2 * len(plan)
    truth, one = read_truth(out / "truth.csv"), plan_truth(plan)
    torch.testing.assert_close(truth.t, one.t)
    taken, bits = several.conditions, several.file.sensor.bits
    light = {"dark": taken.dark, "light": taken.light, "noise_sigma": taken.noise, "bits": bits}
    bound = rig_crlb(rig, plan.target, plan.R, plan.t, **taken.blur, **light)
    torch.testing.assert_close(truth.extra["sz"], bound[:, 2, 2].sqrt(), rtol=1e-6, atol=0)
    assert CameraRig.load(out / "rig.yaml").names == ("left", "right")
    seen = several.of_camera(1)
    torch.testing.assert_close(seen.t, plan.t @ turn.mT + t[1])
    clean = analytic(seen)(torch.zeros(1, dtype=torch.int64))[0]
    frame = decode(out / "right" / truth.frame[0])
    assert frame.shape == (plan.camera.height, plan.camera.width - 40)
    noise = float(seen.conditions.noise[0])
    off = (torch.from_numpy(frame).float() - clean).std()
    assert float(off) == pytest.approx(noise, abs=0.1 + 0.1 * noise)
    assert write_rig_dataset(several, out, resume=True) == 0


def test_a_plan_names_one_camera_or_several(plan: Plan) -> None:
    with pytest.raises(ConfigError, match="names no camera, or both kinds"):
        with_keys(plan, "both.yaml", cameras="rig.yaml")
