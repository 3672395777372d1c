"""The committed sample set is what the script makes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from scripts import make_sample
from torchpose.camera import Camera
from torchpose.io.truth import Truth, read_truth
from torchpose.target import Target

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "data" / "sample"


@pytest.fixture(scope="module")
def truth() -> Truth:
    return read_truth(SAMPLE / "truth.csv")


@pytest.mark.parametrize("row", [3, 10])
def test_frame_is_reproduced(truth: Truth, row: int) -> None:
    committed = cv2.imread(str(SAMPLE / "frames" / truth.frame[row]), cv2.IMREAD_UNCHANGED)
    assert committed is not None
    camera, target = Camera.load(SAMPLE / "camera.yaml"), Target.load(SAMPLE / "target.yaml")
    made = make_sample.sample_frames(camera, target, truth, slice(row, row + 1))[0].numpy()
    assert committed.dtype == made.dtype == np.uint8
    difference = abs(committed.astype(int) - made)
    # another platform's exponential may round a grey value to the other side
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-4


def test_truth_is_reproduced(truth: Truth) -> None:
    made = make_sample.sample_truth(make_sample.sample_camera(), Target.load("quad40"))
    assert (made.frame, made.target, list(made.extra)) == (truth.frame, truth.target, list(truth.extra))
    torch.testing.assert_close(made.t, truth.t, rtol=0, atol=1e-12)
    torch.testing.assert_close(made.rotation_vector, truth.rotation_vector, rtol=0, atol=1e-12)
    # bounds leave out the tails of the blur
    for name, column in truth.extra.items():
        torch.testing.assert_close(made.extra[name], column, rtol=1e-4, atol=0)


def test_conditions(truth: Truth) -> None:
    camera = Camera.load(SAMPLE / "camera.yaml")
    frames = sorted((SAMPLE / "frames").iterdir())
    assert [f.name for f in frames] == truth.frame
    assert sum(f.stat().st_size for f in SAMPLE.rglob("*") if f.is_file()) < 10e6
    # the whole plate is in view
    corners = torch.tensor([[-35, -35, 0], [35, -35, 0], [35, 35, 0], [-35, 35, 0]], dtype=torch.float64)
    pixels = camera.project(corners @ truth.R.mT + truth.t[:, None])
    size = torch.tensor([camera.width - 1, camera.height - 1])
    assert ((pixels > 10) & (pixels < size - 10)).all()
    # the tilt that the truth names is the angle between the normal and the optical axis
    torch.testing.assert_close(truth.R[:, 2, 2].acos().rad2deg(), truth.extra["tilt_deg"], rtol=0, atol=1e-5)
    assert (truth.extra["noise_sigma"] <= 0.5).sum() >= 2
