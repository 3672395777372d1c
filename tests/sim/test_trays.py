"""A tray of one copy is the frame of its target."""

from __future__ import annotations

import torch

from tests.exact import F64, pinhole
from torchpose.geometry import rotations
from torchpose.sim import render
from torchpose.sim.trays import render_tray
from torchpose.target import Target


def test_a_tray_of_one_is_the_frame_of_its_target() -> None:
    camera, target = pinhole(500.0, 456, 304), Target.load("quad40")
    R = rotations.exp(torch.tensor([[0.3, -0.2, 0.8]], dtype=F64))
    t = torch.tensor([[5.0, -3.0, 220.0]], dtype=F64)
    one = render_tray(camera, target, R, t, plate=(70.0, 70.0))
    frame = render(camera, target, R, t, plate=(70.0, 70.0))[0]
    assert (one - frame).abs().max() < 1e-3
