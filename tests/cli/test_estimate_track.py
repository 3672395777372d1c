"""``torchpose estimate --track``: the rows are those without, and most frames are not searched."""

import csv
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchpose import pipeline
from torchpose.camera import Camera
from torchpose.cli.main import main
from torchpose.detect import find_coarse
from torchpose.geometry import rotations
from torchpose.io.films import Film
from torchpose.io.lanes import in_lanes
from torchpose.io.sources import Source
from torchpose.sim import add_noise, render
from torchpose.target import Target

CAMERA = Camera.ideal(560, 420, 800.0)
LOST, BAD, COUNT = 5, 3, 20


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A sequence of frames, some 15 px a frame, one without the target and one that is none."""
    monkeypatch.chdir(tmp_path)
    CAMERA.save("camera.yaml")
    k = torch.arange(COUNT, dtype=torch.float64)
    R = rotations.exp(torch.stack([0.2 + 0.01 * k, -0.1 + 0.01 * k, 0.05 * k], -1))
    t = torch.stack([4 * (0.5 * k).sin(), 4 * (0.5 * k).cos(), 190 + k], -1)
    frames = add_noise(render(CAMERA, Target.load("quad40"), R, t), 1.0).numpy()
    frames[LOST] = 200
    (tmp_path / "frames").mkdir()
    for number, frame in enumerate(frames):
        assert cv2.imwrite(f"frames/{number}.png", frame)
    Path(f"frames/{BAD}.png").write_bytes(b"none")
    return tmp_path / "frames"


def estimated(*words: str) -> int | str | None:
    given = ("--camera", "camera.yaml", "--target", "quad40", "-j", "1", "--batch", "2", "--quiet", *words)
    with pytest.raises(SystemExit) as ended:
        main(["estimate", "frames", *given])
    return ended.value.code


def rows(path: str) -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("folder")
def test_rows_are_those_of_frames_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert estimated("--out", "alone.csv") == 1  # a file is none
    searched: list[int] = []
    search: Callable[..., Any] = find_coarse

    def counted(frames: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        searched.append(len(frames))
        return search(frames, *args, **kwargs)

    monkeypatch.setattr(pipeline, "find_coarse", counted)
    assert estimated("--out", "poses.csv", "--track") == 1
    assert sum(searched) <= 8  # of 19: the first of three stretches, the lost one and its next, what is at the border
    numbers = ("tx", "ty", "tz", "rx", "ry", "rz")
    for one, other in zip(rows("poses.csv"), rows("alone.csv"), strict=True):
        assert [one[c] for c in ("frame", "status", "markers")] == [other[c] for c in ("frame", "status", "markers")]
        if one["status"] == "ok":
            for column in numbers:
                assert abs(float(one[column]) - float(other[column])) < 0.1 * float(other[f"n{column[-2:].strip('t')}"])
    assert sum(row["status"] == "ok" for row in rows("poses.csv")) == COUNT - 2
    assert estimated("--out", "poses.csv", "--track", "--resume") == 1


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("words", [("--out", "-"), ("--out", "p.csv", "--instances", "2")])
def test_what_does_not_go_with_it_is_refused(words: tuple[str, ...], capfd: pytest.CaptureFixture[str]) -> None:
    assert estimated("--track", *words) == 2
    assert "--track: cannot be combined with" in capfd.readouterr().err


def test_every_frame_is_in_one_lane_behind_the_one_before() -> None:
    film = Film(Path("film.mp4"), 50)
    sources = [Source(f"{folder}/{k}", Path(folder) / f"{k}.png", Path()) for folder in "ab" for k in range(20)]
    sources += [Source(f"film#{k}", film.path, Path(), directory=k, film=film) for k in range(50)]
    groups = in_lanes(sources, 3)
    assert sorted(source.name for one in groups for source in one) == sorted(source.name for source in sources)
    assert max(len(batch) for one in groups for batch in one.batches) == 3
    follows = {now.name: before.name for before, now in pairwise(sources)}
    firsts = 0
    for one in groups:
        last: dict[int, str] = {}
        for batch in one.batches:
            assert len({one.lane[source.name] for source in batch}) == len(batch)
            for source in batch:
                lane = one.lane[source.name]
                firsts += lane not in last
                assert lane not in last or follows[source.name] == last[lane]
                last[lane] = source.name
    assert firsts == 7  # three stretches of 8, 8 and 4 frames of each folder, and one film
    assert np.unique([one.lane[source.name] for one in groups for source in one if source.film]).size == 1
