"""What is asked for is found as well as in a search for everything, and the rest is left out."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchpose.detect import Candidates, Verdict, Wanted, find_candidates, find_coarse
from torchpose.detect.validation import merge_duplicates
from torchpose.geometry import conics


def discs(seed: int, covered: bool = False) -> torch.Tensor:
    """One frame (1, 800, 1200) of dark and light discs of 3 to 30 px, by OpenCV; some with a bar over a quarter."""
    rng = np.random.default_rng(seed)
    frame = np.full((1600, 2400), 128, np.uint8)
    for k, (x, y) in enumerate(np.argwhere(np.ones((5, 8)))[rng.permutation(40)]):
        radius, grey = 2 * rng.uniform(3, 30), (30, 220)[k % 2]
        at = 320 * x + 160 + rng.uniform(-20, 20), 300 * y + 150 + rng.uniform(-20, 20)
        cv2.circle(frame, (int(16 * at[1]), int(16 * at[0])), int(16 * radius), grey, -1, cv2.LINE_AA, 4)
        if covered:
            cv2.circle(frame, (int(16 * (at[1] + radius)), int(16 * at[0])), int(6 * radius), 128, -1, cv2.LINE_AA, 4)
    blurred = cv2.GaussianBlur(cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    return torch.from_numpy((blurred + rng.normal(0, 2, blurred.shape)).round().clip(0, 255).astype(np.uint8))[None]


@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_finds_what_is_wanted_as_a_full_search_does(polarity: float, covered: bool) -> None:
    frame = discs(3, covered)
    every, some = find_candidates(frame), find_candidates(frame, wanted=Wanted(polarity, 4.0))
    assert (some.polarity == polarity).all()
    assert (some.ellipse[:, 3] >= 4.0).all()
    every = every[(every.polarity == polarity) & (every.ellipse[:, 3] > 4.5)]
    assert len(every) > 12
    apart = torch.linalg.vector_norm(every.ellipse[:, None, :2] - some.ellipse[:, :2], dim=-1).amin(1)
    assert (apart < 0.5).all()


def test_wanted_of_both_polarities_is_either() -> None:
    assert Wanted.of(torch.tensor([1.0, -1.0, 1.0]), 3.0).polarity == 0
    assert Wanted.of(torch.tensor([-1.0, -1.0]), 3.0).polarity == -1


def test_the_default_is_everything() -> None:
    frame = discs(5)
    every, some = find_candidates(frame, explain=True), find_candidates(frame, explain=True, wanted=Wanted())
    assert torch.equal(every.ellipse.nan_to_num(), some.ellipse.nan_to_num())
    assert not bool((every.verdict == Verdict.UNWANTED).any())


def test_duplicates_are_those_of_a_comparison_of_all_pairs() -> None:
    found = find_candidates(discs(7), explain=True)
    generator = torch.Generator().manual_seed(1)
    again = torch.arange(len(found)).repeat(4)
    jitter = 0.7 * torch.randn(len(again), 4, generator=generator, dtype=torch.float64)
    ellipse = found.ellipse[again] + torch.nn.functional.pad(jitter, (0, 1))
    # each of its own false alarms, so that the order is known
    nfa = -torch.rand(len(again), generator=generator, dtype=torch.float64)
    crowd = replace(found[again], ellipse=ellipse, log10_nfa=nfa, frame=torch.arange(len(again)) % 3)
    crowd = crowd[crowd.ellipse.isfinite().all(-1) & (crowd.ellipse[:, 3] > 1)]
    order = sorted(range(len(crowd)), key=lambda i: (int(crowd.frame[i]), float(crowd.log10_nfa[i])))
    crowd = crowd[torch.tensor(order)]
    center, shape = crowd.ellipse[:, :2], conics.shape_matrix(crowd.ellipse)
    apart = torch.linalg.vector_norm(center[:, None] - center, dim=-1)
    apart = torch.maximum(apart, (shape[:, None] - shape).abs().amax((-2, -1)))
    same = (crowd.frame[:, None] == crowd.frame) & (crowd.polarity[:, None] == crowd.polarity)
    same &= apart < 1 + 0.08 * crowd.ellipse[:, 3]
    kept = crowd[~same.tril(-1).any(1)]
    merged = merge_duplicates(crowd)
    assert 0 < len(merged) < len(crowd)
    assert torch.equal(merged.ellipse, kept.ellipse)


def test_arcs_are_put_together_in_hopeful_frames_alone() -> None:
    """Discs with a bar across are found where there is hope, those that single regions follow everywhere."""
    frame = np.full((800, 1200), 128, np.uint8)
    for k in range(12):
        x, y = 150 + 300 * (k % 4), 150 + 250 * (k // 4)
        cv2.circle(frame, (x, y), 40 + k, 30, -1, cv2.LINE_AA)
        if k % 2:
            cv2.rectangle(frame, (x - 60, y - 12), (x + 60, y + 12), 128, -1)
    frames, wanted = torch.from_numpy(cv2.GaussianBlur(frame, (0, 0), 0.8)).expand(2, -1, -1), Wanted(1.0, 4.0)
    asked: list[Candidates] = []

    def hopeful(found: Candidates) -> torch.Tensor:
        asked.append(found)
        return torch.tensor([True, False])

    coarse = find_coarse(frames, wanted=wanted)[:0]  # what it finds is known whatever is hoped
    every = find_candidates(frames, wanted=wanted, coarse=coarse)
    some = find_candidates(frames, wanted=wanted, coarse=coarse, hopeful=hopeful)
    assert len(asked) == 1
    assert torch.equal(some[some.frame == 0].ellipse, every[every.frame == 0].ellipse)
    assert int((every.frame == 1).sum()) == 12
    assert 6 <= int((some.frame == 1).sum()) < 12
