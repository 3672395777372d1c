"""``torchpose estimate`` on a folder of every kind of picture: a row or a line for each, whatever it is."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch

from tests.io.test_image_bounds import CLAIMS
from tests.io.test_tiff import with_tag, written
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.writers import atomic_path, check_table_path, write_rows
from torchpose.sim import add_noise, render
from torchpose.target import Target

CAMERA = Camera.ideal(400, 320, 700.0)


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    R = rotations.exp(torch.tensor([[0.2, -0.3, 0.4]], dtype=torch.float64))
    t = torch.tensor([[2.0, -1.0, 180.0]], dtype=torch.float64)
    return np.asarray(add_noise(render(CAMERA, Target.load("quad40"), R, t), 1.0).numpy()[0])


@pytest.fixture
def folder(tmp_path: Path, frame: np.ndarray) -> Path:
    """Pictures below ``in``, beside camera.yaml. Their names begin with the status that their row should have."""
    CAMERA.save(tmp_path / "camera.yaml")
    given = tmp_path / "in"
    given.mkdir()
    wide = frame.astype(np.uint16) * 257
    cv2.imwrite(str(given / "ok.png"), frame)
    files = {
        "ok_turned.tif": written(frame, extratags=[(274, 3, 1, 3, True)]),
        "ok_inverted.tif": written(65535 - wide, photometric="miniswhite"),
        "unreadable_unsupported.tif": with_tag(written(frame), 259, 34712),
        "unreadable_corrupt.tif": damaged(written(frame, compression="zlib", rowsperstrip=16)),
        "unreadable_corrupt.png": damaged(cv2.imencode(".png", frame)[1].tobytes()),
        "unreadable_corrupt.jpg": damaged(cv2.imencode(".jpg", frame)[1].tobytes()),
        "unreadable_not_an_image.png": b"words",
        "unreadable_empty.bmp": b"",
        **{f"wrong_size_{i}.png": data for i, data in enumerate(CLAIMS.values())},
    }
    for name, data in files.items():
        (given / name).write_bytes(data)
    with tifffile.TiffWriter(given / "ok_stack.tif") as stack:
        for image in (frame, frame, frame[:100]):
            stack.write(image, photometric="minisblack", metadata=None)
    (given / "unreadable_missing.png").symlink_to(given / "nothing")
    (given / "unreadable_unreadable_file.png").symlink_to(given / "unreadable_unreadable_file.png")
    (Path(os.fsdecode(os.fsencode(given) + b"/ok \xff.png"))).write_bytes((given / "ok.png").read_bytes())
    return tmp_path


def damaged(data: bytes) -> bytes:
    """The file with some bytes of its middle set to zero."""
    middle = len(data) // 2
    return data[:middle] + bytes(9) + data[middle + 9 :]


def estimate(folder: Path, given: str, *options: str) -> int:
    files = ["--camera", str(folder / "camera.yaml"), "--target", "quad40", "--out", str(folder / "poses.csv")]
    with pytest.raises(SystemExit) as ended:
        main(["estimate", str(folder / given), *files, *options])
    return int(ended.value.code or 0)


def table(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "poses.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len({row["frame"] for row in rows}) == len(rows)
    return {row["frame"]: row for row in rows}


def test_every_picture_has_its_row_and_what_is_passed_over_its_line(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(folder / "in" / "pipe.png")
    (folder / "in" / "a.webp").touch()
    (folder / "in" / "b.jp2").touch()
    assert estimate(folder, "in", "--overlay", str(folder / "seen")) == 1
    errors = capfd.readouterr().err
    assert "passed over 1 .jp2, 1 .webp, 1 pipes or devices" in errors
    assert "Traceback" not in errors
    rows = table(folder)
    assert len(rows) == len(list((folder / "in").iterdir())) - 3 + 2  # two further pages
    assert rows.pop("ok_stack.tif#3")["reason"] == "400x100"
    for name, row in rows.items():
        status = next(s for s in ("ok", "unreadable", "wrong_size") if name.startswith(s))
        assert row["status"] == status, name
        if status == "unreadable":
            assert row["reason"] == name.removeprefix("unreadable_").rpartition(".")[0]
    assert (folder / "seen" / "ok_stack.tif#2.png").exists()
    ours = {name: [float(row[c]) for c in ("tx", "ty", "tz", "rx")] for name, row in rows.items() if row["tx"]}
    for name in ("ok_turned.tif", "ok_stack.tif", "ok_stack.tif#2", "ok_inverted.tif"):
        np.testing.assert_allclose(ours[name], ours["ok.png"], atol=1e-4)


def test_a_name_as_long_as_a_name_can_be_has_its_row(folder: Path) -> None:
    name = 251 * "a" + ".png"
    (folder / name).write_bytes((folder / "in" / "ok.png").read_bytes())
    assert estimate(folder, name, "-q") == 0
    assert table(folder)[name]["status"] == "ok"


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_a_table_whose_files_would_have_too_long_names_is_refused_before_the_run(tmp_path: Path, suffix: str) -> None:
    for length in range(225, 256):
        path = tmp_path / ("b" * (length - len(suffix)) + suffix)
        try:
            check_table_path(path, "--out")
        except ConfigError:
            assert length > 240
            continue
        for other in (".partial", ".run.json"):
            path.with_name(path.name + other).touch()
        write_rows(path, [], {"frame": str})
    write_rows(tmp_path / os.fsdecode(b"\xff" + suffix.encode()), [], {"frame": str})  # a name that is no UTF-8


def test_a_run_that_begins_takes_nothing_from_one_that_ends(tmp_path: Path) -> None:
    """Both look at the same place: the one whether it could write there, the other is writing its last file."""
    last = tmp_path / "poses.csv.run.json"
    with atomic_path(last) as temporary:
        temporary.write_text("{}")
        check_table_path(tmp_path / "poses.csv", "--out")
        check_table_path(last.with_suffix(".jsonl"), "--out")
    assert last.read_text() == "{}"


def test_pages_are_resumed_by_their_names(folder: Path) -> None:
    assert estimate(folder, "in/ok_stack.tif", "-q") == 0
    first = table(folder)
    assert list(first) == ["ok_stack.tif", "ok_stack.tif#2", "ok_stack.tif#3"]
    lines = (folder / "poses.csv").read_text().splitlines(keepends=True)
    (folder / "poses.csv").write_text("".join(lines[:2]))
    assert estimate(folder, "in/ok_stack.tif", "-q", "--resume") == 0
    assert table(folder) == first


@pytest.mark.parametrize("given", ["pipe.png", "pipe.jsonl", "pipe", "loop.png", "/dev/zero", "a" * 300 + ".png"])
def test_inputs_that_are_no_files_end_in_a_line(folder: Path, given: str, capfd: pytest.CaptureFixture[str]) -> None:
    if given.startswith("pipe"):
        os.mkfifo(folder / given)
    elif given == "loop.png":
        (folder / given).symlink_to(folder / given)
    assert estimate(folder, given) == 2
    assert capfd.readouterr().err.count("\n") == 1
