"""Every method on every kind of frame, alone in its batch and beside others; and the estimator as a module."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import F64, pinhole, random_poses
from torchpose.geometry import rotations
from torchpose.kernels import has_compiler
from torchpose.pipeline import Method
from torchpose.refine import METHODS
from torchpose.sim import add_noise, render

CAMERA = pinhole(700.0, 640, 480)
QUAD = tp.Target.load("quad40")
KINDS = ["good", "black", "noise", "one marker", "two markers", "three markers", "wrong places"]
STATUS = {
    "good": {tp.Status.OK},
    "black": {tp.Status.NO_TARGET},
    "noise": {tp.Status.NO_TARGET},
    "one marker": {tp.Status.TOO_FEW_MARKERS},
    "two markers": {tp.Status.TOO_FEW_MARKERS},
    "three markers": {tp.Status.OK, tp.Status.AMBIGUOUS},
    "wrong places": {tp.Status.REJECTED},
}


def frame(kind: str) -> Tensor:
    """(1, H, W) uint8."""
    r, t = random_poses(1, 30, (150, 160), seed=2)
    t[:, :2] = 0
    markers = {"one marker": 1, "two markers": 2, "three markers": 3}.get(kind, 4)
    target = QUAD
    if kind == "wrong places":
        shift = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, -4, 0], [0, 0, 0]], dtype=F64)
        target = dataclasses.replace(QUAD, centers=QUAD.centers[[1, 0, 3, 2]] + shift)
    if kind == "black":
        return torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.uint8)
    if kind == "noise":
        return add_noise(torch.full((1, CAMERA.height, CAMERA.width), 128.0), 8.0, seed=1)
    picture = render(CAMERA, target, r, t)
    for u, v in CAMERA.project((r @ QUAD.centers[markers:, :, None])[..., 0] + t).round().int().tolist():
        picture[:, v - 30 : v + 31, u - 30 : u + 31] = 220  # paper over the others
    return add_noise(picture, 1.0, seed=1)


FRAMES = {kind: frame(kind) for kind in KINDS}


@pytest.mark.parametrize("method", METHODS)
def test_methods_give_every_frame_its_status(method: Method) -> None:
    estimator = tp.PoseEstimator(CAMERA, QUAD, method=method)
    together = estimator(torch.cat(list(FRAMES.values())))
    for row, kind in enumerate(KINDS):
        alone = estimator(FRAMES[kind])
        assert tp.Status(int(alone.status[0])) in STATUS[kind], kind
        assert alone.status[0] == together.status[row]
        torch.testing.assert_close(alone.t[0], together.t[row], rtol=0, atol=1e-6, equal_nan=True)
        has_pose = int(alone.status[0]) in (tp.Status.OK, tp.Status.AMBIGUOUS)
        assert bool(alone.t.isfinite().all()) == has_pose
        if has_pose:
            assert (torch.linalg.eigvalsh(alone.covariance[0]) > 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_no_frame_is_no_row(method: Method) -> None:
    assert len(tp.PoseEstimator(CAMERA, QUAD, method=method)(FRAMES["good"][:0])) == 0


def test_frames_without_rings_cost_little() -> None:
    """Nothing is solved or refined where nothing was identified."""
    from tests.test_pipeline import OpCount

    estimator = tp.PoseEstimator(CAMERA, QUAD)
    counts = {}
    for kind in ("good", "black"):
        with OpCount() as ops:
            estimator(FRAMES[kind])
        counts[kind] = ops.count
    assert counts["black"] < 0.27 * counts["good"]  # three thousand of them, of twelve


@pytest.fixture(scope="module")
def estimator() -> tp.PoseEstimator:
    covariance = torch.diag(torch.tensor([0.2, 0.2, 0.1, 0.1], dtype=F64))
    return tp.PoseEstimator(dataclasses.replace(CAMERA, covariance=covariance), QUAD)


def test_copies_and_pickles_estimate_the_same(estimator: tp.PoseEstimator) -> None:
    expected = estimator(FRAMES["good"])
    for again in (copy.deepcopy(estimator), pickle.loads(pickle.dumps(estimator))):
        found = again(FRAMES["good"])
        assert torch.equal(found.t, expected.t)
        assert torch.equal(found.covariance, expected.covariance)


def test_state_carries_the_camera(estimator: tp.PoseEstimator) -> None:
    """Loaded into an estimator with another camera of the same shapes, the state makes it the same."""
    matrix = CAMERA.matrix * torch.tensor([1.1, 1.1, 1.0], dtype=F64)[:, None]
    other = dataclasses.replace(estimator.camera, matrix=matrix, covariance=torch.eye(4, dtype=F64))
    loaded = tp.PoseEstimator(other, QUAD)
    assert loaded.load_state_dict(estimator.state_dict()) == torch.nn.modules.module._IncompatibleKeys([], [])
    assert torch.equal(loaded(FRAMES["good"]).t, estimator(FRAMES["good"]).t)
    assert torch.equal(loaded.camera.matrix, estimator.camera.matrix)


def test_a_state_of_another_target_is_refused(estimator: tp.PoseEstimator) -> None:
    """Its names would stay those of the old one."""
    other = tp.PoseEstimator(estimator.camera, dataclasses.replace(QUAD, centers=1.2 * QUAD.centers))
    with pytest.raises(tp.ConfigError, match="state_dict: made for another target"):
        other.load_state_dict(estimator.state_dict())


def test_a_state_leaves_the_caller_s_camera_alone(estimator: tp.PoseEstimator) -> None:
    camera = dataclasses.replace(
        estimator.camera, matrix=CAMERA.matrix * torch.tensor([[1.1], [1.1], [1.0]], dtype=F64)
    )
    before = camera.matrix.clone()
    tp.PoseEstimator(camera, QUAD).load_state_dict(estimator.state_dict())
    assert torch.equal(camera.matrix, before)


def test_a_state_of_another_camera_is_refused(estimator: tp.PoseEstimator) -> None:
    other = tp.PoseEstimator(dataclasses.replace(estimator.camera, width=320), QUAD)
    with pytest.raises(tp.ConfigError, match="camera"):
        other.load_state_dict(estimator.state_dict())


def test_batches_join() -> None:
    """Two batches one after the other are one: frames are numbered through."""
    estimator = tp.PoseEstimator(CAMERA, QUAD, method="centers")
    frames = [torch.cat([FRAMES["good"], FRAMES["black"]]), FRAMES["three markers"]]
    joined, whole = tp.Poses.cat([estimator(some) for some in frames]), estimator(torch.cat(frames))
    for name in ("frame", "target", "status", "markers"):
        assert torch.equal(getattr(joined, name), getattr(whole, name))
    assert torch.equal(joined.detections.frame, whole.detections.frame)
    torch.testing.assert_close(joined.t, whole.t, rtol=0, atol=1e-6, equal_nan=True)


def test_the_module_moves_as_any_other(estimator: tp.PoseEstimator) -> None:
    """To a device and back; a change of dtype leaves the geometry at double precision."""
    moved = copy.deepcopy(estimator).to("meta")
    assert {value.device.type for value in moved.state_dict().values()} == {"meta"}
    assert moved.camera.matrix.device.type == "meta"
    halved = copy.deepcopy(estimator).half()
    assert halved.camera.matrix.dtype == F64
    assert torch.equal(halved(FRAMES["good"]).t, estimator(FRAMES["good"]).t)
    assert "640x480" in repr(torch.nn.Sequential(estimator))


@pytest.mark.parametrize("method", list(METHODS))
def test_the_default_dtype_of_torch_does_not_matter(method: Method) -> None:
    estimator, frames = tp.PoseEstimator(CAMERA, QUAD, method=method), FRAMES["good"]
    expected = estimator(frames)
    torch.set_default_dtype(F64)
    try:
        found = estimator(frames)
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.ok.all()
    torch.testing.assert_close(found.t, expected.t, rtol=0, atol=0)


@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_compiled_poses_are_the_same(estimator: tp.PoseEstimator) -> None:
    """With missing markers and an uncertain camera, and in any batch: to a thousandth of a standard deviation."""
    compiled = tp.PoseEstimator(estimator.camera, QUAD, compile=True)
    frames = torch.cat([FRAMES[kind] for kind in ("good", "three markers", "black")] * 3)
    expected, found = estimator(frames), compiled(frames)
    assert torch.equal(found.status, expected.status)
    moved = torch.cat([found.t - expected.t, rotations.log(found.R @ expected.R.mT)], -1)[expected.ok]
    assert (moved.abs() < 1e-3 * expected.std[expected.ok]).all()
    torch.testing.assert_close(found.std, expected.std, rtol=1e-4, atol=0, equal_nan=True)
    assert ((compiled(frames[:1]).t - expected.t[:1]).abs() < 1e-3 * expected.std[:1, :3]).all()


def test_compiled_without_a_compiler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(tp.ConfigError, match="compiler"):
        tp.PoseEstimator(CAMERA, QUAD, compile=True)
