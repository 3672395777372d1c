"""``torchpose live`` as a user types it: what it says, what it refuses, how it ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import httpx
import pytest

from tests.live.cell import CAMERA, picture
from torchpose.cli.main import main
from torchpose.live.server import listen


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    CAMERA.save(tmp_path / "camera.json")
    (tmp_path / "frames").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), picture(number))
    return tmp_path


REFUSED: list[tuple[list[str], str]] = [
    (["frames", "--host", "0.0.0.0"], r"0.0.0.0: --host: is beyond this machine: .*; give --token TOKEN"),
    (["frames", "--host", "192.0.2.1", "--token", ""], r"--token: is empty"),
    (["frames", "--token", "a b"], r"--token: has to be"),
    ([], r"SOURCE, --rig: give one of both"),
    (["frames", "--rig", "rig.yaml"], r"SOURCE, --rig: give one of both"),
    (["frames", "--twin", "twin.yaml"], r"--twin: stands in the place of a rig; give --rig too"),
    (["missing"], r"missing: SOURCE: does not exist; give"),
    (["missing.mp4"], r"missing.mp4: SOURCE: does not exist; give"),
    (["camera.json"], r"camera.json: SOURCE: of an unknown kind; give"),
    (["--rig", "missing.yaml"], r"missing.yaml: file: does not exist"),
    (["frames", "--host", "no.such.name.invalid", "--token", "0123456789abc"], r"--host: no.such.name.invalid is no"),
    (["frames", "--host", "192.0.2.1", "--token", "0123456789abc"], r"--port: 192.0.2.1:8765 cannot be served"),
    (["frames", "--port", "65536"], r"--port"),
    (["frames", "--wanted-um", "0"], r"--wanted-um"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=lambda value: " ".join(value)[:40])
def test_what_cannot_be_is_told_in_one_line(
    cell: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(cell)
    with pytest.raises(SystemExit) as ended:
        main(["live", *arguments, "--camera", "camera.json", "--target", "quad40"])
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert re.search(f"error: .*{message}", lines[-1]), lines


def test_a_port_in_use_is_told(cell: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(cell)
    with listen("127.0.0.1", 0) as taken:
        port = str(taken.getsockname()[1])
        with pytest.raises(SystemExit) as ended:
            main(["live", "frames", "--camera", "camera.json", "--target", "quad40", "--port", port])
    assert ended.value.code == 2
    assert "cannot be served (Address already in use); give another --port" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_a_signal_and_leaves_everything_written(cell: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "torchpose", "live", "frames", "--camera", "camera.json", "--target", "quad40"]
    environment = os.environ | {"TORCHPOSE_TOKEN": "0123456789abc", "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(
        [*command, "--port", "0", "--record", "kept"],
        cwd=cell,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stderr is not None
    try:
        line = process.stderr.readline()
        found = re.fullmatch(r"torchpose: live at (http://127\.0\.0\.1:\d+)/ \(Ctrl-C ends\)\n", line)
        assert found is not None, line
        with httpx.Client(base_url=found[1], headers={"authorization": "Bearer 0123456789abc"}, timeout=30) as http:
            end = time.monotonic() + 60
            while (answer := http.get("/api/state")).status_code == 503 and time.monotonic() < end:
                time.sleep(0.1)
            assert answer.json()["status"] == "ok"
            assert http.post("/api/recording", json={"on": True}).status_code == 200
            time.sleep(1.0)
        process.send_signal(number)
        said = process.stderr.read()
        assert process.wait(30) == 0, said
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    (manifest,) = (cell / "kept").glob("recording-*/manifest.jsonl")
    records = manifest.read_text().splitlines()
    assert '"reason":"complete"' in records[-1]
    assert f"{len(records) - 2} frames recorded" in said
    assert "Traceback" not in said
