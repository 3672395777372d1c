"""Frames of a plan as a data set of torch, without files."""

from functools import partial
from pathlib import Path

import cv2
import pytest
import torch
import yaml
from torch.utils.data import DataLoader

from torchpose.camera import Camera
from torchpose.datasets.dataset import write_dataset
from torchpose.datasets.frames import Sample, SimulatedFrames
from torchpose.io.processes import Crew

FRAMES = 6


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> SimulatedFrames:
    folder = tmp_path_factory.mktemp("plan")
    matrix = torch.tensor([[200.0, 0, 47.5], [0, 200, 35.5], [0, 0, 1]], dtype=torch.float64)
    Camera(96, 72, matrix, torch.zeros(4, dtype=torch.float64)).save(folder / "camera.yaml")
    poses = {"random": {"count": FRAMES, "x": [-5, 5], "y": [-5, 5], "z": [160, 200], "tilt_deg": [0, 40]}}
    plan = {"camera": "camera.yaml", "target": "quad40", "seed": 4, "poses": poses, "sensor": {"noise": [0, 3]}}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return SimulatedFrames(folder / "plan.yaml")


def test_frames_are_those_that_simulate_writes(frames: SimulatedFrames, tmp_path: Path) -> None:
    write_dataset(frames.plan, tmp_path / "set", crew=partial(Crew, count=2))
    assert len(frames) == FRAMES
    for number, name in enumerate(frames.plan.names):
        sample = frames[number]
        written = cv2.imread(str(tmp_path / "set" / "frames" / name), cv2.IMREAD_UNCHANGED)
        assert torch.equal(sample.frame, torch.from_numpy(written))
        assert torch.equal(sample.R, frames.plan.R[number])
        assert torch.equal(sample.t, frames.plan.t[number])


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_of_a_loader_are_single_frames(frames: SimulatedFrames, workers: int) -> None:
    found = [Sample(*batch) for batch in DataLoader(frames, batch_size=4, num_workers=workers)]
    assert [tuple(batch.frame.shape) for batch in found] == [(4, 72, 96), (2, 72, 96)]
    joined = Sample(*(torch.cat(parts) for parts in zip(*found, strict=True)))
    for number in range(FRAMES):
        for one, other in zip(frames[number], joined, strict=True):
            assert torch.equal(one, other[number])


def test_there_are_no_frames_beyond_the_last(frames: SimulatedFrames) -> None:
    assert torch.equal(frames[-1].frame, frames[FRAMES - 1].frame)
    with pytest.raises(IndexError, match="has 6 frames"):
        frames[FRAMES]
