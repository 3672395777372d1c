"""Rendered prints that are not as their file says: places, dot gain, and what the rows then claim."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import F64, pinhole, random_poses
from torchpose.geometry import rotations
from torchpose.results import Misfit
from torchpose.sim import add_noise, render
from torchpose.sim.disturbances import lines_moved
from torchpose.sim.prints import PrintErrors, printed

CAMERA = pinhole()
PLATE = (70.0, 70.0)
FRAMES = 6


def known(target: tp.Target, place: float, gain: float) -> tp.Target:
    deviation = torch.tensor([place] * (3 * len(target)) + [gain], dtype=F64)
    return dataclasses.replace(target, covariance=torch.diag(deviation.square()))


def grown(target: tp.Target, gain: float) -> tp.Target:
    """As printed with a dot gain: dark edges moved outwards, whichever tone the rings have."""
    return dataclasses.replace(target, edge_gain=gain)


def frames_of(prints: list[tp.Target], r: Tensor, t: Tensor, dark: float = 30.0, light: float = 220.0) -> Tensor:
    clean = [
        render(CAMERA, p, r[k : k + 1], t[k : k + 1], psf_sigma=0.7, plate=PLATE, dark=dark, light=light)
        for k, p in enumerate(prints)
    ]
    return add_noise(torch.cat(clean), 2.0, seed=3)


def errors(poses: tp.Poses, r: Tensor, t: Tensor) -> Tensor:
    return torch.cat([poses.t - t, rotations.log(poses.R @ r.mT)], -1)


def nees(poses: tp.Poses, r: Tensor, t: Tensor) -> Tensor:
    e = errors(poses, r, t)
    return (e[:, None] @ torch.linalg.solve(poses.covariance, e[..., None]))[:, 0, 0]


def off(target: tp.Target, place: float, count: int) -> list[tp.Target]:
    """Prints of which each ring is off by so much in all directions."""
    g = torch.Generator().manual_seed(2)
    shift = place * torch.randn(count, len(target), 3, dtype=F64, generator=g)
    return [dataclasses.replace(target, centers=target.centers + s) for s in shift]


@pytest.mark.parametrize("method", ["photometric", "edges", "centers"])
@pytest.mark.parametrize("stated", [True, False])
def test_rings_beside_their_places_are_counted(method: str, stated: bool) -> None:
    """20 um. Six frames of NEES 6 in the mean: their sum is chi-squared of 36, below 67 in 999 of 1000."""
    target = tp.Target.load("quad40")
    r, t = random_poses(FRAMES, 30, (140, 180), seed=11)
    frames = frames_of(off(target, 0.02, FRAMES), r, t)
    estimator = tp.PoseEstimator(CAMERA, known(target, 0.02, 0.0) if stated else target, method=method)  # type: ignore[arg-type]
    poses = estimator(frames)
    assert poses.ok.all()
    found = nees(poses, r, t)
    if method == "centers" and not stated:  # two residuals a row tell of its print: now and then both are small
        assert (found > 67).sum() <= 1
    else:
        assert found.sum() < 67
    assert (poses.noise_std[:, :2] < 0.5 * poses.std[:, :2]).all()
    if method == "photometric":
        assert errors(poses, r, t)[:, :3].abs().max() < 0.05
    if not stated:
        assert (poses.misfit == Misfit.PRINT).sum() >= FRAMES - 1


def test_rings_of_a_rough_print_are_looked_for_where_they_are() -> None:
    """50 um, a third of a px, as stated: as precise as places off by that leave it, and not what centres alone tell."""
    target = tp.Target.load("quad40")
    r, t = random_poses(FRAMES, 40, (140, 180), seed=13)
    poses = tp.PoseEstimator(CAMERA, known(target, 0.05, 0.0))(frames_of(off(target, 0.05, FRAMES), r, t))
    assert poses.ok.all()
    assert nees(poses, r, t).sum() < 67
    # depth by four rings whose places along the axis are off alike in the mean: half of one's, 0.025 mm
    assert (poses.std[:, 2] < 0.03).all()


def test_rims_of_printed_cells_are_no_outliers() -> None:
    """Cells of 1 px displace all edges by a third of it: no pixel may be dropped for that, and the rows say how much.

    RMS of what a raster of 150 dpi does to rings and edges of quad40: 4.6 and 3.0 um (`raster_sigmas` in
    scripts/precision_statistics.py). The mean NEES of 16 rows of 6 is below 8.9 in 999 of 1000 drawings.
    """
    target = tp.Target.load("quad40")
    r, t = random_poses(16, 40, (140, 180), seed=12)
    prints = printed(target, PrintErrors(dpi=150.0), 16, torch.Generator().manual_seed(1))
    clean = render(CAMERA, prints, r, t, psf_sigma=0.7, plate=PLATE, dark=30.0, light=220.0)
    frames = add_noise(clean, 2.0, seed=4)
    stated = known(target, 0.0046, 0.0030)
    for file, most in ((stated, 8.9), (target, 20.0)):
        poses = tp.PoseEstimator(CAMERA, file)(frames)
        assert poses.ok.all()
        assert 2.0 < nees(poses, r, t).mean() < most


def test_one_ring_of_another_size_is_left_out() -> None:
    """Larger by a twentieth: the other three are looked for as they are, and tell the pose."""
    target = tp.Target.load("quad40")
    radii = target.radii.clone()
    radii[1] *= 1.05
    r, t = random_poses(16, 40, (140, 180), seed=13)
    poses = tp.PoseEstimator(CAMERA, target)(frames_of([dataclasses.replace(target, radii=radii)] * 16, r, t))
    assert poses.ok.all()
    assert nees(poses, r, t).mean() < 8.9
    assert poses.std[:, 0].max() < 1e-3


def test_a_rolling_shutter_turns_the_pose_and_the_rows_say_so() -> None:
    """Lines that are read one after the other, 2 px in all: axes that are not square, and a pose turned by 0.8 mrad."""
    target = tp.Target.load("quad40")
    r, t = random_poses(12, 40, (140, 180), seed=14)
    clean = render(CAMERA, target, r, t, psf_sigma=0.7, plate=PLATE, dark=30.0, light=220.0)
    shift = torch.linspace(-1, 1, CAMERA.height).expand(12, -1)
    poses = tp.PoseEstimator(CAMERA, target)(add_noise(lines_moved(clean, shift), 2.0, seed=5))
    assert (poses.misfit == Misfit.CAMERA).all()
    roll = errors(poses, r, t)[:, 5]
    assert roll.abs().median() > 5e-4
    assert (roll / poses.std[:, 5]).abs().max() < 5
    assert nees(poses, r, t).mean() < 20


def test_places_come_out() -> None:
    """As far as a frame tells them: the places found lie on those of the print once both are laid over each other."""
    target = tp.Target.load("quad40")
    r, t = random_poses(1, 30, (140, 180), seed=12)
    (print_,) = off(target, 0.02, 1)
    poses = tp.PoseEstimator(CAMERA, known(target, 0.02, 0.0))(frames_of([print_], r, t))
    found = target.centers + poses.place[0, :, :3]
    apart = torch.cdist(print_.centers, print_.centers) - torch.cdist(target.centers, target.centers)
    left = torch.cdist(print_.centers, print_.centers) - torch.cdist(found, found)
    assert left.square().mean().sqrt() < 0.5 * apart.square().mean().sqrt()


def test_rings_turned_by_a_bent_plate_are_where_they_are() -> None:
    """A dome lifts all four alike, which is a pose: their turn is no place. The turn alone would put them 80 um off."""
    target = tp.Target.load("quad40")
    r, t = random_poses(3, 30, (140, 180), seed=12)
    bent = printed(target, PrintErrors(warp=0.04, shape="dome")).as_target()
    poses = tp.PoseEstimator(CAMERA, target)(frames_of([bent] * 3, r, t))
    assert poses.ok.all()
    assert (poses.misfit != Misfit.NONE).all()
    assert poses.place[..., 2].abs().max() < 0.01


def test_a_stated_height_states_how_rings_are_turned() -> None:
    """A plate bent by 40 um with a file that says so is no misfit; with one that does not it is."""
    target = tp.Target.load("quad40")
    r, t = random_poses(3, 30, (140, 180), seed=12)
    bent = printed(target, PrintErrors(warp=0.02, shape="cylinder", direction=0.6)).as_target()
    frames = frames_of([bent] * 3, r, t)
    poses, silent = (tp.PoseEstimator(CAMERA, one)(frames) for one in (known(target, 0.02, 0.0), target))
    assert poses.ok.all()
    assert (poses.misfit == Misfit.NONE).all()
    assert (silent.misfit == Misfit.PRINT).all()
    assert nees(poses, r, t).sum() < 43  # chi-squared of 18, once in 1000


@pytest.mark.slow
def test_bent_prints_are_covered() -> None:
    """24 plates, each bent in its own way: a mean NEES of 6 is known to 0.7; saddles are fewer than heights."""
    target, count = tp.Target.load("quad40"), 24
    r, t = random_poses(count, 30, (140, 180), seed=21)
    g = torch.Generator().manual_seed(22)
    bent = []
    for k in range(count):
        size = 0.06 * float(torch.randn((), generator=g))
        errors = PrintErrors(warp=abs(size), shape=("cylinder", "twist")[k % 2], direction=float(k))
        bent.append(printed(target, errors).as_target())
    height = torch.stack([one.centers[:, 2] for one in bent]).square().mean().sqrt()
    deviation = torch.cat([torch.tensor([0.0, 0.0, float(height)], dtype=F64).repeat(4), torch.zeros(1, dtype=F64)])
    stated = dataclasses.replace(target, covariance=torch.diag(deviation.square()))
    poses = tp.PoseEstimator(CAMERA, stated)(frames_of(bent, r, t))
    assert poses.ok.all()
    assert (poses.misfit == Misfit.NONE).double().mean() > 0.8
    assert 2 < nees(poses, r, t).mean() < 9


def test_residuals_that_are_small_by_chance_are_no_scatter() -> None:
    """All rings off by 10 um as a pose is, and by 0.6 um as none is: the rims say that the noise is no larger."""
    target = tp.Target.load("quad40")
    r, t = random_poses(1, 30, (140, 180), seed=12)
    twist = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=F64)[:, None]
    shift = torch.tensor([0.008, 0.006, 0.0], dtype=F64) + 6e-4 * twist * torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    off_ = dataclasses.replace(target, centers=target.centers + shift)
    poses = tp.PoseEstimator(CAMERA, target)(frames_of([off_], r, t))
    assert poses.ok.all()
    assert int(poses.misfit) not in (Misfit.NONE, Misfit.SCATTER)
    assert (poses.std[0, :2] > 2.5 * poses.noise_std[0, :2]).all()


@pytest.mark.parametrize(("name", "gain"), [("quad40", 0.06), ("quad40", -0.06), ("quad40_dark", 0.06)])
def test_dot_gain_is_an_unknown(name: str, gain: float) -> None:
    """Found to micrometres where the file says that there may be some; the same precision as without."""
    target = tp.Target.load(name)
    r, t = random_poses(3, 30, (140, 180), seed=13)
    frames = frames_of([grown(target, gain)] * 3, r, t)
    poses = tp.PoseEstimator(CAMERA, known(target, 0.0, 0.05))(frames)
    assert poses.ok.all()
    assert (poses.place[..., 3] - gain).abs().max() < 2e-3
    assert nees(poses, r, t).sum() < 43  # chi-squared of 18, once in 1000
    exact = tp.PoseEstimator(CAMERA, grown(target, gain))(frames)
    assert (poses.std < 1.4 * exact.std).all()


def test_unstated_gain_is_told() -> None:
    target = tp.Target.load("quad40")
    r, t = random_poses(3, 30, (140, 180), seed=14)
    poses = tp.PoseEstimator(CAMERA, target)(frames_of([grown(target, 0.03)] * 3, r, t))
    assert poses.ok.all()
    assert (errors(poses, r, t).abs() < 4 * poses.std).all()
    assert (poses.misfit == Misfit.PRINT).all()
    assert (poses.place[..., 3] - 0.03).abs().max() < 3e-3


def test_a_perfect_print_is_as_precise_as_before() -> None:
    """A file that claims nothing costs nothing where nothing is off."""
    target = tp.Target.load("quad40")
    r, t = random_poses(4, 30, (140, 180), seed=15)
    poses = tp.PoseEstimator(CAMERA, target)(frames_of([target] * 4, r, t))
    assert (poses.misfit == Misfit.NONE).all()
    torch.testing.assert_close(poses.covariance, poses.noise)
    assert poses.systematic.shape == (4, 6, 0)
    assert (poses.place == 0).all()
