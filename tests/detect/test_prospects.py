"""The cheap looks that decide what is worth a fit: against analytic arcs, drawn rings and plain loops."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from torchpose.detect import Candidates, Wanted, find_candidates, find_coarse
from torchpose.detect.prospects import crests, rings, roundness, second_edges, sorted_out
from torchpose.detect.regions import Gradient, Regions, gradient, level_line_regions, strong_cells
from torchpose.geometry.segments import run_sums

F64 = torch.float64


def arcs(spans: list[float], polarity: float, ratio: float = 1.0) -> tuple[Regions, torch.Tensor]:
    """Regions (100 cells each) along parts of an ellipse of these spans in rad, and their positions."""
    turn = torch.cat([torch.arange(100, dtype=F64) / 100 * span + 0.3 for span in spans])
    xy = torch.stack([300 + 40 * turn.cos(), 200 + 40 * ratio * turn.sin()], -1)
    normal = torch.stack([ratio * turn.cos(), turn.sin()], -1)
    index = torch.arange(len(spans)).repeat_interleave(100)
    frame = torch.zeros(len(spans), dtype=torch.int64)
    return Regions(torch.arange(len(xy)), index, (7 * polarity * normal).float(), frame), xy


def painted(
    inner: float, outer: float = 30.0, polarity: float = 1.0, ratio: float = 1.0
) -> tuple[Gradient, Candidates]:
    """A ring, or a disc for an inner radius of 0, by OpenCV, and its true outer ellipse as a candidate."""
    outer = 30.0
    frame = np.full((400, 400), 200, np.uint8)
    axes = [(int(64 * r), int(64 * r * ratio)) for r in (outer, inner)]
    cv2.ellipse(frame, (800, 800), (axes[0][0] // 4, axes[0][1] // 4), 0, 0, 360, 40, -1, cv2.LINE_AA, 4)
    if inner:
        cv2.ellipse(frame, (800, 800), (axes[1][0] // 4, axes[1][1] // 4), 0, 0, 360, 200, -1, cv2.LINE_AA, 4)
    if polarity < 0:
        frame = 240 - frame
    one = torch.ones(1, dtype=F64)
    ellipse = torch.tensor([[50.0, 50.0, outer, outer * ratio, 0.0]], dtype=F64)
    found = Candidates(torch.zeros(1, dtype=torch.int64), ellipse, polarity * one, -one, one, torch.zeros(1).long())
    return gradient(torch.from_numpy(frame[:100, :100].copy())[None]), found


def test_run_sums_are_sums_of_the_runs() -> None:
    size = torch.tensor([3, 1, 5])
    values = torch.arange(18, dtype=F64).reshape(2, 9)
    expected = torch.stack([part.sum(-1) for part in values.split([3, 1, 5], -1)], -1)
    assert torch.equal(run_sums(values, size), expected)
    assert run_sums(values[:, :0], size[:0]).shape == (2, 0)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_roundness_of_arcs_of_a_circle(polarity: float) -> None:
    spans = [0.5, 1.5, math.pi, 2 * math.pi]
    mean, turning = roundness(*arcs(spans, polarity))
    # the mean direction of an arc has the length sin(span / 2) / (span / 2)
    expected = torch.tensor([math.sin(s / 2) / (s / 2) for s in spans], dtype=F64)
    torch.testing.assert_close(mean, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(turning, torch.full((4,), polarity, dtype=F64), atol=1e-4, rtol=0)


def test_straight_edges_and_short_arcs_are_not_fitted() -> None:
    regions, xy = arcs([0.2, 1.5, 4.0, 2 * math.pi], 1.0)
    fit, bent = sorted_out(regions, xy, 1.0)
    assert fit.tolist() == [False, False, True, True]
    assert bent.tolist() == [False, True, False, False]
    fit, bent = sorted_out(regions, xy, -1.0)  # of the other polarity the whole circle alone explains edges
    assert fit.tolist() == [False, False, False, True]
    assert not bent.any()
    slender, xy = arcs([2 * math.pi], 1.0, ratio=0.12)
    assert sorted_out(slender, xy, 0.0)[0].all()


@pytest.mark.parametrize("polarity", [1.0, -1.0])
@pytest.mark.parametrize("ratio", [1.0, 0.4])
@pytest.mark.parametrize("inner", [0.2, 0.5, 0.8])
def test_a_ring_has_a_second_edge_and_a_disc_has_none(inner: float, ratio: float, polarity: float) -> None:
    assert rings(*painted(30 * inner, polarity=polarity, ratio=ratio)).all()
    assert second_edges(*painted(0.0, polarity=polarity, ratio=ratio)).item() == 0


def test_crests_are_those_of_a_plain_loop() -> None:
    rng = np.random.default_rng(4)
    frame = cv2.GaussianBlur(rng.integers(0, 255, (40, 60)).astype(np.float32), (0, 0), 1.5)
    grad = gradient(torch.from_numpy(np.stack([frame, frame.T.reshape(40, 60)])))
    cell = strong_cells(grad)
    gx, gy = (g.numpy() for g in grad.components(cell))
    power = {int(c): np.float32(x * x + y * y) for c, x, y in zip(cell, gx, gy, strict=True)}
    kept = []
    for c, x, y in zip(cell.tolist(), gx, gy, strict=True):
        most = max(abs(x), abs(y))
        step = round(float(x / most)) + 60 * round(float(y / most))
        if power[c] >= 0.5 * max(power.get(c - step, 0), power.get(c + step, 0)):
            kept.append(c)
    found = crests(grad, cell)
    assert found.tolist() == kept
    assert 0 < len(found) < len(cell)


def test_crests_of_a_sharp_circle_hold_together() -> None:
    grad, _ = painted(0.0)
    thin = crests(grad, strong_cells(grad))
    assert len(thin) < 0.75 * len(strong_cells(grad))
    regions = level_line_regions(grad, thin, 7)
    assert len(regions.frame) == 1
    assert len(regions.cell) > 2 * math.pi * 30 * 0.8


def crowd() -> tuple[torch.Tensor, np.ndarray]:
    """A frame (1, 1200, 1600) of rings and discs in turn, and the rings' centres."""
    rng = np.random.default_rng(8)
    frame, centers = np.full((1200, 1600), 190, np.uint8), []
    for k, (y, x) in enumerate(np.ndindex(4, 6)):
        at = np.array([250 * x + 160, 280 * y + 160]) + rng.uniform(-20, 20, 2)
        size = (rng.uniform(14, 70), rng.uniform(0.5, 1), rng.uniform(0, 180))
        for scale, grey in ((1.0, 40), (0.5, 190))[: 1 + (k % 2)]:
            axes = (int(16 * scale * size[0]), int(16 * scale * size[0] * size[1]))
            middle = (int(16 * at[0]), int(16 * at[1]))
            cv2.ellipse(frame, middle, axes, size[2], 0, 360, grey, -1, cv2.LINE_AA, 4)
        if k % 2:
            centers.append(at)
    blurred = cv2.GaussianBlur(frame, (0, 0), 0.9) + rng.normal(0, 2, frame.shape)
    return torch.from_numpy(blurred.round().clip(0, 255).astype(np.uint8))[None], np.array(centers)


def test_rings_are_found_at_either_scale() -> None:
    frame, centers = crowd()
    wanted = Wanted.of(torch.tensor([1.0]), 3.0)
    coarse = find_coarse(frame, wanted=wanted)
    for found in (coarse, find_candidates(frame, wanted=wanted), find_candidates(frame, wanted=wanted, coarse=coarse)):
        apart = np.linalg.norm(found.ellipse[:, None, :2].numpy() - centers, axis=-1)
        assert (apart.min(0) < 0.5).all()  # an eighth of a cell of the coarse scale
        assert (found.polarity == 1).all()
    assert len(find_coarse(torch.full((1, 1200, 1600), 90, dtype=torch.uint8), wanted=wanted)) == 0
