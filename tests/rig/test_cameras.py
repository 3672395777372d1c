"""Cameras with the real pypylon on its emulator: settings, frames bit for bit, every fault by its name."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from torchpose.errors import ConfigError
from torchpose.rig.cameras import Cameras
from torchpose.rig.faults import CameraFault, CameraReason
from torchpose.rig.settings import CameraSettings, Rig, load_rig

pylon = pytest.importorskip("pypylon.pylon", reason="pypylon is not installed (extra: rig)")
ROBOT = {"host": "192.0.2.1", "workspace": {"min": [0, 0, 0], "max": [1, 1, 1]}}

SIZE = (64, 48)


def settings(**changes: Any) -> CameraSettings:
    return CameraSettings(**{"width": SIZE[0], "height": SIZE[1], "exposure_us": 5000, "timeout_s": 0.3, **changes})


@pytest.fixture(autouse=True)
def _emulators(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "2")


class Pictures:
    """A scene of random pictures, a new one at every look."""

    def __init__(self, folder: Path, shape: tuple[int, int] = (SIZE[1], SIZE[0]), dtype: Any = np.uint8) -> None:
        self.folder, self.shape, self.dtype = folder, shape, dtype
        self.random = np.random.default_rng(0)
        self.shown: dict[str, NDArray[Any]] = {}

    def __call__(self, name: str) -> Path:
        image = self.random.integers(0, np.iinfo(self.dtype).max, self.shape, self.dtype, endpoint=True)
        path = self.folder / f"{name}.tiff"
        cv2.imwrite(str(path), image, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
        self.shown[name] = image
        return path


def driver(cameras: Cameras, name: str = "camera") -> Any:
    """The pylon camera behind one of ours, to make faults in it."""
    return cameras._open[name]._camera


def test_frames_are_what_the_cameras_see(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)
    with Cameras([settings(name="left"), settings(name="right")], pictures) as cameras:
        for _ in range(5):
            before = time.time()
            frames = cameras.grab(["left", "right"])
            assert [frame.camera for frame in frames] == ["left", "right"]
            for frame in frames:
                np.testing.assert_array_equal(frame.image, pictures.shown[frame.camera])
                assert before <= frame.trigger_time_s <= time.time()
                assert (frame.attempts, frame.failures) == (1, ())


@pytest.mark.parametrize(("pixel_format", "shift"), [("Mono10", 6), ("Mono12", 4), ("Mono16", 0)])
def test_deeper_pixels_keep_their_values(tmp_path: Path, pixel_format: str, shift: int) -> None:
    pictures = Pictures(tmp_path, dtype=np.uint16)
    with Cameras([settings(pixel_format=pixel_format)], pictures) as cameras:
        (frame,) = cameras.grab(["camera"])
    assert frame.image.dtype == np.uint16
    np.testing.assert_array_equal(frame.image, pictures.shown["camera"] >> shift)


def test_settings_are_read_back() -> None:
    wanted = settings(width=128, height=96, exposure_us=1234, gain_db=3.0, nodes={"Gamma": 0.5, "ReverseX": True})
    with Cameras([wanted]) as cameras:
        (description,) = cameras.descriptions
        assert driver(cameras).TriggerMode.Value == "On"
    read = description["settings"]
    assert (read["Width"], read["Height"], read["PixelFormat"]) == (128, 96, "Mono8")
    assert read["ExposureTime"] == pytest.approx(1234)
    assert (read["Gain"], read["Gamma"], read["ReverseX"]) == (pytest.approx(3.0, abs=1e-4), pytest.approx(0.5), True)
    assert (description["emulated"], description["serial"]) == (True, "0815-0000")


def test_full_resolution_of_the_paper_is_taken() -> None:
    with Cameras([settings(width=5472, height=3648, timeout_s=5)]) as cameras:
        (frame,) = cameras.grab(["camera"])
    assert frame.image.shape == (3648, 5472)


def test_a_camera_is_found_by_its_serial_number() -> None:
    with Cameras([settings(name="first", serial="0815-0001"), settings(name="any")]) as cameras:
        assert [d["serial"] for d in cameras.descriptions] == ["0815-0001", "0815-0000"]


def refused(reason: CameraReason, *words: str, action: Callable[[], object]) -> float:
    start = time.monotonic()
    with pytest.raises(CameraFault) as caught:
        action()
    assert caught.value.reason == reason
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    return time.monotonic() - start


def opened(*wanted: CameraSettings) -> None:
    with Cameras(wanted):
        pass


def test_missing_cameras_are_named() -> None:
    refused(CameraReason.NOT_FOUND, "4711", "0815-0000", action=lambda: opened(settings(serial="4711")))
    three = [settings(name=name) for name in "abc"]
    refused(CameraReason.NOT_FOUND, "camera c", action=lambda: opened(*three))


def test_refused_settings_are_named() -> None:
    reason = CameraReason.REFUSED_SETTING
    refused(reason, "Gian", action=lambda: opened(settings(nodes={"Gian": 1.0})))
    refused(reason, "TriggerSource", "Fax", action=lambda: opened(settings(nodes={"TriggerSource": "Fax"})))
    refused(reason, "Gamma", action=lambda: opened(settings(nodes={"Gamma": 1e9})))
    opened(settings())  # a refused camera is given back


def test_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with Cameras([settings(attempts=2)]) as cameras:
        with monkeypatch.context() as lost:
            lost.setattr(cameras._open["camera"], "trigger", time.time)
            took = refused(CameraReason.TIMED_OUT, "0.3 s", action=lambda: cameras.grab(["camera"]))
        assert 2 * 0.3 <= took < 2 * 0.3 + 1
        assert cameras.grab(["camera"])[0].attempts == 1


def test_the_trigger_stays_as_the_capture_needs_it(tmp_path: Path) -> None:
    with Cameras([settings(nodes={"TriggerMode": "Off"})], Pictures(tmp_path)) as cameras:
        assert cameras.descriptions[0]["settings"]["TriggerMode"] == "On"
        assert cameras.grab(["camera"])


def test_failed_buffers_are_tried_again(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)
    with Cameras([settings(name="left"), settings(name="right")], pictures) as cameras:
        left = driver(cameras, "left")
        left.ForceFailedBufferCount.Value = 2
        left.ForceFailedBuffer.Execute()
        first, second = cameras.grab(["left", "right"])
        np.testing.assert_array_equal(first.image, pictures.shown["left"])
        assert (first.attempts, first.failures) == (3, ("failed_buffer", "failed_buffer"))
        assert (second.attempts, second.failures) == (1, ())
        left.ForceFailedBufferCount.Value = 3
        left.ForceFailedBuffer.Execute()
        refused(CameraReason.FAILED_BUFFER, "left", action=lambda: cameras.grab(["left", "right"]))


def test_a_removed_camera_is_seen_although_it_still_delivers() -> None:
    with Cameras([settings()]) as cameras:
        assert cameras.grab(["camera"])
        driver(cameras).FirePnPCallback.Execute()
        refused(CameraReason.REMOVED, "cable", action=lambda: cameras.grab(["camera"]))


def test_a_camera_removed_while_it_exposes(monkeypatch: pytest.MonkeyPatch) -> None:
    with Cameras([settings()]) as cameras:
        camera = cameras._open["camera"]
        trigger = camera.trigger
        monkeypatch.setattr(camera, "trigger", lambda: (driver(cameras).FirePnPCallback.Execute(), trigger())[1])
        refused(CameraReason.REMOVED, action=lambda: cameras.grab(["camera"]))


def test_frames_of_another_size(tmp_path: Path) -> None:
    with Cameras([settings()], Pictures(tmp_path, shape=(40, 64))) as cameras:
        refused(CameraReason.WRONG_SIZE, "64 x 40", "64 x 48", action=lambda: cameras.grab(["camera"]))


def rig_file(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    robot = "robot: {host: 127.0.0.2, workspace: {min: [0, 0, 0], max: [1, 1, 1]}}\n"
    path.write_text(robot + text)
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cameras: []\n", ["cameras"]),
        ("cameras: [{width: 64, height: 48}]\n", ["cameras[0].exposure_us", "missing"]),
        ("cameras: [{width: 64, height: 48, exposure: 5}]\n", ["exposure", "exposure_us"]),
        ("cameras: [{width: 64, height: 48, exposure_us: 5, serial: 4711}]\n", ["serial", "'4711'"]),
        ("cameras: [{width: 64, height: 48, exposure_us: 9000000}]\n", ["timeout_s"]),
        ("cameras: [{width: 64, height: 48, exposure_us: 5, name: a/b}]\n", ["cameras[0].name"]),
        ("cameras: [{width: 6, height: 4, exposure_us: 5}, {width: 6, height: 4, exposure_us: 5}]\n", ["twice"]),
    ],
)
def test_mistakes_in_a_rig_file(tmp_path: Path, text: str, words: list[str]) -> None:
    path = rig_file(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_cameras_on_one_line_are_triggered_at_once(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)
    follows = settings(name="right", nodes={"TriggerSource": "Line1"})
    with Cameras([settings(name="left"), follows], pictures) as cameras:
        first, second = cameras.grab(["left", "right"])
        assert first.trigger_time_s == second.trigger_time_s
        # its frame alone needs the camera that drives the line
        (alone,) = cameras.grab(["right"])
        np.testing.assert_array_equal(alone.image, pictures.shown["right"])
        # one that fails has the others taken again: frames of one moment are of one time
        driver(cameras, "right").ForceFailedBufferCount.Value = 1
        driver(cameras, "right").ForceFailedBuffer.Execute()
        first, second = cameras.grab(["left", "right"])
        assert first.trigger_time_s == second.trigger_time_s
        assert (first.attempts, second.failures) == (1, ("failed_buffer",))


def test_one_action_command_triggers_all(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = {"TriggerSource": "Action1", "ActionDeviceKey": 7, "ActionGroupKey": 5, "ActionGroupMask": 1}
    with Cameras([settings(name="left"), settings(name="right")]) as cameras:
        sent: list[tuple[int, ...]] = []

        class Command:
            def __init__(self, *given: int) -> None:
                self.given = given

            def IssueNoWait(self) -> None:
                sent.append(self.given)
                for name in ("left", "right"):  # what the network does
                    driver(cameras, name).ExecuteSoftwareTrigger()

        monkeypatch.setattr(pylon.GigETransportLayer, "ActionCommand", Command)
        for name, camera in cameras._open.items():  # as if these were cameras on a network
            camera.settings, camera.emulated = settings(name=name, nodes=nodes), False
        first, second = cameras.grab(["left", "right"])
    assert sent == [(7, 5, pylon.AllGroupMask)]
    assert first.trigger_time_s == second.trigger_time_s


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        (("Line1", "Line1"), "wait for a line that none of them drives (left, right)"),
        (("Action1", "Action1"), "waits for an action command without ActionDeviceKey among its nodes"),
    ],
)
def test_triggers_that_nobody_sends_are_refused(sources: tuple[str, str], message: str) -> None:
    names = ("left", "right")
    size = {"width": SIZE[0], "height": SIZE[1], "exposure_us": 5000}
    cameras = [{**size, "name": n, "nodes": {"TriggerSource": s}} for n, s in zip(names, sources, strict=True)]
    with pytest.raises(ValueError, match=re.escape(message)):
        Rig.model_validate({"robot": ROBOT, "cameras": cameras})
