"""Inputs to frames: order, names, what is passed over, what is refused."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchpose.errors import ConfigError
from torchpose.io.sources import find_sources, natural_key


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def names(*inputs: Path) -> list[str]:
    return [source.name for source in find_sources(inputs)]


def test_folders_are_searched_recursively_in_natural_order(tmp_path: Path) -> None:
    expected = ["a/2.png", "a/10.png", "a10/1.png", "b.png", "frame_1.PNG", "frame_02.tiff", "frame_10.jpeg", "z.pgm"]
    touch(*(tmp_path / name for name in reversed(expected)))
    assert names(tmp_path) == expected


def test_hidden_files_other_files_folders_and_pipes_are_passed_over(tmp_path: Path) -> None:
    touch(
        tmp_path / "a.png",
        tmp_path / ".b.png",
        tmp_path / ".c" / "d.png",
        tmp_path / "notes.txt",
        tmp_path / "Thumbs.db",
    )
    (tmp_path / "folder.png").mkdir()
    os.mkfifo(tmp_path / "pipe.png")
    assert names(tmp_path) == ["a.png"]


def test_linked_folders_are_followed_once_and_dangling_links_are_frames(tmp_path: Path) -> None:
    touch(tmp_path / "real" / "1.png")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path / "real")
    (tmp_path / "real" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "gone.png").symlink_to(tmp_path / "nothing.png")
    assert names(tmp_path / "in") == ["gone.png", "link/1.png"]


def test_files_are_named_without_their_folder_and_keep_the_order_given(tmp_path: Path) -> None:
    touch(tmp_path / "x" / "2.png", tmp_path / "y" / "1.png")
    assert names(tmp_path / "x" / "2.png", tmp_path / "y" / "1.png") == ["2.png", "1.png"]


def test_names_that_are_not_utf8_become_valid_text(tmp_path: Path) -> None:
    touch(Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xff.png")))
    (source,) = find_sources([tmp_path])
    assert source.name == "f\\xff.png"
    assert isinstance(source.path, Path)
    assert source.path.exists()


def test_manifest_frames_come_in_the_order_of_capture_with_their_robot_pose(tmp_path: Path) -> None:
    manifest = tmp_path / "run.jsonl"
    manifest.write_text(
        '{"record": "session", "units": {"length": "m"}}\n'
        '{"record": "frame", "id": 10, "image": "i/10.png", "robot_pose": [0.1, 0, -1, 0, 0.5, 0]}\n'
        '{"record": "frame", "id": 2, "image": "i/2.png"}\n'
    )
    first, second = find_sources([manifest])
    assert (first.name, first.path, first.robot_pose) == ("i/10.png", tmp_path / "i/10.png", (100, 0, -1000, 0, 0.5, 0))
    assert (second.name, second.robot_pose) == ("i/2.png", None)


@pytest.mark.parametrize("kind", ["missing", "empty folder", "no image", "unknown suffix", "same name", "same file"])
def test_unusable_inputs_are_refused_in_one_line_that_names_them(tmp_path: Path, kind: str) -> None:
    touch(tmp_path / "a" / "1.png", tmp_path / "b" / "1.png", tmp_path / "c" / "notes.txt", tmp_path / "d.raw")
    (tmp_path / "e").mkdir()
    inputs, named = {
        "missing": ([tmp_path / "gone"], "gone"),
        "empty folder": ([tmp_path / "e"], "e: INPUT: holds no image"),
        "no image": ([tmp_path / "a", tmp_path / "c"], "c: INPUT: holds no image"),
        "unknown suffix": ([tmp_path / "d.raw"], "d.raw"),
        "same name": ([tmp_path / "a", tmp_path / "b"], "b/1.png: INPUT: has the same name"),
        "same file": ([tmp_path / "a", tmp_path / "a" / "1.png"], "a/1.png: INPUT: is given twice; name it once"),
    }[kind]
    with pytest.raises(ConfigError) as caught:
        find_sources(inputs)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.lists(st.tuples(st.sampled_from(["f", "img_", "F"]), st.integers(0, 10**12)), unique=True))
def test_natural_order_sorts_equal_prefixes_by_the_value_of_the_number(pairs: list[tuple[str, int]]) -> None:
    ordered = sorted(pairs, key=lambda pair: natural_key(f"{pair[0]}{pair[1]}.png"))
    assert ordered == sorted(pairs, key=lambda pair: (pair[0].casefold(), pair[1], f"{pair[0]}{pair[1]}"))


def test_each_page_of_a_tiff_file_is_a_frame_of_its_own_name(tmp_path: Path) -> None:
    frames = [np.full((4, 6), value, np.uint8) for value in (1, 2, 3)]
    cv2.imwritemulti(str(tmp_path / "stack.tif"), frames)
    cv2.imwrite(str(tmp_path / "single.tiff"), frames[0])
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    sources = find_sources([tmp_path])
    assert [s.name for s in sources] == ["broken.tif", "single.tiff", "stack.tif", "stack.tif#2", "stack.tif#3"]
    assert [int(s.decode()[0, 0]) for s in sources[2:]] == [1, 2, 3]
    assert names(tmp_path / "stack.tif") == ["stack.tif", "stack.tif#2", "stack.tif#3"]


def test_pictures_that_are_not_read_are_counted_in_one_line(tmp_path: Path) -> None:
    touch(*(tmp_path / name for name in ("a.png", "b.webp", "c/d.WEBP", "e.jp2", "f.heic", ".g.webp", "h.txt")))
    os.mkfifo(tmp_path / "pipe.png")
    lines: list[str] = []
    (source,) = find_sources([tmp_path], lines.append)
    (line,) = lines
    assert source.name == "a.png"
    assert "passed over 2 .webp, 1 .heic, 1 .jp2, 1 pipes or devices;" in line
    (tmp_path / "a.png").unlink()
    with pytest.raises(ConfigError, match=r"holds no image but 2 \.webp"):
        find_sources([tmp_path], lines.append)


def test_pages_behind_that_of_a_record_are_counted(tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "stack.tif"), [np.zeros((4, 6), np.uint8)] * 3)
    (tmp_path / "run.jsonl").write_text('{"record": "frame", "id": 1, "image": "stack.tif"}\n')
    lines: list[str] = []
    assert [s.name for s in find_sources([tmp_path / "run.jsonl"], lines.append)] == ["stack.tif"]
    assert "passed over 2 pages behind the first" in lines[0]


def test_pipes_devices_and_loops_as_input_are_refused_at_once(tmp_path: Path) -> None:
    for name in ("pipe.png", "pipe.jsonl", "pipe"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    given = [
        tmp_path / n for n in ("pipe.png", "pipe.jsonl", "pipe", "loop.png", "loop", "a" * 300 + ".png", "a\0.png")
    ]
    for path in [*given, Path("/dev/zero"), Path("/dev/null")]:
        with pytest.raises(ConfigError, match=r"^[^\n]+: INPUT: [^\n]+$"):
            find_sources([path])
