"""The statements of the paper's Fig. 4 and Table I."""

from __future__ import annotations

import math

import pytest
import torch

from torchpose.analysis.sensitivity import Uncertainty
from torchpose.analysis.sweep import Sweep, sweep
from torchpose.studies import fig04_sensitivity, table01_orientation
from torchpose.studies.fig04_sensitivity import SIGMAS_PX, cases_of, exponent, paper_camera
from torchpose.target import Target

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")


@pytest.fixture(scope="module")
def cases() -> list[Sweep]:
    distance = torch.linspace(12, 32, 11, dtype=torch.float64)
    size = Uncertainty(focal_length=fig04_sensitivity.FOCAL_ERROR)
    plans = cases_of(SIGMAS_PX, size).values()
    return [sweep(paper_camera(), Target.load("quad8"), distance, plan, draws=3000, seed=5) for plan in plans]


def test_without_focal_error_x_and_y_are_linear_and_z_is_quadratic(cases: list[Sweep]) -> None:
    for case in cases[:2]:
        for axis in (0, 1):
            assert exponent(case, axis) == pytest.approx(1, abs=0.03)
            assert case.rms[:, axis].tolist() == pytest.approx((case.lateral / math.sqrt(2)).tolist(), rel=0.05)
        assert exponent(case, 2) == pytest.approx(2, abs=0.05)
        assert case.rms[:, 2].tolist() == pytest.approx((case.depth / math.sqrt(2)).tolist(), rel=0.05)


def test_five_times_the_noise_gives_five_times_the_errors(cases: list[Sweep]) -> None:
    assert torch.allclose(cases[1].rms / cases[0].rms, torch.full((11, 6), 5.0).double(), rtol=0.02)


def test_with_focal_error_z_is_the_sum_of_both_and_x_and_y_hardly_change(cases: list[Sweep]) -> None:
    without, _, wrong = cases
    # the largest error: what noise gives at its largest, and the focal error on top
    together = without.largest[:, 2] + wrong.depth_focal
    assert torch.allclose(wrong.largest[:, 2], together, rtol=0.03)
    assert torch.allclose(wrong.largest[:, 2], wrong.depth + wrong.depth_focal, rtol=0.2)
    assert torch.allclose(wrong.rms[:, :2], without.rms[:, :2], rtol=0.005)
    # eq. (6): the term that is neglected, 0.25 % of the error by noise
    share = (wrong.rms[:, 0] / without.rms[:, 0] - 1).abs()
    assert torch.allclose(share, torch.full((11,), 0.0025).double(), atol=0.0005)


def test_the_study_has_the_papers_figures_beside_ours(cases: list[Sweep]) -> None:
    result = fig04_sensitivity.run()
    assert {table.name for table in result.tables} == {"errors", "budget"}
    by = {c.what.split(";")[0]: c for c in result.comparisons}
    assert by["z, 0.2 px, at 32 mm, rms"].paper == pytest.approx(7.68)
    assert by["z, 0.2 px, at 32 mm, rms"].ours == pytest.approx(by["z, 0.2 px, at 32 mm, rms"].bound, rel=0.15)
    assert any("quadratic" in s for s in result.statements)


def test_table_one_yaw_and_pitch_are_worse_than_roll_and_the_papers_numbers_have_their_circumstances() -> None:
    result = table01_orientation.run()
    noise, focal, readings = result.tables
    for yaw, roll in zip(noise.rows[::2], noise.rows[1::2], strict=True):
        # of a square: sqrt(2) d / a
        ratio = yaw["predicted_rms_deg"] / roll["predicted_rms_deg"]
        assert ratio == pytest.approx(math.sqrt(2) * yaw["distance_mm"] / 4, rel=1e-3)
        assert roll["rms_deg"] == pytest.approx(roll["predicted_rms_deg"], rel=0.15)
    for row in readings.rows:
        assert row["yaw_pitch_deg"] == pytest.approx(0.165, rel=0.02)
        assert row["roll_deg"] == pytest.approx(0.051, rel=0.02)
    assert focal.rows[0]["yaw_pitch_deg"] < 1e-9
    assert focal.rows[-1]["yaw_pitch_deg"] > 0.01
