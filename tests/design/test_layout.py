"""Layouts: rings keep their distance, codes can be told apart, no symmetry hides an exchange."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpose.camera import Camera
from torchpose.design.layout import ARRANGEMENTS, Limits, assign_codes
from torchpose.identify.markers import ratio_tolerance

F64 = torch.float64
LIMITS = Limits(outer=12.0, inner=4.0, width=7.0, scale=6.0)
counts = st.sampled_from(list(ARRANGEMENTS))
sides = st.floats(20.0, 500.0)


@settings(max_examples=60, deadline=None)
@given(counts, sides, sides, st.floats(0.05, 1.0))
def test_rings_keep_clear_of_each_other_and_of_the_rim(count: int, width: float, height: float, part: float) -> None:
    radius = part * LIMITS.largest_radius(count, (width, height))
    if radius == 0:
        return
    places, quiet = LIMITS.places(count, (width, height), radius), LIMITS.quiet(radius)
    assert places.shape == (count, 2)
    room = torch.tensor([width, height], dtype=F64) / 2 - radius - quiet
    assert (places.abs() <= room + 1e-6).all()
    assert float(torch.pdist(places).min()) >= 2 * radius + quiet - 1e-6
    # the outermost rings use the plate
    torch.testing.assert_close(places.abs().amax(0), room)


@settings(max_examples=60, deadline=None)
@given(counts, st.floats(0.5, 60.0))
def test_codes_can_be_read_and_told_apart(count: int, radius: float) -> None:
    ratios = LIMITS.ratios(count, radius)
    semi_minor = radius * LIMITS.scale
    if ratios is None:
        assert semi_minor < 12 or count > 4 or semi_minor < 30
        return
    assert len(ratios) == count
    assert float(ratios[0]) * semi_minor >= 4.0 - 1e-9
    assert (1 - float(ratios[-1])) * semi_minor >= 7.0 - 1e-9
    assert float(ratios.diff().min()) >= 2 * ratio_tolerance(semi_minor) - 1e-9


def test_many_codes_need_large_rings() -> None:
    assert LIMITS.ratios(12, 100.0) is not None
    assert LIMITS.ratios(12, 6.0) is None
    assert LIMITS.ratios(4, 1.9) is None  # below 12 px


def test_limits_follow_the_reduced_frame() -> None:
    def of(width: int, height: int) -> Limits:
        matrix = torch.tensor([[1000.0, 0, width / 2], [0, 1000.0, height / 2], [0, 0, 1]], dtype=F64)
        return Limits.of(Camera(width, height, matrix, torch.zeros(0, dtype=F64)), 5.0)

    assert (of(800, 600).outer, of(800, 600).inner) == (12.0, 4.0)
    # 20 megapixels are reduced by 4 for detection
    assert (of(5472, 3648).outer, of(5472, 3648).inner) == (20.0, 6.0)


@pytest.mark.parametrize("count", ARRANGEMENTS)
@pytest.mark.parametrize("plate", [(80.0, 80.0), (50.0, 80.0)])
def test_codes_differ_under_every_symmetry(count: int, plate: tuple[float, float]) -> None:
    places = LIMITS.places(count, plate, 0.8 * LIMITS.largest_radius(count, plate))
    ratios = torch.linspace(0.25, 0.75, count, dtype=F64)
    codes = assign_codes(places, ratios)
    assert torch.equal(codes.sort().values, ratios)
    gap = float(ratios[1] - ratios[0])
    by_place = {(round(x, 3), round(y, 3)): c for (x, y), c in zip(places.tolist(), codes.tolist(), strict=True)}
    symmetries = 0
    for swap, sx, sy in itertools.product((False, True), (1, -1), (1, -1)):
        if (swap, sx, sy) == (False, 1, 1):
            continue
        change: list[float] = []
        for x, y in places.tolist():
            image = (sx * (y if swap else x), sy * (x if swap else y))
            other = by_place.get((round(image[0], 3) + 0.0, round(image[1], 3) + 0.0))
            change.append(math.nan if other is None else abs(other - by_place[round(x, 3), round(y, 3)]))
        if any(math.isnan(c) for c in change):
            continue  # not a symmetry of these places
        symmetries += 1
        moved = [c for c in change if c > 0]
        assert len(moved) >= count // 2  # rings on the axis of a mirror stay
        assert sum(moved) / count > (0.99 if count == 4 else 1.2) * gap
    assert symmetries >= 3


@settings(max_examples=60, deadline=None)
@given(counts, st.floats(2.0, 60.0), st.floats(0.01, 0.4), st.sampled_from([-1.0, 1.0]))
def test_codes_of_a_print_with_gain_are_nearest_to_their_own(
    count: int, radius: float, most: float, way: float
) -> None:
    limits = replace(LIMITS, gain=most)
    ratios = limits.ratios(count, radius)
    if ratios is None:
        return
    assert LIMITS.ratios(count, radius) is not None  # with gain less fits, not more
    gain = way * most
    outer, inner = radius + gain, radius * ratios - gain
    # the limits hold for the ring as printed
    assert outer * limits.scale >= limits.outer - 1e-9
    assert float(inner.min()) * limits.scale >= limits.inner - 1e-9
    assert float((outer - inner).min()) * limits.scale >= limits.width - 1e-9
    # read as far off as the tolerance allows, by the side to which the gain draws them
    read = inner / outer - way * ratio_tolerance(radius * limits.scale)
    off = (read[:, None] - ratios).abs()
    assert (off.diagonal() <= off.min(1).values + 1e-9).all()
