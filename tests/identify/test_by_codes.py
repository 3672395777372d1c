"""Rings that their codes name without a question: the markers that the geometry gives them, or no answer at all."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.identify import MarkerTable, Scene, by_codes, confirmed, identify
from torchpose.identify.near import Places
from torchpose.rings import Rings
from torchpose.target import Target

CAMERA = pinhole()
COUNT = 3


def scene(target: Target, count: int = COUNT) -> Scene:
    return Scene.of(torch.zeros(count, CAMERA.height, CAMERA.width), CAMERA, MarkerTable.of([target], CAMERA))


def seen(target: Target, count: int = COUNT) -> tuple[Rings, Tensor, Tensor, Tensor]:
    """Rings of frames in any order, the ellipses (B, M, 2, 5), and the poses."""
    r, t = random_poses(count, 50, (140, 200))
    ellipses = exact_ellipses(target, CAMERA, r, t)
    rings = rings_of(ellipses.flatten(0, 1), torch.arange(count).repeat_interleave(len(target)))
    order = torch.randperm(len(rings), generator=torch.Generator().manual_seed(1))
    return rings[order], ellipses, r, t


@pytest.mark.parametrize("name", ["quad40", "hexa50"])
def test_names_are_those_of_the_geometry(name: str) -> None:
    target = Target.load(name)
    rings = seen(target)[0]
    found = by_codes(scene(target), rings)
    assert found is not None
    wanted = identify(rings, MarkerTable.of([target]), CAMERA, COUNT)
    assert found.ring.tolist() == wanted.ring.tolist()
    assert found.copies.tolist() == wanted.copies.tolist()
    torch.testing.assert_close(found.gain, wanted.gain, rtol=0.5, atol=0.01)
    assert found.R.isnan().all()


def test_any_question_is_left_to_the_geometry() -> None:
    target = Target.load("quad40")
    rings = seen(target)[0]
    place = scene(target)
    first = torch.tensor([0])
    assert by_codes(place, rings) is not None
    assert by_codes(place, rings[:0]) is None
    assert by_codes(place, rings[1:]) is None  # one is missing
    assert by_codes(place, Rings.cat([rings, rings[first]])) is None  # one is there twice
    assert by_codes(place, Rings.cat([rings[1:], rings[1:2]])) is None  # one is there twice, another one not at all
    clipped = dataclasses.replace(rings, clipped=torch.zeros_like(rings.clipped).index_fill(0, first, True))
    assert by_codes(place, clipped) is None
    light = dataclasses.replace(rings, polarity=-rings.polarity)
    assert by_codes(place, light) is None
    inner = dataclasses.replace(rings.inner, params=rings.inner.params * torch.tensor([1, 1, 0.5, 0.5, 1], dtype=F64))
    assert by_codes(place, dataclasses.replace(rings, inner=inner)) is None  # no code is right


def test_rings_elsewhere_than_the_last_pose_puts_them_are_not_confirmed() -> None:
    target = Target.load("quad40")
    rings, ellipses, r, t = seen(target)
    row, marker = torch.ones(COUNT, len(target), dtype=torch.bool).nonzero().unbind(-1)
    there = Places(row, marker, ellipses.flatten(0, 1), ellipses.flatten(0, 1), r, t)
    order = torch.randperm(len(rings), generator=torch.Generator().manual_seed(1))  # as in `seen`
    found = confirmed(scene(target), there, rings, order)
    assert found is not None
    assert found.R is r
    turned = order.view(-1).roll(1)  # each in the place of another one
    assert confirmed(scene(target), there, rings, turned) is None
    aside = there._replace(ideal=there.ideal + torch.tensor([30.0, 0, 0, 0, 0], dtype=F64))
    assert confirmed(scene(target), aside, rings, order) is None
