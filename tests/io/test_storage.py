"""Frames from stores and tables into them: an S3 server on the loopback, Arrow's and fsspec's file systems."""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.stores import ENVIRONMENT, Unsteady, s3_server
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.io import storage
from torchpose.io.images import UnreadableImageError
from torchpose.io.sources import Source, find_sources
from torchpose.io.staged import Staged
from torchpose.io.storage import Place, StorageError, as_place, place_of

pytest.importorskip("moto")
SAMPLE = Path(__file__).parents[2] / "data" / "sample"
ARGUMENTS = ["--camera", str(SAMPLE / "camera.yaml"), "--target", str(SAMPLE / "target.yaml"), "--method", "centers"]


def estimate(*arguments: str | Path) -> int:
    """The exit code."""
    with pytest.raises(SystemExit) as ended:
        main(["estimate", *map(str, arguments), *ARGUMENTS])
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[str, Unsteady]]:
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    with s3_server("cell", every=5) as served:
        yield served


@pytest.fixture
def bucket(server: tuple[str, Unsteady], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Place:
    for name, value in (ENVIRONMENT | {"AWS_ENDPOINT_URL": server[0], "XDG_CACHE_HOME": str(tmp_path)}).items():
        monkeypatch.setenv(name, value)
    storage._file_system.cache_clear()
    return Place("s3://cell")


def test_round_trip_and_listing(bucket: Place) -> None:
    place = bucket / "a folder" / "b#1?.bin"
    place.write(b"first" * 100)
    place.write(b"second" * 100)
    assert (place.kind(), place.parent.kind(), (bucket / "none").kind()) == ("file", "folder", "nothing")
    assert place.read(600) == b"second" * 100
    assert [(one.name, one.size) for one in (bucket / "a folder").listed()] == [("b#1?.bin", 600)]
    with place.open() as opened:
        opened.seek(2)
        assert opened.read(3) == b"con"
    with pytest.raises(StorageError, match="more than 3 bytes"):
        place.read(3)
    place.remove()
    assert place.kind() == "nothing"


def test_requests_are_tried_again_however_many_have_failed(bucket: Place, server: tuple[str, Unsteady]) -> None:
    """More than the hundred failures that AWS's standard strategy lets a process have."""
    place, before = bucket / "often.bin", server[1].failed
    place.write(b"x" * 1000)  # longer than the answer that says why: Arrow asks again only then
    while server[1].failed - before < 105:
        assert place.read(1000) == b"x" * 1000


@pytest.mark.parametrize("scheme", ["memory://shelf", "file"])
def test_other_file_systems(scheme: str, tmp_path: Path) -> None:
    folder = as_place(tmp_path / "a b") if scheme == "file" else Place(scheme)
    (folder / "c.bin").write(b"1")
    (folder / "d" / "e.bin").write(b"22")
    assert sorted((one.name, one.size) for one in folder.listed()) == [("c.bin", 1), ("d/e.bin", 2)]
    assert (folder / "d" / "e.bin").read(2) == b"22"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("s3://key:secret-word@cell/x", "holds credentials"),
        ("s3://cell/x?secret_key=secret-word", "secret_key is not known"),
        (
            "nothing://cell/x",
            r"^nothing://cell: URL: cannot be used \(.*\); use s3://, gs:// or file://, or install what ",
        ),
        ("ftp://cell/x", r"^ftp://cell: URL: cannot be used \("),
        ("s3://other/x", "the bucket does not exist"),
        ("s3://cell/none", "does not exist"),
    ],
)
def test_a_url_that_leads_nowhere_is_one_line(bucket: Place, url: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        find_sources([place_of(url)])
    assert "\n" not in str(caught.value)
    assert "secret-word" not in str(caught.value)


def test_a_table_for_a_url_that_nothing_writes_is_refused_before_anything_is_measured(bucket: Place) -> None:
    with pytest.raises(ConfigError, match=r"^ftp://cell: URL: cannot be used \("):
        Staged(place_of("ftp://cell/poses.csv"), None, resume=False)


def test_a_store_that_does_not_answer(bucket: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    storage._file_system.cache_clear()
    monkeypatch.setattr(storage, "_TRIES", 1)
    with pytest.raises(ConfigError, match="does not answer"):
        find_sources([place_of("s3://cell/run")])
    lost = Source("a.png", Place("s3://cell/run/a.png"), Place("s3://cell/run"))
    with pytest.raises(UnreadableImageError, match="storage"):
        lost.decode()


def test_a_run_from_and_to_a_store_has_the_rows_of_one_on_a_disk(
    bucket: Place, server: tuple[str, Unsteady], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every fifth request fails: the store's library tries again."""
    for name in ("000.png", "001.png", "002.png"):
        (bucket / "run 1" / name).write((SAMPLE / "frames" / name).read_bytes())
    (bucket / "run 1" / "003.png").write((SAMPLE / "frames" / "003.png").read_bytes()[:5000])
    (bucket / "run 1" / "notes.txt").write(b"no picture")
    place, folder, table = "s3://cell/run%201", tmp_path / "frames", bucket / "out" / "poses.csv"
    folder.mkdir()
    for source in find_sources([place_of(place)]):
        assert isinstance(source.path, Place)
        (folder / source.name).write_bytes(source.path.read(1 << 30))
    assert estimate(place, "--out", str(table)) == 1
    assert estimate(folder, "--out", tmp_path / "own.csv") == 1
    assert table.read(1 << 20) == (tmp_path / "own.csv").read_bytes()
    assert b"003.png,quad40,unreadable" in table.read(1 << 20)
    # what was unreadable is replaced, the rest stays
    (bucket / "run 1" / "003.png").write((SAMPLE / "frames" / "003.png").read_bytes())
    assert estimate(place, "--out", str(table), "--resume") == 0
    assert table.read(1 << 20).count(b",ok,") == 4
    assert not list(tmp_path.rglob("poses.csv*")), "nothing stays on this machine"
    assert server[1].failed > 3
    assert "secret-word" not in "".join(capfd.readouterr())
    assert estimate(place, "--out", "s3://other/poses.csv") == 2
    assert "s3://other/poses.csv: --out: the bucket does not exist" in capfd.readouterr().err


def test_simulate_fills_a_store_and_goes_on(bucket: Place, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    plan, out = tmp_path / "plan.yaml", bucket / "set"
    matrix = torch.tensor([[250.0, 0, 79.5], [0, 250.0, 59.5], [0, 0, 1]], dtype=torch.float64)
    Camera(160, 120, matrix, torch.zeros(4, dtype=torch.float64)).save(tmp_path / "camera.yaml")
    text = (
        "camera: camera.yaml\ntarget: quad40\nseed: {seed}\nbounds: false\n"
        "print: {{seed: 4, center_sigma: 0.1, gain: [0.1, 0.2]}}\n"
        "poses: {{grid: {{distance: 160, angles_deg: [0], positions: [[0, 0, 0], [5, 0, 0]]}}}}\n"
    )
    plan.write_text(text.format(seed=3))

    def simulate(*arguments: str) -> int:
        with pytest.raises(SystemExit) as ended:
            main(["simulate", str(plan), "--threads", "1", *arguments])
        assert isinstance(ended.value.code, int)
        return ended.value.code

    def stored() -> dict[str, bytes]:
        return {one.name: (out / one.name).read(1 << 30) for one in out.listed()}

    assert simulate("--out", str(tmp_path / "own")) == 0
    assert simulate("--out", str(out)) == 0
    whole = stored()
    own = {path.relative_to(tmp_path / "own").as_posix(): path.read_bytes() for path in (tmp_path / "own").rglob("*.*")}
    assert whole == own
    assert {"frames/0001.png", "truth.csv", "prints.csv", "print.yaml", "plan.json"} < set(whole)
    assert simulate("--out", str(out)) == 2
    assert "s3://cell/set: --out: holds frames; add --resume" in capfd.readouterr().err
    for name in ("frames/0001.png", "truth.csv"):  # as a run that was killed leaves it
        (out / name).remove()
    assert simulate("--out", str(out), "--resume") == 0
    assert stored() == whole
    plan.write_text(text.format(seed=5))
    assert simulate("--out", str(out), "--resume") == 2
    assert "s3://cell/set: --resume: the frames there were made with another plan" in capfd.readouterr().err
    assert simulate("--out", "s3://other/set") == 2
    assert "the bucket does not exist" in capfd.readouterr().err
    assert simulate("--out", str(out), "--bop") == 2
    assert "--bop: links the frames, which a store cannot" in capfd.readouterr().err


def test_films_of_a_store_are_named(bucket: Place) -> None:
    (bucket / "films" / "a.mp4").write(b"film")
    (bucket / "films" / "b.png").write((SAMPLE / "frames" / "011.png").read_bytes())
    lines: list[str] = []
    assert [source.name for source in find_sources([bucket / "films"], lines.append)] == ["b.png"]
    (line,) = lines
    assert line.startswith("s3://cell/films: passed over 1 films, which are read from a disk alone; what is read ends")
    assert ".mp4" not in line
    with pytest.raises(
        ConfigError, match=r"s3://cell/films/a.mp4: INPUT: a film, which is read from a disk alone; cop"
    ):
        find_sources([bucket / "films" / "a.mp4"])


@pytest.mark.slow
def test_processes_that_read_a_store_give_the_same_rows(bucket: Place, tmp_path: Path) -> None:
    """Fresh ones: a connection cannot be forked."""
    for number in range(6):
        name = f"{number:03d}.png"
        (bucket / "run 2" / name).write((SAMPLE / "frames" / name).read_bytes())
    for threads, out in (("1", tmp_path / "one.csv"), ("2", bucket / "two.csv")):
        assert estimate("s3://cell/run%202", "--out", str(out), "--batch", "2", "--threads", threads) == 0
    assert (bucket / "two.csv").read(1 << 20) == (tmp_path / "one.csv").read_bytes()


def test_manifests_and_stacks_of_a_store(bucket: Place) -> None:
    import cv2

    lines = (
        '{"record": "session", "units": {"length": "m"}}\n'
        '{"record": "frame", "id": 1, "image": "images/a.tif", "robot_pose": [0.1, 0, 0, 0, 0, 1]}\n'
    )
    (bucket / "session" / "manifest.jsonl").write(lines.encode())
    stack = [np.full((20, 30), value, np.uint8) for value in (1, 2)]
    ok, data = cv2.imencodemulti(".tif", stack)
    assert ok
    (bucket / "session" / "images" / "a.tif").write(data.tobytes())
    (recorded,) = find_sources([place_of("s3://cell/session/manifest.jsonl")])
    assert recorded.robot_pose == (100.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert recorded.decode().max() == 1
    pages = find_sources([place_of("s3://cell/session/images")])
    assert [(page.name, int(page.decode().max())) for page in pages] == [("a.tif", 1), ("a.tif#2", 2)]
    assert not pages[0].likely_encoded()
    with pytest.raises(ConfigError, match=r"s3://cell/session/manifest.jsonl: INPUT: has no frame of camera 'left'"):
        find_sources([place_of("s3://cell/session/manifest.jsonl#left")])
