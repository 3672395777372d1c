"""Elliptic Gaussians, smear and disc against Fourier transforms in closed form, moments and finite differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import special
from torch import Tensor

from tests.sim.test_renderer import BROWN, camera, pose, target
from torchpose.errors import ConfigError, FrameError
from torchpose.sim import Defocus, render, shapes

F64 = torch.float64
FRONTAL = torch.eye(3, dtype=F64)[None], torch.tensor([[1.0, -2.0, 200.0]], dtype=F64)
CENTER, SCALE = np.array([63.3 + 2.0, 60.8 - 4.05]), np.array([2.0, 2.025])  # px and px/mm of that pose

WEIGHT = torch.randn(70, 80, generator=torch.Generator().manual_seed(0))


def covariance(major: float, minor: float, angle_deg: float) -> Tensor:
    a = math.radians(angle_deg)
    axes = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]], dtype=F64)
    return axes @ torch.diag(torch.tensor([major**2, minor**2], dtype=F64)) @ axes.T


def jinc(x: np.ndarray) -> np.ndarray:
    """2 J1(x) / x, the Fourier transform of a disc of the area 1."""
    x = np.maximum(x, 1e-12)
    found: np.ndarray = 2 * special.j1(x) / x
    return found


def disc_image(radius: float, S: np.ndarray, smear: np.ndarray, disc: float, size: tuple[int, int]) -> np.ndarray:
    """Coverage of a disc of a radius in mm, blurred, as a Fourier series over a picture that is periodic."""
    period, cut = 160, 6.5 / math.sqrt(np.linalg.eigvalsh(S)[0])  # what is cut off is below 1e-9
    k = 2 * math.pi / period * np.arange(-math.ceil(cut * period / 2 / math.pi), 1 + cut * period / 2 / math.pi)
    x, y = np.meshgrid(k, k)
    a, b = radius * SCALE
    spectrum = math.pi * a * b * jinc(np.hypot(a * x, b * y)) * np.exp(-1j * (x * CENTER[0] + y * CENTER[1]))
    spectrum = spectrum * np.exp(-0.5 * (S[0, 0] * x * x + 2 * S[0, 1] * x * y + S[1, 1] * y * y))
    spectrum *= np.sinc((x * smear[0] + y * smear[1]) / 2 / math.pi) * jinc(disc * np.hypot(x, y))
    spectrum *= np.sinc(x / 2 / math.pi) * np.sinc(y / 2 / math.pi)
    across, along = (np.exp(1j * np.outer(np.arange(n), k)) for n in size)
    found: np.ndarray = (across @ spectrum @ along.T).real / period**2
    return found


@pytest.mark.parametrize(
    ("psf", "smear", "disc"),
    [
        (covariance(1.6, 0.7, 30), (0.0, 0.0), 0.0),
        (covariance(3.0, 1.0, 45), (0.0, 0.0), 0.0),
        (covariance(4.0, 2.0, -70), (0.0, 0.0), 0.0),
        (covariance(2.4, 0.6, 0), (0.0, 0.0), 0.0),
        (covariance(0.8, 0.5, 135), (0.0, 0.0), 0.0),
        (0.7, (8.5, -8.5), 0.0),
        (0.7, (0.0, 3.0), 0.0),
        (0.7, (0.0, 0.0), 5.0),
        (covariance(1.4, 0.8, 60), (4.0, 1.0), 2.0),
    ],
)
def test_is_the_convolution(psf: Tensor | float, smear: tuple[float, float], disc: float) -> None:
    ring = shapes.ring((0, 0), 9.0, 4.0, level=0.0)
    found = render(camera(), ring, *FRONTAL, psf_sigma=psf, smear=smear, disc=disc, light=1.0)
    S = psf.numpy() if isinstance(psf, Tensor) else psf**2 * np.eye(2)
    outer, inner = (disc_image(r, S, np.array(smear), disc, (120, 128)) for r in (9.0, 4.0))
    # smear and disc are integrated to 1e-5 of the contrast, the line of the Gaussian to 5e-6
    np.testing.assert_allclose(1 - found[0].double().numpy(), outer - inner, rtol=0, atol=2e-5)


def test_second_moments_add_up() -> None:
    S, smear, disc, radius = covariance(2.0, 0.9, 25), torch.tensor([5.0, 3.0], dtype=F64), 3.0, 3.0
    dot = shapes.ring((0, 0), radius, level=0.0)
    frame = render(camera(), dot, *FRONTAL, psf_sigma=S, smear=smear, disc=disc, light=1.0)[0].double()
    mass = 1 - frame
    v, u = torch.meshgrid(torch.arange(120, dtype=F64), torch.arange(128, dtype=F64), indexing="ij")
    from_center = torch.stack([u, v], -1) - torch.from_numpy(CENTER)
    mean = (mass[..., None] * from_center).sum((0, 1)) / mass.sum()
    found = torch.einsum("hw,hwi,hwj->ij", mass, from_center, from_center) / mass.sum()
    own = torch.diag(torch.from_numpy((radius * SCALE) ** 2)) / 4
    expected = own + S + torch.outer(smear, smear) / 12 + torch.eye(2, dtype=F64) * (disc**2 / 4 + 1 / 12)
    torch.testing.assert_close(mean, torch.zeros(2, dtype=F64), rtol=0, atol=1e-4)
    torch.testing.assert_close(found, expected, rtol=2e-5, atol=1e-4)


def loss_of(blur: Tensor) -> Tensor:
    """A sum over a frame, of S11, S12, S22, smear and disc (6,)."""
    cam = camera(80, 70, distortion=BROWN)
    R, t = pose(35, 60, (-6.0, -8.0, 200.0))
    look: dict[str, Any] = {"psf_sigma": blur[[0, 1, 1, 2]].view(1, 2, 2), "smear": blur[None, 3:5], "disc": blur[5:]}
    return (render(cam, target(), R, t, **look)[0] * WEIGHT).double().sum()


@pytest.mark.parametrize(
    "start",
    [
        [0.64, 0.0, 0.64, 0.0, 0.0, 0.0],
        [0.64, 0.0, 0.64, 2.0, 1.0, 0.0],
        [1.4, -0.5, 0.9, 0.0, 0.0, 1.5],
        [1.4, 0.5, 0.9, 0.0, 0.0, 0.0],
    ],
)
def test_gradients_are_those_of_finite_differences(start: list[float]) -> None:
    at = torch.tensor(start, dtype=F64)
    backward = torch.func.grad(loss_of)(at)
    forward = torch.func.jacfwd(loss_of)(at)
    torch.testing.assert_close(forward, backward, rtol=1e-4, atol=1e-2)
    step = 5e-3
    for k in range(6 if start[5] > 0 else 5):
        shift = torch.zeros(6, dtype=F64).index_fill(0, torch.tensor(k), step)
        with torch.no_grad():
            difference = (loss_of(at + shift) - loss_of(at - shift)) / (2 * step)
        torch.testing.assert_close(backward[k], difference, rtol=3e-3, atol=0.1)


def test_frames_have_blur_of_their_own() -> None:
    cam = camera(distortion=BROWN)
    R, t = pose(30, 10, (3.0, -2.0, 190.0))
    psf = torch.stack([covariance(*s) for s in ((0.7, 0.7, 0), (1.4, 0.8, 30), (1.0, 0.6, 100))])
    smear, disc = torch.tensor([[3.0, 1.0], [0.0, 0.0], [-1.0, 2.0]], dtype=F64), torch.tensor([0.0, 1.0, 0.5])
    together = render(
        cam, target(), R.expand(3, 3, 3), t.expand(3, 3), psf_sigma=psf, smear=smear, disc=disc
    )  # fmt: skip
    alone = [render(cam, target(), R, t, psf_sigma=psf[i], smear=smear[i], disc=disc[i]) for i in range(3)]
    # each to 1e-5 of the contrast, by other nodes
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=4e-3)
    round_ = render(cam, target(), R, t, psf_sigma=0.7, smear=smear[0])
    torch.testing.assert_close(round_, alone[0], rtol=0, atol=1e-4)


def test_smear_reaches_into_the_frame() -> None:
    # a disc just outside of the left border
    dot = shapes.ring((-40.0, 0.0), 3.0, level=0.0)
    still, smeared = (render(camera(), dot, *FRONTAL, smear=s, light=1.0)[0] for s in ((0.0, 0.0), (36.0, 0.0)))
    assert (still == 1).all()
    assert smeared.min() < 0.8


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"psf_sigma": torch.tensor([[1.0, 2.0], [2.0, 1.0]])}, "covariance"),
        ({"psf_sigma": torch.tensor([[1.0, 0.2], [0.1, 1.0]])}, "symmetric"),
        ({"disc": -1.0}, "disc"),
        ({"disc": 1.0, "defocus": Defocus(2.0, 8.0, 100.0)}, "give disc or defocus"),
    ],
)
def test_what_is_no_blur_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        render(camera(), target(), *FRONTAL, **wrong)


def test_shapes_of_blur_that_disagree() -> None:
    for wrong in ({"psf_sigma": torch.ones(2)}, {"smear": torch.zeros(3, 2)}, {"smear": (1.0,)}):
        with pytest.raises(FrameError, match="1 poses"):
            render(camera(), target(), *FRONTAL, **wrong)
