"""The stage for other people's pipelines, and frames as a data set of torch."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torchpose.errors import ArgumentError
from torchpose.io import FrameDataset, PoseStage
from torchpose.io.images import decode
from torchpose.pipeline import PoseEstimator

SAMPLE = Path(__file__).parents[2] / "data" / "sample"
CAMERA, TARGET = SAMPLE / "camera.yaml", SAMPLE / "target.yaml"
PATHS = [str(SAMPLE / "frames" / f"{number:03d}.png") for number in range(3)]


def test_paths_and_images_have_the_same_poses_as_the_estimator() -> None:
    stage = PoseStage(CAMERA, TARGET, method="centers")
    frames = np.stack([decode(Path(path)) for path in PATHS])
    by_path = stage({"path": np.array([*PATHS, "gone.png", PATHS[0]], dtype=object), "part": np.arange(5)})
    by_image = stage({"image": frames})
    poses = PoseEstimator(stage._work.camera, stage._work.targets, method="centers")(frames)
    assert by_path["status"].tolist() == ["ok", "ok", "ok", "unreadable", "ok"]
    assert by_path["frame"].tolist() == [*PATHS, "gone.png", PATHS[0]]
    assert by_path["part"].tolist() == [0, 1, 2, 3, 4]
    assert np.isnan(by_path["tx"][3])
    for columns in ({name: values[:3] for name, values in by_path.items()}, by_image):
        found = np.stack([columns[name] for name in ("tx", "ty", "tz")], 1)
        np.testing.assert_allclose(found, poses.t.numpy(), rtol=0, atol=1e-7)  # batches of other sizes round otherwise
    assert by_image["frame"].tolist() == ["0", "1", "2"]


def test_a_batch_without_frames_is_refused() -> None:
    with pytest.raises(ArgumentError, match="batch: has the columns name; give path or image"):
        PoseStage(CAMERA, TARGET)({"name": np.array(["a"])})


@pytest.mark.parametrize("workers", [0, 2])
def test_workers_of_a_loader_share_the_frames(workers: int, tmp_path: Path) -> None:
    frames = FrameDataset([SAMPLE / "frames"], CAMERA, batch=5)
    assert len(frames) == 3
    loader = DataLoader(frames, batch_size=None, num_workers=workers)
    found = {name: frame for names, batch in loader for name, frame in zip(names, batch, strict=True)}
    assert sorted(found) == [f"{number:03d}.png" for number in range(12)]
    for path in PATHS:
        assert torch.equal(found[Path(path).name], torch.from_numpy(decode(Path(path))))


def test_unreadable_frames_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(Path(PATHS[0]).read_bytes())
    (tmp_path / "b.png").write_bytes(b"no picture")
    frames = FrameDataset(tmp_path, CAMERA)
    assert [names for names, _ in frames] == [["a.png"]]
    assert frames.faults == {"b.png": "not_an_image"}
