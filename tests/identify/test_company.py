"""Rings that may be markers beside other ones: no true marker is dropped, what is in no pose is."""

import pytest
import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses
from torchpose.identify import MarkerTable, beside_another
from torchpose.target import Target

QUAD = Target.load("quad40")
TABLE = MarkerTable.of([QUAD])
CAMERA = pinhole()


def together(outer: Tensor, frame: Tensor, polarity: Tensor | None = None) -> Tensor:
    side = torch.ones(len(outer), dtype=F64) if polarity is None else polarity
    return beside_another((frame, side, outer), TABLE, CAMERA.matrix)


@pytest.mark.parametrize("distance", [(110.0, 200.0), (400.0, 900.0)])
def test_any_two_markers_of_a_pose_are_company(distance: tuple[float, float]) -> None:
    """Every pair alone, at any tilt, each circle drawn off by a pixel and its size by as much."""
    every = exact_ellipses(QUAD, CAMERA, *random_poses(100, 75.0, distance))[:, :, 0]
    pairs = every[:, torch.combinations(torch.arange(4))].flatten(0, 1)
    generator = torch.Generator().manual_seed(0)
    off = torch.rand(*pairs.shape[:-1], 3, dtype=F64, generator=generator) * 2 - 1
    pairs[..., :2] += off[..., :2]
    pairs[..., 2:4] += off[..., 2:]
    frame = torch.arange(len(pairs)).repeat_interleave(2)
    # at the steepest tilts a ring hides behind another one
    clear = torch.linalg.vector_norm(pairs[:, 0, :2] - pairs[:, 1, :2], dim=-1) > pairs[..., 3].sum(-1)
    assert clear.double().mean() > 0.95
    assert bool(together(pairs.flatten(0, 1), frame).view(-1, 2)[clear].all())


@pytest.mark.parametrize("what", ["alone", "of other frames", "of another polarity", "too far away", "much nearer"])
def test_no_company(what: str) -> None:
    outer = exact_ellipses(QUAD, CAMERA, *random_poses(1, 20.0, (300.0, 301.0)))[0, :2, 0].clone()
    frame, polarity = torch.zeros(2, dtype=torch.int64), torch.ones(2, dtype=F64)
    assert bool(together(outer, frame, polarity).all())
    if what == "alone":
        outer, frame, polarity = outer[:1], frame[:1], polarity[:1]
    elif what == "of other frames":
        frame[1] = 1
    elif what == "of another polarity":
        polarity[1] = -1.0
    elif what == "too far away":
        outer[1, :2] = outer[0, :2] + 8 * (outer[1, :2] - outer[0, :2])
    else:
        outer[1, 2:4] *= 4
    assert not bool(together(outer, frame, polarity).any())
