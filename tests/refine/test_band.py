"""Band pixels against the distance of every pixel of the frame."""

from __future__ import annotations

import pytest
import torch

from torchpose import ellipse
from torchpose.refine.photometric.band import band_pixels

F64 = torch.float64
HEIGHT, WIDTH, BAND = 110, 120, 3.5
# whole; cut by the left border; thin, so that both bands merge; hole smaller than the band
OUTER = torch.tensor(
    [[50.3, 40.2, 20, 12, 0.7], [2.0, 60, 15, 9, 1.2], [30, 90.5, 18, 17.5, 2.0], [80, 70, 12, 11, 0.3]], dtype=F64
)
RATIO = torch.tensor([0.5, 0.4, 0.85, 0.2], dtype=F64)


@pytest.fixture
def inner() -> torch.Tensor:
    inner = OUTER.clone()
    inner[:, 2:4] *= RATIO[:, None]
    return inner


def test_every_pixel_near_an_edge_once_and_no_other(inner: torch.Tensor) -> None:
    ring, u, v = band_pixels(OUTER, inner, torch.full((4,), BAND), HEIGHT, WIDTH)
    key = (ring * HEIGHT + v) * WIDTH + u
    assert key.unique().numel() == key.numel()
    assert (key.diff() > 0).all()
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    uv = torch.stack([columns, rows], -1).flatten(0, 1).double()
    for k in range(len(OUTER)):
        index = torch.full((len(uv),), k)
        near = torch.minimum(ellipse.distance(uv, index, OUTER).abs(), ellipse.distance(uv, index, inner).abs())
        taken = torch.zeros(HEIGHT * WIDTH, dtype=torch.bool)
        taken[(v * WIDTH + u)[ring == k]] = True
        assert taken[near < BAND - 0.6].all()
        assert (near[taken] < BAND + 1.2).all()


def test_outside_the_frame_and_none(inner: torch.Tensor) -> None:
    away = OUTER.clone()
    away[:, 0] += 500
    assert band_pixels(away, inner + (away - OUTER), torch.full((4,), BAND), HEIGHT, WIDTH)[0].numel() == 0
    assert band_pixels(OUTER[:0], inner[:0], torch.zeros(0), HEIGHT, WIDTH)[0].numel() == 0
