"""The claim of the designer: errors over the working volume are as predicted, within 10 %."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from scripts import design_check
from torchpose.design import Need, WorkingVolume

CAMERA = """
image_width: 640
image_height: 520
camera_matrix: {rows: 3, cols: 3, data: [800, 0, 319.5, 0, 800, 259.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [-0.05, 0.01, 0.0002, -0.0001]}
"""


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> design_check.Case:
    (tmp_path / "small.yaml").write_text(CAMERA)
    monkeypatch.setattr(design_check, "CAMERAS", tmp_path)
    volume = WorkingVolume((140.0, 160.0), (5.0, 3.0), math.radians(20))
    return design_check.Case("small", volume, (50.0, 50.0), Need(1.0, 5.0))


def test_rows_and_table(case: design_check.Case) -> None:
    rows = design_check.run("small", case, 8, 1)
    assert [row["axis"] for row in rows] == ["x", "y", "z", "pitch", "yaw", "roll"]
    for row in rows:
        assert row["ok"] == 8
        assert 0.3 < row["ratio"] < 2.5
        assert row["largest_predicted"] <= 1.03 * row["worst_predicted"]
    assert design_check.markdown(rows)[2].startswith("| small | 4 | 8 of 8 | ")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_errors_are_as_predicted(case: design_check.Case) -> None:
    for row in design_check.run("small", case, 600, 2):
        assert row["ok"] == 600
        assert row["ratio"] == pytest.approx(1, abs=0.1)
