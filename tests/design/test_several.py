"""What several cameras promise beside the joint Cramer-Rao bound and what the estimator states of their frames."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import torchpose as tp
from torchpose.analysis import rig_crlb, with_second
from torchpose.design import (
    Imaging,
    Need,
    WorkingVolume,
    design_target,
    deviations,
    edge_covariance,
    predict_volume,
    predicted_covariance,
    share_that_counts,
)
from torchpose.design.printing import PRINTS
from torchpose.design.view import rings_that_count
from torchpose.geometry import rotations
from torchpose.sim import Defocus, add_noise, render

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")

F64 = torch.float64
TARGET = tp.Target.load("quad40")
VOLUME = WorkingVolume((150.0, 150.0), tilt=math.radians(10))
PLACES = torch.tensor([2e-3, 2e-3, 2e-3, 1e-5, 1e-5, 1e-5], dtype=F64)  # mm, rad


def camera() -> tp.Camera:
    matrix = torch.tensor([[800.0, 0, 319.5], [0, 790.0, 259.5], [0, 0, 1]], dtype=F64)
    return tp.Camera(640, 520, matrix, torch.tensor([-0.1, 0.02, 1e-3, -1e-3], dtype=F64))


def rig(degrees: float = 40.0, *, places: bool = False) -> tp.CameraRig:
    exact = with_second(camera(), 150.0, math.radians(degrees))
    return replace(exact, covariance=torch.diag(PLACES.square())) if places else exact


def poses(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return VOLUME.random(count, torch.Generator().manual_seed(3))


def stated_by_estimate(several: tp.CameraRig, target: tp.Target, R: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Median of what the estimator states for each pose in five frames."""
    frames = [render(one, target, *several.seen_by(k, R, t), psf_sigma=0.7) for k, one in enumerate(several.cameras)]
    estimator, every = tp.PoseEstimator(several, target), []
    for seed in range(5):
        estimated = estimator([add_noise(own, 2.0, seed=10 * seed + k) for k, own in enumerate(frames)])
        assert estimated.ok.all()
        every.append(deviations(estimated.covariance))
    return torch.stack(every).median(0).values


@pytest.mark.parametrize("places", [False, True])
def test_a_rig_promises_what_the_estimator_states_and_the_bound_allows(places: bool) -> None:
    several = rig(places=places)
    R, t = poses(4)
    found = deviations(predicted_covariance(several, TARGET, R, t, Imaging()))
    bound = deviations(rig_crlb(several, TARGET, R, t, psf_sigma=0.7, noise_sigma=2.0))
    assert (found / bound > 0.98).all()
    assert (found / bound < 1.2).all()
    torch.testing.assert_close(found, stated_by_estimate(several, TARGET, R, t), rtol=0.08, atol=0)
    # the closed form that searches go by
    quick = deviations(edge_covariance(several, TARGET, R, t, Imaging()))
    assert ((found / quick - 1).abs() < 0.15).all()


def test_a_rig_counts_what_the_files_of_cameras_and_target_state() -> None:
    square = torch.diag(torch.tensor([0.2, 0.2, 0.1, 0.1], dtype=F64).square())
    several = rig(places=True)
    several = replace(several, cameras=tuple(replace(one, covariance=square) for one in several.cameras))
    target = PRINTS["glass"].stated_by(TARGET)
    R, t = poses(3)
    found = deviations(predicted_covariance(several, target, R, t, Imaging()))
    torch.testing.assert_close(found, stated_by_estimate(several, target, R, t), rtol=0.08, atol=0)
    assert (found > 1.5 * deviations(predicted_covariance(rig(), TARGET, R, t, Imaging()))).any(1).all()


def test_a_rig_of_one_camera_is_that_camera() -> None:
    R, t = poses(2)
    for predict in (edge_covariance, predicted_covariance):
        one, rigged = (predict(x, TARGET, R, t, Imaging()) for x in (camera(), tp.CameraRig.alone(camera())))
        assert torch.equal(one, rigged)


def test_what_a_further_camera_has_not_in_view_tells_nothing() -> None:
    """One that looks away changes nothing; one that has two rings of four tells something."""
    R, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0, 150.0]], dtype=F64)
    both = rig()
    away = tp.CameraRig(both.cameras, both.R, both.t + torch.tensor([[0.0] * 3, [500.0, 0, 0]], dtype=F64))
    half = tp.CameraRig(both.cameras, both.R, both.t + torch.tensor([[0.0] * 3, [60.0, 0, 0]], dtype=F64))
    assert int(rings_that_count(half.cameras[1], TARGET, *half.seen_by(1, R, t)).sum()) == 2
    for predict in (edge_covariance, predicted_covariance):
        none, some, all_ = (deviations(predict(x, TARGET, R, t, Imaging()))[0] for x in (away, half, both))
        alone = deviations(predict(camera(), TARGET, R, t, Imaging()))[0]
        # with several cameras the edge gain of the print is asked of all together: as here with one
        torch.testing.assert_close(none, alone, rtol=0.02, atol=0)
        assert float(some[2]) < 0.85 * float(alone[2])
        assert float(all_[2]) < float(some[2])
    assert share_that_counts(away, 1, TARGET, VOLUME) == 0
    assert share_that_counts(both, 1, TARGET, VOLUME) > 0.9


def test_rings_count_from_their_printed_side_and_as_large_as_the_stages_ask() -> None:
    eye, turn = torch.eye(3, dtype=F64), rotations.exp(torch.tensor([0.0, math.pi, 0.0], dtype=F64))
    R = torch.stack([eye, turn, eye])
    t = torch.tensor([[0.0, 0, 150.0], [0.0, 0, 150.0], [0.0, 0, 900.0]], dtype=F64)
    assert rings_that_count(camera(), TARGET, R, t).all(1).tolist() == [True, False, False]


def test_every_camera_is_focused_on_one_point() -> None:
    several, lens = rig(60.0), Defocus(4.0, 8.0, 100.0)
    imaging = Imaging(lens=lens).of_camera(several, 1)
    assert imaging.lens is not None
    point = several.R[1] @ torch.tensor([0.0, 0.0, 100.0], dtype=F64) + several.t[1]
    assert imaging.lens.focus_distance == pytest.approx(float(point[2]))
    assert Imaging(lens=lens).of_camera(several, 0).lens == lens


def test_a_design_for_two_cameras_meets_what_one_cannot() -> None:
    need = Need(0.6, 0.6)
    with pytest.raises(tp.ConfigError, match="cannot be reached"):
        design_target(camera(), VOLUME, (40.0, 40.0), need, Imaging(), markers=4)
    made = design_target(rig(), VOLUME, (40.0, 40.0), need, Imaging(), markers=4)
    worst = made.precision.worst
    assert float(need.excess(worst)) <= 1
    alone = predict_volume(camera(), made.target, VOLUME, Imaging()).worst
    assert float(alone[2]) > 2 * float(worst[2])
    assert made.precision.rows(need, alone=made.precision)[2]["worst_first_camera_alone"] == float(worst[2])
