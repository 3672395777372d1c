"""The choice of a target: it promises what was asked for, with the fewest rings, or says what can be had."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import torchpose as tp
from torchpose.design import (
    Design,
    Imaging,
    Need,
    WorkingVolume,
    design_target,
    deviations,
    predict_volume,
    predicted_covariance,
)
from torchpose.errors import ConfigError
from torchpose.sim import add_noise, render

F64 = torch.float64
VOLUME = WorkingVolume((140.0, 160.0), (5.0, 3.0), math.radians(25))
IMAGING = Imaging()


def camera(scale: float = 1.0) -> tp.Camera:
    matrix = torch.tensor([[800.0 * scale, 0, 319.5 * scale], [0, 800.0 * scale, 259.5 * scale], [0, 0, 1]], dtype=F64)
    return tp.Camera(round(640 * scale), round(520 * scale), matrix, torch.zeros(0, dtype=F64))


@pytest.fixture(scope="module")
def made() -> Design:
    return design_target(camera(), VOLUME, (50.0, 50.0), Need(1.0, 5.0), IMAGING)


def test_a_design_promises_what_was_needed(made: Design, tmp_path: Path) -> None:
    worst = made.precision.worst
    assert float(worst[:2].max()) <= 1.0
    assert float(worst[2]) <= 5.0
    assert (made.precision.middle <= worst).all()
    assert len(made.target) == 4  # the fewest
    assert made.target.name == "rings4_50x50"
    assert made.code_gap >= 2
    assert (made.target.centers[:, :2].abs() + made.target.radii[:, :1] < 25.0).all()
    path = tmp_path / "target.yaml"
    made.target.save(path)
    again = tp.Target.load(path)
    assert torch.equal(again.centers, made.target.centers)
    assert torch.equal(again.radii, made.target.radii)


def test_no_point_of_the_volume_is_worse_than_the_worst(made: Design) -> None:
    R, t = VOLUME.random(24, torch.Generator().manual_seed(1))
    found = deviations(predicted_covariance(camera(), made.target, R, t, IMAGING))
    assert (found.amax(0) < 1.03 * made.precision.worst).all()


def test_a_designed_target_is_read_at_the_extremes(made: Design) -> None:
    R, t = VOLUME.extremes()
    some = torch.arange(0, len(t), 97)
    frames = render(camera(), made.target, R[some], t[some], plate=(50.0, 50.0), surround=128.0)
    poses = tp.PoseEstimator(camera(), made.target)(add_noise(frames, 2.0))
    assert (poses.status == tp.Status.OK).all()
    assert (poses.markers == 4).all()
    error = (poses.t - t[some]).abs().amax(0) * 1e3
    assert (error < 5 * made.precision.worst[:3]).all()


def test_more_rings_where_four_do_not_reach_it() -> None:
    # nine rings have longer edges than four on an oblong plate
    plate, volume = (70.0, 30.0), WorkingVolume((150.0, 150.0))
    four = design_target(camera(), volume, plate, Need(9.0, 9.0), IMAGING, markers=4)
    six = design_target(camera(), volume, plate, Need(9.0, 9.0), IMAGING, markers=6)
    between = float((four.precision.worst[:2].max() + six.precision.worst[:2].max()) / 2)
    assert float(six.precision.worst[:2].max()) < 0.97 * between
    assert len(design_target(camera(), volume, plate, Need(between, 9.0), IMAGING).target) > 4


def test_room_for_dot_gain_is_left_and_stated(tmp_path: Path) -> None:
    plain = design_target(camera(), VOLUME, (50.0, 50.0), Need(2.0, 9.0), IMAGING, markers=4)
    made = design_target(camera(), VOLUME, (50.0, 50.0), Need(2.0, 9.0), IMAGING, markers=4, print_gain=0.1)
    assert made.code_gap >= 2
    assert made.target.radii[:, 1].min() * made.limits.scale >= made.limits.inner + 0.1 * made.limits.scale - 0.05
    made.target.save(tmp_path / "target.yaml")
    assert "centers_covariance" not in (tmp_path / "target.yaml").read_text()
    again = tp.Target.load(tmp_path / "target.yaml")
    assert plain.target.covariance is None
    assert again.covariance is not None
    assert float(again.covariance[-1, -1].sqrt()) == pytest.approx(0.1 / 3)
    assert not again.covariance[:-1, :-1].any()
    with pytest.raises(ConfigError, match=r"print_gain: -0\.1 mm"):
        design_target(camera(), VOLUME, (50.0, 50.0), Need(2.0, 9.0), IMAGING, print_gain=-0.1)
    with pytest.raises(ConfigError, match="4 codes need"):
        design_target(camera(), VOLUME, (50.0, 50.0), Need(2.0, 9.0), IMAGING, markers=4, print_gain=2.0)


def test_dark_background_and_name() -> None:
    found = design_target(
        camera(), VOLUME, (60.0, 40.0), Need(2.0, 9.0, 0.02), IMAGING, name="left", background="dark", markers=6
    )
    assert (found.target.name, found.target.background, len(found.target)) == ("left", "dark", 6)
    assert float(found.precision.worst[3:].max()) <= 20.0


def test_out_of_reach_says_what_can_be_reached() -> None:
    with pytest.raises(ConfigError, match=r"cannot be reached: the best layout .* um, .*enlarge the plate"):
        design_target(camera(), VOLUME, (50.0, 50.0), Need(0.01, 0.05), IMAGING, markers=6)


def test_a_plate_out_of_view_says_what_is_in_view() -> None:
    with pytest.raises(ConfigError, match=r"larger than what is in view .* about [1-9]"):
        design_target(camera(), VOLUME, (300.0, 300.0), Need(1, 5), IMAGING)
    with pytest.raises(ConfigError, match=r"larger than what is in view .* about [1-9]"):
        design_target(camera(), VOLUME, (1e6, 1e6), Need(1, 5), IMAGING)


def test_a_plate_too_small_says_so() -> None:
    with pytest.raises(ConfigError, match="4 codes need"):
        design_target(camera(), VOLUME, (8.0, 8.0), Need(1, 5), IMAGING)
    with pytest.raises(ConfigError, match="12 codes need"):
        design_target(camera(), VOLUME, (40.0, 40.0), Need(1, 5), IMAGING, markers=12)


@pytest.mark.parametrize("plate", [(0.0, 50.0), (-5.0, 50.0), (math.nan, 50.0), (50.0, math.inf)])
def test_impossible_plates_are_refused(plate: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"plate: .*; give"):
        design_target(camera(), VOLUME, plate, Need(1, 5), IMAGING)


def test_impossible_needs_and_numbers_are_refused() -> None:
    for need in ((0.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, 1.0, math.nan)):
        with pytest.raises(ConfigError, match=r"accuracy: .*; give"):
            Need(*need)
    with pytest.raises(ConfigError, match="markers: 5"):
        design_target(camera(), VOLUME, (50.0, 50.0), Need(1, 5), IMAGING, markers=5)


def test_an_existing_target_out_of_view_is_refused() -> None:
    with pytest.raises(ConfigError, match="leave the frame"):
        predict_volume(camera(), tp.Target.load("quad40"), WorkingVolume((60.0, 160.0)), IMAGING)
