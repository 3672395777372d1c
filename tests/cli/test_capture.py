"""``torchpose capture`` on the twin, with the real pypylon and ur-rtde: sessions, every fault, Ctrl-C, resume."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from signal import Signals
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml

from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.io.manifest import read_manifest
from torchpose.rig.cameras import Cameras, Frame
from torchpose.rig.robot import Robot, RobotReading
from torchpose.rig.twin.controller import TwinController
from torchpose.rig.twin.scene import Scene

pytest.importorskip("pypylon.pylon", reason="needs pypylon: pip install '.[rig]'")
pytestmark = pytest.mark.skipif(not find_spec("rtde_control"), reason="needs ur-rtde: pip install '.[rig]'")

F64 = torch.float64
CAMERA = Camera(
    320, 240, torch.tensor([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]], dtype=F64), torch.zeros(5, dtype=F64)
)
_numbers = itertools.count(1)


Script = Callable[[int, TwinController, Cameras], None]


class Cell:
    """Files of a small cell on the twin, and the command as a user types it.

    A script, if set, is called before every exposure with its number, the twin's controller, and the cameras.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.capsys, self.monkeypatch = folder, capsys, monkeypatch
        self.out = folder / "run"
        self.script: Script = lambda number, controller, cameras: None
        self.robot: Any = None
        self.watcher: Any = None
        process = os.getpid() % 60000 + 256
        self.host = f"127.{process // 256}.{process % 256}.{next(_numbers) % 250 + 2}"
        CAMERA.save(folder / "camera.json")
        self.rig: dict[str, Any] = {
            "robot": {
                "host": "192.0.2.1",
                "tcp": [0.0, 0.0, 60.0, 0.0, 0.0, 0.0],
                "workspace": {"min": [350.0, -50.0, 250.0], "max": [450.0, 50.0, 350.0]},
                "speed_mm_s": 60.0,
                "acceleration_mm_s2": 1200.0,
                "settle": {"samples": 3, "timeout_s": 1.0},
                "connect_timeout_s": 3.0,
                "move_margin_s": 2.0,
            },
            "cameras": [{"name": "camera", "width": 320, "height": 240, "exposure_us": 1000.0, "timeout_s": 0.4}],
            "dwell_s": 0.0,
        }
        self.twin: dict[str, Any] = {
            "host": self.host,
            "cameras": [self.twin_camera("camera")],
            "target": "quad40",
            "tool_from_target": {"rotation": [math.pi, 0.0, 0.0], "translation": [0.3, -0.2, 0.4]},
            "imaging": {"plate": [70.0, 70.0]},
        }
        self.plan: dict[str, Any] = {
            "name": "small",
            "origin": {"translation": [400.0, 0.0, 300.0], "rotation": [math.pi, 0.0, 0.0]},
            "axes": "base",
            "steps": [{"static": {"repeats": 2}}, {"translation": {"axes": ["x"], "values_mm": [12]}}],
        }
        self._watch(monkeypatch)

    @staticmethod
    def twin_camera(name: str) -> dict[str, dict[str, list[float]] | str]:
        place = {"rotation": [0.01, -0.02, 0.03], "translation": [401.0, -2.0, 130.0]}
        return {"name": name, "camera": "camera.json", "base_from_camera": place}

    def _watch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        numbers, grab, move = itertools.count(), Cameras.grab, Robot.move

        def scripted(cameras: Cameras, names: list[str]) -> list[Frame]:
            scene: Any = cameras._scene
            self.script(next(numbers), scene.__self__.controller, cameras)
            return grab(cameras, names)

        def noted(robot: Robot, pose: tuple[float, float, float, float, float, float]) -> RobotReading:
            self.robot = robot
            return move(robot, pose)

        monkeypatch.setattr(Cameras, "grab", scripted)
        monkeypatch.setattr(Robot, "move", noted)

    def run(self, *options: str) -> tuple[str | int | None, list[str]]:
        """Exit code and the lines on stderr."""
        for name in ("rig", "twin", "plan"):
            (self.folder / f"{name}.yaml").write_text(yaml.safe_dump(getattr(self, name)))
        plan, rig, twin = (str(self.folder / f"{name}.yaml") for name in ("plan", "rig", "twin"))
        self.capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(["capture", plan, "--rig", rig, "--twin", twin, "--out", str(self.out), "--yes", *options])
        return ended.value.code, self.capsys.readouterr().err.splitlines()

    def records(self, kind: str | None = None) -> list[dict[str, Any]]:
        lines = (self.out / "manifest.jsonl").read_text().splitlines()
        return [r for r in map(json.loads, lines) if kind in (None, r["record"])]

    def is_complete(self, names: list[str] | tuple[str, str, str, str] = ("0000", "0001", "0002", "0003")) -> bool:
        """Whether every frame is there once, with its image, and the session is closed."""
        frames = self.records("frame")
        assert [frame["id"] for frame in frames] == list(names)
        for frame in frames:
            data = (self.out / frame["image"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == frame["sha256"]
        assert [p.name for p in sorted((self.out / "images").iterdir())] == [f"{name}.png" for name in names]
        assert self.records()[-1] == self.records("end")[-1]
        assert (self.records("end")[-1]["reason"], self.records("end")[-1]["frames"]) == ("complete", len(names))
        return True


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cell:
    return Cell(tmp_path, monkeypatch, capsys)


def test_a_session_joins_images_and_poses(cell: Cell) -> None:
    cell.plan["steps"].append({"rotation": {"axes": ["pitch"], "values_deg": [5]}})
    code, lines = cell.run("--camera", str(cell.folder / "camera.json"), "--target", "quad40")
    assert code == 0
    assert lines[-1] == f"6 frames in {cell.out / 'manifest.jsonl'}: ok 6"
    assert cell.is_complete([f"{i:04d}" for i in range(6)])
    session, *frames, _end = cell.records()
    assert (session["record"], session["emulated"], session["units"]["length"]) == ("session", True, "mm")
    assert session["robot"]["tcp_offset"] == pytest.approx([0, 0, 60, 0, 0, 0])
    assert session["cameras"][0]["settings"]["PixelFormat"] == "Mono8"
    kinds = [(f["waypoint"]["kind"], f["waypoint"]["axis"], f["waypoint"]["value"]) for f in frames]
    assert kinds[2:4] == [("translation", "x", 0.0), ("translation", "x", 12.0)]
    assert kinds[4:] == [("rotation", "pitch", 0.0), ("rotation", "pitch", 5.0)]
    assert [f["waypoint"]["origin"] for f in frames] == [True, True, True, False, True, False]
    for frame in frames:
        assert frame["before"]["host_time_s"] < frame["trigger_time_s"] < frame["after"]["host_time_s"]
        assert frame["before"]["safety_bits"] == 1
        assert frame["robot_pose"][:3] == pytest.approx(frame["commanded_pose"][:3], abs=0.05)
    assert [f.robot_pose for f in read_manifest(cell.out / "manifest.jsonl")] == [
        tuple(f["robot_pose"]) for f in frames
    ]


def test_the_poses_of_the_frames_are_those_of_the_robot(cell: Cell) -> None:
    cell.plan["steps"] = [
        {"handeye": {"count": 3, "x_mm": [-10, 10], "z_mm": [-5, 10], "tilt_deg": [10, 20], "roll_deg": [-15, 15]}}
    ]
    cell.rig["robot"]["speed_mm_s"] = 250.0
    cell.twin["robot"] = {"repeatability_mm": 0.02, "reading_noise_mm": 0.005}
    assert cell.run()[0] == 0
    poses = cell.folder / "poses.jsonl"
    camera = str(cell.folder / "camera.json")
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "estimate",
                str(cell.out / "manifest.jsonl"),
                "--camera",
                camera,
                "--target",
                "quad40",
                "--out",
                str(poses),
            ]
        )
    assert ended.value.code == 0
    scene = Scene.load(cell.folder / "twin.yaml")
    for row, frame in zip(map(json.loads, poses.read_text().splitlines()), cell.records("frame"), strict=True):
        assert row["status"] == "ok"
        R, t = scene.camera_from_target("camera", frame["robot_pose"])
        found = rotations.exp(torch.tensor([row["rx"], row["ry"], row["rz"]], dtype=F64))
        assert float(rotations.angle_between(found, R)) < 1e-3
        # some hundredths of a millimetre of the robot, and of a 320 px camera some more along its axis
        assert [row["tx"], row["ty"]] == pytest.approx(t[:2].tolist(), abs=0.1)
        assert row["tz"] == pytest.approx(float(t[2]), abs=0.3)


def test_several_cameras_at_once(cell: Cell) -> None:
    cell.rig["cameras"] = [{**cell.rig["cameras"][0], "name": name} for name in ("left", "right")]
    cell.twin["cameras"] = [cell.twin_camera(name) for name in ("left", "right")]
    cell.twin["cameras"][1]["base_from_camera"]["translation"] = [391.0, -2.0, 130.0]
    names = [f"{i:04d}_{camera}" for i in range(4) for camera in ("left", "right")]

    def full_disk(number: int, controller: TwinController, cameras: Cameras) -> None:
        if number == 2:
            (cell.out / "images" / ".0002_right.png.tmp").symlink_to("/dev/full")

    cell.script = full_disk
    assert cell.run()[0] == 1
    assert [r["id"] for r in cell.records("frame")] == names[:5]
    assert cell.run("--resume")[0] == 0
    assert cell.is_complete(names)
    left, right = cell.records("frame")[:2]
    assert left["before"] == right["before"]
    assert left["sha256"] != right["sha256"]
    # one camera's frames alone
    path = f"{cell.out / 'manifest.jsonl'}#right"
    poses, camera = cell.folder / "poses.csv", str(cell.folder / "camera.json")
    with pytest.raises(SystemExit) as ended:
        main(["estimate", path, "--camera", camera, "--target", "quad40", "--out", str(poses), "--method", "centers"])
    assert ended.value.code == 0
    assert [line.split(",")[0] for line in poses.read_text().splitlines()[1:]] == [
        f"images/{name}.png" for name in names[1::2]
    ]


def pylon_camera(cameras: Cameras) -> Any:
    return cameras._open["camera"]._camera


def lose_triggers(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    cameras._open["camera"].trigger = time.time  # type: ignore[method-assign]  # tells the time, triggers nothing


def fail_buffers(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    pylon_camera(cameras).ForceFailedBufferCount.Value = 3
    pylon_camera(cameras).ForceFailedBuffer.Execute()


def unplug_camera(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    pylon_camera(cameras).FirePnPCallback.Execute()


def change_size(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    path = cell.folder / "small.png"
    cv2.imwrite(str(path), np.zeros((200, 320), np.uint8))
    cameras._scene = functools.partial(lambda _scene, _name: path, cameras._scene)


def fill_disk(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    (cell.out / "images" / ".0002.png.tmp").symlink_to("/dev/full")


def robot_fault(name: str, at_fraction: float | None = None) -> Callable[..., Any]:
    return lambda cell, controller, cameras: controller.inject(name, at_fraction)


def kill_driver(cell: Cell, controller: TwinController, cameras: Cameras) -> None:
    cell.robot._child.kill()


FAULTS = [
    (lose_triggers, "time_out", 2),
    (fail_buffers, "failed_buffer", 2),
    (unplug_camera, "camera_removed", 2),
    (change_size, "wrong_size", 2),
    (fill_disk, "disk_full", 2),
    (robot_fault("protective_stop", 0.5), "protective_stop", 3),
    (robot_fault("emergency_stop"), "emergency_stop", 2),
    (robot_fault("kill"), "connection_lost", 2),
    (robot_fault("stall"), "stale_stream", 2),
    (kill_driver, "child_died", 2),
]


@pytest.mark.parametrize(("make", "reason", "kept"), FAULTS, ids=[reason for _, reason, _ in FAULTS])
def test_a_fault_ends_the_session_and_resume_completes_it(
    cell: Cell, make: Callable[..., Any], reason: str, kept: int
) -> None:
    begun = []

    def script(number: int, controller: TwinController, cameras: Cameras) -> None:
        if number == 2:  # before the third exposure
            make(cell, controller, cameras)
            begun.append(time.monotonic())

    cell.script = script
    code, lines = cell.run()
    assert time.monotonic() - begun[0] < 8  # of a command that ends its processes, too
    assert code == 1
    assert lines[-1].startswith(f"torchpose: error: {reason}: ")
    assert lines[-1].endswith(f"({cell.out} keeps {kept} of 4 frames; add --resume to go on)")
    end = cell.records()[-1]
    assert (end["record"], end["reason"], end["frames"]) == ("end", reason, kept)
    cell.script = lambda number, controller, cameras: None
    assert cell.run("--resume")[0] == 0
    assert cell.is_complete()
    assert [r["resumed"] for r in cell.records("session")] == [False, True]


@pytest.mark.parametrize(
    ("fault", "reason"), [("silent", "timed_out"), ("refuse_script", "refused_script"), ("not_remote", "not_remote")]
)
def test_a_robot_that_cannot_start(cell: Cell, fault: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as faulty:
        faulty.setattr("torchpose.rig.twin.scene.TwinController", functools.partial(TwinController, faults=[fault]))
        begin = time.monotonic()
        code, lines = cell.run()
        assert time.monotonic() - begin < 15
    assert (code, lines[-1].split(": ")[2]) == (1, reason)
    assert not (cell.out / "manifest.jsonl").exists()
    assert cell.run()[0] == 0
    assert cell.is_complete()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_stop_the_robot_at_once(cell: Cell, number: Signals) -> None:
    times = {}

    def interrupt(controller: TwinController) -> None:
        while controller.state()["fraction"] < 0.2 or not controller.state()["moving"]:
            time.sleep(0.002)
        times["signal"] = time.monotonic()
        os.kill(os.getpid(), number)
        while controller.state()["moving"]:
            time.sleep(0.002)
        times["stand"] = time.monotonic()
        times["fraction"] = controller.state()["fraction"]

    def script(number: int, controller: TwinController, cameras: Cameras) -> None:
        if number == 2:
            cell.watcher = threading.Thread(target=interrupt, args=[controller])
            cell.watcher.start()

    cell.rig["robot"]["speed_mm_s"] = 10.0
    cell.script = script
    code, lines = cell.run()
    cell.watcher.join()
    assert code == 130
    assert "interrupted: the robot is stopped" in lines[-1]
    assert times["stand"] - times["signal"] < 0.2
    assert times["fraction"] < 0.9
    assert cell.records()[-1]["reason"] == "interrupted"
    cell.script = lambda number, controller, cameras: None
    assert cell.run("--resume")[0] == 0
    assert cell.is_complete()


def test_a_killed_run_is_resumed_from_a_torn_line(cell: Cell) -> None:
    assert cell.run()[0] == 0
    manifest = cell.out / "manifest.jsonl"
    lines = manifest.read_bytes().splitlines(keepends=True)
    manifest.write_bytes(b"".join(lines[:3]) + lines[3][:100])  # two frames, and a part of the third
    assert cell.run("--resume")[0] == 0
    assert cell.is_complete()


def test_nothing_moves_without_consent(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the twin was started")

    monkeypatch.setattr("torchpose.rig.twin.scene.TwinController", refuse)
    code, lines = cell.run("--dry-run")
    assert code == 0
    assert "  x: 400.0 to 412.0 mm in the base, workspace 350 to 450" in lines
    assert "<svg" in (cell.out / "path.svg").read_text()
    monkeypatch.setattr("typer.confirm", lambda *_, **__: False)
    words = ["capture", str(cell.folder / "plan.yaml"), "--rig", str(cell.folder / "rig.yaml"), "--out", str(cell.out)]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "not confirmed" in cell.capsys.readouterr().err
    assert not (cell.out / "manifest.jsonl").exists()


def mistakes() -> list[Callable[..., Any]]:
    def outside(cell: Cell) -> str:
        cell.plan["steps"] = [{"translation": {"axes": ["x"], "values_mm": [70]}}]
        return "waypoint 0001 (translation x 70 mm) has x = 470.0 mm, outside of the workspace"

    def not_a_number(cell: Cell) -> str:
        cell.plan["steps"] = [{"poses": [[400.0, float("nan"), 300.0, 3.1, 0.0, 0.0]]}]
        return "steps[0].poses[0][1]: is not finite"

    def other_camera(cell: Cell) -> str:
        cell.rig["cameras"][0]["name"] = "left"
        return "cameras: 'left' of the rig file is missing"

    def other_size(cell: Cell) -> str:
        cell.rig["cameras"][0]["width"] = 300
        return "320 x 240 px, in the rig file 300 x 240"

    def no_place(cell: Cell) -> str:
        del cell.twin["cameras"][0]["base_from_camera"]
        return "does not say where it is"

    def two_places(cell: Cell) -> str:
        cell.twin["base_from_target"] = cell.twin["tool_from_target"]
        return "give tool_from_target or base_from_target, one of both"

    def not_loopback(cell: Cell) -> str:
        cell.twin["host"] = "192.168.0.10"
        return "host"

    def unknown_key(cell: Cell) -> str:
        cell.rig["dwell"] = 1
        return "did you mean dwell_s?"

    return [outside, not_a_number, other_camera, other_size, no_place, two_places, not_loopback, unknown_key]


@pytest.mark.parametrize("mistake", mistakes(), ids=lambda mistake: mistake.__name__)
def test_mistakes_in_the_files(cell: Cell, mistake: Callable[..., Any]) -> None:
    words = mistake(cell)
    code, lines = cell.run()
    assert code == 2
    assert len(lines) == 1
    assert words in lines[0]
    assert not cell.out.exists()


def test_mistakes_with_sessions(cell: Cell) -> None:
    assert cell.run("--resume") == (2, [lines := cell.run("--resume")[1][0]])
    assert "--resume: does not exist" in lines
    cell.plan["steps"] = [{"static": {"repeats": 1}}]
    assert cell.run("--quiet")[0] == 0
    assert "--out: holds a session already" in cell.run()[1][0]
    assert cell.run("--resume")[1][-1].endswith("complete, nothing is missing")
    cell.plan["steps"] = [{"static": {"repeats": 2}}]
    assert "has another plan" in cell.run("--resume")[1][0]
    cell.plan["steps"] = [{"static": {"repeats": 1}}]
    (cell.out / "images/0000.png").unlink()
    assert "0000.png: --resume: is missing" in cell.run("--resume")[1][0]
    with contextlib.suppress(SystemExit):
        main(["capture", "plan.yaml"])
    assert "see torchpose capture --help" in cell.capsys.readouterr().err
