"""The claim of the designer: errors over the working volume are as predicted, within 10 %."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import pytest

from torchpose.design import Need, WorkingVolume

SCRIPT = Path(__file__).parents[2] / "scripts" / "design_check.py"
CAMERA = """
image_width: 640
image_height: 520
camera_matrix: {rows: 3, cols: 3, data: [800, 0, 319.5, 0, 800, 259.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [-0.05, 0.01, 0.0002, -0.0001]}
"""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("design_check", SCRIPT)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def case(script, tmp_path, monkeypatch):
    (tmp_path / "small.yaml").write_text(CAMERA)
    monkeypatch.setattr(script, "CAMERAS", tmp_path)
    volume = WorkingVolume((140.0, 160.0), (5.0, 3.0), math.radians(20))
    return script.Case("small", volume, (50.0, 50.0), Need(1.0, 5.0))


def test_rows_and_table(script, case):
    rows = script.run("small", case, 8, 1)
    assert [row["axis"] for row in rows] == ["x", "y", "z", "pitch", "yaw", "roll"]
    for row in rows:
        assert row["ok"] == 8
        assert 0.3 < row["ratio"] < 2.5
        assert row["largest_predicted"] <= 1.03 * row["worst_predicted"]
    assert script.markdown(rows)[2].startswith("| small | 4 | 8 of 8 | ")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_errors_are_as_predicted(script, case):
    for row in script.run("small", case, 600, 2):
        assert row["ok"] == 600
        assert row["ratio"] == pytest.approx(1, abs=0.1)
