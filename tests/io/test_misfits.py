"""What the summary of a run says of target and camera file."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from torchpose.io.misfits import Misfits

IDS = [0, 1, 2, 3]


def told(rows: list[dict[str, Any]], stated: tuple[float, float] = (0.0, 0.0)) -> list[str]:
    misfits = Misfits()
    for row in rows:
        misfits.add({"status": "ok", "reason": None, "misfit": None, "place": [[0.0] * 5] * 4} | row)
    return misfits.lines("quad40", IDS, stated)


def test_what_chance_makes_stand_out_is_not_told() -> None:
    assert told([{"misfit": "scatter"}] + [{}] * 99) == []
    assert told([{}] * 100) == []


@pytest.mark.parametrize(
    ("kind", "fix"),
    [("print", "--measure-target"), ("camera", "torchpose calibrate"), ("tone", "--tone"), ("scatter", "lost lines")],
)
def test_the_likely_cause_is_named(kind: str, fix: str) -> None:
    (line,) = told([{"misfit": kind}] * 12 + [{}] * 8)
    assert f"12 of 20 ok rows show more than noise and the stated uncertainties ({kind} 12)" in line
    assert fix in line


def test_places_that_are_the_same_in_all_frames_are_told_by_marker() -> None:
    place = [[0.01, -0.02, 0.0, 0.0, 0.0], [0.0] * 5, [0.0] * 5, [0.0] * 5]
    (line,) = told([{"place": place}] * 10)
    assert "markers sit 11 um beside their places, the same in all 10 frames" in line
    assert "0 (x +10.0, y -20.0, z +0.0, edge +0.0, size +0.0)" in line


@pytest.mark.parametrize(("factor", "lines"), [(1.0, 0), (3.0, 2)])
def test_what_the_file_states_is_not_told(factor: float, lines: int) -> None:
    """A target that was measured to 0.2 um: the same nanometres in all frames are no news."""
    place = [[1e-4 * factor, 1e-4 * factor, 1e-4 * factor, 3e-5 * factor, 0.0]] * 4
    assert len(told([{"place": place}] * 10, (1e-4 * 3**0.5, 3e-5))) == lines


def test_places_that_differ_from_frame_to_frame_are_not() -> None:
    rng = np.random.default_rng(1)
    assert told([{"place": rng.normal(0, 0.01, (4, 5)).tolist()} for _ in range(40)]) == []


def test_edges_and_sizes_that_are_the_same_in_all_frames_are_told() -> None:
    (line,) = told([{"place": [[0.0, 0.0, 0.0, -0.035, 0.002]] * 4}] * 10)
    assert "dark edges lie -35 um further out than the file says, rings are +2 um larger in radius" in line


def test_a_marker_that_no_row_uses_is_told() -> None:
    (line,) = told([{"place": [[0.0] * 5, [0.0] * 5, None, [0.0] * 5]}] * 10)
    assert "marker 2 is used in none of 10 ok rows" in line


def test_rejected_rows_are_told_where_they_are_most() -> None:
    (line,) = told([{"status": "rejected", "reason": "residual"}] * 6 + [{}] * 3)
    assert "6 rows are rejected because no pose explains their rings" in line
    assert told([{"status": "rejected", "reason": "residual"}] * 2 + [{}] * 30) == []
