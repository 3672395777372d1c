from __future__ import annotations

from torchpose.studies import fig02_pnp


def test_the_iterative_method_is_as_good_as_opencvs_and_errors_grow_with_the_noise() -> None:
    result = fig02_pnp.run(poses=60)
    errors, times = result.tables
    by = {(row["method"], row["noise_px"]): row for row in errors.rows}
    for noise in fig02_pnp.NOISE_PX:
        ours, theirs = by["torchpose iterative", noise], by["cv2 ITERATIVE", noise]
        assert abs(ours["orientation_median_deg"] / theirs["orientation_median_deg"] - 1) < 0.01
        assert ours["without_pose"] == 0
        assert (
            by["4 sides as lines", noise]["position_median_mm"] < by["4 corners as points", noise]["position_median_mm"]
        )
    medians = [by["torchpose iterative", noise]["position_median_mm"] for noise in fig02_pnp.NOISE_PX]
    assert medians == sorted(medians)
    assert all(row["seconds_for_1000"] > 0 for row in times.rows)
