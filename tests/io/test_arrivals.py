"""When a file counts as whole, with events of the system and without."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchpose.errors import ConfigError
from torchpose.io.arrivals import Arrivals

SETTLE = 0.25  # s


@pytest.fixture(params=["events", "polling"])
def arrivals(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Arrivals]:
    if request.param == "events":
        pytest.importorskip("watchdog")
    one = Arrivals(tmp_path, settle=SETTLE, events=request.param == "events")
    assert one.by_events == (request.param == "events")
    one.ready(0.0)
    yield one
    one.close()


def names(arrivals: Arrivals, wait: float = 6 * SETTLE) -> list[str]:
    return [file.name for file in arrivals.ready(wait)]


def test_files_that_are_there_come_first_in_natural_order(tmp_path: Path) -> None:
    for name in ("10.png", "9.png", ".hidden.png", "a.txt", "b.png.part"):
        (tmp_path / name).write_text("x")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "1.TIF").write_text("x")
    time.sleep(SETTLE)
    arrivals = Arrivals(tmp_path, settle=SETTLE, events=False)
    assert names(arrivals, 0.0) == ["9.png", "10.png", "sub/1.TIF"]
    assert names(arrivals, 2 * SETTLE) == []


def test_a_file_in_pieces_comes_when_it_is_left_alone(arrivals: Arrivals, tmp_path: Path) -> None:
    with (tmp_path / "a.png").open("wb") as file:
        for _ in range(6):
            file.write(b"x")
            file.flush()
            assert names(arrivals, SETTLE / 2) == []
    (found,) = arrivals.ready(6 * SETTLE)
    assert (found.name, found.stamp[0], found.last, found.unchanged) == ("a.png", 6, False, True)
    (tmp_path / "a.png").write_bytes(b"other")
    assert not found.unchanged


def test_a_file_renamed_into_place_and_one_in_a_new_folder(arrivals: Arrivals, tmp_path: Path) -> None:
    (tmp_path / "a.tmp").write_text("x")
    (tmp_path / "a.tmp").rename(tmp_path / "a.png")
    assert names(arrivals) == ["a.png"]
    (tmp_path / "new" / "deep").mkdir(parents=True)
    (tmp_path / "new" / "deep" / "b.png").write_text("x")
    assert names(arrivals) == ["new/deep/b.png"]
    assert not arrivals.waiting


def test_events_need_not_wait_for_a_file_to_settle(tmp_path: Path) -> None:
    pytest.importorskip("watchdog")
    arrivals = Arrivals(tmp_path, settle=30.0)
    arrivals.ready(0.0)
    (tmp_path / "a.png").write_text("x")
    (tmp_path / "b.tmp").write_text("x")
    (tmp_path / "b.tmp").rename(tmp_path / "b.png")
    found: list[str] = []
    for _ in range(20):
        found += names(arrivals, 0.5)
        if len(found) == 2:
            break
    arrivals.close()
    assert sorted(found) == ["a.png", "b.png"]


def test_a_file_that_is_put_back_waits_for_its_next_change_or_for_long(arrivals: Arrivals, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("half")
    (half,) = arrivals.ready(6 * SETTLE)
    arrivals.put_back(half)
    assert arrivals.waiting
    assert names(arrivals, 2 * SETTLE) == []
    (tmp_path / "a.png").write_text("whole file")
    (whole,) = arrivals.ready(6 * SETTLE)
    assert not whole.last
    arrivals.put_back(whole)
    (left,) = arrivals.ready(30 * SETTLE)
    assert left.last
    (tmp_path / "b.png").write_text("gone again")
    (gone,) = arrivals.ready(6 * SETTLE)
    (tmp_path / "b.png").unlink()
    arrivals.put_back(gone)
    assert not arrivals.waiting


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="gone: FOLDER: cannot be read"):
        Arrivals(tmp_path / "gone")


def test_what_is_passed_over_is_told_once_a_kind(tmp_path: Path) -> None:
    for name in ("a.webp", "b.webp", "c.jp2", "film.MP4", "note.txt", "d.png.part"):
        (tmp_path / name).write_text("x")
    told: list[str] = []
    arrivals = Arrivals(tmp_path, settle=SETTLE, events=False, tell=told.append)
    assert names(arrivals, 3 * SETTLE) == []
    assert sorted(line.split(": passed over, as all ")[1].split()[0] for line in told) == [".jp2", ".mp4", ".webp"]
    (tmp_path / "late.webp").write_text("x")
    (tmp_path / "late.gif").write_text("x")
    assert names(arrivals, 3 * SETTLE) == []
    assert [line.split(": passed over")[0] for line in told[3:]] == [str(tmp_path / "late.gif")]


def test_a_folder_that_goes_and_comes_back_is_told(tmp_path: Path) -> None:
    folder, told = tmp_path / "in", list[str]()
    folder.mkdir()
    arrivals = Arrivals(folder, settle=SETTLE, events=False, tell=told.append)
    assert names(arrivals, 2 * SETTLE) == []
    folder.rename(tmp_path / "away")
    assert names(arrivals, 3 * SETTLE) == []
    assert told == [f"{folder}: FOLDER: cannot be read any more; waiting for it"]
    (tmp_path / "away" / "a.png").write_text("x")
    (tmp_path / "away").rename(folder)
    assert names(arrivals) == ["a.png"]
    assert told[1:] == [f"{folder}: FOLDER: is back"]
