"""What people expect of a program in a shell: pipes, lists of files, short options, defaults from a file, films."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import typer

from torchpose.camera import Camera
from torchpose.cli.main import app, main
from torchpose.io.films import Film, NoFrameError, frames_of_film
from torchpose.io.images import UnreadableImageError
from torchpose.sim import render
from torchpose.target import Target

WIDTH, HEIGHT = 320, 240
CAMERA = Camera.ideal(WIDTH, HEIGHT, 500.0)
DISTANCES = (240.0, 245.0, 250.0, 255.0)
Run = Callable[..., tuple[Any, str, str]]


@pytest.fixture(scope="session")
def pictures() -> np.ndarray:
    """Frames (4, H, W) of quad40 at DISTANCES."""
    rotation = torch.eye(3, dtype=torch.float64).repeat(len(DISTANCES), 1, 1)
    translation = torch.tensor([[0.0, 0.0, z] for z in DISTANCES], dtype=torch.float64)
    frames = render(CAMERA, Target.load("quad40"), rotation, translation, plate=(70.0, 70.0))
    return frames.round().byte().numpy()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in a folder with camera.yaml; gives the exit code and what was printed."""
    monkeypatch.chdir(tmp_path)
    CAMERA.save("camera.yaml")

    def call(*words: str) -> tuple[Any, str, str]:
        with pytest.raises(SystemExit) as exit_:
            main([*words])
        captured = capfd.readouterr()
        return exit_.value.code, captured.out, captured.err

    return call


GIVEN = ("-c", "camera.yaml", "-t", "quad40", "-j", "1")


def write(path: str, image: np.ndarray) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(path, image)


def film(path: str, frames: np.ndarray, codec: str = "MJPG") -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 25.0, frames.shape[:0:-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


def table(path: str) -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_on_standard_output_are_those_of_a_file(run: Run, pictures: np.ndarray) -> None:
    for i, picture in enumerate(pictures):
        write(f"f/{i}.png", picture)
    Path("f/bad.png").touch()
    code, out, err = run("estimate", "f", *GIVEN, "-o", "-", "--batch", "2")
    assert code == 1
    assert "bad.png (empty)" in err
    assert run("estimate", "f", *GIVEN, "-o", "new/folders/p.jsonl", "--batch", "2")[:2] == (1, "")
    assert out == Path("new/folders/p.jsonl").read_text()
    assert [json.loads(line)["status"] for line in out.splitlines()] == ["ok"] * 4 + ["unreadable"]


@pytest.mark.parametrize("option", ["--resume", "--detections=d.csv"])
def test_what_standard_output_cannot_have(run: Run, pictures: np.ndarray, option: str) -> None:
    write("f/0.png", pictures[0])
    code, out, err = run("estimate", "f", *GIVEN, "-o", "-", option)
    assert (code, out) == (2, "")
    assert f"which has no {option.split('=')[0]}" in err


def test_a_reader_that_closes_its_pipe_ends_the_run_without_a_word(tmp_path: Path, pictures: np.ndarray) -> None:
    for i in range(12):
        write(str(tmp_path / f"f/{i}.png"), pictures[0])
    CAMERA.save(tmp_path / "camera.yaml")
    command = [sys.executable, "-m", "torchpose", "estimate", "f", *GIVEN, "-q", "--batch", "1", "-o", "-"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        assert json.loads(child.stdout.readline())["frame"] == "0.png"
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 141


LETTERS = {"camera": "-c", "target": "-t", "out": "-o", "method": "-m", "threads": "-j", "detections": "-d"}
LETTERS |= {"files_from": "-f", "quiet": "-q", "help": "-h"}


def test_common_options_have_their_letter_in_every_command() -> None:
    """As docs/shell.md has it."""
    command: Any = typer.main.get_command(app)
    found = [(name, option.name, option.opts) for name, one in command.commands.items() for option in one.params]
    assert {"live", "capture"} <= {name for name, option, _ in found if option == "camera"}
    assert [one for one in found if one[1] in LETTERS and LETTERS[one[1]] not in one[2]] == []


@pytest.mark.parametrize("ends", ["\n", "\0", "\r\n", "\ufeff\n"])
def test_lists_of_files(
    run: Run, pictures: np.ndarray, ends: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = ["run/a/1.png", str(tmp_path / "run/b/1.png"), "./run/b/deep/a b.png"]
    for name, picture in zip(names, pictures, strict=False):
        write(name, picture)
    write("run/b/other.png", pictures[0])
    mark, ends = ("\ufeff", ends[1:]) if ends.startswith("\ufeff") else ("", ends)  # as editors of Windows begin a file
    Path("list").write_bytes((mark + ends.join([*names, ""])).encode())
    if ends == "\n" and not mark:
        with Path("list").open() as file:
            monkeypatch.setattr(sys, "stdin", file)
            assert run("estimate", "-f", "-", *GIVEN, "-o", "p.csv")[0] == 0
    else:
        assert run("estimate", "-f", "list", *GIVEN, "-o", "p.csv")[0] == 0
    assert [row["frame"] for row in table("p.csv")] == ["a/1.png", "b/1.png", "b/deep/a b.png"]
    assert [float(row["tz"]) for row in table("p.csv")] == pytest.approx(DISTANCES[:3], abs=0.5)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "INPUT: is missing; give"),
        (("-f", "none"), "none: --files-from: No such file"),
        (("-f", "."), ".: file: is a folder"),
        (("-f", "empty"), "empty: --files-from: names no file"),
        (("-f", "gone"), "nowhere.png: INPUT: does not exist"),
        (("-f", "stored"), "s3://cell/a.png: --files-from: is a URL; lists name files, give it as INPUT"),
        (("m.jsonl",), "m.jsonl: INPUT: has no frame with an image; write a line "),
        (("a.webp",), "a.webp: INPUT: of a kind that is not read"),
    ],
)
def test_mistakes_with_inputs_are_told_in_a_line(run: Run, words: tuple[str, ...], told: str) -> None:
    Path("empty").write_text("\n\n")
    Path("gone").write_text("nowhere.png\n")
    Path("stored").write_text("s3://cell/a.png\n")
    Path("m.jsonl").write_text('{"record": "session"}\n')
    Path("a.webp").touch()
    code, _, err = run("estimate", *words, *GIVEN, "-o", "p.csv")
    assert code == 2
    assert told in err
    assert err.count("\n") == 1


def test_a_project_file_gives_what_the_command_line_does_not(run: Run, pictures: np.ndarray) -> None:
    write("set/frames/0.png", pictures[0])
    CAMERA.save("set/frames/lens.yaml")
    project = Path("set/frames/torchpose.yaml")
    project.write_text("camera: lens.yaml\ntarget: [quad40, hexa50]\nmethod: centers\n")
    code, _, err = run("estimate", "set/frames", "-o", "p.csv", "-j", "1")
    assert code == 0
    assert err.count("set/frames/torchpose.yaml: camera lens.yaml, target quad40 hexa50, method centers\n") == 1
    assert [row["target"] for row in table("p.csv")] == ["quad40", "hexa50"]
    made = json.loads(Path("p.csv.run.json").read_text())
    assert made["--method"] == "centers"
    # the command line wins, and nothing is said of what is not taken
    code, _, err = run("estimate", "set/frames", "-t", "quad40", "-m", "edges", "-o", "p.csv", "-j", "1")
    assert code == 0
    assert "torchpose.yaml: camera lens.yaml\n" in err
    assert [row["target"] for row in table("p.csv")] == ["quad40"]
    # in the working directory where there is none beside the frames
    Path("torchpose.yaml").write_text("camera: camera.yaml\ntarget: quad40\n")
    project.unlink()
    assert run("estimate", "set/frames/0.png", "-o", "p.csv", "-q") == (0, "", "")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("camra: c.yaml", "torchpose.yaml: camra: unknown key; did you mean camera?"),
        ("method: best", "torchpose.yaml: method: is 'best'; write"),
        ("instances: 0", "torchpose.yaml: instances: is 0; give at least 1"),
        ("target: []", "torchpose.yaml: target: is empty; give at least 1"),
        ("target: quad40", "--camera: is missing; give it, or write `camera: ...` into torchpose.yaml"),
        ("camera: none.yaml", "f/none.yaml: file: does not exist"),
        ("assume_upright: maybe", "f/torchpose.yaml: assume_upright: is neither true nor false; write one of them"),
        ("", "f/torchpose.yaml: file: is empty"),
        (None, "f/torchpose.yaml: file: does not exist; check the path"),
    ],
)
def test_project_files_that_are_refused(run: Run, pictures: np.ndarray, text: str | None, told: str) -> None:
    """None: a link to nothing. That of the working directory is another one."""
    write("f/0.png", pictures[0])
    if text is None:
        Path("torchpose.yaml").write_text("camera: camera.yaml\ntarget: quad40\n")
        Path("f/torchpose.yaml").symlink_to("gone.yaml")
    else:
        Path("f/torchpose.yaml").write_text(text)
    code, _, err = run("estimate", "f", "-o", "p.csv")
    assert code == 2
    assert told in err
    assert err.count("\n") == 1


def test_two_project_files_are_not_mixed(run: Run, pictures: np.ndarray) -> None:
    for folder in ("a", "b"):
        write(f"{folder}/{folder}.png", pictures[0])
        Path(folder, "torchpose.yaml").write_text("camera: camera.yaml")
    assert "b/torchpose.yaml: INPUT: has another torchpose.yaml than a" in run("estimate", "a", "b", "-o", "p.csv")[2]


def test_the_shell_completes_commands_and_targets() -> None:
    def completed(words: str) -> str:
        asked = {"_TORCHPOSE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        command = [sys.executable, "-c", "from torchpose.cli.main import main; main()"]
        done = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, check=True)
        return done.stdout

    assert "estimate" in completed("torchpose est").split()
    assert completed("torchpose estimate --target quad").split() == ["quad40", "quad40_dark", "quad8"]


@pytest.mark.parametrize(("name", "codec"), [("v.avi", "FFV1"), ("v.mp4", "mp4v")])
def test_frames_of_a_film_have_rows(run: Run, pictures: np.ndarray, name: str, codec: str) -> None:
    film(name, pictures[[0, 1, 2, 3, 2, 1, 0]], codec)
    assert run("estimate", name, *GIVEN, "--tone", "linear", "-o", "p.csv", "--overlay", "o", "--batch", "2")[0] == 0
    rows = table("p.csv")
    assert [row["frame"] for row in rows] == [f"{name}#{number}" for number in range(1, 8)]
    truth = [DISTANCES[i] for i in (0, 1, 2, 3, 2, 1, 0)]
    assert [float(row["tz"]) for row in rows] == pytest.approx(truth, abs=1.0)
    assert Path("o", f"{name}#7.png").exists()


def test_a_film_that_ends_early_has_its_rows_and_one_that_says_so(run: Run, pictures: np.ndarray) -> None:
    film("f/v.avi", pictures[[0] * 10])
    whole = Path("f/v.avi").read_bytes()
    Path("f/v.avi").write_bytes(whole[: len(whole) // 2])
    Path("f/w.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    Path("f/x.avi").write_text("#EXTM3U\nhttp://127.0.0.1/secret\n")
    write("f/z.png", pictures[0])
    code, _, err = run("estimate", "f", *GIVEN, "--tone", "linear", "-o", "p.csv")
    assert code == 1
    rows = {row["frame"]: row["status"] + row["reason"] for row in table("p.csv")}
    first = [rows[f"v.avi#{number}"] for number in range(1, 4)]
    assert first == ["ok"] * 3
    told = [name for name, what in rows.items() if what == "unreadabletruncated"]
    assert len(told) == 1
    assert told == [name for name in rows if name.startswith("v.avi")][-1:]
    assert rows["w.mp4"] == "unreadablecorrupt"
    assert rows["x.avi"] == "unreadablenot_an_image"
    assert rows["z.png"] == "ok"
    assert f"{told[0]} (truncated)" in err
    # a resumed run has the same rows
    assert run("estimate", "f", *GIVEN, "--tone", "linear", "-o", "p.csv", "--resume")[0] == 1
    assert {row["frame"]: row["status"] + row["reason"] for row in table("p.csv")} == rows


def test_frames_of_a_film_come_in_any_order_from_bounded_memory(tmp_path: Path) -> None:
    path = str(tmp_path / "v.mkv")
    frames = np.stack([np.full((HEIGHT, WIDTH), 2 * number, np.uint8) for number in range(60)])
    film(path, frames, "FFV1")
    assert frames_of_film(Path(path)) == (60, False)
    one = Film(Path(path), 60)
    for number in (0, 3, 1, 2, 40, 39, 38, 59, 5):
        assert abs(float(one.decode(number, threads=4).mean()) - 2 * number) <= 1, number
        assert len(one._ahead) <= 4
    longer = Film(Path(path), 70)
    with pytest.raises(NoFrameError):
        longer.decode(65)
    with pytest.raises(UnreadableImageError, match="truncated") as caught:
        longer.decode(60)
    assert not isinstance(caught.value, NoFrameError)


def test_a_film_of_another_size_and_detect(run: Run, pictures: np.ndarray) -> None:
    film("v.avi", pictures[:2, :200])
    assert run("estimate", "v.avi", *GIVEN, "-o", "p.csv")[0] == 0
    assert [(row["status"], row["reason"]) for row in table("p.csv")] == [("wrong_size", "320x200")] * 2
    assert run("detect", "v.avi", "-o", "d.csv")[0] == 0
    assert {row["frame"] for row in table("d.csv")} == {"v.avi#1", "v.avi#2"}
