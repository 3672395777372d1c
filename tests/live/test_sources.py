"""Folders, films and rigs played as cameras: the newest frame, what was passed over, faults by name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from torchpose.errors import ConfigError
from torchpose.io.films import Film
from torchpose.io.sources import Source
from torchpose.live.sources import Clock, camera_of_rig, player
from torchpose.results import Status

SIZE = (64, 48)
ROOT = Path(__file__).parents[2]


class Time:
    """A clock that only goes on where somebody waits, or works."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += max(seconds, 1e-3)


def test_clock_gives_what_is_due_and_never_the_same_twice() -> None:
    time = Time()
    clock = Clock(10.0, time)
    assert clock.due(time.wait) == 0
    assert clock.due(time.wait) == 1
    time.now += 0.55
    assert clock.due(time.wait) == 6
    assert clock.due(time.wait) == 7
    assert time.now == pytest.approx(100.7, abs=0.01)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number + 8}.png"), np.full((48, 64), 10 * number, np.uint8))
    (tmp_path / "10.png").write_bytes(b"\x89PNG\r\n\x1a\n broken")
    cv2.imwrite(str(tmp_path / "11.png"), np.zeros((10, 10), np.uint8))
    return tmp_path


def test_folder_is_played_in_order_over_and_over(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time = Time()
    played = player(folder, SIZE, 10.0, lambda line: None)
    assert played.kind == "folder"
    played._clock = Clock(10.0, time)
    shots = [played.newest(time.wait) for _ in range(5)]
    assert [shot.name for shot in shots] == ["8.png", "9.png", "10.png", "11.png", "8.png"]
    assert shots[1].image is not None
    assert shots[1].image[0, 0] == 10
    assert [shot.fault and shot.fault.status for shot in shots] == [
        None,
        None,
        Status.UNREADABLE,
        Status.WRONG_SIZE,
        None,
    ]
    time.now += 0.65  # the estimator was busy: what has passed is dropped, not queued
    late = played.newest(time.wait)
    assert (late.name, late.passed_over) == ("10.png", 5)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, SIZE)
    assert writer.isOpened()
    for number in range(10):
        writer.write(np.full((48, 64, 3), 20 * number + 10, np.uint8))
    writer.release()
    return path


def test_film_is_played_by_the_clock(film: Path) -> None:
    time = Time()
    found = player(film, SIZE, None, lambda line: None)
    assert found.kind == "video"
    assert found._rate == 20.0  # the film's own
    found._clock = Clock(20.0, time)
    with found:
        shots = [found.newest(time.wait) for _ in range(3)]
        assert [shot.name for shot in shots] == ["clip.avi#1", "clip.avi#2", "clip.avi#3"]
        assert [float(shot.image.mean()) for shot in shots if shot.image is not None] == pytest.approx(
            [10, 30, 50], abs=3
        )
        time.now += 0.22  # three frames go by
        late = found.newest(time.wait)
        assert (late.name, late.passed_over) == ("clip.avi#7", 3)
        assert late.image is not None
        assert float(late.image.mean()) == pytest.approx(130, abs=3)
        names = [found.newest(time.wait).name for _ in range(5)]
        assert names == ["clip.avi#8", "clip.avi#9", "clip.avi#10", "clip.avi#1", "clip.avi#2"]  # over again
        time.now += 100.0  # after a pause it does not decode all that it missed
        assert found.newest(time.wait).passed_over <= 20


def test_film_of_another_size_has_a_fault(film: Path) -> None:
    shot = player(film, (640, 480), None, lambda line: None).newest(Time().wait)
    assert shot.fault is not None
    assert (shot.fault.status, shot.fault.reason) == (Status.WRONG_SIZE, "64x48")


def test_a_film_that_ends_early_shows_so_and_goes_on(film: Path) -> None:
    whole = film.read_bytes()
    film.write_bytes(whole[: 8 * len(whole) // 10])
    time = Time()
    found = player(film, SIZE, 20.0, lambda line: None)
    found._clock = Clock(20.0, time)
    shots = [found.newest(time.wait) for _ in range(12)]
    some = len(found.sources)  # frames, and one that says that there were to be more
    assert 2 <= some < 10
    assert [shot.name for shot in shots] == [f"clip.avi#{k % some + 1}" for k in range(12)]
    ends = [shot.fault.reason if shot.fault else "" for shot in shots]
    assert ends == ["truncated" if k % some == some - 1 else "" for k in range(12)]


def test_frames_that_a_film_lacks_are_asked_for_once(film: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "z.png"), np.full((48, 64), 200, np.uint8))
    found = player(tmp_path, SIZE, 20.0, lambda line: None)
    of = found.sources[0].film
    assert of is not None
    longer = Film(film, 13)  # as where packets do not decode
    found.sources = [Source(f"clip.avi#{k + 1}", film, tmp_path, directory=k, film=longer) for k in range(13)]
    found.sources.append(Source("z.png", tmp_path / "z.png", tmp_path))
    time = Time()
    found._clock = Clock(20.0, time)
    names = [found.newest(time.wait).name for _ in range(14)]
    shown = [f"clip.avi#{k}" for k in range(1, 12)]  # the eleventh says that it is not there
    assert names == [*shown, "z.png", *shown[:2]]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("missing", "does not exist"),
        ("missing.mp4", "does not exist"),
        ("list.avi", r"holds no .* \(not_an_image\)"),
        ("none.mp4", r"holds no .* \(empty\)"),
        ("empty", "holds no image"),
        ("v.mpg", "of a kind that is not read"),
    ],
)
def test_what_is_no_source_is_named(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "list.avi").write_text("#EXTM3U\nhttp://127.0.0.1/secret\n")  # FFmpeg alone would fetch that
    (tmp_path / "none.mp4").touch()
    (tmp_path / "v.mpg").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=f"{name}: SOURCE: {why}.*; give "):
        player(tmp_path / name, SIZE, None, lambda line: None)


def test_rigs_are_checked() -> None:
    rig, twin = ROOT / "configs/rig/ur5_2mp.yaml", ROOT / "configs/rig/twin_2mp.yaml"
    assert camera_of_rig(rig, twin, (1824, 1216), None).kind == "twin"
    assert camera_of_rig(Path(f"{rig}#camera"), None, (1824, 1216), None).kind == "camera"
    with pytest.raises(ConfigError, match="--rig: has no camera 'left'; known are camera"):
        camera_of_rig(Path(f"{rig}#left"), None, (1824, 1216), None)
    with pytest.raises(ConfigError, match="--rig: camera camera has 1824 x 1216, but --camera 640 x 480"):
        camera_of_rig(rig, None, (640, 480), None)
