"""``torchpose estimate --instances`` as a user types it: tables, pictures, a resumed run, evaluate."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from tests.cli.test_estimate import without_note
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.io.truth import Truth, write_truth
from torchpose.sim import add_noise
from torchpose.sim.trays import render_tray
from torchpose.target import Target

F64 = torch.float64
CAMERA = Camera(
    912,
    608,
    torch.tensor([[1000.0, 0, 455.5], [0, 1000, 303.5], [0, 0, 1]], dtype=F64),
    torch.tensor([-0.05, 0.01, 0.0, 0.0], dtype=F64),
)
QUAD = Target.load("quad40")
TURN = torch.tensor([[0.2, -0.1, 0.1], [0.1, 0.3, 1.2], [-0.2, 0.1, -0.7]], dtype=F64)
PLACE = torch.tensor([[80.0, 5.0, 340.0], [-80.0, -5.0, 345.0], [0.0, 8.0, 350.0]], dtype=F64)  # not from left to right
COUNTS = (3, 1, 2)  # copies in each frame


@pytest.fixture(scope="session")
def trays() -> list[np.ndarray]:
    R = rotations.exp(TURN)
    clean = [render_tray(CAMERA, QUAD, R[:n], PLACE[:n], plate=(70.0, 70.0)) for n in COUNTS]
    return list(add_noise(torch.stack(clean), 1.0, seed=4).numpy())


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], trays: list[np.ndarray]
) -> Callable[..., Any]:
    """Runs the command in a folder with frames/; gives the exit code and what was printed on stderr."""
    monkeypatch.chdir(tmp_path)
    CAMERA.save("camera.yaml")
    Path("frames").mkdir()
    for i, tray in enumerate(trays):
        assert cv2.imwrite(f"frames/{i}.png", tray)
    # torchpose simulate writes no trays: the truth of each copy is a row
    frames = [f"{i}.png" for i, n in enumerate(COUNTS) for _ in range(n)]
    index = torch.cat([torch.arange(n) for n in COUNTS])
    write_truth("truth.csv", Truth(frames, ["quad40"] * len(frames), PLACE[index], TURN[index]))

    def call(*words: str, target: str = "quad40", out: str = "poses.csv") -> tuple[str | int | None, str]:
        options = ["--camera", "camera.yaml", "--target", target, "--out", out, "--threads", "1"]
        with pytest.raises(SystemExit) as exit_:
            main(["estimate", "frames", *words, *options])
        return exit_.value.code, without_note(capfd.readouterr().err)

    return call


def table(path: str = "poses.csv") -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_row_for_every_copy_from_left_to_right(run: Callable[..., Any]) -> None:
    assert run("--instances", "5", "--detections", "det.csv", "--overlay", "seen") == (0, "")
    rows = table()
    assert [(row["frame"], row["instance"], row["copies"]) for row in rows] == [
        *(("0.png", number, "3") for number in "012"),
        ("1.png", "0", "1"),
        *(("2.png", number, "2") for number in "01"),
    ]
    assert {row["status"] for row in rows} == {"ok"}
    for row, copy in zip(rows, (1, 2, 0, 0, 1, 0), strict=True):
        np.testing.assert_allclose([float(row[c]) for c in ("tx", "ty", "tz")], PLACE[copy], atol=0.1)
        np.testing.assert_allclose([float(row[c]) for c in ("rx", "ry", "rz")], TURN[copy], atol=3e-3)
    seen = table("det.csv")
    assert [(d["frame"], d["instance"], d["marker"]) for d in seen] == [
        (row["frame"], row["instance"], str(marker)) for row in rows for marker in range(4)
    ]
    for d in seen:
        # the marker is where the pose of its copy puts it
        (row,) = [r for r in rows if (r["frame"], r["instance"]) == (d["frame"], d["instance"])]
        R = rotations.exp(torch.tensor([float(row[c]) for c in ("rx", "ry", "rz")], dtype=F64))
        t = torch.tensor([float(row[c]) for c in ("tx", "ty", "tz")], dtype=F64)
        u, v = CAMERA.project(R @ QUAD.centers[int(d["marker"])] + t).tolist()
        assert np.hypot(float(d["u"]) - u, float(d["v"]) - v) < 0.2


def test_every_format_has_the_number_of_the_copy(run: Callable[..., Any]) -> None:
    for out in ("poses.csv", "poses.jsonl", "poses.parquet"):
        assert run("--instances", "3", out=out) == (0, "")
    lines = [json.loads(line) for line in Path("poses.jsonl").read_text().splitlines()]
    cells = pq.read_table("poses.parquet").to_pylist()
    for row, line, cell in zip(table(), lines, cells, strict=True):
        assert int(row["instance"]) == line["instance"] == cell["instance"]
        assert int(row["copies"]) == line["copies"] == cell["copies"]


def test_without_it_a_row_a_frame_and_a_word_on_what_was_left_out(run: Callable[..., Any]) -> None:
    code, said = run()
    assert code == 0
    assert said == (
        "torchpose: 2 of 3 frames show more copies of a target than they have rows, up to 3 of quad40; "
        "--instances 3 looks for all\n"
    )
    assert [(row["frame"], row["instance"], row["copies"]) for row in table()] == [
        ("0.png", "0", "3"), ("1.png", "0", "1"), ("2.png", "0", "2"),
    ]  # fmt: skip
    # the same of rows that are kept, and of some of the copies
    assert run("--resume") == (0, said)
    assert run("--instances", "2") == (0, said.replace("2 of 3 frames", "1 of 3 frames"))
    assert run("--quiet") == (0, "")


def test_a_resumed_run_has_the_rows_of_an_undisturbed_one(run: Callable[..., Any]) -> None:
    whole = ("--instances", "3", "--detections", "det.csv", "--batch", "1")
    assert run(*whole) == (0, "")
    expected = Path("poses.csv").read_bytes(), Path("det.csv").read_bytes()
    # the journal of a run that was killed after the first frame
    Path("frames/1.png").rename("1.png")
    Path("frames/2.png").rename("2.png")
    assert run(*whole) == (0, "")
    for name in ("1.png", "2.png"):
        Path(name).rename(f"frames/{name}")
    assert run(*whole, "--resume") == (0, "")
    assert (Path("poses.csv").read_bytes(), Path("det.csv").read_bytes()) == expected
    code, said = run("--instances", "2", "--detections", "det.csv", "--resume")
    assert code == 2
    assert "--instances" in said


def test_evaluate_finds_the_truth_of_every_copy(run: Callable[..., Any], capfd: pytest.CaptureFixture[str]) -> None:
    def evaluated(*words: str) -> str:
        with pytest.raises(SystemExit) as exit_:
            main(["evaluate", "poses.csv", "truth.csv", *words])
        assert exit_.value.code == 0
        return capfd.readouterr().out

    run("--instances", "3")
    assert "6 rows: 6 ok" in evaluated("--out", "errors.csv")
    errors = table("errors.csv")
    assert [row["instance"] for row in errors] == ["2", "0", "1", "0", "1", "0"]
    assert all(abs(float(row["x_um"])) < 50 for row in errors)
    # copies that were not looked for are missing, copies that the truth does not have are told of
    run()
    assert re.search("6 rows: (3 ok, 3 no_target|3 no_target, 3 ok)", evaluated())
    run("--instances", "3")
    lines = Path("truth.csv").read_text().splitlines()
    Path("truth.csv").write_text("\n".join([lines[0], *lines[2:]]) + "\n")
    assert "1 further rows with a pose are of copies that the truth does not have" in evaluated()


def test_a_table_without_the_column_is_read(run: Callable[..., Any], capfd: pytest.CaptureFixture[str]) -> None:
    """As it was written before there were instances: by evaluate, and by --resume."""
    Path("frames/0.png").unlink()
    Path("frames/2.png").unlink()
    run("--detections", "det.csv")
    new = Path("poses.csv").read_bytes(), Path("det.csv").read_bytes()
    for name in ("poses.csv", "det.csv"):
        rows = table(name)
        old = [column for column in rows[0] if column not in ("instance", "copies")]
        with Path(name).open("w", newline="") as file:
            writer = csv.DictWriter(file, old, extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    origin = json.loads(Path("poses.csv.run.json").read_text())
    del origin["--instances"]
    Path("poses.csv.run.json").write_text(json.dumps(origin))
    lines = Path("truth.csv").read_text().splitlines()
    Path("truth.csv").write_text("\n".join([lines[0], lines[4]]) + "\n")
    with pytest.raises(SystemExit):
        main(["evaluate", "poses.csv", "truth.csv"])
    assert "1 rows: 1 ok" in capfd.readouterr().out
    assert run("--detections", "det.csv", "--resume") == (0, "")
    (row,) = table()
    assert (row["status"], row["instance"], row["copies"]) == ("ok", "0", "")
    assert Path("det.csv").read_bytes() == new[1]
    assert run("--detections", "det.csv") == (0, "")
    assert Path("poses.csv").read_bytes() == new[0]


def test_pictures_number_the_copies(run: Callable[..., Any], trays: list[np.ndarray]) -> None:
    """The axes of every copy are drawn, and one plate says how many there are."""
    assert run("--instances", "3", "--overlay", "seen") == (0, "")
    drawn = np.asarray(cv2.imread("seen/0.png"), dtype=int)
    coloured = (drawn.max(-1) - drawn.min(-1)) > 60
    at = CAMERA.project(PLACE).round().long().tolist()
    for u, v in at:
        assert coloured[v - 12 : v + 13, u - 12 : u + 13].sum() > 20
    green = (np.abs(drawn - np.array([60, 170, 40])).max(-1) < 4).mean(1) > 0.5
    assert 10 < green.sum() < 40


def test_targets_that_look_alike_end_in_one_line(run: Callable[..., Any]) -> None:
    text = Path(__file__).parents[2].joinpath("torchpose/targets/quad40.yaml").read_text()
    Path("twin.yaml").write_text(text.replace("quad40", "twin"))
    code, said = run("--target", "twin.yaml")
    assert code == 2
    assert said.count("\n") == 1
    for word in ("quad40", "twin", "--instances"):
        assert word in said
