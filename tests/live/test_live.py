"""The estimator's thread, recordings that `estimate` reads, stills, and what the interface answers."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.live.cell import CAMERA, TARGET, Page, Scene, looking, picture, served
from torchpose import pipeline
from torchpose.cli.main import main
from torchpose.detect import find_coarse
from torchpose.io.images import decode
from torchpose.io.manifest import read_manifest
from torchpose.io.reader import Fault
from torchpose.io.rows import POSE_SCHEMA
from torchpose.live import engine, recording
from torchpose.live.engine import Observer
from torchpose.live.sources import Shot
from torchpose.pipeline import PoseEstimator
from torchpose.results import Status
from torchpose.rig.faults import CameraFault, CameraReason, SessionFault, SessionReason


def press(page: Page, on: bool) -> dict[str, object]:
    answer = httpx.post(f"{page.url}/api/recording", json={"on": on}, timeout=30)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_state_is_the_row_of_estimate_with_its_age(tmp_path: Path) -> None:
    scene = Scene(images=[picture(5)], gap_s=0.3)
    with served(scene, tmp_path) as page:
        first = httpx.get(f"{page.url}/api/state")
        assert first.status_code in (200, 503)
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        row = httpx.get(f"{page.url}/api/state").json()
        assert list(row) == [*POSE_SCHEMA, "age_s", "fault"]
        assert 0 <= row["age_s"] < 10
        poses = PoseEstimator(CAMERA, TARGET)(picture(5))
        assert [row["tx"], row["ty"], row["tz"]] == poses.t[0].tolist()
        assert row["sz"] == float(poses.std[0, 2])
        assert row["nz"] == float(poses.noise_std[0, 2])


def test_a_target_that_moves_leaves_and_comes_back_is_seen_as_in_single_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Looked for near the last pose; covered, lost, or elsewhere, all over the frame."""
    searches: list[int] = []
    search = find_coarse

    def counted(*args: Any, **kwargs: Any) -> Any:
        searches.append(1)
        return search(*args, **kwargs)

    monkeypatch.setattr(pipeline, "find_coarse", counted)
    covered = picture(3)
    covered[:180, :240] = 90
    empty, far = np.full_like(covered, 110), picture(6, t=(14.0, -6.0, 155.0))
    near, nearer = picture(2, t=(2.0, 1.0, 150.0)), picture(7, t=(13.0, -6.0, 155.0))
    images = [picture(1), near, covered, empty, picture(4), far, nearer]
    follows = Observer(CAMERA, TARGET)
    whole = []
    for number, image in enumerate(images):
        shot = Shot(f"{number}", 0.0, image)
        searches.clear()
        row = follows.look(shot).row
        whole.append(bool(searches))
        alone = Observer(CAMERA, TARGET).look(shot).row
        assert (row["status"], row["markers"]) == (alone["status"], alone["markers"])
        for axis in "xyz" if row["tx"] is not None else "":
            assert abs(row[f"t{axis}"] - alone[f"t{axis}"]) < 0.1 * alone[f"n{axis}"]
    assert whole[:2] == [True, False]
    assert whole[3:] == [True, True, True, False]  # three markers have a second pose or none, by the last digit
    follows.look(Shot("gap", 0.0, None, Fault(Status.UNREADABLE, "corrupt")))
    searches.clear()
    assert follows.look(Shot("again", 0.0, images[-1])).row["status"] == "ok"
    assert not searches  # a frame that could not be read says nothing of where the target is


def test_a_recording_is_estimated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = [picture(number, t=(0.1 * number, 0.0, 150.0)) for number in range(5)]
    scene = Scene(images=images, gap_s=0.1)
    kept = tmp_path / "kept"
    with served(scene, kept) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        assert not kept.exists()  # until somebody asks
        started = press(page, True)
        assert started["on"]
        assert press(page, True)["name"] == started["name"]  # twice is once
        page.until(lambda: page.live.recorder.state.frames >= 4, 30)
        stopped = press(page, False)
    folder = kept / str(stopped["name"])
    frames = read_manifest(folder / "manifest.jsonl")
    assert len(frames) == stopped["frames"]
    records = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    assert [record["record"] for record in records] == ["session", *["frame"] * len(frames), "end"]
    assert records[-1]["reason"] == "complete"
    for record in records[1:-1]:  # each picture is the frame that its record names
        number = int(record["source_frame"].removesuffix(".png"))
        assert np.array_equal(decode(folder / record["image"]), images[number % 5])
        assert record["status"] == "ok"
    CAMERA.save(tmp_path / "camera.json")
    out = tmp_path / "poses.jsonl"
    command = ["estimate", str(folder / "manifest.jsonl"), "--camera", str(tmp_path / "camera.json")]
    with pytest.raises(SystemExit) as ended:
        main([*command, "--target", "quad40", "--out", str(out), "-q"])
    assert ended.value.code == 0, capsys.readouterr().err
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["status"] for row in rows] == ["ok"] * len(frames)
    for row, record in zip(rows, records[1:-1], strict=True):
        number = int(record["source_frame"].removesuffix(".png"))
        assert row["tx"] == pytest.approx(0.1 * (number % 5), abs=0.005)


def test_a_still_is_the_frame_with_its_row(tmp_path: Path) -> None:
    scene = Scene(images=[picture(7)], gap_s=0.2)
    with served(scene, tmp_path) as page:
        assert httpx.post(f"{page.url}/api/still", json={}).status_code in (200, 409)
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        names = [httpx.post(f"{page.url}/api/still", json={}).json()["name"] for _ in range(2)]
        assert len(set(names)) == 2
        for name in names:
            assert "/" not in name
            assert np.array_equal(decode(tmp_path / name), picture(7))
            row = json.loads((tmp_path / name).with_suffix(".json").read_text())
            assert row["status"] == "ok"


def test_a_slow_disk_leaves_frames_out_and_keeps_nobody_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = recording._LiveSession.write

    def slow(*args: object, **kwargs: object) -> None:
        assert passed.wait(30)  # until a frame has come that could not be taken
        write(*args, **kwargs)  # type: ignore[arg-type]

    passed = threading.Event()
    monkeypatch.setattr(recording._LiveSession, "write", slow)
    lines: list[str] = []
    with looking(Scene(gap_s=0.01), tmp_path, lines) as live:
        page = Page(0, live, lines)
        page.until(lambda: live.snapshot.sight is not None, 30)
        live.recorder.start()
        page.until(lambda: live.recorder.state.left_out > 0, 30)
        assert live.recorder.state.frames == 0
        passed.set()
        page.until(lambda: live.recorder.state.frames >= 2, 30)
        state = live.recorder.stop()
    assert state.left_out > 0
    assert len(list(tmp_path.glob("*/images/*.png"))) == live.recorder.state.frames


def test_a_full_disk_ends_the_recording_and_the_page_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with served(Scene(), tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        press(page, True)
        page.until(lambda: page.live.recorder.state.frames >= 1, 30)

        def full(*_: object) -> None:
            raise SessionFault(SessionReason.DISK_FULL, f"{tmp_path}: no space left on the disk; free some")

        monkeypatch.setattr(recording._LiveSession, "check_space", full)
        page.until(lambda: not page.live.recorder.state.on, 30)
        assert page.live.recorder.state.fault == "disk_full"
        refused = httpx.post(f"{page.url}/api/recording", json={"on": True})
        assert refused.status_code == 507
        assert refused.json() == {"error": "The disk is full."}  # the path is for the terminal
        assert str(tmp_path) in page.lines[-1]
        assert httpx.get(f"{page.url}/api/state").json()["status"] == "ok"


class Failing(Scene):
    """A camera that fails now and then."""

    faults: int = 1
    entered: int = 0

    def __enter__(self) -> Failing:
        self.entered += 1
        return self

    def newest(self, wait: Callable[[float], object]) -> Shot:
        if self.number == 2 and self.entered == 1:
            raise CameraFault(CameraReason.REMOVED, "camera camera: has been disconnected; check cable and power")
        if self.number == 4 and self.entered == 2:
            raise ZeroDivisionError("of the program")
        return super().newest(wait)


def test_faults_are_shown_and_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "AGAIN_S", 0.5)
    with served(Failing(), tmp_path) as page:
        page.until(lambda: page.live.snapshot.fault == "camera_removed", 30)
        assert httpx.get(f"{page.url}/api/state").json()["fault"] == "camera_removed"
        assert page.lines[0] == "camera camera: has been disconnected; check cable and power"
        page.until(lambda: page.live.snapshot.fault == "internal", 30)
        page.until(lambda: page.live.snapshot.fault is None, 30)
        assert "please report it" in page.lines[1]
        assert len(page.lines) == 2


def test_frames_that_cannot_be_read_have_a_row(tmp_path: Path) -> None:
    class Broken(Scene):
        def newest(self, wait: Callable[[float], object]) -> Shot:
            wait(0.1)
            return Shot("a.png", time.time(), None, Fault(Status.UNREADABLE, "truncated"))

    with served(Broken(), tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        row = httpx.get(f"{page.url}/api/state").json()
        assert (row["status"], row["reason"], row["tx"]) == ("unreadable", "truncated", None)
        assert httpx.get(f"{page.url}/api/picture").status_code == 204
        assert httpx.post(f"{page.url}/api/still", json={}).status_code == 409


def test_pictures_are_made_only_for_those_who_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchpose.live import pictures

    made: list[int] = []
    encode = pictures.encode

    def counted(snapshot: engine.Snapshot) -> bytes:
        made.append(snapshot.version)
        return encode(snapshot)

    monkeypatch.setattr(pictures, "encode", counted)
    with served(Scene(gap_s=0.02), tmp_path) as page:
        page.until(lambda: page.live.snapshot.number > 5, 30)
        assert made == []
        with httpx.Client(base_url=page.url) as http:
            for _ in range(30):
                assert http.get("/api/picture").headers["content-type"] == "image/jpeg"
        assert 1 <= len(made) < 30
        assert len(set(made)) == len(made)


def test_events_tell_the_history_and_then_every_frame(tmp_path: Path) -> None:
    with served(Scene(gap_s=0.2), tmp_path) as page:
        page.until(lambda: page.live.snapshot.number > 1, 30)
        with httpx.stream("GET", f"{page.url}/api/events", timeout=30) as viewer:
            assert viewer.headers["content-type"].startswith("text/event-stream")
            lines = iter(viewer.iter_lines())
            assert next(lines) == "event: history"
            points = json.loads(next(lines).removeprefix("data: "))["points"]
            assert len(points) >= 2
            assert len(points[0]) == 18
            numbers: list[int] = []
            while len(numbers) < 3:
                if next(lines) == "event: frame":
                    state = json.loads(next(lines).removeprefix("data: "))
                    numbers.append(state["number"])
                    assert state["seen"]["row"]["status"] == "ok"
                    assert len(state["seen"]["outlines"]) == 4
                    assert len(state["seen"]["axes"]) == 3
                    assert "covariance" not in state["seen"]["row"]
            assert numbers == sorted(set(numbers))


def test_it_ends_at_once_with_viewers_there(tmp_path: Path) -> None:
    with served(Scene(), tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        watching, ended = threading.Event(), threading.Event()

        def watch() -> None:
            # on a loaded machine the stream may be cut before it has ended
            stream = httpx.stream("GET", f"{page.url}/api/events", timeout=30)
            with contextlib.suppress(httpx.RemoteProtocolError), stream as viewer:
                for _ in viewer.iter_lines():
                    watching.set()
            ended.set()

        thread = threading.Thread(target=watch)
        thread.start()
        assert watching.wait(20)
        began = time.monotonic()
    assert time.monotonic() - began < 10
    thread.join(10)
    assert ended.is_set()
