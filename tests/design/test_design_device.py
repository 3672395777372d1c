"""Tensors are made where the inputs are."""

import math

import pytest
import torch

import torchpose as tp
from tests.devices import DeviceNamed
from torchpose.analysis import Uncertainty, pose_crlb, propagate, simulate_frames, simulate_points
from torchpose.analysis.evaluation import Estimates, evaluate
from torchpose.analysis.localisers import by_centroid, by_corner, centre_bound
from torchpose.analysis.marks import marks
from torchpose.analysis.sweep import fit, sweep
from torchpose.design import PRINTS, Imaging, Need, WorkingVolume, design_target, predict_volume
from torchpose.design.precision import precision_map
from torchpose.geometry import rotations
from torchpose.io.truth import Truth
from torchpose.sim import render

# torch's forward mode loads a module that warns of torch's own use of torch.jit.script
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")

F64 = torch.float64
CAMERA = tp.Camera.ideal(640, 520, 800.0)
VOLUME = WorkingVolume((140.0, 150.0), (3.0, 2.0), math.radians(20))


def test_designs_follow_the_camera() -> None:
    near = WorkingVolume((140.0, 140.0))
    with DeviceNamed("design", "analysis"):
        made = design_target(CAMERA, VOLUME, (50.0, 50.0), Need(1.0, 5.0), Imaging(), markers=6)
        printed = design_target(
            CAMERA, VOLUME, (50.0, 50.0), Need(8.0, 30.0), Imaging(), markers=4, printing=PRINTS["plotter"]
        )
        again = predict_volume(CAMERA, made.target, near, Imaging())
        found = precision_map(CAMERA, made.target, near, Imaging())
    assert printed.measured is not None
    places = (made.target.centers, made.target.radii, again.t, found.by_tilt, found.by_place)
    for value in (*places, made.precision.worst, printed.precision.worst, printed.measured.worst):
        assert value.device.type == "cpu"
        assert value.dtype == F64


def test_analyses_follow_their_inputs() -> None:
    target = tp.Target.load("quad40")
    R, t = VOLUME.random(2, torch.Generator().manual_seed(1))
    bent = tp.Camera(
        640, 520, CAMERA.matrix, torch.tensor([-0.1, 0.02, 0, 0], dtype=F64), covariance=torch.eye(4).double()
    )
    sizes = Uncertainty(0.1, 1e-3, 0.5, (1e-3,) * 4, 1e-3, 1e-3, 1e-3, 1e-4)
    covariances = Uncertainty(0.01 * torch.eye(2, dtype=F64).expand(4, 2, 2))
    distance = torch.tensor([140.0, 150.0], dtype=F64)
    with DeviceNamed("design", "analysis"):
        values = [propagate(bent, target, R, t, sizes, features=kind).total for kind in ("centers", "rings")]
        values += [propagate(bent, target, R, t, covariances).total, pose_crlb(bent, target, R, t)]
        values += [simulate_points(bent, target, R, t, some, draws=2) for some in (sizes, covariances)]
        values.append(simulate_frames(bent, target, R, t, Uncertainty(focal_length=1e-4), draws=2))
        drawn = sweep(CAMERA, target, distance, Uncertainty(0.1, 1e-3), draws=3, tilt=0.2)
        values += [drawn.errors, drawn.lateral, fit(distance, drawn.rms[:, 0], (0, 1))]
        estimates = Estimates(["ok", "lost"], R, t, values[0], full_covariance=True)
        values.append(evaluate(estimates, Truth(["a", "b"], ["quad40"] * 2, t, rotations.log(R))).error)
    for value in values:
        assert value.device.type == "cpu"
        assert value.dtype == F64


def test_marks_follow_the_frames() -> None:
    camera = tp.Camera(96, 96, torch.tensor([[100.0, 0, 47.5], [0, 100, 47.5], [0, 0, 1]]), torch.zeros(0))
    start = torch.full((1, 2), 47.5, dtype=F64)
    for mark in marks(30.0**2 * math.pi / 4):
        pose = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 50]], dtype=F64)
        frames = render(camera, mark.draw(30.0, (0.0, 0.0)), *pose, light=220.0).round().byte()
        outline = mark.edges[None] * 2 + 47.5
        with DeviceNamed("design", "analysis"):
            found = mark.locate(frames, outline, start, 0.7, camera.to(F64))
            bound = centre_bound(outline, 0.01)
            middle = by_centroid(frames, start, 20.0, 30.0, 220.0)
            corner = by_corner(frames, start, 5)
        assert found.isfinite().all()
        assert {value.device.type for value in (found, bound, middle, corner)} == {"cpu"}
