"""Capture manifests: torn ends are tolerated, everything else that is wrong is refused by line and field."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from torchpose.camera import Camera, CameraRig
from torchpose.errors import ConfigError
from torchpose.io.manifest import read_manifest
from torchpose.io.moments import find_moments

SESSION = {"record": "session", "schema": 1, "units": {"length": "mm"}}
FRAME = {"record": "frame", "id": 0, "image": "0.png", "robot_pose": [1, 2, 3, 0.1, 0.2, 0.3], "sha256": "ignored"}


def write(path: Path, *records: dict[str, Any] | str, end: str = "\n") -> Path:
    path.write_text("\n".join(r if isinstance(r, str) else json.dumps(r) for r in records) + end)
    return path


def test_frames_without_image_other_records_and_blank_lines_are_passed_over(tmp_path: Path) -> None:
    failed = FRAME | {"id": 1, "image": None}
    path = write(tmp_path / "m.jsonl", SESSION, FRAME, "", {"record": "note", "text": "x"}, failed, {"record": "end"})
    (frame,) = read_manifest(path)
    assert frame.image == "0.png"
    assert frame.robot_pose == (1, 2, 3, 0.1, 0.2, 0.3)


@pytest.mark.parametrize("kept", range(1, len(json.dumps(FRAME))))
def test_a_torn_last_line_is_dropped_wherever_it_was_cut(tmp_path: Path, kept: int) -> None:
    torn = json.dumps(FRAME | {"id": 1, "image": "1.png"})[:kept]
    path = write(tmp_path / "m.jsonl", SESSION, FRAME, torn, end="")
    assert [frame.image for frame in read_manifest(path)] == ["0.png"]


def test_a_whole_last_line_counts_without_its_newline(tmp_path: Path) -> None:
    path = write(tmp_path / "m.jsonl", SESSION, FRAME, FRAME | {"id": 1, "image": "1.png"}, end="")
    assert [frame.image for frame in read_manifest(path)] == ["0.png", "1.png"]


@pytest.mark.parametrize(
    ("records", "field"),
    [
        ([SESSION, '{"record": "frame", "id"', FRAME], "line 2: not JSON"),
        ([SESSION, "[1, 2]"], "line 2: not an object"),
        ([SESSION, {"record": "frame", "image": "a.png"}], "line 2: id"),
        ([SESSION, {"record": "frame", "id": 1}], "line 2: image"),
        ([SESSION, {"record": "frame", "id": 1, "image": 5}], "line 2: image"),
        ([SESSION, FRAME, FRAME | {"image": "1.png"}], "line 3: id"),
        ([SESSION, FRAME, FRAME | {"id": 1}], "line 3: image"),
        ([{"record": "session"}, FRAME], "line 2: robot_pose: in unknown units"),
        ([{"record": "session", "units": {"length": "inch"}}], "line 1: units"),
        ([SESSION, FRAME | {"robot_pose": [1, 2, 3, 4, 5]}], "line 2: robot_pose"),
        ([SESSION, FRAME | {"robot_pose": [1, 2, 3, 4, 5, float("nan")]}], "line 2: robot_pose"),
        ([SESSION, FRAME | {"robot_pose": "home"}], "line 2: robot_pose"),
        (
            [SESSION, FRAME | {"robot_pose": [1, 2, 3, 180, 0, -90]}],
            "line 2: robot_pose: .* in rad, no angles",
        ),
        ([SESSION, FRAME | {"robot_pose": [10**400, 2, 3, 4, 5, 6]}], "line 2: 1000.* a number of 401 digits"),
        ([SESSION, FRAME | {"robot_pose": [1e20, 2, 3, 4, 5, 6]}], "line 2: robot_pose"),
        ([SESSION, FRAME | {"image": "a\0.png"}], "line 2: image"),
        ([SESSION, FRAME | {"image": "\ud800.png"}], "line 2: image"),
        ([SESSION, FRAME | {"image": "\x1b[2J.png"}], "line 2: image"),
        ([SESSION, FRAME | {"camera": {"a": 1}}], "line 2: camera"),
        ([SESSION, '{"record": ' + "[" * 100_000 + "]" * 100_000 + "}"], "line 2: lists and mappings lie"),
        ([SESSION, '{"record": "frame", "record": "end"}'], "line 2: record: given twice"),
        ([SESSION, FRAME | {"robot_pose": [1, 2, 3, 4, 5, "6"]}], "line 2: robot_pose"),
        ([SESSION, FRAME | {"id": True}], "line 2: id"),
        ([SESSION | {"units": ["mm"]}], "line 1: units"),
    ],
)
def test_broken_records_are_refused_by_line_and_field(
    tmp_path: Path, records: list[dict[str, Any] | str], field: str
) -> None:
    path = write(tmp_path / "m.jsonl", *records)
    with pytest.raises(ConfigError, match=field) as caught:
        read_manifest(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_frames_of_one_camera(tmp_path: Path) -> None:
    path = tmp_path / "manifest.jsonl"
    frames = [{"record": "frame", "id": i, "image": f"{i}.png", "camera": "ab"[i % 2]} for i in range(4)]
    path.write_text("".join(json.dumps(frame) + "\n" for frame in frames))
    assert [frame.image for frame in read_manifest(path, "b")] == ["1.png", "3.png"]
    with pytest.raises(ConfigError, match=r"frames of 2 cameras; pick one: manifest.jsonl#a"):
        read_manifest(path)
    with pytest.raises(ConfigError, match="no frame of camera 'c'; known are a, b"):
        read_manifest(path, "c")


def test_pictures_of_a_moment_that_were_not_taken_at_one_time_are_told(tmp_path: Path) -> None:
    """The largest difference and its moment; nothing where all are within a millisecond or no time is recorded."""
    camera = Camera.ideal(8, 8, 8.0)
    eye = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    rig = CameraRig([camera, camera], eye, torch.zeros(2, 3, dtype=torch.float64), names=["a", "b"])

    def told(times: list[float | None]) -> list[str]:
        lines = []
        for number, time in enumerate(times):
            moment, name = divmod(number, 2)
            record = {"record": "frame", "id": number, "image": f"{moment}_{'ab'[name]}.png", "camera": "ab"[name]}
            lines.append(json.dumps(record | ({} if time is None else {"trigger_time_s": time})))
        path = tmp_path / "manifest.jsonl"
        path.write_text("\n".join(lines) + "\n")
        said: list[str] = []
        assert len(find_moments(path, rig, said.append)) == len(times) // 2
        return said

    assert told([1.7e9, 1.7e9 + 4e-4, 1.7e9 + 3, 1.7e9 + 3]) == []
    assert told([None, None]) == []
    (line,) = told([1.7e9, 1.7e9 + 0.02, 1.7e9 + 3, 1.7e9 + 3.25])
    assert "pictures of 2 of 2 moments were triggered up to 250 ms apart (1.png)" in line
