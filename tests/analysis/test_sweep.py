from __future__ import annotations

import math

import pytest
import torch

from torchpose.analysis.sensitivity import Uncertainty
from torchpose.analysis.sweep import fit, sweep
from torchpose.studies.fig04_sensitivity import paper_camera
from torchpose.target import Target

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")
F64 = torch.float64


def test_a_polynomial_is_found_again() -> None:
    d = torch.linspace(12, 32, 11, dtype=F64)
    assert torch.allclose(fit(d, 3 + 2 * d, (0, 1)), 3 + 2 * d)
    assert torch.allclose(fit(d, 0.1 * d**2 + 2 * d, (1, 2)), 0.1 * d**2 + 2 * d)
    assert not torch.allclose(fit(d, d**2, (0, 1)), d**2, rtol=0.01)


def test_the_lens_is_longer_than_assumed_by_its_whole_share_in_every_draw() -> None:
    d = torch.tensor([12.0, 32.0], dtype=F64)
    s = sweep(paper_camera(), Target.load("quad8"), d, Uncertainty(image=1e-6, focal_length=0.0025), draws=5)
    # the image is larger, so the target seems nearer
    assert torch.allclose(s.errors[..., 2], (-d * 0.0025 / 1.0025).expand(5, 2), rtol=1e-4)
    assert torch.allclose(s.depth_focal, d * 0.0025 / 1.0025)


def test_tilted_and_off_centre_targets_stand_on_the_axis() -> None:
    target = Target.load("quad40")
    s = sweep(
        paper_camera(), target, torch.tensor([160.0]), Uncertainty(image=0.1), tilt=math.radians(20), draws=500, seed=3
    )
    assert s.budget.seen.all()
    assert (s.rms / s.budget.std() - 1).abs().max() < 0.12
