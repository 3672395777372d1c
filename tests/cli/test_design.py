"""``torchpose design`` as a user types it."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from torchpose.analysis import with_second
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.design import Imaging, WorkingVolume, predict_volume
from torchpose.target import Target

CAMERA = """
image_width: 640
image_height: 520
camera_matrix: {rows: 3, cols: 3, data: [800, 0, 319.5, 0, 800, 259.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [-0.05, 0.01, 0.0002, -0.0001]}
"""
GOOD = ["--distance", "150", "--plate", "50x50", "--accuracy-um", "1", "5"]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs the command in a folder of its own with a camera file; gives exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    with_second(Camera.load(tmp_path / "camera.yaml"), 150.0, 0.7).save(tmp_path / "rig.yaml")

    def call(*words: float | str) -> tuple[str | int | None, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(["design", *map(str, words)])
        return ended.value.code, *capfd.readouterr()

    return call


def test_a_design(run: Callable[..., Any], tmp_path: Path) -> None:
    code, out, err = run(
        "--camera", "camera.yaml", "--distance-range", 140, 160, "--tilt", 15, "--offset", 4, 0, "--plate", "50x40",
        "--accuracy-um", 2, 9, "--accuracy-deg", 0.02, "--f-number", 4, "--focal-length", 8, "--name", "left",
        "--out", "made"
    )  # fmt: skip
    assert (code, err) == (0, "")
    for word in ("predicted standard deviations", "pitch", "mdeg", "needed", "depth of field: focused on 149.3 mm"):
        assert word in out
    names = ["left.yaml", "left.svg", "left.pdf", "left_precision.csv", "left_map.png"]
    assert sorted(p.name for p in (tmp_path / "made").iterdir()) == sorted(names)
    for name in names:
        assert f"made/{name}" in out
    target = Target.load(tmp_path / "made" / "left.yaml")
    assert target.name == "left"
    beyond = target.centers[:, :2].abs().amax(0) + target.radii[0, 0]
    assert beyond[0] < 25
    assert beyond[1] < 20
    with (tmp_path / "made" / "left_precision.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["axis"] for row in rows] == ["x", "y", "z", "pitch", "yaw", "roll"]
    for row in rows:
        assert 0 < float(row["middle"]) <= float(row["worst"]) <= float(row["needed"])
        assert 140 <= float(row["worst_z_mm"]) <= 160
        assert -4 <= float(row["worst_x_mm"]) <= 4
        assert 0 <= float(row["worst_tilt_deg"]) <= 15.01
    picture = cv2.imread(str(tmp_path / "made" / "left_map.png"))
    assert picture is not None
    assert picture.shape[1] > 1200
    assert picture.std() > 20


def test_the_sheet_of_an_existing_target(run: Callable[..., Any], tmp_path: Path) -> None:
    code, out, err = run("--target", "quad40", "--plate", "70x70", "--out", "a/b")
    assert (code, err) == (0, "")
    assert out.split() == ["a/b/quad40.svg", "a/b/quad40.pdf"]
    assert run("--target", "quad8", "--out", "a/b")[0] == 0
    assert (tmp_path / "a" / "b" / "quad8.pdf").read_bytes().startswith(b"%PDF")


def test_the_precision_of_an_existing_target(run: Callable[..., Any], tmp_path: Path) -> None:
    code, out, _ = run("--target", "quad40", "--camera", "camera.yaml", "--distance", 150, "--out", "a", "--blur", 0.9)
    assert code == 0
    assert "depth of field: not counted" in out
    with (tmp_path / "a" / "quad40_precision.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["needed"] for row in rows] == [""] * 6
    assert all(float(row["middle"]) > 0 for row in rows)


def test_a_second_camera_at_an_angle(run: Callable[..., Any], tmp_path: Path) -> None:
    words = ("--target", "quad40", "--distance", 150, "--camera", "camera.yaml", "--second-camera", 40)
    code, out, err = run(*words, "--out", "made")
    assert (code, err) == (0, "")
    assert "cam1: counts with 100 % of the rings" in out
    with (tmp_path / "made" / "quad40_precision.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rig = with_second(Camera.load(tmp_path / "camera.yaml"), 150.0, math.radians(40))
    promised = predict_volume(rig, Target.load("quad40"), WorkingVolume((150.0, 150.0)), Imaging())
    assert [float(row["worst"]) for row in rows] == pytest.approx(promised.worst.tolist())
    assert float(rows[2]["worst_first_camera_alone"]) > 2.5 * float(rows[2]["worst"])
    with (tmp_path / "made" / "second_camera.csv").open(newline="") as file:
        angles = {float(row["angle deg"]): float(row["z um"]) for row in csv.DictReader(file)}
    assert 0.98 < float(rows[2]["middle"]) / angles[40.0] < 1.2  # the bound
    assert (tmp_path / "made" / "second_camera.png").is_file()


def test_a_print_class_is_counted_and_stated(run: Callable[..., Any], tmp_path: Path) -> None:
    words = ("--camera", "camera.yaml", *GOOD, "--markers", 4, "--name", "mine")
    code, out, err = run(*words, "--print", "plotter", "--out", "made")
    assert (code, err) == (0, "")
    assert "print: too coarse as it comes, good enough once it is measured; worst measured: after torchpose cal" in out
    text = (tmp_path / "made" / "mine.yaml").read_text()
    assert "center_sigma: 0.01\n" in text
    assert "edge_gain_sigma: 0.015\n" in text
    with (tmp_path / "made" / "mine_precision.csv").open(newline="") as file:
        rows = {row["axis"]: row for row in csv.DictReader(file)}
    assert float(rows["x"]["worst"]) > float(rows["x"]["needed"]) > 3 * float(rows["x"]["worst_measured"])
    assert b"Print: centres to 10 um, edges to 15 um, 1 sigma." in (tmp_path / "made" / "mine.pdf").read_bytes()
    assert "print: counted as exact; give --print" in run(*words, "--out", "exact")[1]
    code, out, _ = run(*words[:2], "--distance", 150, "--target", "quad40", "--print", "5,5", "--out", "there")
    assert code == 0
    assert "print: counted as the target file states it" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "none.yaml", *GOOD], "none.yaml: file: does not exist"),
        (GOOD, "--camera: is missing"),
        (["--camera", "camera.yaml", *GOOD[2:]], "--distance: is missing"),
        (["--camera", "camera.yaml", *GOOD[:2], *GOOD[4:]], "--plate: is missing"),
        (["--camera", "camera.yaml", *GOOD[:4]], "--accuracy-um: is missing"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "50"], "--plate: '50' is not a size"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "-5x50"], "--plate: '-5x50' is not a size"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "nanxnan"], "--plate: 'nanxnan' is not a size"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "0x50"], "plate: 0 x 50 mm"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "500x500"], "larger than what is in view"),
        (["--camera", "camera.yaml", *GOOD, "--plate", "6x6"], "4 codes need"),
        (["--camera", "camera.yaml", *GOOD, "--distance", "-150"], "distance: -150 to -150 mm"),
        (["--camera", "camera.yaml", *GOOD, "--distance", "nan"], "distance: nan"),
        (["--camera", "camera.yaml", *GOOD, "--distance-range", "160", "170"], "150 mm is not within the range"),
        (["--camera", "camera.yaml", *GOOD, "--tilt", "-1"], "tilt: -1 degrees"),
        (["--camera", "camera.yaml", *GOOD, "--tilt", "nan"], "tilt: nan degrees"),
        (["--camera", "camera.yaml", *GOOD, "--roll", "400"], "roll: 400 degrees"),
        (["--camera", "camera.yaml", *GOOD, "--offset", "-1", "0"], "offset: -1 0 mm"),
        (["--camera", "camera.yaml", *GOOD, "--accuracy-um", "0", "1"], "accuracy: 0 is not above 0"),
        (["--camera", "camera.yaml", *GOOD, "--accuracy-um", "nan", "1"], "accuracy: nan is not above 0"),
        (["--camera", "camera.yaml", *GOOD, "--accuracy-um", "0.001", "1", "--markers", "4"], "cannot be reached"),
        (["--camera", "camera.yaml", *GOOD, "--blur", "0"], "blur: 0 px"),
        (["--camera", "camera.yaml", *GOOD, "--noise", "-1"], "noise: -1 grey levels"),
        (["--camera", "camera.yaml", *GOOD, "--levels", "200", "100"], "levels: 200 100"),
        (["--camera", "camera.yaml", *GOOD, "--f-number", "4"], "--focal-length"),
        (["--camera", "camera.yaml", *GOOD, "--f-number", "-4", "--focal-length", "8"], "f_number: -4"),
        (["--camera", "camera.yaml", *GOOD, "--markers", "5"], "markers: 5"),
        (["--camera", "camera.yaml", *GOOD, "--print", "inkjet"], "print: 'inkjet' is none of glass, plotter, laser"),
        (["--camera", "camera.yaml", *GOOD, "--print", "-1,2"], "print: places off by -1 um, edges by 2 um; give"),
        (["--camera", "camera.yaml", *GOOD, "--print-gain", "-1"], "print_gain: -0.001 mm"),
        (["--camera", "camera.yaml", *GOOD, "--background", "grey"], "background: is 'grey'"),
        (["--camera", "camera.yaml", *GOOD, "--name", "a/b"], "name: has the character '/'"),
        (["--target", "quad41"], "quad41: target: is neither a file nor built in"),
        (["--target", "quad40", "--plate", "20x70"], "does not hold the rings of quad40"),
        (["--target", "quad40", "--name", "x"], "leave --name, --markers and --print-gain out"),
        (["--target", "quad40", "--distance", "100"], "--camera: is missing"),
        (["--cameras", "rig.yaml", "--camera", "camera.yaml", *GOOD], "--camera: stands beside --cameras"),
        (["--cameras", "rig.yaml", "--second-camera", "40", *GOOD], "--second-camera: stands beside --cameras"),
        (["--second-camera", "40", *GOOD], "--camera: is missing"),
        (["--camera", "camera.yaml", "--second-camera", "90", *GOOD], "--second-camera: 90 degrees; give an angle"),
        (["--cameras", "none.yaml", *GOOD], "none.yaml: file: does not exist"),
        (["--cameras", "rig.yaml", "--target", "quad40", "--distance", "60"], "leave the frame"),
        (["--target", "quad40", "--camera", "camera.yaml", "--distance", "60"], "leave the frame"),
    ],
)
def test_mistakes_are_one_clear_line(run: Callable[..., Any], tmp_path: Path, words: list[str], message: str) -> None:
    code, out, err = run(*words, "--out", "made")
    assert code == 2
    assert err.startswith("torchpose: error: ")
    assert err.count("\n") == 1
    assert message in err
    assert out == ""
    assert not list(tmp_path.glob("made/*"))


def test_a_folder_that_cannot_be_written(run: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, _, err = run("--target", "quad40", "--out", "file/made")
    assert code == 2
    assert "file/made: --out: " in err
    assert err.count("\n") == 1
