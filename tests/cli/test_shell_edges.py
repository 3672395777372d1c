"""What a shell and a disk do to a run: names, places, threads, full devices, files that were changed since."""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.io.journal import unseal
from torchpose.pipeline import PoseEstimator
from torchpose.sim import render
from torchpose.target import Target

WIDTH, HEIGHT = 320, 240
CAMERA = Camera.ideal(WIDTH, HEIGHT, 500.0)
BLANK = np.full((HEIGHT, WIDTH), 200, np.uint8)


def png(path: str, image: np.ndarray = BLANK) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(path, image)


def picture(z: float) -> np.ndarray:
    """A frame of quad40 at a distance."""
    import torch

    rotation, translation = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, z]], dtype=torch.float64)
    return render(CAMERA, Target.load("quad40"), rotation, translation, plate=(70.0, 70.0))[0].round().byte().numpy()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs a command in a folder with camera.yaml; gives the exit code and what was printed on stderr."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    CAMERA.save("camera.yaml")

    def call(*words: str) -> tuple[str | int | None, str]:
        with pytest.raises(SystemExit) as exit_:
            main([*words])
        return exit_.value.code, capfd.readouterr().err

    return call


ESTIMATE = ["estimate", "--camera", "camera.yaml", "--target", "quad40", "--out", "p.csv", "--threads", "1"]


def statuses() -> dict[str, str]:
    with Path("p.csv").open(newline="") as file:
        return {row["frame"]: row["status"] for row in csv.DictReader(file)}


def one_line(told: tuple[str | int | None, str], code: int, words: str) -> None:
    assert told[0] == code
    assert words in told[1]
    assert told[1].count("\n") == 1
    assert told[1][:-1].isprintable()


@pytest.mark.parametrize("command", ["estimate", "detect"])
@pytest.mark.parametrize("image", ["../out.png", "sub/../../out.png", "{absolute}", "link/out.png"])
def test_pictures_stay_in_their_folder(run: Callable[..., Any], command: str, image: str) -> None:
    """A manifest may name images anywhere; their pictures go below DIR or nowhere."""
    Path("pictures").mkdir()
    Path("pictures/link").symlink_to(Path("..").resolve(), target_is_directory=True)
    Path("link").symlink_to(Path("..").resolve(), target_is_directory=True)
    png("../out.png")
    image = image.format(absolute=Path("../out.png").resolve())
    lines = [{"record": "session"}, {"record": "frame", "id": 1, "image": image}]
    Path("m.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    before = {path: path.read_bytes() for path in Path("..").glob("*.png")}
    words = ESTIMATE if command == "estimate" else ["detect", "--out", "p.csv"]
    told = run(*words, "m.jsonl", "--overlay", "pictures")
    one_line(told, 2, "/work/pictures; give an INPUT whose frames lie in")
    assert {path: path.read_bytes() for path in Path("..").glob("*.png")} == before
    assert not Path("p.csv").exists()


def test_a_name_too_long_for_a_picture_is_told_before_anything_is_read(run: Callable[..., Any]) -> None:
    png("f/a.bmp")
    Path("f/a.bmp").rename("f/" + "a" * 249 + ".bmp")
    one_line(run(*ESTIMATE, "f", "--overlay", "pictures"), 2, "the name is too long for a picture's; shorten it")


@pytest.mark.parametrize(("one", "two"), [("a.pgm", "a.pgm.png"), ("d/a.bmp", "d/a.bmp.png")])
def test_two_frames_that_would_be_one_picture_are_told(run: Callable[..., Any], one: str, two: str) -> None:
    png(f"f/{one}")
    png(f"f/{two}")
    png("f/other.png")
    message = f"{one}: --overlay: would be the same picture as that of {two}, {Path(two).name}; rename one"
    one_line(run(*ESTIMATE, "f", "--overlay", "pictures"), 2, message)
    assert run(*ESTIMATE, "f")[0] == 0, "without pictures there is nothing in the way"


def test_an_input_that_is_given_twice_is_called_so(run: Callable[..., Any]) -> None:
    png("f/a.png")
    one_line(run(*ESTIMATE, "f", "f/a.png"), 2, "a.png: INPUT: is given twice; name it once")


def test_resume_does_again_what_was_replaced_or_could_not_be_used(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    png("f/a.png", picture(150.0))
    png("f/b.png", picture(160.0))
    png("f/small.png", BLANK[:100])
    Path("f/torn.png").write_bytes(Path("f/a.png").read_bytes()[:500])
    code, _ = run(*ESTIMATE, "f")
    assert code == 1
    assert statuses() == {"a.png": "ok", "b.png": "ok", "small.png": "wrong_size", "torn.png": "unreadable"}
    kept = Path("p.csv").read_text().splitlines()[2]
    assert json.loads(Path("p.csv.run.json").read_text())["files"]["a.png"][0] == os.stat("f/a.png").st_size
    # one is replaced by a picture of the same size in bytes, two by such as can be used
    png("f/small.png", picture(170.0))
    shutil.copy("f/b.png", "f/torn.png")
    os.utime("f/a.png", ns=(1, 1))
    seen: list[int] = []
    forward = PoseEstimator.forward

    def counted(self: PoseEstimator, frames: Any, *rest: Any, **more: Any) -> Any:
        seen.append(len(frames))
        return forward(self, frames, *rest, **more)

    monkeypatch.setattr(PoseEstimator, "forward", counted)
    assert run(*ESTIMATE, "f", "--batch", "1", "--resume")[0] == 0
    assert set(statuses().values()) == {"ok"}
    assert seen == [1, 1, 1]  # not b.png
    assert Path("p.csv").read_text().splitlines()[2] == kept
    assert run(*ESTIMATE, "f", "--batch", "1", "--resume")[0] == 0
    assert len(seen) == 3


def test_a_damaged_line_of_the_journal_is_done_again(run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "abc":
        png(f"f/{name}.png", picture(150.0))
    assert run(*ESTIMATE, "f", "--batch", "1")[0] == 0
    whole = Path("p.csv").read_bytes()
    Path("p.csv").unlink()
    with monkeypatch.context() as cut:
        cut.setattr("torchpose.io.store.ResultStore.finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert run(*ESTIMATE, "f", "--batch", "1")[0] == 130
    journal = Path("p.csv.partial")
    lines = journal.read_bytes().splitlines(keepends=True)
    assert all(unseal(line) for line in lines)
    journal.write_bytes(b"".join([*lines[:2], lines[2].replace(b'"tz": 1', b'"tz": 2'), lines[3]]))
    code, error = run(*ESTIMATE, "f", "--batch", "1", "--resume")
    assert code == 0
    assert "torchpose: 1 damaged lines of p.csv.partial left out, their frames done again\n" in error
    assert Path("p.csv").read_bytes() == whole


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (
            [BLANK[:100]] * 3,
            "no frame has the size of the camera file, 320x240: all frames are 320x100; give",
        ),
        ([BLANK] * 3, "quad40: no marker of it in any of 3 frames; check --target"),
    ],
    ids=["sizes", "nothing"],
)
def test_mistakes_of_a_whole_run_are_told_off_a_terminal_too(
    run: Callable[..., Any], frames: list[np.ndarray], words: str
) -> None:
    for number, frame in enumerate(frames):
        png(f"f/{number}.png", frame)
    one_line(run(*ESTIMATE, "f", "--quiet"), 0, f"torchpose: warning: {words}")


NAME = "\x1b[31m\x1b]0;x\x07[red]\n.png"


def test_names_neither_steer_the_terminal_nor_are_markup(run: Callable[..., Any]) -> None:
    png("a.png")
    Path("f").mkdir()
    Path("f", NAME).write_bytes(Path("a.png").read_bytes()[:60])
    told = run(*ESTIMATE, "f")
    one_line(told, 1, r"\x1b[31m\x1b]0;x\x07[red]\n.png (truncated): INPUT: 1 could not be read")
    assert statuses() == {NAME: "unreadable"}
    one_line(run(*ESTIMATE, "f/\x1b[2J"), 2, r"f/\x1b[2J: INPUT: does not exist")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--threads", "100000"], "'--threads'"),
        (["--batch", "1000000000"], "'--batch'"),
    ],
)
def test_more_threads_than_a_process_has_are_refused(run: Callable[..., Any], words: list[str], told: str) -> None:
    png("f/a.png")
    one_line(run(*ESTIMATE, "f", *words), 2, told)


LONG = "a" * 300
NO_PLACE = {
    "loop": "loop",
    "long": LONG,
    "below a long name": f"{LONG}/x",
    "below a loop": "loop/x",
    "far": "p/" * 2500,
}
WHERE = {
    "out": [*ESTIMATE, "f", "--out", "PLACE.csv"],
    "detections": [*ESTIMATE, "f", "--detections", "PLACE.csv"],
    "overlay": [*ESTIMATE, "f", "--overlay", "PLACE"],
    "image": [*ESTIMATE, "PLACE.png"],
    "manifest": [*ESTIMATE, "PLACE.jsonl"],
    "camera": [*ESTIMATE, "f", "--camera", "PLACE#1"],
    "target": [*ESTIMATE, "f", "--target", "PLACE"],
    "hand-eye": [*ESTIMATE, "f", "--hand-eye", "PLACE"],
    "calibration": ["calibrate", "f", "--target", "quad40", "--out", "PLACE.yaml"],
    "poses": ["evaluate", "PLACE.csv", "t"],
    "truth": ["evaluate", "p.csv", "PLACE"],
    "plan": ["simulate", "PLACE", "--out", "s"],
}


@pytest.mark.parametrize("kind", NO_PLACE)
def test_names_that_no_file_can_have_are_told_in_one_line(run: Callable[..., Any], kind: str) -> None:
    png("f/a.png")
    for suffix in ("", ".csv", ".png", ".jsonl", ".yaml"):
        Path(f"loop{suffix}").symlink_to(f"loop{suffix}")
    for where, words in WHERE.items():
        code, told = run(*(word.replace("PLACE", NO_PLACE[kind]) for word in words))
        # a table takes the place of a link that leads nowhere
        replaced = kind == "loop" and where in ("out", "detections", "calibration")
        assert code in ((0, 2) if replaced else (2,)), where
        assert "Traceback" not in told, where
        assert told.count("\n") <= 1, where


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ([*ESTIMATE, ""], "an argument"),
        ([*ESTIMATE, "f", "--overlay", ""], "--overlay"),
        ([*ESTIMATE, "f", "--hand-eye="], "--hand-eye"),
        (["watch", "", "-c", "camera.yaml"], "an argument"),
    ],
)
def test_an_empty_argument_is_no_folder(run: Callable[..., Any], words: list[str], name: str) -> None:
    """As a path "" is the working folder: a variable without a value would have it measured, or written to."""
    png("a.png")
    png("f/a.png")
    one_line(run(*words), 2, f"error: {name}: is empty; give a value, or leave it out")
    assert not Path("p.csv").exists()


def test_a_negative_deviation_is_called_so(run: Callable[..., Any]) -> None:
    words = ["calibrate", "f", "--target", "quad40", "--measure-target", "t.yaml", "--distance", "0", "1", "40", "-0.1"]
    one_line(run(*words), 2, "-0.1: a negative number stands where an option should")


def test_no_memory_is_told_in_one_line(run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:121] DefaultCPUAllocator: can't allocate memory: you tried")

    png("f/a.png")
    monkeypatch.setattr(PoseEstimator, "forward", full)
    one_line(run(*ESTIMATE, "f"), 2, "memory: there is not enough for this; give a smaller --batch")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's full device")
@pytest.mark.parametrize(("stdout", "stderr"), [("/dev/full", None), ("/dev/full", "/dev/full")])
def test_a_full_device_ends_in_one_line(tmp_path: Path, stdout: str, stderr: str | None) -> None:
    command = [sys.executable, "-m", "torchpose", "--version"]
    with open(stdout, "w") as out, open(stderr or tmp_path / "err", "w") as err:
        code = subprocess.run(command, stdout=out, stderr=err, check=False).returncode
    assert code == 2
    if stderr is None:
        told = (tmp_path / "err").read_text()
        assert told == (
            "torchpose: error: output: cannot be written or opened (No space left on device); free some, or choose "
            "another place\n"
        )
