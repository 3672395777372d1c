"""``torchpose watch``: pictures as they arrive, to tables and pipes; signals; restarts."""

from __future__ import annotations

import contextlib
import csv
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from scripts.soak_watch import run as soak
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.sim import render
from torchpose.target import Target

WIDTH, HEIGHT = 320, 240
CAMERA = Camera.ideal(WIDTH, HEIGHT, 500.0)
GIVEN = ("-c", "camera.yaml", "-t", "quad40", "-j", "1", "--settle", "0.2")


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    rotation, translation = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0, 0, 250.0]], dtype=torch.float64)
    return render(CAMERA, Target.load("quad40"), rotation, translation, plate=(70.0, 70.0))[0].round().byte().numpy()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, picture: np.ndarray) -> Path:
    """The working directory, with camera.yaml and in/0.png."""
    monkeypatch.chdir(tmp_path)
    CAMERA.save("camera.yaml")
    Path("in").mkdir()
    cv2.imwrite("in/0.png", picture)
    return tmp_path


def watch(*words: str) -> int | str | None:
    with pytest.raises(SystemExit) as end:
        main(["watch", "in", *GIVEN, "--idle", "0.5", *words])
    return end.value.code


def test_a_table_grows_from_run_to_run(folder: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]) -> None:
    Path("torchpose.yaml").write_text("method: centers\n")
    assert watch("-o", "new/p.csv", "--poll") == 0
    assert "in: waiting for pictures, read again and again" in (err := capfd.readouterr().err)
    assert "torchpose.yaml: method centers" in err
    assert "in: 1 rows (1 ok)" in err
    whole = Path("in/0.png").read_bytes()
    Path("in/cut.png").write_bytes(whole[:2000])
    cv2.imwrite("in/small.png", picture[:100])
    cv2.imwrite("in/0.png", picture)  # has its row
    assert watch("-o", "new/p.csv", "--poll") == 1
    assert "cut.png (truncated)" in capfd.readouterr().err
    with Path("new/p.csv").open(newline="") as file:
        rows = {row["frame"]: row["status"] for row in csv.DictReader(file)}
    assert list(rows.items()) == [("0.png", "ok"), ("small.png", "wrong_size"), ("cut.png", "unreadable")]
    # standard output starts anew, with the same rows
    assert watch("-o", "-", "-q") == 1
    out = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert {row["frame"]: row["status"] for row in out} == rows
    assert watch("-o", "new/p.csv", "-m", "edges") == 2
    assert "were made with another --method" in capfd.readouterr().err


def test_rows_go_to_those_who_listen(folder: Path, picture: np.ndarray) -> None:
    client = pytest.importorskip("websockets.sync.client")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    heard: list[str] = []

    def listen() -> None:
        while not heard:
            # the environment, where proxies stand, may change while the command imports
            with contextlib.suppress(OSError, KeyError, RuntimeError), client.connect(f"ws://127.0.0.1:{port}") as rows:
                cv2.imwrite("in/.late.png", picture)
                Path("in/.late.png").rename("in/late.png")
                heard.extend(rows)

    listener = threading.Thread(target=listen)
    listener.start()
    assert watch("-o", "p.jsonl", "--websocket", str(port), "--idle", "3") == 0
    listener.join(60)
    assert "late.png" in [json.loads(line)["frame"] for line in heard]
    assert heard[-1] == Path("p.jsonl").read_text().splitlines()[-1]


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_a_signal_ends_it_with_everything_written(folder: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "torchpose", "watch", "in", *GIVEN, "-o", "p.jsonl"]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as child:
        end = time.monotonic() + 120
        while not (Path("p.jsonl").exists() and Path("p.jsonl").stat().st_size) and time.monotonic() < end:
            time.sleep(0.05)
        child.send_signal(number)
        _, err = child.communicate(timeout=60)
    assert child.returncode == 0, err
    assert "in: 1 rows (1 ok)" in err
    (line,) = Path("p.jsonl").read_text().splitlines()
    assert json.loads(line)["status"] == "ok"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-o", "p.parquet"), "p.parquet: --out: cannot grow; give -, or"),
        (("-o", "p.csv", "--hand-eye", "tool.yaml"), "--hand-eye: is of a camera on the tool"),
    ],
)
def test_mistakes_are_told_in_a_line(
    folder: Path, words: tuple[str, ...], told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    Path("tool.yaml").write_text("tool_from_camera: {rotation: [0, 0, 0], translation: [0, 0, 50]}\n")
    assert watch(*words) == 2
    err = capfd.readouterr().err
    assert told in err
    assert err.count("\n") == 1
    assert not Path("p.csv").exists()


@pytest.mark.parametrize(("files", "kills"), [(24, 1), pytest.param(10000, 10, marks=pytest.mark.slow)])
def test_killed_and_started_again_every_file_has_its_row_once(tmp_path: Path, files: int, kills: int) -> None:
    found = soak(tmp_path / "soak", files, kills)
    assert dict(found) == {"rows": files, "missing": 0, "twice": 0, "wrong": 0, "exit code 0": 1}
