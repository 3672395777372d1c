"""Identification on exact rings: the code proposes, the geometry decides."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.geometry import rotations
from torchpose.identify import Identified, MarkerTable, identify
from torchpose.pose import crossed_out
from torchpose.rings import Rings
from torchpose.target import Target

CAMERA = pinhole()
QUAD = Target.load("quad40")


def clutter(rings: Rings, extra: Tensor, frame: Tensor) -> Rings:
    """``rings`` followed by rings with ellipses ``extra`` (C, 2, 5)."""
    return Rings.cat([rings, rings_of(extra, frame)])


def scene(target: Target, count: int, tilt_deg: float = 60.0, seed: int = 0) -> tuple[Rings, Tensor, Tensor]:
    """Rings of ``count`` frames, marker by marker, with their poses."""
    r, t = random_poses(count, tilt_deg, (140, 200), seed)
    frame = torch.arange(count).repeat_interleave(len(target))
    return rings_of(exact_ellipses(target, CAMERA, r, t).flatten(0, 1), frame, seed=seed), r, t


def found(rings: Rings, targets: list[Target], frames: int) -> Identified:
    return identify(rings, MarkerTable.of(targets), CAMERA, frames, 1)


@pytest.mark.parametrize("name", ["quad40", "hexa50"])
def test_every_marker_in_any_pose(name: str) -> None:
    target = Target.load(name)
    rings, r, _ = scene(target, 200)
    result = found(rings, [target], 200)
    expected = torch.arange(len(rings)).view(200, len(target))
    assert torch.equal(result.ring, expected)
    assert rotations.angle_between(result.R, r).max() < 0.2


def test_order_of_the_rings_does_not_matter() -> None:
    rings, _, _ = scene(QUAD, 20)
    shuffle = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    shuffled = rings[shuffle]
    result = found(shuffled, [QUAD], 20)
    assert torch.equal(shuffle[result.ring], torch.arange(80).view(20, 4))


def test_strays_with_a_marker_s_code_are_left_out() -> None:
    """One stray a frame copies the code of a marker, elsewhere in the frame and of another size."""
    rings, _, _ = scene(QUAD, 100)
    stray = torch.stack([rings.outer.params, rings.inner.params], 1).view(100, 4, 2, 5)[
        torch.arange(100), torch.arange(100) % 4
    ]
    stray = stray.clone()
    stray[..., 0] = stray[..., 0].mean(-1, keepdim=True) + 150.0
    stray[..., 2:4] *= 0.7
    result = found(clutter(rings, stray, torch.arange(100)), [QUAD], 100)
    assert torch.equal(result.ring, torch.arange(400).view(100, 4))


def test_codes_in_the_wrong_places_are_no_target() -> None:
    """Two markers swapped on the part: no pose has more than two of them where their codes say."""
    swapped = dataclasses.replace(QUAD, centers=QUAD.centers[[1, 0, 2, 3]])
    rings, _, _ = scene(QUAD, 50, tilt_deg=30)
    result = found(rings, [swapped], 50)
    assert ((result.ring >= 0).sum(-1) == 2).all()
    assert (result.proposed(torch.ones(len(rings), dtype=torch.bool)) == 4).all()


def test_hidden_markers() -> None:
    rings, _, _ = scene(QUAD, 40)
    keep = torch.ones(40, 4, dtype=torch.bool)
    keep[torch.arange(40), torch.arange(40) % 4] = False
    index = keep.flatten().nonzero()[:, 0]
    some = rings[index]
    result = found(some, [QUAD], 40)
    assert torch.equal(result.ring >= 0, keep)
    assert torch.equal(index[result.ring[keep]], index)


def test_two_rings_alone_are_seen_from_the_front() -> None:
    """From behind they would look the same."""
    rings, _, _ = scene(QUAD, 60)
    result = found(rings[torch.arange(len(rings)) % 4 < 2], [QUAD], 60)
    assert ((result.ring >= 0).sum(-1) == 2).all()
    assert (result.R[:, 2, 2] > 0).all()


def test_polarity_separates_targets_of_one_code() -> None:
    rings, _, _ = scene(QUAD, 5)
    result = found(rings, [QUAD, Target.load("quad40_dark")], 5)
    assert (result.ring[0::2] >= 0).all()
    assert (result.ring[1::2] == -1).all()


def test_one_ring_alone_and_none() -> None:
    rings, _, _ = scene(QUAD, 2)
    one = torch.tensor([2])
    single = rings[one]
    result = found(single, [QUAD], 2)
    assert result.ring.tolist() == [[-1, -1, 0, -1], [-1, -1, -1, -1]]
    assert result.R.isnan().all()
    nothing = torch.zeros(0, dtype=torch.int64)
    none = rings[nothing]
    assert (found(none, [QUAD], 2).ring == -1).all()


def test_table_pads_shorter_targets() -> None:
    table = MarkerTable.of([QUAD, Target.load("hexa50")])
    assert table.valid.sum(-1).tolist() == [4, 6]
    assert table.ids[0, 4:].tolist() == [-1, -1]
    assert table.centers.dtype == F64


def test_no_marker_lies_across_a_ring() -> None:
    """A pose whose unseen marker would lie half across a measured ring is doubted; one concentric with it is not."""
    r, t = torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, 300.0]], dtype=F64)
    truth = exact_ellipses(QUAD, CAMERA, r, t)[0]
    seen, frame = torch.tensor([[True, True, True, False]]), torch.zeros(1, dtype=torch.int64)
    for shift, expected in ((0.0, False), (0.7, True), (3.0, False)):
        ring = truth[3:].clone()
        ring[..., 0] += shift * ring[:, 0, 2]
        rings = rings_of(ring, frame)
        across = crossed_out(rings, frame, r, t, MarkerTable.of([QUAD]), seen, CAMERA.matrix)
        assert across.tolist() == [expected]
