"""Blender against the analytic renderer: the same plan, two independent programs. Runs where bpy is installed.

pip install -e '.[blender,dev]' under Python 3.11, then pytest -m slow tests/datasets/test_blender.py
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
import torch

import torchpose as tp
from torchpose.datasets.blender import filter_width
from torchpose.datasets.dataset import analytic
from torchpose.datasets.plan import Plan, load_plan
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.sim import add_noise

FRAMES = int(os.environ.get("TORCHPOSE_BLENDER_FRAMES", "4"))

PLAN = """
camera: camera.json
target: quad40
seed: 5
poses:
  random: {{count: {count}, x: [-20, 20], y: [-12, 12], z: [150, 175], tilt_deg: [0, 50]}}
imaging: {{psf_sigma: 0.7, dark: 30, light: 220, plate: [70, 70], surround: 128}}
sensor: {{noise: 0}}
bounds: false
"""


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """The 2 MP camera with unequal focal lengths and a principal point off the centre."""
    matrix = torch.tensor([[1111.0, 0, 925.0], [0, 1105.0, 598.0], [0, 0, 1]], dtype=torch.float64)
    tp.Camera(1824, 1216, matrix, torch.zeros(4, dtype=torch.float64)).save(tmp_path / "camera.json")
    (tmp_path / "plan.yaml").write_text(PLAN.format(count=FRAMES))
    return load_plan(tmp_path / "plan.yaml")


def test_filter_width_has_the_variance() -> None:
    x = torch.linspace(-0.5, 0.5, 200001, dtype=torch.float64)
    terms = ((0, 0.35875), (1, 0.48829), (2, 0.14128), (3, 0.01168))
    window = torch.stack([a * (2 * math.pi * k * x).cos() for k, a in terms]).sum(0)
    variance = float((x.square() * window).sum() / window.sum())
    for psf in (0.4, 0.7, 1.5):
        assert (2 * filter_width(psf)) ** 2 * variance == pytest.approx(psf**2 + 1 / 12, rel=1e-4)


@pytest.mark.parametrize(
    ("field", "old", "new"),
    [
        ("imaging.plate", "plate: [70, 70], ", ""),
        ("imaging.clutter", "plate:", "clutter: 3, plate:"),
        ("imaging.motion_mm", "plate:", "motion_mm: 0.1, plate:"),
        ("print.each", "sensor:", "print: {each: frame}\nsensor:"),
        ("print.center_sigma", "sensor:", "print: {center_sigma: 0.02}\nsensor:"),
        ("print.dpi", "sensor:", "print: {dpi: 600}\nsensor:"),
    ],
)
def test_what_is_not_modelled_is_an_error(plan: Plan, field: str, old: str, new: str) -> None:
    from torchpose.datasets.blender import blender

    path = plan.path
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=field):
        blender(load_plan(path))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shape", ["dome", "cylinder", "twist"])
def test_agrees_on_a_print(plan: Plan, shape: str) -> None:
    pytest.importorskip("bpy")
    from torchpose.datasets.blender import blender

    made = f"{{center_sigma: [0.05, 0.05, 0], gain: 0.06, warp: 0.8, warp_shape: {shape}, warp_deg: 25}}"
    plan.path.write_text(plan.path.read_text().replace("sensor:", f"print: {made}\nsensor:"))
    printed = load_plan(plan.path)
    which = torch.arange(2)
    seen, expected, nominal = (f(which) for f in (blender(printed), analytic(printed), analytic(plan)))
    # both know the print: what is left is sampling noise and the shape of the pixel filter
    inks = ink(printed, seen), ink(printed, expected), ink(plan, nominal)
    off, moved = (inks[i][..., :2] - inks[1][..., :2] for i in (0, 2))
    grown = [float(inks[i][..., 2].sum() / inks[2][..., 2].sum()) - 1 for i in (0, 1)]
    print(f"{shape}: {off.norm(dim=-1).max():.4f} of {moved.norm(dim=-1).mean():.3f} px, area by {grown}")
    assert off.norm(dim=-1).max() < 0.005
    assert moved.norm(dim=-1).mean() > 0.2
    assert grown[0] == pytest.approx(grown[1], abs=3e-4)
    assert grown[1] > 0.02


@pytest.mark.slow
@pytest.mark.timeout(3600)  # twelve seconds a frame on one core
def test_agrees_with_the_analytic_renderer(plan: Plan) -> None:
    pytest.importorskip("bpy")
    from torchpose.datasets.blender import blender

    which = torch.arange(len(plan))
    frames = {"blender": blender(plan)(which), "analytic": analytic(plan)(which)}
    centroids = {name: ink_centroids(plan, f) for name, f in frames.items()}
    difference = centroids["blender"] - centroids["analytic"]
    rms = float(difference.square().sum(-1).mean().sqrt())
    print(f"{len(plan)} frames: centroids differ by {rms:.5f} px rms, {difference.norm(dim=-1).max():.5f} px at most")
    assert rms < 0.005

    # with the noise of the paper's grid, against which Cycles' own sampling noise is small
    estimator = tp.PoseEstimator(plan.camera, plan.target)
    one, other = (estimator(add_noise(f, 2.0, seed)) for seed, f in enumerate(frames.values()))
    assert one.ok.all()
    assert other.ok.all()
    turn = rotations.log(one.R @ other.R.mT)
    error = torch.cat([one.t - other.t, turn], 1)
    both = one.covariance + other.covariance
    distance = (error[:, None] @ torch.linalg.solve(both, error[:, :, None])).flatten()
    print(f"poses differ by {error.square().mean(0).sqrt().tolist()} rms, squared distances {distance.tolist()}")
    # 99.9 % of chi-squared with 6 degrees of freedom lie below
    assert (distance < 22.5).all()


def ink_centroids(plan: Plan, frames: torch.Tensor) -> torch.Tensor:
    """(B, M, 2) centroids of the dark mass within 1.2 outer radii of each marker."""
    return ink(plan, frames)[..., :2]


def ink(plan: Plan, frames: torch.Tensor) -> torch.Tensor:
    """(B, M, 3) centroids of the dark mass within 1.2 outer radii of each marker, and that mass in px."""
    c = plan.conditions
    camera, target = plan.camera, plan.target
    out = []
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    ray = torch.nn.functional.pad(camera.undistort_points(torch.stack([u, v], -1).double()), (0, 1), value=1.0)
    for i, frame in enumerate(frames):
        R, t = plan.R[i], plan.t[i]
        depth = (R[:, 2] @ t) / (ray @ R[:, 2])
        plane = (depth[..., None] * ray - t) @ R[:, :2]
        dark = (c.light[i] - frame) / (c.light[i] - c.dark[i])
        for center, radius in zip(target.centers, target.radii[:, 0], strict=True):
            mass = dark * ((plane - center[:2]).norm(dim=-1) < 1.2 * radius)
            total = mass.sum()
            out.append(torch.stack([(mass * u).sum() / total, (mass * v).sum() / total, total]))
    return torch.stack(out).view(len(frames), len(target), 3)
