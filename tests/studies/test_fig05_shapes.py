"""Fig. 5 with few frames: what the tables hold, and the statements that do not depend on luck."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchpose.studies import fig05_shapes
from torchpose.studies.fig05_shapes import Condition

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")


def test_the_study_says_which_shape_is_best_where(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    curves = {
        "noise": {v: Condition(noise=v) for v in (2.0, 16.0)},
        "blur_px": {1.5: Condition(blur=1.5)},
        "tilt_deg": {v: Condition(tilt=v) for v in (30.0, 45.0)},
        "distortion_k1_corrected": {-0.15: Condition(distortion=-0.15)},
        "distortion_k1_uncorrected": {-0.15: Condition(distortion=-0.15, corrected=False)},
        "cover": {0.2: Condition(cover=0.2)},
    }
    monkeypatch.setattr(fig05_shapes, "CURVES", curves)
    monkeypatch.setattr(fig05_shapes, "recognition", lambda frames, seed: fig05_recognition_of(seed))
    done: list[float] = []
    result = fig05_shapes.run(progress=done.append)
    assert done == sorted(done)
    assert done[-1] == 1
    accuracy, bars, found, _codes = result.tables
    assert len(accuracy.rows) == 8 * 5
    assert {row["mark"] for row in found.rows} == {row["mark"] for row in accuracy.rows}
    # the paper's reasons for concentric rings
    tilted = {row["mark"]: row["rms_px"] for row in accuracy.rows if row["curve"] == "tilt_deg" and row["value"] == 45}
    assert min(tilted, key=tilted.__getitem__) == "concentric rings"
    assert tilted["filled circle"] > 20 * tilted["concentric rings"]
    left = {r["mark"]: r["rms_px"] for r in accuracy.rows if r["curve"] == "distortion_k1_uncorrected"}
    assert min(left, key=left.__getitem__) == "concentric rings"
    # and its claim about the cross, which holds for the centroid
    centroid = {row["bar_over_extent"]: row["centroid_rms_px"] for row in bars.rows}
    assert centroid[0.5] < centroid[0.2] < centroid[0.1]
    assert {c.what for c in result.comparisons} >= {"rings: false recognitions a frame"}
    assert len(result.save(tmp_path)) == 4 + 3 + 1


def fig05_recognition_of(seed: int) -> list[dict[str, object]]:
    from torchpose.studies.fig05_recognition import recognition

    return recognition(1, seed)
