"""Both minima of two given starts, in few calls: those of the solver that works on any number of poses."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.pnp.scenes import CUBOID, F64, GRID, MATRIX, SQUARE, pixels, views
from torchpose import pnp
from torchpose.geometry import rotations

ROWS = 24


def two_starts(r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Near the truth, and its mirror image along the line of sight."""
    g = torch.Generator().manual_seed(5)
    r = rotations.exp(0.1 * torch.randn(len(r), 3, generator=g, dtype=F64)) @ r
    t = t * (1 + 0.1 * torch.randn(len(t), 1, generator=g, dtype=F64))
    sight = t / t.norm(dim=-1, keepdim=True)
    turned = (torch.eye(3, dtype=F64) - 2 * sight[:, :, None] * sight[:, None]) @ r
    return torch.stack([r, turned @ torch.diag(torch.tensor([1.0, 1, -1], dtype=F64))], 1), torch.stack([t, t], 1)


@pytest.mark.parametrize("sigma", [0.01, 3.0, 30.0])
@pytest.mark.parametrize("points", [SQUARE, GRID, CUBOID, SQUARE[:3]], ids=["square", "grid", "cuboid", "three"])
def test_minima_are_those_of_solve(points: Tensor, sigma: float) -> None:
    r, t, xy = views(points, ROWS, seed=3)
    mask = torch.ones(ROWS, len(points), dtype=torch.bool)
    mask[::5, -1] = len(points) < 5  # one that is not seen, where there are enough
    uv = torch.where(mask[..., None], pixels(xy, sigma), torch.nan)
    covariances = (sigma**2 * torch.tensor([[1.0, 0.3], [0.3, 0.8]], dtype=F64)).expand(ROWS, len(points), 2, 2)
    every, starts = points.expand(ROWS, -1, -1), two_starts(r, t)
    found = pnp.pair_minima(every, uv, MATRIX, covariances, mask, starts, 60)
    wanted = pnp.solve(
        every, uv.nan_to_num(), MATRIX, covariances=covariances, mask=mask, initial=starts, max_iterations=60
    )
    sound = wanted.code <= pnp.PnPCode.AMBIGUOUS
    assert sound.sum() >= ROWS - 2
    chi2, order = found.chi2[sound].nan_to_num(nan=torch.inf).sort(1)
    both = torch.stack([wanted.chi2, wanted.chi2_alt], 1)[sound].nan_to_num(nan=torch.inf)
    torch.testing.assert_close(chi2, both, rtol=1e-9, atol=1e-9)
    each = torch.arange(len(order))
    # of three points both minima are exact, and either may come first
    clear = both[:, 1] - both[:, 0] > 1e-9
    for ours, theirs in ((found.R, wanted.R), (found.t, wanted.t), (found.rms, wanted.rms)):
        best = ours[sound][each, order[:, 0]]
        torch.testing.assert_close(best[clear], theirs[sound][clear], rtol=1e-6, atol=1e-6)


def test_points_behind_the_camera() -> None:
    r, t, xy = views(SQUARE, 2, seed=3)
    mask = torch.ones(2, 4, dtype=torch.bool)
    covariances = torch.eye(2, dtype=F64).expand(2, 4, 2, 2)
    starts = torch.stack([r, r], 1), -torch.stack([t, t], 1)
    found = pnp.pair_minima(SQUARE.expand(2, -1, -1), pixels(xy), MATRIX, covariances, mask, starts, 60)
    assert found.behind.all()
    assert found.R.isnan().all()
    assert found.chi2.isnan().all()


@pytest.mark.parametrize("points", [SQUARE, GRID], ids=["square", "grid"])
def test_starts_of_planes_have_the_true_pose(points: Tensor) -> None:
    """Wherever the plane lies in the target, and with a point that is not seen where there are enough."""
    r, t, xy = views(points, ROWS, seed=4)
    mask = torch.ones(ROWS, len(points), dtype=torch.bool)
    mask[::3, 0] = len(points) < 5
    R, at, known = pnp.planar_starts(points.expand(ROWS, -1, -1), torch.where(mask[..., None], xy, 0.0), mask)
    assert known.all()
    off = (R - r[:, None]).abs().amax((2, 3)) + (at - t[:, None]).abs().amax(2) / t[:, None, 2]
    assert off.amin(1).max() < 1e-9
    wanted = pnp.planar(points, xy, mask=mask)
    both = (R[:, :, None] - wanted.R[:, None]).abs().amax((3, 4))
    assert both.amin(2).max() < 1e-9


def test_no_starts_without_a_plane() -> None:
    _, _, xy = views(SQUARE, 3, seed=4)
    line = torch.tensor([[0.0, 0, 0], [1, 1, 0], [2, 2, 0], [3, 3, 0]], dtype=F64)
    points = torch.stack([line, CUBOID[:4] + torch.tensor([[0.0, 0, 30]] + 3 * [[0.0, 0, 0]], dtype=F64), SQUARE])
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[2, :2] = False  # two points are seen
    assert not pnp.planar_starts(points, torch.where(mask[..., None], xy, 0.0), mask)[2].any()
