"""The step of the photometric fit against plain least squares, and its prior on gradients against their truth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpose.refine.photometric.light import LEVELS, POSE, normal_equations

F64 = torch.float64
MARKERS, PIXELS, TRIALS = 4, 300, 400
GRADIENTS = (1, 2, 4, 5)


class Step(NamedTuple):
    """pose: (N, 9). levels: (K, L). information: (N, 9, 9) at unit noise, levels eliminated. variance: (N,)."""

    pose: Tensor
    levels: Tensor
    information: Tensor
    variance: Tensor


def problem() -> Tensor:
    """Columns (4, 300, 15) of which pose and gradients are told apart only in part."""
    g = torch.Generator().manual_seed(0)
    columns = torch.randn(MARKERS, PIXELS, POSE + LEVELS, dtype=F64, generator=g)
    columns[..., 0] += columns[..., POSE + 1] + columns[..., POSE + 4]
    return columns


def step(columns: Tensor, levels: Tensor, noise: Tensor) -> Step:
    """Step from the true pose and ``levels`` (4, 6) under ``noise`` (T, 4, 300), every trial a frame."""
    trials = len(noise)
    by_gain = torch.zeros_like(noise)
    every = torch.cat([columns.expand(trials, -1, -1, -1), torch.stack([noise, by_gain], -1)], -1).flatten(0, 1)
    row = torch.arange(trials).repeat_interleave(MARKERS)
    used = torch.full((trials * MARKERS,), float(PIXELS), dtype=F64)
    normal, variance = normal_equations(every.mT @ every, used, levels.repeat(trials, 1), row, levels.new_zeros(trials))
    found = normal.solve()
    return Step(found.own, found.eliminated, found.information * variance[:, None, None], variance)


def noises(trials: int) -> Tensor:
    return torch.randn(trials, MARKERS, PIXELS, dtype=F64, generator=torch.Generator().manual_seed(1))


def free_information(columns: Tensor) -> Tensor:
    """Information (9, 9) about the pose where all levels are free."""
    pose, levels = columns[..., :POSE], columns[..., POSE:]
    cross = levels.mT @ pose
    return (pose.mT @ pose - cross.mT @ torch.linalg.solve(levels.mT @ levels, cross)).sum(0)


def test_steep_light_is_plain_least_squares() -> None:
    columns = problem()
    levels = torch.full((MARKERS, LEVELS), 1e4, dtype=F64)
    noise = noises(1)
    found = step(columns, levels, noise)
    design = torch.zeros(MARKERS * PIXELS, POSE + MARKERS * LEVELS, dtype=F64)
    for k in range(MARKERS):
        rows, own = slice(k * PIXELS, (k + 1) * PIXELS), POSE + k * LEVELS
        design[rows, :POSE] = columns[k, :, :POSE]
        design[rows, own : own + LEVELS] = columns[k, :, POSE:]
    plain = torch.linalg.lstsq(design, noise.flatten()[:, None]).solution
    torch.testing.assert_close(found.pose[0], plain[:POSE, 0], rtol=0, atol=1e-5)
    torch.testing.assert_close(found.levels.flatten(), plain[POSE:, 0], rtol=0, atol=1e-4)
    torch.testing.assert_close(found.information[0], free_information(columns), rtol=1e-5, atol=1e-5)


def test_even_light_costs_little_and_the_covariance_knows() -> None:
    columns = problem()
    levels = torch.zeros(MARKERS, LEVELS, dtype=F64)
    levels[:, [0, 3]] = 100.0
    found = step(columns, levels, noises(TRIALS))
    nees = (found.pose[:, None] @ found.information @ found.pose[..., None]).flatten() / found.variance
    assert 8.4 < nees.mean() < 9.6  # 400 trials: 9, deviation 0.21
    free = torch.linalg.inv(free_information(columns))[0, 0]
    assert found.pose[:, 0].square().mean() < 0.75 * free


def test_light_as_uneven_as_its_noise_does_little_harm() -> None:
    """The worst case: the same gradient, one to five deviations of its noise, in all markers, and along the pose."""
    columns = problem()
    noise = noises(TRIALS)
    for height in (0.07, 0.15, 0.35):
        levels = torch.zeros(MARKERS, LEVELS, dtype=F64)
        levels[:, GRADIENTS] = height
        found = step(columns, levels, noise)
        nees = (found.pose[:, None] @ found.information @ found.pose[..., None]).flatten() / found.variance
        assert 8.0 < nees.mean() < 11.5
