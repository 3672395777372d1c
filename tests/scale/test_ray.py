"""``--engine ray``: the rows of the local engine, whatever the workers, and what a lost worker costs."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.stores import ENVIRONMENT, s3_server
from torchpose.cli.main import main
from torchpose.errors import ConfigError
from torchpose.io import storage
from torchpose.io.rows import DETECTION_SCHEMA, POSE_SCHEMA, Row
from torchpose.io.sources import find_sources
from torchpose.io.storage import Place, StorageError
from torchpose.io.tally import Tally
from torchpose.io.writers import read_table
from torchpose.scale.cluster import answered, answers
from torchpose.scale.estimate import pending
from torchpose.scale.parts import Parts

SAMPLE = Path(__file__).parents[2] / "data" / "sample"
ARGUMENTS = ["--camera", str(SAMPLE / "camera.yaml"), "--target", str(SAMPLE / "target.yaml"), "--method", "centers"]


pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::ResourceWarning"
)


def rows(path: Path) -> list[Row]:
    return read_table(path, POSE_SCHEMA, ["frame"])


def estimate(*arguments: str | Path) -> int:
    """The exit code."""
    with pytest.raises(SystemExit) as ended:
        main(["estimate", *map(str, arguments)])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_mistakes_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    mistakes: list[tuple[list[str | Path], str]] = [
        (["--address", "auto"], "--address: is of --engine ray alone"),
        (["--engine", "ray", "--overlay", tmp_path], "--overlay: is not drawn by --engine ray"),
        (["--engine", "ray", "--device", "cuda"], "--device: is cpu with --engine ray"),
        (["--engine", "ray", "--address", "127.0.0.1:9", "--threads", "2"], "--threads: is of a cluster that starts"),
        (["--engine", "ray", "--address", "here"], "here: --address: is none; give HOST:PORT"),
        (["--engine", "ray", "--address", "127.0.0.1:9"], "127.0.0.1:9: --address: no Ray cluster answers"),
    ]
    for arguments, message in mistakes:
        assert estimate(SAMPLE / "frames", *ARGUMENTS, "--out", tmp_path / "a.parquet", *arguments) == 2
        lines = capfd.readouterr().err.splitlines()
        assert len(lines) == 1
        assert message in lines[0]
        shutil.rmtree(tmp_path / "a.parquet", ignore_errors=True)
    assert estimate(SAMPLE / "frames", *ARGUMENTS, "--out", tmp_path / "a.csv", "--engine", "ray") == 2
    assert "writes a folder that ends in .parquet" in capfd.readouterr().err
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert estimate(film, *ARGUMENTS, "--out", tmp_path / "a.parquet", "--engine", "ray") == 2
    assert "film.avi: --engine ray: a film is decoded from its beginning" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        main(["simulate", "plan.yaml", "--out", str(tmp_path), "--engine", "ray", "--backend", "blender"])
    assert "--backend: blender renders on this machine alone" in capfd.readouterr().err


def test_without_ray_there_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert estimate(SAMPLE / "frames", *ARGUMENTS, "--out", tmp_path / "a.parquet", "--engine", "ray") == 2
    assert "--engine ray: Ray is not installed; install it with pip install" in capfd.readouterr().err


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for path in sorted((SAMPLE / "frames").iterdir())[:5]:
        shutil.copy(path, folder)
    (folder / "009.png").write_bytes(b"no picture")
    return folder


def test_what_a_worker_meets_reaches_the_command_as_it_is() -> None:
    ray = pytest.importorskip("ray")

    class Data:
        """Of a data set what `answers` asks for."""

        def __init__(self, *work: Callable[[], Any]) -> None:
            self._work = work

        def iter_rows(self) -> Iterator[dict[str, Any]]:
            yield from ({"result": answered(one)} for one in self._work)

    def fail(error: Exception) -> Any:
        raise error

    assert [result for _, result in answers(Data(lambda: 1, lambda: "two"), "result")] == [1, "two"]
    with pytest.raises(ConfigError, match=r"^--out: access is denied; ask; add --resume to go on$"):
        list(answers(Data(partial(fail, StorageError("access is denied", "ask"))), "result"))
    with pytest.raises(ConfigError, match=r"^x: is none$"):
        list(answers(Data(partial(fail, ConfigError("x: is none"))), "result"))
    text = (
        "ray::submit()\n  File x\nZeroDivisionError: by 0\n\nThe above exception was the direct cause of\nHow to retry"
    )
    with pytest.raises(ConfigError, match=r"^--engine ray: a worker ended \(ZeroDivisionError: by 0\); add --resume"):
        list(answers(Data(partial(fail, ray.exceptions.RayError(text))), "result"))


def test_workers_elsewhere_find_the_frames(frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(frames.parent)
    poses = Parts.at(tmp_path / "p.parquet", POSE_SCHEMA)
    blocks = pending(find_sources([Path(frames.name)]), 4, poses, Tally())
    assert [[source.path for source in block.sources] for block in blocks] == [
        sorted(frames.iterdir())[:4],
        sorted(frames.iterdir())[4:],
    ]
    assert blocks[0].sources[0].name == "000.png"


def test_rows_are_those_of_the_local_engine(frames: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    folder = tmp_path / "frames"
    shutil.copytree(frames, folder)
    poses, marks, own = tmp_path / "p.parquet", tmp_path / "d.parquet", tmp_path / "own.parquet"
    on_ray: list[str | Path] = [folder, *ARGUMENTS, "--engine", "ray", "--threads", "2", "--batch", "2", "--out", poses]
    on_ray += ["--detections", marks]
    assert estimate(*on_ray) == 1
    local: list[str | Path] = [folder, *ARGUMENTS, "--batch", "2", "--threads", "1"]
    assert estimate(*local, "--out", own, "--detections", tmp_path / "d.jsonl") == 1
    assert rows(poses) == rows(own)
    assert [row for row in rows(poses) if row["status"] != "ok"] == [rows(own)[-1]]
    found = read_table(marks, DETECTION_SCHEMA, ["frame"])
    assert found == read_table(tmp_path / "d.jsonl", DETECTION_SCHEMA, ["frame"])
    listed = json.loads((poses / "_SUCCESS").read_text())["parts"]
    assert listed == sorted(path.name for path in poses.glob("part-*"))
    assert estimate(*on_ray) == 2  # not over what is there
    assert "add --resume" in capfd.readouterr().err

    # a resumed run does what is missing, torn, changed or was unreadable, and nothing else
    first, second, third = (poses / name for name in listed)
    first.unlink()
    third.write_bytes(third.read_bytes()[:-9])
    shutil.copy(SAMPLE / "frames" / "009.png", folder)
    kept = second.stat().st_mtime_ns
    assert estimate(*on_ray, "--resume") == 0
    assert second.stat().st_mtime_ns == kept
    assert estimate(*local, "--out", own) == 0
    assert rows(poses) == rows(own)
    assert estimate(*on_ray, "--resume", "--instances", "2") == 2
    assert "were made with another --instances" in capfd.readouterr().err


def test_simulated_frames_are_those_of_the_local_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a store too, of which every fifth request fails."""
    pytest.importorskip("ray")
    pytest.importorskip("moto")
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        f"camera: {SAMPLE / 'camera.yaml'}\ntarget: quad40\nseed: 3\n"
        "poses: {grid: {distance: 160, angles_deg: [0], positions: [[0, 0, 0], [5, 0, 0], [0, 0, 9]]}}\n"
    )
    own = tmp_path / "own"
    with s3_server("cell", every=5) as (url, application):
        for name, value in (ENVIRONMENT | {"AWS_ENDPOINT_URL": url}).items():
            monkeypatch.setenv(name, value)
        storage._file_system.cache_clear()
        for out, options in (
            (str(own), ["--threads", "1"]),
            ("s3://cell/set", ["--engine", "ray", "--threads", "2", "--batch", "1"]),
        ):
            with pytest.raises(SystemExit) as ended:
                main(["simulate", str(plan), "--out", out, *options])
            assert ended.value.code == 0
        files = sorted(path.relative_to(own).as_posix() for path in own.rglob("*.*"))
        assert len(files) >= 7
        stored = Place("s3://cell/set")
        assert sorted(one.name for one in stored.listed()) == files
        for file in files:
            assert (stored / file).read(1 << 30) == (own / file).read_bytes(), file
        assert application.failed > 3
    storage._file_system.cache_clear()


def copies(folder: Path, count: int) -> None:
    folder.mkdir()
    pictures = sorted((SAMPLE / "frames").iterdir())
    for number in range(count):
        (folder / f"{number:05d}.png").hardlink_to(pictures[number % len(pictures)])


def started(command: Sequence[str | Path]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "torchpose", *map(str, command)])


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seconds", [8.0, 20.0])
def test_lost_nodes_cost_time_alone(seconds: float, tmp_path: Path) -> None:
    """Two of three nodes are killed in the middle; `scripts/bench_scale.py loss` does it at more moments."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    copies(tmp_path / "frames", 200)
    cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
        out = tmp_path / "p.parquet"
        command: list[str | Path] = [
            "estimate",
            tmp_path / "frames",
            *ARGUMENTS,
            "--engine",
            "ray",
            "--batch",
            "4",
            "--out",
            out,
        ]
        run = started([*command, "--address", cluster.address])
        for node in nodes:
            time.sleep(seconds)
            cluster.remove_node(node, allow_graceful=False)
        if run.wait() != 0:
            assert started([*command, "--resume"]).wait() == 0
    finally:
        cluster.shutdown()
    assert sorted(row["frame"] for row in rows(out)) == [f"{number:05d}.png" for number in range(200)]
    assert all(row["status"] == "ok" for row in rows(out))
