"""Poses of whole frames against the Cramer-Rao bound: what the model covers, what it does not, damage.

Few frames of every case of scripts/precision_statistics.py; the figures of docs/precision.md come from that script.
"""

from __future__ import annotations

from typing import Any

import pytest

from scripts import precision_statistics as statistics
from torchpose.pipeline import Method

FRAMES = 12
RATIOS = ("lateral_ratio", "depth_ratio", "rotation_ratio")


def row(case: str, method: Method) -> dict[str, Any]:
    (found,) = statistics.run(case, statistics.CASES[case], [method], FRAMES, seed=7)
    return found


@pytest.mark.parametrize(
    ("case", "ratio"),
    [
        ("grid", 1.6),
        ("tilt", 1.6),
        ("noise-8", 1.6),
        ("k1-0.3", 1.6),
        ("motion", 1.6),
        ("cover-35", 2.0),  # a ring covered so far is not always found
        ("missing", 1.6),
        ("srgb", 2.5),  # the bound is that of even noise; linearising makes it uneven
        pytest.param("disc", 1.6, marks=pytest.mark.slow),
        pytest.param("blackman-harris", 1.6, marks=pytest.mark.slow),
    ],
)
def test_photometric_is_near_the_bound(case: str, ratio: float) -> None:
    found = row(case, "photometric")
    assert found["ok"] == FRAMES
    # 12 frames: the ratio scatters by 10 to 20 %, the mean NEES of 6 by 1
    assert max(found[name] for name in RATIOS) < ratio
    assert 3.5 < found["nees"] < 9.0


@pytest.mark.parametrize("case", ["tilt", "noise-8", "k1-0.3", "cover-35", "missing"])
def test_edges_stay_within_their_covariance(case: str) -> None:
    found = row(case, "edges")
    assert found["ok"] == FRAMES
    assert max(found[name] for name in RATIOS) < 2.2
    assert 2.5 < found["nees"] < 9.0


def test_methods_in_order_of_precision() -> None:
    rows = statistics.run(
        "tilt", statistics.CASES["tilt"], ["photometric", "edges", "centers", "paper"], FRAMES, seed=7
    )
    ratios = [found["lateral_ratio"] for found in rows]
    # 12 frames do not tell the first two apart
    assert 1.2 * max(ratios[:2]) < ratios[2] < 0.5 * ratios[3]
