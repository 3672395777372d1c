"""Fields and textures against the autocorrelation that they claim, and their place on the print."""

from __future__ import annotations

import math

import pytest
import torch

from tests.sim.test_renderer import BROWN, camera, pose, target
from torchpose.errors import ConfigError
from torchpose.sim import render, shapes
from torchpose.sim.fields import keys_of, smooth_field, uniform
from torchpose.sim.texture import Texture

F64 = torch.float64


def autocorrelation(field: torch.Tensor, shift: tuple[int, int]) -> float:
    return float((field * field.roll(shift, (-2, -1))).mean())


@pytest.mark.parametrize("length", [1.5, 4.0, 9.0])
def test_field_has_its_autocorrelation(length: float) -> None:
    field = smooth_field(keys_of(24, 5, "test"), (160, 224), length)
    assert float(field.square().mean()) == pytest.approx(1, abs=0.02)
    # 24 fields of some 160 224 / (pi length^2) independent places
    tolerance = 5 * math.sqrt(math.pi * length**2 / (24 * 160 * 224))
    for shift in ((1, 0), (0, 3), (4, -4), (7, 2)):
        expected = math.exp(-(shift[0] ** 2 + shift[1] ** 2) / length**2)
        assert autocorrelation(field, shift) == pytest.approx(expected, abs=tolerance)
    together = torch.corrcoef(field.flatten(1)) - torch.eye(24)
    assert together.abs().max() < 5 * math.sqrt(2 * math.pi * length**2 / (160 * 224))


def test_chance_is_of_the_frame_and_of_the_purpose() -> None:
    keys = keys_of(5, 3, "haze")
    assert torch.equal(keys_of(2, 3, "haze", torch.tensor([4, 1])), keys[[4, 1]])
    assert len(torch.cat([keys, keys_of(5, 3, "ghost"), keys_of(5, 4, "haze")]).unique()) == 15
    chance = uniform(keys_of(200, 1, "test"), 100)
    assert float(chance.mean()) == pytest.approx(0.5, abs=0.01)
    assert float(chance.std()) == pytest.approx(math.sqrt(1 / 12), abs=0.01)


def test_texture_is_fixed_to_the_print() -> None:
    cam = camera(256, 240, distortion=BROWN)
    key = keys_of(1, 0, "paper").expand(2)
    R = torch.eye(3, dtype=F64).expand(2, 3, 3)
    # 400 px focal length: 0.5 mm a px; moved by 8 px along u, 4 px along v of the frame with equal focal lengths
    square = camera(256, 240)
    square.matrix[1, 1] = 400.0
    t = torch.tensor([[0.0, 0.0, 200.0], [4.0, -2.0, 200.0]], dtype=F64)
    paper = Texture(key, 0.05, 3.0)
    light = shapes.polygon([])[torch.zeros(1, dtype=torch.bool)]  # nothing printed
    frame, moved = render(square, light, R, t, light=100.0, texture=paper) / 100 - 1
    torch.testing.assert_close(moved[0:200, 8:250], frame[4:204, 0:242], rtol=0, atol=2e-3)
    # under perspective and distortion the frame sees the same reflectance in the same place of the plate
    tilted, at = pose(40, 20, (2.0, 1.0, 210.0))
    seen = render(cam, light, tilted, at, light=100.0, texture=Texture(key[:1], 0.05, 3.0))[0] / 100 - 1
    v, u = torch.meshgrid(torch.arange(60, 180, 7), torch.arange(60, 200, 7), indexing="ij")
    ray = cam.undistort_points(torch.stack([u, v], -1).double().view(-1, 2))
    ray = torch.cat([ray, torch.ones(len(ray), 1, dtype=F64)], 1)
    depth = (tilted[0, :, 2] @ at[0]) / (ray @ tilted[0, :, 2])
    plane = (depth[:, None] * ray - at[0]) @ tilted[0]
    pixel = square.project(plane + t[0]).float()
    grid = 2 * pixel / torch.tensor([255.0, 239.0]) - 1
    expected = torch.nn.functional.grid_sample(frame[None, None], grid[None, None], "bicubic", align_corners=True)
    inside = (grid.abs() < 0.97).all(1)
    assert inside.sum() > 300
    difference = (seen[v, u].flatten() - expected.flatten())[inside]
    # bicubic interpolation of the tile, and of the frame here
    assert float(difference.square().mean().sqrt()) < 0.04 * 0.05


@pytest.mark.parametrize("length", [0.6, 2.0])
def test_texture_has_share_and_length(length: float) -> None:
    cam = camera(400, 400)
    cam.matrix[1, 1] = 400.0
    paper = Texture(keys_of(6, 1, "paper"), 0.02, length)
    R, t = torch.eye(3, dtype=F64).expand(6, 3, 3), torch.tensor([[0.0, 0, 80.0]], dtype=F64).expand(6, 3)
    light = shapes.polygon([])[torch.zeros(1, dtype=torch.bool)]
    field = render(cam, light, R, t, light=200.0, texture=paper) / 200 - 1  # 5 px a mm
    share = float(field.square().mean().sqrt())
    assert share == pytest.approx(0.02, rel=0.03)
    for shift in (2, 5):
        found = float((field[..., shift:] * field[..., :-shift]).mean()) / share**2
        assert found == pytest.approx(math.exp(-((shift / 5 / length) ** 2)), abs=0.05)


def test_texture_is_on_the_plate_and_below_the_covers() -> None:
    cam, (R, t) = camera(), pose(20, 0, (0.0, 0.0, 200.0))
    cover = shapes.rectangle((8.0, 8.0), 8.0, 8.0, level=128.0)
    options = {"plate": (30.0, 30.0), "covers": cover}
    plain, papery = (
        render(cam, target(), R, t, texture=texture, **options)[0]
        for texture in (None, Texture(keys_of(1, 0, "paper"), 0.05, 1.0))
    )
    gain = papery / plain
    assert 0.03 < float(gain[plain > 215].std()) < 0.07  # paper
    assert 0.03 < float(gain[plain < 32].std()) < 0.07  # ink
    assert torch.equal(papery[plain == 90], plain[plain == 90])  # surround
    at = cam.project((R[0] @ torch.tensor([8.0, 8.0, 0.0], dtype=F64)) + t[0]).round().long()
    torch.testing.assert_close(papery[at[1], at[0]], torch.tensor(128.0), rtol=0, atol=1e-3)


def test_a_texture_without_length_is_refused() -> None:
    with pytest.raises(ConfigError, match="texture: needs"):
        Texture(keys_of(1, 0, "paper"), 0.02, 0.0)
