"""Kornia's augmentations as faults of frames: they depend on seed and number alone, and wrong names are told."""

from __future__ import annotations

import pytest
import torch
from kornia import augmentation
from torch import nn

from torchpose.errors import ConfigError
from torchpose.sim import faults_of, with_faults

FRAMES = torch.linspace(20, 220, 3 * 40 * 50).view(3, 40, 50)
WANTED: dict[str, dict[str, object]] = {
    "RandomGaussianIllumination": {"gain": [0.1, 0.2]},
    "RandomErasing": {"scale": [0.01, 0.03], "value": 0.2},
    "RandomSaltAndPepperNoise": {"amount": [0.01, 0.02]},
}


def test_a_frame_has_its_own_faults_in_any_batch() -> None:
    before = torch.random.get_rng_state()
    faults = faults_of(WANTED)
    whole = with_faults(FRAMES, faults, 7)
    assert torch.equal(torch.random.get_rng_state(), before)  # nobody else's chance is touched
    alone = with_faults(FRAMES[2:], faults, 7, index=torch.tensor([2]))
    torch.testing.assert_close(whole[2:], alone, rtol=0, atol=0)
    assert (whole[0] - FRAMES[0] != whole[1] - FRAMES[1]).any()
    assert (with_faults(FRAMES, faults, 8) != whole).any()
    assert whole.min() >= 0
    assert whole.max() <= 255.001


def test_any_module_on_frames_of_0_to_1_is_a_fault() -> None:
    torch.testing.assert_close(with_faults(FRAMES, nn.Identity()), FRAMES)
    dead = with_faults(FRAMES, augmentation.RandomSaltAndPepperNoise(amount=(0.02, 0.02), p=1.0))
    changed = (dead - FRAMES).abs() > 1e-3
    assert 0.005 < changed.float().mean() < 0.03
    assert set(dead[changed].tolist()) == {0.0, 255.0}


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"RandomErase": {}}, "faults.RandomErase: .* did you mean RandomErasing"),
        ({"RandomErasing": {"size": 3}}, "faults.RandomErasing: .*size"),
        ({"RandomJPEG": {}}, "faults.RandomJPEG: "),  # for colour alone
        ({"RandomCrop": {"size": [8, 8]}}, "faults.RandomCrop: changes the shape"),
    ],
)
def test_wrong_faults_are_one_line(wanted: dict[str, dict[str, object]], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        faults_of(wanted)
    assert "\n" not in str(caught.value)
