"""Sequences: with the last poses the rings are looked for near them, and the results are those of all the frame."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpose import pipeline
from torchpose.camera import Camera
from torchpose.detect.candidates import find_coarse
from torchpose.errors import ArgumentError, ConfigError
from torchpose.geometry import rotations
from torchpose.pipeline import PoseEstimator
from torchpose.results import Poses, Status
from torchpose.sim import add_noise, render
from torchpose.target import Target
from torchpose.tracking import Tracker

F64 = torch.float64
MATRIX = torch.tensor([[800.0, 0, 399.5], [0, 800, 299.5], [0, 0, 1]], dtype=F64)
CAMERA = Camera(800, 600, MATRIX, torch.tensor([-0.1, 0.02, 0.001, 0.0], dtype=F64))
COVERED, HALF = 3, 5  # frames without the target, and with a marker covered


@pytest.fixture(scope="module")
def sequence() -> Tensor:
    """Frames (8, H, W) of a target that moves by 18 px a frame and turns; lost in one of them."""
    k = torch.arange(8, dtype=F64)
    R = rotations.exp(torch.stack([0.3 + 0.03 * k, -0.2 + 0.02 * k, 0.04 * k], -1))
    t = torch.stack([-20 + 4.0 * k, -8 + 2.4 * k, 220 + 0.8 * k], -1)
    frames = add_noise(render(CAMERA, Target.load("quad40"), R, t), 2.0, seed=3)
    frames[COVERED] = 200
    middle = CAMERA.project(R[HALF] @ Target.load("quad40").centers[0] + t[HALF]).round().long()
    frames[HALF, middle[1] - 40 : middle[1] + 40, middle[0] - 40 : middle[0] + 40] = 90
    return frames


@pytest.fixture(scope="module")
def estimator() -> PoseEstimator:
    return PoseEstimator(CAMERA, "quad40")


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Frames of every search of whole frames."""
    counts: list[int] = []
    search: Callable[..., Any] = find_coarse

    def counted(frames: Tensor, *args: Any, **kwargs: Any) -> Any:
        counts.append(len(frames))
        return search(frames, *args, **kwargs)

    monkeypatch.setattr(pipeline, "find_coarse", counted)
    return counts


def same(found: Poses, wanted: Poses) -> bool:
    """Whether statuses are equal and poses to a tenth of a standard deviation."""
    assert found.status.tolist() == wanted.status.tolist()
    assert found.markers.tolist() == wanted.markers.tolist()
    some = wanted.t.isfinite().all(1)
    off = torch.cat([found.t - wanted.t, rotations.log(found.R @ wanted.R.mT)], 1)[some] / wanted.noise_std[some]
    return bool((off.abs() < 0.1).all())


def test_a_sequence_has_the_results_of_single_frames(
    estimator: PoseEstimator, sequence: Tensor, searched: list[int]
) -> None:
    last: Poses | None = None
    whole, seen = [], []
    for frame in sequence:
        searched.clear()
        wanted = estimator(frame)
        searched.clear()
        last = estimator(frame, near=last)
        seen.append(len(searched))
        whole.append(int(wanted.status[0]))
        assert same(last, wanted)
    assert whole == [Status.NO_TARGET if k == COVERED else Status.OK for k in range(len(sequence))]
    # all over the frame without a last pose, and where the target is not whole
    assert [k for k, count in enumerate(seen) if count] == [0, COVERED, COVERED + 1, HALF]


def test_several_sequences_are_one_batch(estimator: PoseEstimator, sequence: Tensor, searched: list[int]) -> None:
    last = estimator(sequence[[0, COVERED, 6]])
    now = sequence[[1, COVERED + 1, 7]]
    wanted = estimator(now)
    searched.clear()
    assert same(estimator(now, near=last), wanted)
    assert searched == [1]  # the one that was lost


def test_poses_of_other_targets_are_refused(estimator: PoseEstimator, sequence: Tensor) -> None:
    both = PoseEstimator(CAMERA, ["quad40", "hexa50"])(sequence[:1])
    with pytest.raises(ConfigError, match=r"^near: poses of 2 targets"):
        estimator(sequence[:1], near=both)


def test_a_tracker_keeps_the_last_pose_of_every_sequence(
    estimator: PoseEstimator, sequence: Tensor, searched: list[int]
) -> None:
    """Two sequences, of which one pauses, and their order changes; each goes on where it was."""
    tracker = Tracker(estimator)
    assert same(tracker(sequence[[0, 5]], ["left", "right"]), estimator(sequence[[0, 5]]))
    tracker(sequence[[1]], ["left"])
    searched.clear()
    now = tracker(sequence[[6, 2]], ["right", "left"])
    assert not searched
    assert same(now, estimator(sequence[[6, 2]]))
    tracker.forget("left")
    searched.clear()
    tracker(sequence[[7, 3]], ["right", "left"])
    assert searched == [1]
    with pytest.raises(ArgumentError, match=r"^sequences: 1 names for 2 frames"):
        tracker(sequence[:2], ["left"])


def test_poses_given_as_matrices_are_those_of_all_targets(estimator: PoseEstimator, sequence: Tensor) -> None:
    last = estimator(sequence[:1])
    assert same(estimator(sequence[1:2], near=(last.R[None], last.t[None])), estimator(sequence[1:2]))
    with pytest.raises(ArgumentError, match=r"^near: has shapes \(1, 3, 3\)"):
        estimator(sequence[1:2], near=(last.R, last.t))
