"""What the library takes as it comes: frames as arrays, targets by name, states, modules by their short names."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp

SAMPLE = Path(__file__).parents[1] / "data" / "sample"
IMAGE = cv2.imread(str(sorted(SAMPLE.rglob("*.png"))[0]), cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def camera() -> tp.Camera:
    return tp.Camera.load(SAMPLE / "camera.yaml")


def test_short_names_need_no_import_of_their_own() -> None:
    code = "import torchpose as tp; " + "; ".join(
        ("tp.zernike.locate", "tp.sim.render", "tp.centers.compensate", "tp.analysis.rms", "tp.detect.find_candidates",
         "tp.calibration.calibrate_hand_eye", "tp.design.design_target")
    )  # fmt: skip
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])


def test_frames_are_taken_as_they_come(camera: tp.Camera) -> None:
    """One frame or a batch, tensors or arrays, grey or RGB, in any range of values."""
    assert IMAGE is not None
    by_name = tp.PoseEstimator(camera, str(SAMPLE / "target.yaml"), method="centers")
    estimator = tp.PoseEstimator(camera, [tp.Target.load(SAMPLE / "target.yaml")], method="centers")
    tensor = torch.from_numpy(IMAGE)
    expected = estimator(tensor[None])
    assert bool(expected.ok.all())
    read_only = np.frombuffer(IMAGE.tobytes(), np.uint8).reshape(IMAGE.shape)  # of which torch warns
    for frames in (IMAGE, IMAGE[None], tensor, np.broadcast_to(IMAGE, (1, 3, *IMAGE.shape)), read_only):
        assert torch.equal(by_name(frames).t, expected.t)
    assert len(tp.PoseEstimator(camera, ["quad40"]).targets) == 1
    with pytest.raises(tp.ConfigError, match="target: is neither a file nor built in"):
        tp.PoseEstimator(camera, "quad41")
    with pytest.raises(tp.ConfigError, match="target: is of type int"):
        tp.PoseEstimator(camera, 40)  # type: ignore[arg-type]
    with pytest.raises(tp.ConfigError, match=r"instances: 2.5 given"):
        tp.PoseEstimator(camera, "quad40", instances=2.5)  # type: ignore[arg-type]
    with pytest.raises(tp.ConfigError, match="camera: is of type str"):
        tp.PoseEstimator("camera.yaml", "quad40")  # type: ignore[arg-type]


def test_frames_that_hold_no_pixels_or_colours_last_are_called_so(camera: tp.Camera) -> None:
    assert IMAGE is not None
    estimator = tp.PoseEstimator(camera, "quad40", method="centers")
    tensor = torch.from_numpy(IMAGE)
    colours = np.repeat(IMAGE[..., None], 3, -1)
    for frames in (colours, colours[None], torch.from_numpy(colours)):
        with pytest.raises(tp.FrameError, match=r"^frames: shape \(.*3\) has its colours last, as OpenCV"):
            estimator(frames)
    with pytest.raises(tp.FrameError, match=r"^frames: is sparse_coo; pass"):
        estimator(tensor.to_sparse())
    with pytest.raises(tp.FrameError, match=r"^frames: is on the device meta; pass"):
        estimator(tensor.to("meta"))
    wide = IMAGE.astype(np.longdouble) / 255
    assert torch.equal(estimator(wide).t, estimator(tensor.double() / 255).t)


def test_candidates_are_the_same_in_any_form_of_a_frame() -> None:
    assert IMAGE is not None
    tensor = torch.from_numpy(IMAGE)
    expected = tp.detect.find_candidates(tensor[None].float(), 4)
    assert len(expected) > 0
    for frames in (IMAGE, tensor, IMAGE.astype(np.float32) / 255, tensor[None, None] / 255):
        found = tp.detect.find_candidates(frames, 4)
        assert len(found) == len(expected)
        assert torch.cdist(found.ellipse[:, :4], expected.ellipse[:, :4]).amin(0).max() < 0.05, (
            "a byte is rounded when it is reduced"
        )
    assert len(tp.detect.find_candidates(IMAGE / 255, 4, float_range=255.0)) == 0, "as it says, all of it is black"
    wrong: list[Any] = [tensor.to(torch.complex64), IMAGE[0], "picture"]
    for frames in wrong:
        with pytest.raises(tp.TorchposeError, match="frames: "):
            tp.detect.find_candidates(frames)
    with pytest.raises(tp.ArgumentError, match="factor: is 0"):
        tp.detect.find_candidates(IMAGE, 0)


def test_a_state_is_assigned_to_an_estimator_without_numbers(camera: tp.Camera) -> None:
    assert IMAGE is not None
    estimator = tp.PoseEstimator(camera, "quad40", method="centers")
    bare = tp.PoseEstimator(camera, "quad40", method="centers").to("meta")
    bare.load_state_dict(estimator.state_dict(), assign=True)
    assert torch.equal(bare(IMAGE).t, estimator(IMAGE).t)


@pytest.mark.parametrize("name", ['7 "A"', "back\\slash", "1e3", "\u00e4\U0001f4f7", "yes: no #"])
def test_adjustments_of_any_name_are_read_back(tmp_path: Path, name: str) -> None:
    replace(tp.Target.load("quad40"), adjustment=name).save(tmp_path / "target.yaml")
    assert tp.Target.load(tmp_path / "target.yaml").adjustment == name


@pytest.mark.slow
def test_compiled_estimators_are_the_same(camera: tp.Camera) -> None:
    assert IMAGE is not None
    estimator = tp.PoseEstimator(camera, SAMPLE / "target.yaml", method="centers")
    frames = torch.from_numpy(IMAGE)[None]
    torch.testing.assert_close(torch.compile(estimator)(frames).t, estimator(frames).t)
