"""Working volumes: their poses lie within them, their smallest scale is that of the rings."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from torchpose import ellipse
from torchpose.camera import Camera
from torchpose.design import WorkingVolume
from torchpose.errors import ConfigError

F64 = torch.float64
VOLUME = WorkingVolume((150.0, 170.0), (10.0, 5.0), math.radians(20), math.radians(30))


def camera(distortion: tuple[float, float, float, float] = (-0.1, 0.02, 1e-3, -1e-3)) -> Camera:
    matrix = torch.tensor([[1100.0, 0, 450], [0, 1090.0, 300], [0, 0, 1]], dtype=F64)
    return Camera(901, 601, matrix, torch.tensor(distortion, dtype=F64))


def angles(R: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Tilt of the normal, and turn about the optical axis, of R = exp(lean) Rz(roll)."""
    tilt = R[:, 2, 2].clamp(max=1).acos()
    axis = torch.stack([R[:, 1, 2], -R[:, 0, 2], torch.zeros(len(R), dtype=F64)], 1)
    lean = -axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-30) * tilt[:, None]
    from torchpose.geometry import rotations

    turn = rotations.exp(-lean) @ R
    return tilt, torch.atan2(turn[:, 1, 0], turn[:, 0, 0])


@pytest.mark.parametrize("kind", ["extremes", "random"])
def test_poses_lie_within_the_volume_and_reach_its_borders(kind: str) -> None:
    g = torch.Generator().manual_seed(0)
    R, t = VOLUME.extremes() if kind == "extremes" else VOLUME.random(4000, g)
    tilt, roll = angles(R)
    for value, low, high in (
        (t[:, 2], 150, 170),
        (t[:, 0], -10, 10),
        (t[:, 1], -5, 5),
        (tilt.rad2deg(), 0, 20),
        (roll.rad2deg(), -30, 30),
    ):
        span = high - low
        assert float(value.min()) == pytest.approx(low, abs=1e-5 if kind == "extremes" else 0.01 * span)
        assert float(value.max()) == pytest.approx(high, abs=1e-5 if kind == "extremes" else 0.01 * span)


def test_middle() -> None:
    R, t = VOLUME.middle
    assert torch.equal(R[0], torch.eye(3, dtype=F64))
    assert t.tolist() == [[0, 0, 160]]
    assert WorkingVolume((150, 170), nominal=155).middle[1].tolist() == [[0, 0, 155]]


def test_least_scale_is_the_smallest_semi_minor_axis_of_small_rings() -> None:
    cam = camera()
    R, t = VOLUME.extremes()
    angle = torch.arange(32, dtype=F64) * (2 * math.pi / 32)
    circle = 0.01 * torch.stack([angle.cos(), angle.sin(), torch.zeros(32, dtype=F64)], 1)
    smallest = math.inf
    for corner in ([-20.0, -12.0, 0], [20.0, -12.0, 0], [-20.0, 12.0, 0], [20.0, 12.0, 0], [0.0, 0, 0]):
        point = circle + torch.tensor(corner, dtype=F64)
        pixel = cam.project(point @ R.mT + t[:, None])
        index = torch.arange(len(t)).repeat_interleave(32)
        smallest = min(smallest, float(ellipse.fit(pixel.flatten(0, 1), index, len(t))[:, 3].min()) / 0.01)
    assert VOLUME.least_scale(cam, (20.0, 12.0)) == pytest.approx(smallest, rel=1e-3)


@pytest.mark.parametrize(
    "limits",
    [
        {"distance": (0.0, 100.0)},
        {"distance": (200.0, 100.0)},
        {"distance": (math.nan, 100.0)},
        {"distance": (100.0, math.inf)},
        {"distance": (100.0, 200.0), "offset": (-1.0, 0.0)},
        {"distance": (100.0, 200.0), "offset": (0.0, math.nan)},
        {"distance": (100.0, 200.0), "tilt": -0.1},
        {"distance": (100.0, 200.0), "tilt": math.radians(85)},
        {"distance": (100.0, 200.0), "roll": math.nan},
        {"distance": (100.0, 200.0), "nominal": 250.0},
    ],
)
def test_impossible_volumes_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="; "):
        WorkingVolume(**limits)
