"""``torchpose sensitivity`` as a user types it."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import pytest

from torchpose.cli.main import main

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")


def run(*arguments: object) -> str | int | None:
    with pytest.raises(SystemExit) as stopped:
        main(["sensitivity", *map(str, arguments)])
    return stopped.value.code


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_papers_set_up_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--out", tmp_path / "o", "--steps", 3, "--draws", 50) == 0
    shown = capsys.readouterr().out
    assert "0.2 px, focal length 0.25 %" in shown
    rows = rows_of(tmp_path / "o" / "errors.csv")
    assert {row["case"] for row in rows} == {"0.2 px", "1 px", "0.2 px, focal length 0.25 %"}
    far = next(r for r in rows if r["case"] == "0.2 px" and r["axis"] == "z" and float(r["distance_mm"]) == 32)
    assert float(far["paper_equations"]) == pytest.approx(7.68)
    assert float(far["predicted_rms"]) == pytest.approx(7.68 / 2**0.5, rel=1e-3)
    budget = rows_of(tmp_path / "o" / "budget.csv")
    assert {row["source"] for row in budget} == {"image", "focal_length", "total"}
    for name in ("errors.png", "budget.png"):
        assert cv2.imread(str(tmp_path / "o" / name)) is not None


def test_another_camera_and_every_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = ("--focal-error-percent", 0.05, "--principal-point-px", 1, "--print-um", 5, "--flatness-um", 10)
    more = ("--radius-um", 5, "--scale-percent", 0.05, "--distortion", "1e-4,1e-4,1e-5,1e-5", "--tilt-deg", 20)
    view = ("--camera", "data/sample/camera.yaml", "--target", "quad40", "--distance", 150, 170, "--steps", 3)
    assert run("--out", tmp_path, *view, *sources, *more, "--sigma-px", 0.01, "--draws", 20) == 0
    budget = rows_of(tmp_path / "budget.csv")
    found = {row["source"] for row in budget if "focal" in row["case"]}
    assert {"image", "distortion", "print_centers", "print_flatness", "print_radii", "print_scale", "total"} <= found


PRINTED = """
name: mine
units: mm
background: light
center_sigma: 0.02
edge_gain_sigma: 0.03
markers:
  - {id: 0, center: [-20, -20], outer_radius: 5.0, inner_radius: 1.5}
  - {id: 1, center: [20, -20], outer_radius: 5.0, inner_radius: 2.0}
  - {id: 2, center: [20, 20], outer_radius: 5.0, inner_radius: 2.5}
  - {id: 3, center: [-20, 20], outer_radius: 5.0, inner_radius: 3.0}
"""


def test_what_the_files_state_is_counted_and_what_they_do_not_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "target.yaml").write_text(PRINTED)
    view = ("--camera", "data/sample/camera.yaml", "--target", tmp_path / "target.yaml", "--distance", 150, 170)
    few = ("--steps", 3, "--focal-error-percent", 0, "--sigma-px", 0.01, "--draws", 400, "--noise", 2)
    assert run("--out", tmp_path / "o", *view, *few) == 0
    shown = capsys.readouterr().out
    assert "edges of the rings, noise 2" in shown
    assert "so exact but for the options: camera (its covariance" in shown
    rows = rows_of(tmp_path / "o" / "budget.csv")
    near = {(r["case"], r["source"]): r for r in rows if float(r["distance_mm"]) == 150}
    assert {source for _, source in near} == {"image", "target", "total"}
    edges = {source: row for (case, source), row in near.items() if "edges" in case}
    # four markers of 20 um: the mean of their places, whatever the noise
    assert float(edges["target"]["x_um"]) == pytest.approx(10, rel=0.1)
    assert float(edges["total"]["z_um"]) < 0.3 * float(near["0.01 px", "total"]["z_um"])  # sizes of rings tell
    drawn = next(r for r in rows_of(tmp_path / "o" / "errors.csv") if r["axis"] == "z")
    assert float(drawn["rms"]) == pytest.approx(float(drawn["predicted_rms"]), rel=0.15)
    assert cv2.imread(str(tmp_path / "o" / "budget_rings.png")) is not None


def test_without_other_sources_there_is_noise_alone(tmp_path: Path) -> None:
    assert run("--out", tmp_path, "--focal-error-percent", 0, "--sigma-px", 0.5, "--steps", 3, "--draws", 5) == 0
    assert {row["case"] for row in rows_of(tmp_path / "errors.csv")} == {"0.5 px"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--sigma-px", 0), "--sigma-px: is 0"),
        (("--sigma-px", "nan"), "--sigma-px: is nan"),
        (("--print-um", -1), "--print-um: is -1"),
        (("--distance", 30, 20), "--distance: is 30.0 20.0; give NEAR above 0"),
        (("--distance", 5, 20), "at 5 mm not all markers are in the frame"),
        (("--tilt-deg", 90), "--tilt-deg"),
        (("--distortion", "1e-3"), "--distortion: 1 numbers for 0 coefficients"),
        (("--distortion", "a,b"), "is no list of numbers"),
        (("--target", "quad9"), "quad9: target: is neither a file nor built in"),
        (("--camera", "missing.yaml"), "missing.yaml"),
        (("--draws", 1), "draws"),
        (("--noise", 0), "--noise: is 0"),
        (("--noise", 2, "--levels", 200, 100), "--levels: is 200 100"),
        (("--noise", 2, "--blur", -1), "--blur: is -1"),
    ],
)
def test_wrong_input_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, int | str], message: str
) -> None:
    assert run("--out", tmp_path / "o", "--steps", 3, "--draws", 5, *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_folder_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert run("--out", tmp_path / "file", "--steps", 3, "--draws", 5, "--sigma-px", 1) == 2
    assert "--out" in capsys.readouterr().err
