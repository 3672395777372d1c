"""Several copies of a target in one frame, on exact rings: every copy once, none mixed."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, rings_of
from torchpose.geometry import rotations
from torchpose.identify import Identified, MarkerTable, identify
from torchpose.identify.assignments import propose
from torchpose.identify.hypotheses import hypotheses
from torchpose.rings import Rings
from torchpose.target import Target

CAMERA = pinhole()
QUAD = Target.load("quad40")


def lattice(columns: int, rows: int, pitch: float, tilt: float = 0.3, depth: float = 900.0, turns: int = 0) -> Tensor:
    """Poses (K, 3, 4) of copies side by side in one plane, turned by quarter turns of a seed other than 0."""
    base = rotations.exp(torch.tensor([tilt, 0.3 * tilt, 0.1], dtype=F64))
    i, j = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="ij")
    at = torch.stack([i - (columns - 1) / 2, j - (rows - 1) / 2, 0.0 * i], -1).flatten(0, 1).to(F64) * pitch
    turn = torch.zeros_like(at)
    if turns:
        g = torch.Generator().manual_seed(turns)
        turn[:, 2] = torch.randint(0, 4, (len(at),), generator=g) * (math.pi / 2)
    R = base @ rotations.exp(turn)
    t = at @ base.T + torch.tensor([0.0, 0.0, depth], dtype=F64)
    return torch.cat([R, t[..., None]], -1)


def rings_of_poses(poses: Tensor, hidden: Tensor | None = None) -> tuple[Rings, Tensor]:
    """Rings of one frame in random order, and which of them (K, 4) is each marker, -1 where ``hidden`` (K, 4)."""
    ellipses = exact_ellipses(QUAD, CAMERA, poses[..., :3], poses[..., 3]).flatten(0, 1)
    shown = torch.ones(len(ellipses), dtype=torch.bool) if hidden is None else ~hidden.flatten()
    order = torch.randperm(len(ellipses), generator=torch.Generator().manual_seed(5))
    order = order[shown[order]]
    place = torch.full((len(ellipses),), -1)
    place[order] = torch.arange(len(order))
    return rings_of(ellipses[order], torch.zeros(len(order), dtype=torch.int64), sigma=0.1), place.view(-1, 4)


def found(rings: Rings, instances: int) -> Identified:
    return identify(rings, MarkerTable.of([QUAD]), CAMERA, 1, instances)


def rows(ring: Tensor) -> set[tuple[int, ...]]:
    return {tuple(row) for row in ring.tolist()}


@pytest.mark.parametrize(("columns", "height", "turns"), [(2, 1, 1), (3, 2, 2), (5, 4, 3), (8, 6, 4)])
def test_touching_plates_are_told_apart(columns: int, height: int, turns: int) -> None:
    """Plates of 70 mm side by side, each turned at random: rings of neighbours are 30 mm apart, its own 40 mm."""
    poses = lattice(columns, height, 70.0, turns=turns)
    rings, truth = rings_of_poses(poses)
    result = found(rings, 100)
    assert rows(result.ring) == rows(truth)
    assert len(result) == len(poses)
    assert (result.copies == len(poses)).all()


@pytest.mark.parametrize(("seed", "count"), [(0, 0), (1, 9), (2, 6), (15, 3), (16, 9), (33, 9)])
def test_four_neighbours_that_look_like_a_copy_are_none(seed: int, count: int) -> None:
    """At twice the spacing of the markers any four neighbours have the layout of one more copy between them.

    Rings of ``count`` copies are covered, so that such a phantom explains more rings than the copies that it takes
    them from. The seeds are those that were hard.
    """
    poses = lattice(6, 5, 80.0)
    g = torch.Generator().manual_seed(seed)
    hidden = torch.zeros(30, 4, dtype=torch.bool)
    covered = torch.randperm(30, generator=g)[:count]
    hidden[covered, torch.randint(0, 4, (count,), generator=g)] = True
    rings, truth = rings_of_poses(poses, hidden)
    result = found(rings, 100)
    assert rows(result.ring) == rows(truth)
    assert len(result) == 30


def test_a_covered_copy_takes_no_ring_of_its_neighbour() -> None:
    poses = lattice(3, 3, 70.0)
    hidden = torch.zeros(9, 4, dtype=torch.bool)
    hidden[[0, 4, 8], [2, 1, 0]] = True
    rings, truth = rings_of_poses(poses, hidden)
    assert rows(found(rings, 100).ring) == rows(truth)


def test_copies_of_two_rings_are_not_counted() -> None:
    poses = lattice(3, 1, 70.0, depth=500.0)
    hidden = torch.zeros(3, 4, dtype=torch.bool)
    hidden[1, :2] = True
    rings, truth = rings_of_poses(poses, hidden)
    result = found(rings, 100)
    assert rows(result.ring) == rows(truth[[0, 2]])
    assert result.copies.tolist() == [2, 2]


def test_the_best_supported_copies_come_first() -> None:
    poses = lattice(5, 1, 70.0, depth=600.0)
    hidden = torch.zeros(5, 4, dtype=torch.bool)
    hidden[[0, 2, 3], 1] = True
    rings, truth = rings_of_poses(poses, hidden)
    result = found(rings, 2)
    assert rows(result.ring) == rows(truth[[1, 4]])
    assert (result.copies == 5).all()
    alone = found(rings, 1)
    assert len(alone) == 1
    assert torch.equal(alone.ring, result.ring[:1])


def test_frames_and_targets_keep_their_rings() -> None:
    """Three frames with 2, 0 and 3 copies beside a target that is nowhere: at least a row each, in order."""
    hexa = Target.load("hexa50")
    parts = []
    for frame, columns in ((0, 2), (2, 3)):
        rings, _ = rings_of_poses(lattice(columns, 1, 70.0, depth=500.0))
        parts.append(Rings.cat([rings]))
        parts[-1].frame.fill_(frame)
    result = identify(Rings.cat(parts), MarkerTable.of([QUAD, hexa]), CAMERA, 3, 10)
    assert result.group.tolist() == [0, 0, 1, 2, 3, 4, 4, 4, 5]
    assert (result.ring[result.group % 2 == 0] >= 0)[:, :4].all(1).tolist() == [True, True, False, True, True, True]
    assert (result.ring[:2][result.ring[:2] >= 0] < 8).all()


def test_poses_grow_with_the_rings_and_not_with_their_square() -> None:
    table = MarkerTable.of([QUAD])
    counts = []
    for columns, height in ((4, 3), (8, 6), (16, 12)):
        rings, _ = rings_of_poses(lattice(columns, height, 70.0, tilt=0.1))
        tried = hypotheses(propose(rings, table, CAMERA.matrix), table, CAMERA.matrix, 1.0)
        counts.append((len(tried.R), len(tried.pose)))
    for few, many in itertools.pairwise(counts):
        assert many[0] < 5.5 * few[0]  # of four times the rings
        assert many[1] < 5.5 * few[1]
