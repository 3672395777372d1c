"""Following an ellipse along the edge."""

from __future__ import annotations

import torch

from torchpose.detect.arcs import follow
from torchpose.detect.regions import gradient


def test_ellipses_larger_than_the_frame_are_given_up() -> None:
    # a hairline in a clean raster fits an ellipse of a hundred million pixels; its samples would fill the memory
    frame = torch.full((1, 60, 80), 255.0)
    frame[:, 30] = 0.0
    huge = torch.tensor([[40.0, 1e8, 1e8, 1e7, 1.5707]], dtype=torch.float64)
    followed = follow(gradient(frame), torch.zeros(1, dtype=torch.int64), huge, torch.ones(1, dtype=torch.float64))
    assert followed.isnan().all()
