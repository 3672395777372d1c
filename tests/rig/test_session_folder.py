"""A session's folder: what is on the disk after every kind of failure."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from torchpose.errors import ConfigError
from torchpose.rig.faults import SessionFault, SessionReason
from torchpose.rig.session import Session

IMAGE = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
POSE = [400.0, 0.0, 300.0, 3.0, 0.0, 0.0]
READING = {
    "pose": POSE,
    "joints": POSE,
    "robot_time_s": 1.0,
    "host_time_s": 2.0,
    "robot_mode": 7,
    "safety_mode": 1,
    "safety_bits": 1,
    "runtime_state": 2,
}
TAKEN: dict[str, Any] = {
    "camera": "camera",
    "waypoint": {"kind": "static", "id": "0000", "origin": True},
    "commanded_pose": POSE,
    "robot_pose": POSE,
    "before": READING,
    "after": READING,
    "trigger_time_s": 1.5,
    "camera_time": 0,
    "attempts": 1,
    "failures": [],
}


def opened(folder: Path, **changes: Any) -> Session:
    return Session(folder, **{"plan": "p", "images": {"camera": [64, 48, "Mono16"]}, **changes})


def begun(folder: Path, **changes: Any) -> Session:
    session = opened(folder, **changes).__enter__()
    session.begin(emulated=True, plan="small", waypoints=2, robot={}, cameras=[])
    return session


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]


def test_a_frame_is_an_image_and_a_line(tmp_path: Path) -> None:
    with begun(tmp_path) as session:
        session.write("0000", IMAGE, **TAKEN)
        session.end("complete")
    first, frame, end = records(tmp_path)
    assert (first["record"], first["emulated"], first["plan"], first["resumed"]) == ("session", True, "small", False)
    data = (tmp_path / frame["image"]).read_bytes()
    assert hashlib.sha256(data).hexdigest() == frame["sha256"]
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), IMAGE)
    assert (frame["id"], frame["width"], frame["height"]) == ("0000", 64, 48)
    assert (end["reason"], end["frames"]) == ("complete", 1)


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (errno.ENOSPC, SessionReason.DISK_FULL),
        (errno.EDQUOT, SessionReason.DISK_FULL),
        (errno.EIO, SessionReason.NOT_WRITABLE),
    ],
)
def test_a_line_that_does_not_fit_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, reason: SessionReason
) -> None:
    session = begun(tmp_path)
    session.write("0000", IMAGE, **TAKEN)
    before = (tmp_path / "manifest.jsonl").read_bytes()
    write = os.write

    def full(file: int, data: bytes) -> int:
        if len(data) > 20:
            return write(file, data[:20])  # a part of it still fits
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as disk:
        disk.setattr("torchpose.rig.session.os.write", full)
        with pytest.raises(SessionFault) as caught:
            session.write("0001", IMAGE, **TAKEN)
        session.end("disk_full")  # says nothing where even that does not fit
    assert caught.value.reason == reason
    assert (tmp_path / "manifest.jsonl").read_bytes() == before
    assert session.done == {"0000"}


def test_an_image_that_does_not_fit_leaves_nothing(tmp_path: Path) -> None:
    with begun(tmp_path) as session:
        (tmp_path / "images" / ".0000.png.tmp").symlink_to("/dev/full")
        with pytest.raises(SessionFault, match="no space left") as caught:
            session.write("0000", IMAGE, **TAKEN)
        session.end("disk_full")
    assert caught.value.reason == SessionReason.DISK_FULL
    assert list((tmp_path / "images").iterdir()) == []
    assert [r["record"] for r in records(tmp_path)] == ["session", "end"]


def test_a_resumed_session_knows_what_is_there(tmp_path: Path) -> None:
    with begun(tmp_path) as session:
        session.write("0000", IMAGE, **TAKEN)
        session.write("0001", IMAGE, **TAKEN)
    manifest = tmp_path / "manifest.jsonl"
    manifest.write_bytes(manifest.read_bytes()[:-30])  # the last line is torn
    with begun(tmp_path, resume=True) as session:
        assert session.done == {"0000"}
        session.write("0001", IMAGE, **TAKEN)
    assert [r["record"] for r in records(tmp_path)] == ["session", "frame", "session", "frame"]
    whole = manifest.read_bytes()
    manifest.write_bytes(whole[:-1])  # only the newline is missing: the line is whole
    with begun(tmp_path, resume=True) as session:
        assert session.done == {"0000", "0001"}
        session.end("complete")
    assert [r["record"] for r in records(tmp_path)][2:] == ["session", "frame", "session", "end"]


@pytest.mark.parametrize(
    ("line", "change", "message"),
    [
        (0, {"images": 1}, "line 1: images: "),
        (0, {"schema": "torchpose.capture/2"}, "line 1: schema: "),
        (1, {"sha256": None}, "line 2: sha256: is not text"),
        (1, {"robot_pose": [1.0, 2.0]}, "line 2: robot_pose"),
        (1, {"before": {**READING, "pose": "home"}}, "line 2: before.pose: "),
    ],
)
def test_a_manifest_that_was_changed_is_refused_by_line_and_field(
    tmp_path: Path, line: int, change: dict[str, Any], message: str
) -> None:
    with begun(tmp_path) as session:
        session.write("0000", IMAGE, **TAKEN)
    lines = records(tmp_path)
    lines[line] |= change
    (tmp_path / "manifest.jsonl").write_text("".join(json.dumps(record) + "\n" for record in lines))
    with pytest.raises(ConfigError, match=message) as caught:
        opened(tmp_path, resume=True)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_resumed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--resume: does not exist"):
        opened(tmp_path, resume=True)
    with begun(tmp_path):
        pass
    with pytest.raises(ConfigError, match="--out: holds a session already"):
        opened(tmp_path)
    with pytest.raises(ConfigError, match="has another plan"):
        opened(tmp_path, resume=True, plan="q")
    with pytest.raises(ConfigError, match="other cameras or image sizes"):
        opened(tmp_path, resume=True, images={"camera": [64, 40, "Mono16"]})
    with opened(tmp_path, resume=True) as session, pytest.raises(ConfigError, match="emulated is True there and False"):
        session.begin(emulated=False)


def test_a_session_that_cannot_begin(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ConfigError, match="--out: cannot be made"):
        opened(file).__enter__()
    with opened(tmp_path / "run") as session, pytest.raises(SessionFault, match="free some"):
        session.check_space(2**62)
    session.end("disk_full")
    assert not session.begun


def test_two_captures_cannot_write_one_session(tmp_path: Path) -> None:
    with begun(tmp_path) as session:
        session.write("0000", IMAGE, **TAKEN)
        before = (tmp_path / "manifest.jsonl").read_bytes()
        with pytest.raises(ConfigError, match="--out: another capture is writing this session; wait for it"):
            opened(tmp_path, resume=True)
        assert (tmp_path / "manifest.jsonl").read_bytes() == before
    with begun(tmp_path, resume=True) as session:
        assert session.done == {"0000"}


def test_a_session_that_began_meanwhile_is_not_begun_again(tmp_path: Path) -> None:
    late = opened(tmp_path)
    with begun(tmp_path), pytest.raises(ConfigError, match="another capture is writing"):
        late.__enter__()
    with pytest.raises(ConfigError, match="holds a session already"):
        late.__enter__()


def test_a_killed_capture_holds_no_lock(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from tests.rig.test_session_folder import IMAGE, TAKEN, Path, begun\n"
        "one = begun(Path(sys.argv[2])); one.write('0000', IMAGE, **TAKEN); print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parents[2]), str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ConfigError, match="another capture is writing"):
            opened(tmp_path, resume=True)
        other.kill()
    with begun(tmp_path, resume=True) as session:
        assert session.done == {"0000"}


def test_an_image_that_is_not_the_one_written_is_refused(tmp_path: Path) -> None:
    with begun(tmp_path) as session:
        session.write("0000", IMAGE, **TAKEN)
    image = tmp_path / "images" / "0000.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ConfigError, match=r"0000\.png: --resume: is not the image that was written"):
        opened(tmp_path, resume=True)
    image.write_bytes(whole)
    manifest = tmp_path / "manifest.jsonl"
    manifest.write_bytes(manifest.read_bytes() + manifest.read_bytes().splitlines(keepends=True)[1])
    with pytest.raises(ConfigError, match="line 3: id: '0000' occurs twice"):
        opened(tmp_path, resume=True)


def test_an_image_outside_of_the_session_is_refused(tmp_path: Path) -> None:
    with begun(tmp_path / "s") as session:
        session.write("0000", IMAGE, **TAKEN)
    lines = records(tmp_path / "s")
    lines[1]["image"] = "../s2/0000.png"
    (tmp_path / "s" / "manifest.jsonl").write_text("".join(json.dumps(record) + "\n" for record in lines))
    with pytest.raises(ConfigError, match=r"line 2: image: .* lies outside of the session"):
        opened(tmp_path / "s", resume=True)
