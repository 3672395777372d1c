"""The studies of the paper's own tables and figures, at their smallest: what must hold whatever the seeds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchpose.datasets.plan import load_plan
from torchpose.studies import (
    fig06_regions,
    fig07_subpixel,
    fig11_simulation,
    reproduce,
    table02_detection,
    table03_centers,
    table04_compensation,
)
from torchpose.studies.script import text_of
from torchpose.studies.study import StudyResult

CONFIGS = Path(__file__).parents[2] / "configs"


def check(result: StudyResult, folder: Path) -> None:
    """Every table and picture can be written and shown."""
    for path in result.save(folder):
        assert path.stat().st_size > 0
    for table in result.tables:
        assert text_of(table).count("\n") == len(table.rows) + 1


def test_table_ii_finds_all_circles_and_explains_the_papers_error(tmp_path: Path) -> None:
    result = table02_detection.run(seeds=1)
    found, explained = result.tables
    for row in found.rows:
        assert (row["found_of_8"], row["false"]) == (8, 0)
        assert row["rms_px"] < 0.05
    for row in explained.rows:
        assert row["mean_with_both_mistakes_px"] == pytest.approx(row["paper_mean_px"], abs=0.05)
    check(result, tmp_path)


def test_fig_6_finds_every_circle_and_knows_the_markers(tmp_path: Path) -> None:
    result = fig06_regions.run()
    drawing, phone = result.tables[0].rows
    assert (drawing["found"], drawing["other_ellipses"], drawing["rings"]) == (8, 0, 4)
    assert phone["found"] == phone["circles"]
    assert "4 are known as markers; the pose is ok" in result.statements[-1]
    check(result, tmp_path)


def test_fig_7_corrected_edges_give_the_true_size(tmp_path: Path) -> None:
    result = fig07_subpixel.run()
    for row in result.tables[0].rows:
        assert row["axes_error_corrected_px"] < 0.02 < row["axes_error_as_read_px"]
        assert row["center_error_corrected_px"] < 0.02
    check(result, tmp_path)


@pytest.mark.slow
def test_table_iii_photometric_is_near_the_bound_and_the_papers_chain_below_its_figures(tmp_path: Path) -> None:
    result = table03_centers.run(seeds=12)
    for row in result.tables[0].rows:
        if row["noise"] > 0:
            assert row["photometric_over_bound"] < 1.35  # 96 errors: 7 % of scatter
        if row["paper_largest_px"] is not None:
            assert row["paper_px"] < row["paper_largest_px"]
    check(result, tmp_path)


def test_table_iv_compensates_at_every_tilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table04_compensation, "TILTS_DEG", (5, 10, 60))
    result = table04_compensation.run(seeds=3)
    for row in result.tables[0].rows:
        assert row["formula_exact_px"] < 1e-9
        if row["noise"] == 0:
            assert row["measured_exact_px"] < 0.002
            assert row["measured_ellipse_px"] == pytest.approx(row["formula_ellipse_px"], abs=0.005)
    check(result, tmp_path)


def test_fig_11_has_the_plan_of_the_configs_and_obeys_equation_5(tmp_path: Path) -> None:
    ours, configured = fig11_simulation.paper_plan(), load_plan(CONFIGS / "plans" / "paper_grid.yaml")
    assert torch.equal(ours.R, configured.R)
    assert torch.equal(ours.t, configured.t)
    assert torch.equal(ours.camera.matrix, configured.camera.matrix)
    assert ours.file.imaging == configured.file.imaging
    assert ours.file.sensor == configured.file.sensor
    result = fig11_simulation.run(frames=6)
    by = {(row["frames"], row["axis"]): row for row in result.tables[0].rows}
    assert by["analytic", "z"]["ok"] == 6
    assert by["analytic", "z"]["rms"] < 4 * by["analytic", "z"]["bound_sigma"]
    assert by["analytic, focal length 0.25 % too long", "z"]["bias"] == pytest.approx(400, abs=30)
    check(result, tmp_path)


def test_every_study_of_the_report_has_a_script() -> None:
    scripts = {path.read_text(encoding="utf-8") for path in (CONFIGS.parent / "scripts").glob("*.py")}
    for name in reproduce.STUDIES:
        assert any(f"import {name}\n" in text for text in scripts), name
