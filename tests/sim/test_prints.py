"""Prints against their statistics, areas in closed form, and polygons whose corners lie on the bent plate."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.sim.test_renderer import BROWN, camera, pose, target
from torchpose.errors import ConfigError, FrameError
from torchpose.sim import PrintErrors, printed, render, shapes
from torchpose.sim.prints import Warp
from torchpose.target import Target

F64 = torch.float64
STRAIGHT = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 200.0]], dtype=F64)
QUAD = Target.load("quad40")


def drawn(count: int, **errors: Any) -> Any:
    return printed(QUAD, PrintErrors(**errors), count, torch.Generator().manual_seed(3))


def test_places_have_their_deviation() -> None:
    prints = drawn(4000, center_sigma=[0.01, 0.02, 0.05])
    error = prints.centers - QUAD.centers
    torch.testing.assert_close(
        error.square().mean((0, 1)).sqrt(), torch.tensor([0.01, 0.02, 0.05], dtype=F64), rtol=0.03, atol=0
    )
    # markers, axes and prints have nothing in common: correlations of 4000 pairs are below 5 / sqrt(4000)
    correlation = torch.corrcoef(error.flatten(1).T) - torch.eye(12, dtype=F64)
    assert correlation.abs().max() < 5 / math.sqrt(4000)
    assert torch.equal(prints.radii, QUAD.radii.expand(4000, 4, 2))


@pytest.mark.parametrize(("background", "sign"), [("light", 1), ("dark", -1)])
@pytest.mark.parametrize("gain", [-0.2, 0.0, 0.3])
def test_dark_edges_move_outwards(background: Literal["light", "dark"], sign: int, gain: float) -> None:
    prints = printed(target(background=background), PrintErrors(gain=gain))
    R, t = pose(0, 0, (0.0, 0.0, 200.0))
    frame = render(camera(), prints, R, t, dark=0.0, light=1.0)[0].double()
    ink = frame if background == "dark" else 1 - frame  # of the ring, whichever its tone
    area = math.pi * ((5.0 + sign * gain) ** 2 - (1.5 - sign * gain) ** 2)
    assert float(ink.sum()) * 200**2 / (400 * 405) == pytest.approx(area, rel=1e-5)


def test_scale_is_of_all_lengths() -> None:
    prints = drawn(2, scale=torch.tensor([0.01, -0.02], dtype=F64))
    for number, factor in enumerate((1.01, 0.98)):
        torch.testing.assert_close(prints.as_target(number).centers, factor * QUAD.centers)
        torch.testing.assert_close(prints.as_target(number).radii, factor * QUAD.radii)


def height(kind: Warp, warp: float, angle: float, x: Any, y: Any) -> Any:
    """Of the plate of quad40, whose rings lie in a disc of that radius about the origin."""
    radius = 20 * math.sqrt(2) + 5
    a = (x * math.cos(angle) + y * math.sin(angle)) / radius
    b = (y * math.cos(angle) - x * math.sin(angle)) / radius
    return warp * {"dome": 2 * (a * a + b * b) - 1, "cylinder": 2 * a * a - 0.5, "twist": a * a - b * b}[kind]


@pytest.mark.parametrize("kind", ["dome", "cylinder", "twist"])
def test_plate_has_its_height(kind: Warp) -> None:
    warp, angle = 0.07, 0.6
    prints = drawn(1, warp=warp, shape=kind, direction=angle)
    x, y, z = (prints.centers[0] - QUAD.centers * torch.tensor([1.0, 1.0, 0.0])).unbind(-1)
    assert x.abs().max() == y.abs().max() == 0
    x, y = QUAD.centers[:, 0], QUAD.centers[:, 1]
    torch.testing.assert_close(z, height(kind, warp, angle, x, y))
    torch.testing.assert_close(prints.height(QUAD.centers[:, :2])[0], z)
    # markers that are off their places lie on the plate there
    off = drawn(3, warp=warp, shape=kind, direction=angle, center_sigma=[0.5, 0.5, 0.0], scale=0.01).centers
    torch.testing.assert_close(off[..., 2], height(kind, warp, angle, off[..., 0], off[..., 1]))
    step = 1e-3
    slope = [
        (height(kind, warp, angle, x + a, y + b) - height(kind, warp, angle, x - a, y - b)) / (2 * step)
        for a, b in ((step, 0.0), (0.0, step))
    ]
    normal = torch.nn.functional.normalize(torch.stack([-slope[0], -slope[1], torch.ones(4, dtype=F64)], -1), dim=-1)
    torch.testing.assert_close(prints.normals[0], normal)
    # over the disc: mean 0, twice the amplitude from the lowest to the highest point
    r, phi = torch.meshgrid(
        (torch.arange(400, dtype=F64) + 0.5) / 400, torch.arange(360, dtype=F64).deg2rad(), indexing="ij"
    )
    disc = height(kind, warp, angle, (20 * math.sqrt(2) + 5) * r * phi.cos(), (20 * math.sqrt(2) + 5) * r * phi.sin())
    assert float((r * disc).sum() / r.sum()) == pytest.approx(0, abs=2e-3 * warp)
    assert float(disc.max() - disc.min()) == pytest.approx(2 * warp, rel=5e-3)


def outline(center: Tensor, radius: float, kind: Warp, warp: float, turn: float) -> np.ndarray:
    angle = np.arange(2000) * (2 * math.pi / 2000)
    x, y = float(center[0]) + radius * np.cos(angle), float(center[1]) + radius * np.sin(angle)
    return np.stack([x, y, height(kind, warp, turn, x, y)], -1)


@pytest.mark.parametrize("kind", ["dome", "cylinder", "twist"])
def test_rings_are_bent_as_the_plate_is(kind: Warp) -> None:
    warp, angle = 0.1, 0.6
    cam = replace(
        camera(640, 640, distortion=BROWN), matrix=torch.tensor([[900.0, 0, 320], [0, 900, 320], [0, 0, 1]]).double()
    )
    R, t = pose(40, 30, (0.0, 0.0, 190.0))
    prints = drawn(1, warp=warp, shape=kind, direction=angle)
    rings = [
        [outline(c, o, kind, warp, angle), outline(c, i, kind, warp, angle)[::-1].copy()]
        for c, (o, i) in zip(QUAD.centers, QUAD.radii.tolist(), strict=True)
    ]
    witness = shapes.cat([shapes.polygon(ring, 30.0) for ring in rings])
    found = render(cam, prints, R, t)[0]
    expected = render(cam, witness, R, t, light=220.0)[0]
    # the rings keep their radii along the plate, the polygons along x and y: half of the slope's square, 1e-4
    flat = render(cam, replace(prints, curvature=torch.zeros_like(prints.curvature)), R, t)[0]
    rms = [float((f - expected).square().mean().sqrt()) for f in (found, flat)]
    assert rms[0] < 0.1 * rms[1]
    assert rms[1] > 0.01


@pytest.mark.parametrize("dpi", [50, 300])
def test_raster_has_the_cells_of_the_ring(dpi: float) -> None:
    prints = printed(target(), PrintErrors(dpi=dpi), 2, torch.Generator().manual_seed(1))
    frames = render(camera(), prints, *(x.expand(2, *x.shape[1:]) for x in STRAIGHT), dark=0.0, light=1.0).double()
    for frame, phase in zip(frames, prints.phase.numpy(), strict=True):
        cell = 25.4 / dpi
        x, y = np.meshgrid(*(p + cell * (np.arange(-400, 400) + 0.5) for p in phase))
        black = (np.hypot(x, y) < 5.0) & (np.hypot(x, y) >= 1.5)
        area = float((1 - frame).sum()) * 200**2 / (400 * 405)
        assert area == pytest.approx(black.sum() * cell**2, rel=2e-5)
    assert (frames[0] - frames[1]).abs().max() > 0.005


def test_raster_is_the_rows_of_its_cells() -> None:
    prints = printed(target(), PrintErrors(dpi=60), 1, torch.Generator().manual_seed(2))
    cell, phase = 25.4 / 60, prints.phase[0].numpy()
    rows = []
    for j in range(-20, 20):
        y = phase[1] + cell * (j + 0.5)
        x = phase[0] + cell * (np.arange(-40, 40) + 0.5)
        black = (np.hypot(x, y) < 5.0) & (np.hypot(x, y) >= 1.5)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], black.astype(int), [0]])))
        for a, b in edges.reshape(-1, 2):
            left, right = x[a] - cell / 2, x[b - 1] + cell / 2
            rows.append(shapes.rectangle(((left + right) / 2, y), right - left, cell))
    cam, (R, t) = camera(distortion=BROWN), pose(50, 30, (3.0, -4.0, 190.0))
    found = render(cam, prints, R, t)
    expected = render(cam, shapes.cat(rows), R, t, light=220.0)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3)
    assert (found - render(cam, target(), R, t)).abs().max() > 3


def test_raster_lies_on_the_bent_plate() -> None:
    cam, (R, t) = camera(640, 640), pose(40, 30, (0.0, 0.0, 300.0))
    errors = {"warp": 0.5, "shape": "dome", "center_sigma": 0.1}
    smooth, fine = drawn(1, **errors), drawn(1, **errors, dpi=1200)
    found, expected = render(cam, fine, R, t), render(cam, smooth, R, t)
    flat = render(cam, drawn(1, center_sigma=0.1), R, t)
    difference = [float((f - expected).square().mean().sqrt()) for f in (found, flat)]
    assert difference[0] < 0.1 * difference[1]


def test_each_frame_has_its_own_print() -> None:
    cam = camera(640, 640)
    R, t = pose(30, 10, (3.0, -2.0, 300.0))
    prints = drawn(3, center_sigma=0.2, gain=torch.tensor([0.0, 0.1, 0.2]), warp=0.2)
    dark = torch.tensor([20.0, 30.0, 40.0])
    together = render(cam, prints, R.expand(3, 3, 3), t.expand(3, 3), dark=dark)
    alone = [render(cam, prints[i : i + 1], R, t, dark=dark[i : i + 1]) for i in range(3)]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=1e-3)
    assert (together[0] - together[1]).abs().max() > 20
    same = render(cam, drawn(1).repeated(2), R.expand(2, 3, 3), t.expand(2, 3))
    torch.testing.assert_close(same, render(cam, QUAD, R, t).expand(2, -1, -1), rtol=0, atol=1e-3)
    with pytest.raises(FrameError, match="3 prints are not one for each of 1 poses"):
        render(cam, prints, R, t)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"center_sigma": -0.1}, "center_sigma: is negative"),
        ({"dpi": 0.0}, "dpi: is 0; give cells an inch"),
        ({"gain": -2.0}, "gain: leaves nothing of a ring"),
    ],
)
def test_what_cannot_be_printed_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        drawn(1, **wrong)


def test_only_a_flat_target_is_warped() -> None:
    lifted = replace(QUAD, centers=QUAD.centers + torch.tensor([[0.0, 0, 5], [0, 0, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(ConfigError, match="warp: is for targets in a plane"):
        printed(lifted, PrintErrors(warp=0.05))
