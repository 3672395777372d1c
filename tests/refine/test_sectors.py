"""What the grey values around a ring say of a pose: the check by sectors, and the second fit of doubtful rows."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses
from torchpose.geometry import rotations
from torchpose.geometry.sectors import SECTORS
from torchpose.refine import Refined, Sight, refine_photometric
from torchpose.refine.photometric.grey_chi2 import grey_chi2
from torchpose.refine.photometric.sectors import (
    Sectors,
    away_from_unclear,
    doubtful,
    in_step,
    level_scatter,
    roughness,
    shift_scatter,
    trust,
)
from torchpose.sim import add_noise, render, shapes
from torchpose.target import Target

CAMERA = pinhole()
QUAD = Target.load("quad40")


def arguments(frames: Tensor, r: Tensor, t: Tensor, off: float = 1e-2) -> tuple[Sight, Tensor, Tensor]:
    """Of `refine_photometric`, from a start that is off by ``off`` mm."""
    g, count = torch.Generator().manual_seed(5), len(r)
    start = t + off * torch.randn(count, 3, dtype=F64, generator=g)
    sight = Sight.of(frames, CAMERA, QUAD, torch.arange(count), exact_ellipses(QUAD, CAMERA, r, t))
    return sight, r, start


def nees(result: Refined, r: Tensor, t: Tensor) -> Tensor:
    e = torch.cat([result.t - t, rotations.log(result.R @ r.mT)], -1)
    return (e[:, None] @ torch.linalg.inv(result.covariance) @ e[..., None]).flatten()


def random_sectors(markers: int, tau: float = 0.0) -> Sectors:
    """Sums as noise of 1 leaves them, where edges are displaced at random, by ``tau`` px in cells of four sectors."""
    g = torch.Generator().manual_seed(3)
    hold = 50 + 100 * torch.rand(markers, 2 * SECTORS, generator=g)
    shift = tau * torch.randn(markers, SECTORS // 2, generator=g).repeat_interleave(4, 1)
    pull = hold * shift + hold.sqrt() * torch.randn(hold.shape, generator=g)
    count = torch.full_like(hold, 60)
    return Sectors(count, count, count, pull, hold, torch.zeros(markers, 1, dtype=torch.int64))


def test_trust_finds_the_variance_of_the_displacements() -> None:
    """Edges that scatter by 0.05 px: weights are 1 / (v + tau^2) on average, and near 1 where there is noise alone."""
    clear = torch.ones(40, 2 * SECTORS, dtype=torch.bool)
    one = torch.ones(40)
    assert trust(random_sectors(40), clear, one).mean() > 0.9
    s = random_sectors(40, tau=0.05)
    weight = trust(s, clear, one)
    hold = s.hold.unflatten(1, (-1, 4)).sum(-1).repeat_interleave(4, 1)
    expected = 1 / (1 + 0.05**2 * hold)
    used = weight > 0
    assert used.float().mean() > 0.9
    assert abs(float((weight / expected)[used].mean()) - 1) < 0.2


def test_roughness_is_what_most_edges_of_all_rings_have() -> None:
    """Four rings a row whose edges scatter by 0.3 px; by noise; that are shifted; and with much of two covered."""
    row, one = torch.arange(40) // 4, torch.ones(40)
    angle = (torch.arange(SECTORS) + 0.5) * (2 * torch.pi / SECTORS)
    rough, still = random_sectors(40, tau=0.3), random_sectors(40)
    found = roughness(rough, one, row)  # the median of 24 cells, and no ring much more than the best one of its row
    assert 0.75 < float(found.mean()) / 0.3 < 1.1
    assert (found > 0.1).all()
    assert (roughness(still, one, row) == 0).double().mean() > 0.95
    shifted = dataclasses.replace(still, pull=still.pull + still.hold * 0.1 * angle.cos().repeat(2))
    assert (roughness(shifted, one, row) == 0).double().mean() > 0.9
    # two thirds of two rings of each row: their own medians would say 0.2 px
    pull, cover = still.pull.clone(), torch.zeros(40, 2 * SECTORS, dtype=torch.bool)
    cover[::2, : SECTORS // 3 * 4] = True
    covered = dataclasses.replace(still, pull=torch.where(cover, pull + rough.pull, pull))
    assert (roughness(covered, one, row) < 0.02).all()


def test_what_moves_a_ring_is_no_scatter_where_rims_scatter() -> None:
    """Rings shifted by 0.2 px whose edges scatter by 0.05: weights are those of the scatter alone."""
    clear, one = torch.ones(40, 2 * SECTORS, dtype=torch.bool), torch.ones(40)
    angle = (torch.arange(SECTORS) + 0.5) * (2 * torch.pi / SECTORS)
    s = random_sectors(40, tau=0.05)
    shifted = dataclasses.replace(s, pull=s.pull + s.hold * 0.2 * angle.cos().repeat(2))
    without, rough = trust(shifted, clear, one), trust(shifted, clear, one, one)
    hold = s.hold.unflatten(1, (-1, 4)).sum(-1).repeat_interleave(4, 1)
    expected = 1 / (1 + 0.05**2 * hold)
    assert abs(float((rough / expected)[rough > 0].mean()) - 1) < 0.2
    assert float((without / expected)[without > 0].mean()) < 0.4


def test_edges_in_step_along_lines_tell_the_variance_of_shifts() -> None:
    """Lines of 8 px displaced along u: the shift of a ring has the variance that 400 drawings of them give it."""
    count, tau = 400, 0.1
    g = torch.Generator().manual_seed(7)
    rings = torch.tensor([[100.0, 100.0, 36.0, 36.0, 0.0], [100.0, 100.0, 20.0, 20.0, 0.0]], dtype=F64)
    angle = (torch.arange(SECTORS) + 0.5) * (2 * torch.pi / SECTORS)
    radius = torch.tensor([20.0, 36.0])[:, None]  # inner circle first
    line = ((100 + radius * angle.sin()) / 8).floor().long()
    hold = torch.full((count, 2, SECTORS), 100.0)
    shift = tau * torch.randn(count, 30, generator=g)[:, line] * angle.cos()
    noise = hold.rsqrt() * torch.randn(hold.shape, generator=g)
    one, row = torch.ones(count, dtype=F64), torch.arange(count)
    empty = torch.ones(count, 2 * SECTORS)
    for moved, name in ((torch.zeros_like(shift), "noise"), (shift, "lines")):
        pull, cell = hold * (noise + moved), torch.zeros(count, 1, dtype=torch.int64)
        sectors = Sectors(empty, empty, empty, pull.flatten(1), hold.flatten(1), cell)
        factor, freedom, alone = in_step(sectors, one, rings.expand(count, 2, 5), row, count)
        weight = hold * angle.cos()
        found = (weight * (noise + moved)).sum((1, 2)) / (weight * angle.cos()).sum((1, 2))
        assert abs(float(alone[:, 0].mean() * (weight * angle.cos()).sum((1, 2)).mean()) - 1) < 1e-6
        assert (freedom > 5).all()
        true = float(found.var() / alone[:, 0].mean())
        mean = float(factor[:, 0].mean())
        # bands share most of the lines' edges, not all
        assert 0.6 < mean / true < 1.2
        assert (true > 5) == (name == "lines")
        assert abs(float(factor[:, 1].mean()) / mean - 1) < 0.1 if name == "noise" else factor[:, 1].mean() < 0.6 * mean


def test_odd_harmonics_tell_the_variance_of_shifts() -> None:
    """White displacements, and such that are alike over 4 px along the rim: what drawings do to the shift of a ring."""
    count, rows = 1600, 400
    g = torch.Generator().manual_seed(14)
    rings = torch.tensor([[100.0, 100.0, 36.0, 36.0, 0.0], [100.0, 100.0, 16.0, 16.0, 0.0]], dtype=F64)
    angle = (torch.arange(SECTORS) + 0.5) * (2 * torch.pi / SECTORS)
    hold, empty = torch.full((count, 2, SECTORS), 100.0), torch.ones(count, 2 * SECTORS)
    noise = hold.rsqrt() * torch.randn(hold.shape, generator=g)
    place = torch.stack([angle.cos(), angle.sin()], -1)
    alike = [torch.exp(-(torch.cdist(place * radius, place * radius) / 4).square()) for radius in (16.0, 36.0)]
    roots = torch.stack([torch.linalg.cholesky(each + 1e-4 * torch.eye(SECTORS)) for each in alike])
    shared = 0.3 * (roots @ torch.randn(count, 2, SECTORS, 1, generator=g))[..., 0]
    one, row = torch.ones(count, dtype=F64), torch.arange(count) // 4
    for moved, beyond in ((torch.zeros_like(noise), 1.0), (shared, 15.0)):
        pull, cell = hold * (noise + moved), torch.zeros(count, 1, dtype=torch.int64)
        sectors = Sectors(empty, empty, empty, pull.flatten(1), hold.flatten(1), cell)
        factor = shift_scatter(sectors, one, rings.expand(count, 2, 5), row, rows)
        weight = hold * angle.cos()
        true = float((pull * angle.cos()).sum((1, 2)).square().mean() / (weight * angle.cos()).sum((1, 2)).mean())
        assert true > 0.9 * beyond
        assert 0.8 < float(factor.mean()) / true < 1.2


def test_level_scatter_is_that_of_sums() -> None:
    """1 for independent pixels; noise that 16 pixels in a row of a sector share makes it 16."""
    count = 60
    g = torch.Generator().manual_seed(8)
    cell = torch.arange(2 * SECTORS).repeat_interleave(16) + 2 * SECTORS * torch.arange(count)[:, None]
    weight = 0.2 + torch.rand(count, 1, generator=g).expand(cell.shape)
    empty = torch.ones(count, 2 * SECTORS)
    sectors = Sectors(empty, empty, empty, empty, empty, cell)
    apart = torch.randn(cell.shape, generator=g)
    shared = apart[:, ::16].repeat_interleave(16, 1)
    one, row = torch.ones(count, dtype=F64), torch.zeros(count, dtype=torch.int64)
    for residual, expected in ((apart, 1.0), (shared, 16.0)):
        assert abs(float(level_scatter(sectors, weight, residual, one, row, 1)) / expected - 1) < 0.15


def test_doubt_needs_more_than_noise() -> None:
    clear, one = torch.ones(4, 2 * SECTORS, dtype=torch.bool), torch.ones(4)
    row, step = torch.zeros(4, dtype=torch.int64), torch.full((1,), 7.0, dtype=F64)
    six = torch.full((1,), 6.0, dtype=F64)
    assert not doubtful(random_sectors(4), clear, one, row, step, six).any()
    assert doubtful(random_sectors(4, tau=0.05), clear, one, row, step, six).all()
    # a step of 200 is noise where it comes from one pixel of twenty, not where it comes from one of six
    assert doubtful(random_sectors(4), clear, one, row, step + 193, six).all()
    assert not doubtful(random_sectors(4), clear, one, row, step + 193, six + 14).any()
    covered = clear.clone()
    covered[2, SECTORS : SECTORS + 5] = False
    assert doubtful(random_sectors(4), covered, one, row, step, six).all()


def test_runs_of_unclear_sectors_take_their_neighbours() -> None:
    clear = torch.ones(1, 2 * SECTORS, dtype=torch.bool)
    clear[0, [0, SECTORS - 1, SECTORS + 20]] = (
        False  # a run across the seam of the inner circle, one alone on the outer
    )
    lost = (~away_from_unclear(random_sectors(1), clear))[0].nonzero()[:, 0].tolist()
    assert lost == [0, 1, SECTORS - 2, SECTORS - 1, SECTORS + 20]


def test_curved_light_and_a_glare_leave_no_false_certainty() -> None:
    """Large rings in light that falls by 1 / distance^2, and a bright spot whose tail lies over one of them."""
    r, t = random_poses(4, 40, (80, 90), seed=3)
    frames = render(CAMERA, QUAD, r, t, psf_sigma=1.2)
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    light = 1 / (1 + ((u - 0.2 * CAMERA.width) ** 2 + v**2) / CAMERA.width**2)
    ring = exact_ellipses(QUAD, CAMERA, r, t)[:, 0, 0]
    away = (u - ring[:, 0, None, None] - ring[:, 2, None, None]).square() + (v - ring[:, 1, None, None]).square()
    glare = 150 * torch.exp(-away / (0.5 * ring[:, 2, None, None]).square())
    result = refine_photometric(*arguments(add_noise((frames * light + glare).float(), 1.0), r, t))
    assert result.good.all()
    assert nees(result, r, t).max() < 25


def test_blurred_rings_under_a_cover_start_at_their_own_grey() -> None:
    """No pixel shows the ring's own grey, and a third of two rings is covered by paper: levels must not bend to it."""
    target = Target.load("quad40_dark")
    r, t = random_poses(4, 30, (300, 320), seed=4)
    cover = shapes.cat(
        [shapes.rectangle((x + 4.5, y), 4.0, 12.0, 0.0, 35.0) for x, y, _ in target.centers[2:].tolist()]
    )
    frames = render(CAMERA, target, r, t, psf_sigma=2.5, covers=cover)
    result = refine_photometric(*arguments(add_noise(frames, 2.0), r, t))
    assert (result.good & (result.kept > 0.7)).all()
    assert nees(result, r, t).max() < 30


def test_grey_values_tell_a_tilt_from_its_mirror_image() -> None:
    """Chi-squared of the mirrored tilt less that of the true one, far beyond noise, and the opposite when swapped."""
    r, t = random_poses(4, 40, (300, 320), seed=6)
    frames = add_noise(render(CAMERA, QUAD, r, t, psf_sigma=0.8), 2.0)
    given = arguments(frames, r, t)
    right = refine_photometric(*given)
    line = torch.nn.functional.normalize(t, dim=-1)
    flip = torch.eye(3, dtype=F64) - 2 * line[:, :, None] * line[:, None]
    normal = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=F64))
    mirrored = dataclasses.replace(right, R=flip @ r @ normal, t=t)
    chi2, there, explained = grey_chi2(given[0], right, mirrored)
    assert (chi2 > 20).all()
    assert there[:, 0].all()
    assert explained[:, 0].all()
    torch.testing.assert_close(grey_chi2(given[0], mirrored, right)[0], -chi2)
