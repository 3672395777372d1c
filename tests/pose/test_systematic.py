"""Poses of the joint problem of frame, print and camera, and what residuals show beyond."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import pytest
import torch
from torch import Tensor

import torchpose as tp
from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.geometry import rotations
from torchpose.geometry.robust import quantile
from torchpose.identify import MarkerTable
from torchpose.pose import (
    PLACE,
    Evidence,
    MarkerNormals,
    Setting,
    center_normals,
    gather_evidence,
    on_print,
    solve_poses,
)
from torchpose.pose.excess import OF_CAMERA, OF_EDGES, OF_MARKER, SURE, Picture, excess_of, may_be_off
from torchpose.refine.centers import refine_centers
from torchpose.results import Misfit
from torchpose.target import Target

CAMERA_FILE = pinhole()
# the same, with a lens that is known to have no distortion
KNOWN_LENS = tp.Camera(
    width=CAMERA_FILE.width,
    height=CAMERA_FILE.height,
    matrix=CAMERA_FILE.matrix,
    distortion=torch.zeros(4, dtype=F64),
    covariance=torch.zeros(8, 8, dtype=F64),
)
MARKERS = 2  # of `problem`
ALONG = OF_MARKER * MARKERS + OF_EDGES
QUAD = Target.load("quad40")


def uncertain(place: float, gain: float) -> Target:
    deviation = torch.tensor([place] * (3 * len(QUAD)) + [gain], dtype=F64)
    return dataclasses.replace(QUAD, covariance=torch.diag(deviation.square()))


def evidence(
    target: Target, r: Tensor, t: Tensor, sigma: float, camera: tp.Camera = CAMERA_FILE, printed: Target | None = None
) -> Evidence:
    """Noisy measurements of all markers of one print, as the target's file has them."""
    count, markers = len(r), len(target)
    ellipses = exact_ellipses(printed or target, camera, r, t)
    rings = rings_of(ellipses.flatten(0, 1), torch.arange(count).repeat_interleave(markers), sigma)
    table = MarkerTable.of([target])[torch.zeros(count, dtype=torch.int64)]
    return gather_evidence(rings, torch.arange(count * markers).view(count, markers), table, camera)


def by_hand(normals: MarkerNormals, R: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Pose step and covariance of one row from the stacked problem of pose, places and their prior, all at once."""
    markers = normals.right.shape[1]
    size = 6 + 3 * markers
    matrix, right = torch.zeros(size, size, dtype=F64), torch.zeros(size, dtype=F64)
    for m in range(markers):
        pick = torch.zeros(6, size, dtype=F64)
        pick[:, :6] = torch.eye(6, dtype=F64)
        pick[:3, 6 + 3 * m : 9 + 3 * m] = R[0]
        matrix += pick.T @ normals.information[0, m, :6, :6] @ pick
        right += pick.T @ normals.right[0, m, :6]
    matrix[6:, 6:] += torch.linalg.inv(place)
    covariance = torch.linalg.inv(matrix)
    return (covariance @ right)[:6], covariance[:6, :6]


def test_places_are_unknowns_with_their_prior() -> None:
    """The same as the dense problem that has every place among its unknowns."""
    r, t = random_poses(1, 30, (150, 190))
    target = uncertain(0.02, 0.0)
    e = evidence(target, r, t, 0.01)
    normals = center_normals(e, r, t)
    joint = on_print(normals, Setting(e, r, t, KNOWN_LENS, False), torch.zeros(1, 4, PLACE, dtype=F64))
    assert target.covariance is not None
    step, covariance = by_hand(normals, r, target.covariance[:-1, :-1])
    torch.testing.assert_close(joint.step[0], step, rtol=1e-6, atol=1e-10)
    torch.testing.assert_close(joint.covariance[0], covariance, rtol=1e-6, atol=1e-14)
    torch.testing.assert_close(
        joint.noise + joint.systematic @ joint.systematic.mT, joint.covariance, rtol=1e-9, atol=1e-16
    )


def test_the_camera_s_part_is_the_pose_s_own_response() -> None:
    """Column by column: solve again with fx, fy, cx, cy or a coefficient of the lens changed."""
    r, t = random_poses(4, 30, (150, 190))
    start = dataclasses.replace(pinhole(), distortion=torch.zeros(4, dtype=F64))
    e = evidence(QUAD, r, t, 1e-5, start)
    s = solve_poses(e, (r, t))
    xy = (e.center - e.matrix[:2, 2]) / e.matrix.diagonal()[:2]
    for k, step in enumerate([0.05, 0.05, 0.05, 0.05, 1e-4, 1e-4]):
        matrix, distortion = start.matrix.clone(), start.distortion.clone()
        if k < 4:
            matrix[(0, 1, 0, 1)[k], (0, 1, 2, 2)[k]] += step
        else:
            distortion[k - 4] += step
        other = dataclasses.replace(start, matrix=matrix, distortion=distortion)
        ideal = other.undistort_points(start.distort(xy)) * other.matrix.diagonal()[:2] + other.matrix[:2, 2]
        moved = solve_poses(dataclasses.replace(e, center=ideal, matrix=other.matrix), (r, t))
        change = torch.cat([moved.t - s.t, rotations.log(moved.R @ s.R.mT)], -1) / step
        one = torch.zeros(8, 8, dtype=F64)
        one[k, k] = 1
        known = dataclasses.replace(start)
        object.__setattr__(known, "covariance", one)  # of all parameters
        setting = Setting(e, s.R, s.t, known, False)
        joint = on_print(center_normals(e, s.R, s.t), setting, torch.zeros(4, 4, PLACE, dtype=F64), estimate=False)
        torch.testing.assert_close(joint.systematic[..., 0].abs(), change.abs(), rtol=0.03, atol=2e-4)


@pytest.mark.parametrize("place", [0.003, 0.02])
def test_prints_of_many_rows_are_covered(place: float) -> None:
    """NEES of 300 poses, each of a print of its own: 6 with a standard deviation of 0.2."""
    r, t = random_poses(300, 30, (150, 190))
    target, g = uncertain(place, 0.0), torch.Generator().manual_seed(3)
    every = []
    for k in range(len(r)):
        shift = place * torch.randn(4, 3, dtype=F64, generator=g)
        printed = dataclasses.replace(QUAD, centers=QUAD.centers + shift)
        every.append(exact_ellipses(printed, CAMERA_FILE, r[k : k + 1], t[k : k + 1]))
    rings = rings_of(torch.cat(every).flatten(0, 1), torch.arange(300).repeat_interleave(4), 0.01)
    table = MarkerTable.of([target])[torch.zeros(300, dtype=torch.int64)]
    e = gather_evidence(rings, torch.arange(1200).view(300, 4), table, CAMERA_FILE)
    s = solve_poses(e, (r, t))
    joint = on_print(
        center_normals(e, s.R, s.t), Setting(e, s.R, s.t, CAMERA_FILE, False), torch.zeros(300, 4, PLACE, dtype=F64)
    )
    error = torch.cat([s.t + joint.step[:, :3] - t, rotations.log(rotations.exp(joint.step[:, 3:]) @ s.R @ r.mT)], -1)
    nees = (error[:, None] @ torch.linalg.solve(joint.covariance, error[..., None]))[:, 0, 0]
    assert 5.3 < nees.mean() < 6.7


def problem(rows: int, seed: int, deviation: Tensor, factor: float = 1.0) -> tuple[Tensor, Tensor]:
    """Information about markers, edges and a camera, and right sides of true ones of these deviations, with noise."""
    g = torch.Generator().manual_seed(seed)
    by = torch.randn(rows, 40, ALONG + OF_CAMERA, dtype=F64, generator=g) * 3000
    by[..., ALONG:] *= 1e-3
    true = deviation * torch.randn(rows, ALONG + OF_CAMERA, dtype=F64, generator=g)
    noise = factor**0.5 * torch.randn(rows, 40, dtype=F64, generator=g)
    measured = (by @ true[..., None])[..., 0] + noise
    return by.mT @ by, (by.mT @ measured[..., None])[..., 0]


def of_places(size: float) -> Tensor:
    """Deviations of places, all three ways."""
    marker = torch.tensor([size] * 3 + [0.0] * (OF_MARKER - 3), dtype=F64)
    return torch.cat([marker.repeat(MARKERS), torch.zeros(OF_EDGES + OF_CAMERA, dtype=F64)])


def test_noise_alone_is_explained() -> None:
    found = excess_of(*problem(500, 0, of_places(0.0)))
    assert found.explained.all()
    assert abs(found.chi2.mean() - found.freedom.double().mean()) < 1
    widened = (found.factor > 1) | (found.deviation > 0).any(-1)
    assert widened.double().mean() < 0.01


@pytest.mark.parametrize("kind", ["print", "camera", "scatter"])
def test_what_is_off_is_told_and_measured(kind: str) -> None:
    """Each explanation where it is the right one, and how large: to a factor of 1.5 in the median."""
    deviation = of_places(0.02 if kind == "print" else 0.0)
    if kind == "camera":
        deviation[ALONG:] = 0.5
    found = excess_of(*problem(200, 1, deviation, 20.0 if kind == "scatter" else 1.0))
    size = {"print": found.deviation[:, 0], "camera": found.deviation[:, -1], "scatter": found.factor}
    true = {"print": 0.02, "camera": 0.5, "scatter": 20.0}[kind]
    assert (found.misfit == Misfit[kind.upper()]).double().mean() > 0.95
    assert true / 1.5 < size[kind].median() < 1.5 * true
    assert found.explained.double().mean() > 0.97


def test_a_camera_counts_by_what_residuals_say_of_it() -> None:
    """Of 300 cameras that are off in one number or in all: the mean square of the numbers is that of what they are, in
    place of the deviation that they may have, of which one residual tells next to nothing.
    """
    for chosen in ([ALONG], [ALONG + 5], list(range(ALONG, ALONG + OF_CAMERA))):
        deviation = of_places(0.0)
        deviation[chosen] = 3.0
        g = torch.Generator().manual_seed(8)
        by = torch.randn(300, 40, ALONG + OF_CAMERA, dtype=F64, generator=g)
        by[..., :ALONG] *= 3000
        true = deviation * torch.randn(300, ALONG + OF_CAMERA, dtype=F64, generator=g)
        measured = (by @ true[..., None])[..., 0] + torch.randn(300, 40, dtype=F64, generator=g)
        found = excess_of(by.mT @ by, (by.mT @ measured[..., None])[..., 0])
        lens = found.misfit == Misfit.CAMERA
        assert lens.double().mean() > 0.75
        assert (found.lens[~lens] == 0).all()
        said = (found.lens @ found.lens.mT).diagonal(dim1=-2, dim2=-1)[lens]
        off = true[lens, ALONG:].square()
        at = [k - ALONG for k in chosen]
        assert abs(float(said[:, at].mean() / off[:, at].mean()) - 1) < 0.1
        # row by row, to the noise of what they tell
        assert float((said[:, at].sqrt() - off[:, at].sqrt()).square().mean()) < 0.3**2
        assert float(found.deviation[lens][:, chosen].square().mean() / off[:, at].mean()) > 1.5 or len(chosen) > 1


@pytest.mark.parametrize("size", [0.0131, 0.0177, 0.0236])
def test_many_residuals_tell_the_size_of_print_errors(size: float) -> None:
    """To some per cent, wherever it lies between the sizes that are tried, and the residuals are explained."""
    markers, rows = 40, 3
    g = torch.Generator().manual_seed(4)
    by = 3000 * torch.randn(rows, 300, OF_MARKER * markers + OF_EDGES + OF_CAMERA, dtype=F64, generator=g)
    true = torch.zeros(by.shape[-1], dtype=F64)
    true[: OF_MARKER * markers] = torch.tensor([size] * 3 + [0.0] * 2, dtype=F64).repeat(markers)
    numbers = true * torch.randn(rows, len(true), dtype=F64, generator=g)
    measured = (by @ numbers[..., None])[..., 0] + torch.randn(rows, 300, dtype=F64, generator=g)
    found = excess_of(by.mT @ by, (by.mT @ measured[..., None])[..., 0])
    assert found.explained.all()
    assert (found.misfit == Misfit.PRINT).all()
    assert ((found.deviation[:, 0] / size).log().abs() < 0.4).all()


def test_what_the_rims_do_not_show_is_no_scatter() -> None:
    """Residuals 2.4 times too large look like larger noise; edges that scatter along the rims as noise does deny it."""
    information, right = problem(40, 5, of_places(0.0), 6.0)
    silent, told = (excess_of(information, right, e) for e in (None, torch.full((40,), 56.0, dtype=F64)))
    assert (silent.misfit == Misfit.SCATTER).double().mean() > 0.8
    assert (told.misfit == Misfit.SCATTER).double().mean() < 0.4
    assert (told.misfit != Misfit.NONE).all()
    assert told.explained.double().mean() > 0.9
    assert (silent.maybe[silent.misfit == Misfit.SCATTER] > 0).all()
    assert (silent.maybe[silent.misfit != Misfit.SCATTER] == 0).all()


def test_normals_of_noise_that_is_correlated_are_those_of_the_whole_covariance() -> None:
    """Sixty edges with noise in common, weighed by the inverse of its whole covariance."""
    g = torch.Generator().manual_seed(11)
    by = torch.randn(1, 1, 60, 7, dtype=F64, generator=g)
    motions = torch.randn(1, 1, 7, 2, dtype=F64, generator=g)
    measured = torch.randn(1, 1, 60, 1, dtype=F64, generator=g)
    normals = MarkerNormals(by.mT @ by, (by.mT @ measured)[..., 0])
    both = normals.scattered(normals.by_motions(motions))
    apart = by @ motions
    whole = torch.linalg.inv(torch.eye(60, dtype=F64) + apart @ apart.mT)
    torch.testing.assert_close(both.information, by.mT @ whole @ by)
    torch.testing.assert_close(both.right, (by.mT @ whole @ measured)[..., 0])


def test_rings_that_shift_more_than_they_scatter() -> None:
    """A picture displaced by 0.3 px so that rings shift and do no more is told from one that moves them anyhow."""
    g = torch.Generator().manual_seed(12)
    by = 20 * torch.randn(100, 40, 7 * MARKERS, dtype=F64, generator=g)
    noise, shift = (torch.randn(100, n, 1, dtype=F64, generator=g) for n in (40, 2 * MARKERS))
    moved = torch.nn.functional.pad(0.3 * shift.view(100, MARKERS, 2), (0, 5)).view(100, -1, 1)
    shifts, anyhow = torch.diag(torch.tensor([1.0, 1.0] + 5 * [0.0], dtype=F64)), 0.5 * torch.eye(7, dtype=F64)
    fields = torch.stack([shifts, anyhow])[:, None].expand(100, 2, MARKERS, 7, 7)

    def picture(measured: Tensor, which: Tensor) -> Picture:
        return Picture(*(x[which] for x in (by.mT @ by, (by.mT @ measured)[..., 0], fields)))

    def found(measured: Tensor) -> Tensor:
        excess = excess_of(*problem(100, 13, of_places(0.0), 20.0), picture=partial(picture, measured))
        scatters = excess.misfit == Misfit.SCATTER
        assert scatters.double().mean() > 0.9
        assert (excess.factor[scatters] == 1).all()
        assert (excess.field[~scatters] == 0).all()
        return excess.field[scatters].sqrt().median(0).values

    shifted, still = found(noise + by @ moved), found(noise)
    assert 0.2 < shifted[0] < 0.45
    assert shifted[1] < 0.3 * shifted[0]
    assert (still < 0.02).all()


def test_centres_that_shift_leave_the_pose_where_it_is() -> None:
    """Both circles of a ring by 0.1 px, and by 0.02 px apart: what they are apart does not tell the pose instead."""
    r, t = random_poses(100, 40, (140, 190))
    g = torch.Generator().manual_seed(5)
    ellipses = exact_ellipses(QUAD, CAMERA_FILE, r, t)
    ellipses[..., :2] += 0.1 * torch.randn(100, 4, 1, 2, dtype=F64, generator=g)
    ellipses[..., :2] += 0.02 * torch.randn(100, 4, 2, 2, dtype=F64, generator=g)
    rings = rings_of(ellipses.flatten(0, 1), torch.arange(100).repeat_interleave(4), 0.05)
    table = MarkerTable.of([QUAD])[torch.zeros(100, dtype=torch.int64)]
    e = gather_evidence(rings, torch.arange(400).view(100, 4), table, CAMERA_FILE)
    s = solve_poses(e, (r, t))
    found = refine_centers(e, s.R, s.t)
    setting = Setting(e, found.R, found.t, CAMERA_FILE, False)
    joint = on_print(found.normals, setting, torch.zeros(100, 4, PLACE, dtype=F64))
    assert (joint.misfit == Misfit.SCATTER).sum() > 20
    before = found.t - t
    assert (before + joint.step[:, :3]).square().mean() < 1.5 * before.square().mean()


def test_one_thing_of_a_camera_is_seen_where_the_sum_is_no_surprise() -> None:
    """k1 off by 4.5 deviations of what 30 residuals tell of it: a camera, also where chi-squared of all is usual."""
    number = ALONG + 5
    information, right = problem(300, 15, of_places(0.0))
    off = torch.zeros(300, information.shape[-1], dtype=F64)
    off[:, number] = 4.5 / information[:, number, number].sqrt()
    found = excess_of(information, right + (information @ off[..., None])[..., 0])
    usual = found.chi2 < quantile(found.freedom, SURE)
    assert usual.double().mean() > 0.2
    assert (found.misfit[usual] == Misfit.CAMERA).double().mean() > 0.4


@pytest.mark.parametrize("deviations", [0.0, 2.5, 4.0])
def test_a_number_that_may_be_off_counts_by_its_share(deviations: float) -> None:
    """Against sums over the number itself: a hundred thousand of it under every deviation that it may have."""
    told = torch.tensor([0.04, 1.0, 25.0], dtype=F64)
    found = may_be_off(told, deviations * told.sqrt())
    sizes = torch.logspace(-3, math.log10(300), 16, dtype=F64)[:, None, None]
    unit = torch.linspace(-12, 12, 100_001, dtype=F64)
    prior = torch.softmax(-0.5 * unit.square(), 0)
    number = sizes * unit  # (16, 1, n)
    likelihood = prior * (deviations * told.sqrt()[:, None] * number - 0.5 * told[:, None] * number.square()).exp()
    evidence = likelihood.sum(-1)
    share = evidence / (
        3 * 6 * 16 + evidence.sum(0)
    )  # nothing as likely as three families, k1 one of six of the camera
    mean = (likelihood * number).sum(-1) / evidence
    torch.testing.assert_close(found, (share * mean.square()).sum(0), rtol=1e-3, atol=1e-12)


def test_what_residuals_do_not_tell_of_a_lens_is_not_counted() -> None:
    nothing, zero = torch.tensor([0.0, 1e-9, 4.0], dtype=F64), torch.zeros(3, dtype=F64)
    assert (may_be_off(nothing, zero) == 0).all()


def test_rows_of_a_lens_that_bends_a_little_more_cover_more_of_their_errors() -> None:
    """k1 off by few deviations of what a row tells of it, and the pose by a dozen of its own; a lens that is known."""
    target = Target.load("hexa50")
    r, t = random_poses(200, 30, (120, 140))
    exact = evidence(target, r, t, 0.02)
    nees = {}
    for k1 in (0.0, 0.002):
        true = dataclasses.replace(KNOWN_LENS, distortion=torch.tensor([k1, 0.0, 0.0, 0.0], dtype=F64))
        xy = (exact.center - exact.matrix[:2, 2]) / exact.matrix.diagonal()[:2]
        e = dataclasses.replace(exact, center=true.distort(xy))
        s = solve_poses(e, (r, t))
        for camera in (CAMERA_FILE, KNOWN_LENS):
            setting = Setting(e, s.R, s.t, camera, False)
            joint = on_print(center_normals(e, s.R, s.t), setting, torch.zeros(200, len(target), PLACE, dtype=F64))
            turned = rotations.exp(joint.step[:, 3:]) @ s.R
            error = torch.cat([s.t + joint.step[:, :3] - t, rotations.log(turned @ r.mT)], -1)
            nees[k1, camera.lens_stated] = (
                error[:, None] @ torch.linalg.solve(joint.covariance, error[..., None])
            ).mean()
    assert nees[0.002, False] < nees[0.002, True] / 3
    assert 5.3 < nees[0.0, False] < 6.2  # and little is lost where the lens is as its file says


def test_what_no_print_may_have_is_not_explained() -> None:
    assert not excess_of(*problem(20, 2, of_places(30.0))).explained.any()


def test_a_target_measured_by_the_same_camera_shares_its_errors() -> None:
    """The pose of a measured target with both files, against draws of camera and places from their joint covariance."""
    g = torch.Generator().manual_seed(7)
    size = 3 * len(QUAD) + 1
    scale = torch.cat([torch.full((size,), 0.004, dtype=F64), torch.full((4,), 0.3, dtype=F64)])
    root = scale[:, None] * torch.randn(size + 4, size + 4, dtype=F64, generator=g) / (size + 4) ** 0.5
    joint = root @ root.T
    joint[size - 1], joint[:, size - 1] = 0.0, 0.0  # centres tell of no gain
    camera = dataclasses.replace(pinhole(), covariance=joint[size:, size:], adjustment="one")
    parts = {"covariance": joint[:size, :size], "adjustment": "one", "cross_covariance": joint[:size, size:]}
    target = dataclasses.replace(QUAD, **parts)
    r, t = random_poses(1, 30, (150, 190))
    table = MarkerTable.of([target], camera)
    both = table.by_print[0] @ table.by_print[0].mT + table.by_camera[0] @ table.by_camera[0].mT
    torch.testing.assert_close(both[0, :3, :3], joint[:3, :3], rtol=1e-6, atol=1e-12)
    draws = 3000
    drawn = torch.linalg.cholesky(joint + 1e-14 * torch.eye(size + 4, dtype=F64)) @ torch.randn(
        size + 4, draws, dtype=F64, generator=g
    )
    matrix = camera.matrix + torch.zeros(draws, 3, 3, dtype=F64)
    for k, (i, j) in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
        matrix[:, i, j] += drawn[size + k]
    x = (r @ (QUAD.centers + drawn[: size - 1].T.unflatten(-1, (-1, 3))).mT).mT + t[:, None]
    raw = (x @ matrix.mT)[..., :2] / x[..., 2:]
    noise = 0.003
    raw = raw + noise * torch.randn(raw.shape, dtype=F64, generator=g)
    ellipses = exact_ellipses(QUAD, camera, r, t)
    rings = rings_of(ellipses.flatten(0, 1), torch.zeros(4, dtype=torch.int64), noise * 10)
    one = gather_evidence(rings, torch.arange(4).view(1, 4), table[torch.zeros(1, dtype=torch.int64)], camera)
    covariance = noise**2 * torch.eye(2, dtype=F64).expand(1, 4, 2, 2)
    every = dataclasses.replace(one, covariance=covariance)[torch.zeros(draws, dtype=torch.int64)]
    every = dataclasses.replace(every, center=raw)
    s = solve_poses(every, (r.expand(draws, -1, -1), t.expand(draws, -1)))
    setting = Setting(every, s.R, s.t, camera, False)
    found = on_print(center_normals(every, s.R, s.t), setting, torch.zeros(draws, 4, PLACE, dtype=F64))
    turned = rotations.exp(found.step[:, 3:]) @ s.R
    error = torch.cat([s.t + found.step[:, :3] - t, rotations.log(turned @ r.mT)], -1)
    nees = (error[:, None] @ torch.linalg.solve(found.covariance, error[..., None]))[:, 0, 0]
    assert 5.6 < nees.mean() < 6.4
    apart = dataclasses.replace(camera, adjustment="another")
    assert (MarkerTable.of([target], apart).by_camera == 0).all()


def test_an_uncertain_scale_is_an_uncertain_distance() -> None:
    """All lengths larger by a factor, the image is that of a target nearer by it: depth has that deviation besides."""
    target = dataclasses.replace(QUAD, scale_sigma=1e-3)
    r, t = random_poses(1, 30, (150, 190))
    e = evidence(target, r, t, 1e-3)
    joint = on_print(center_normals(e, r, t), Setting(e, r, t, KNOWN_LENS, False), torch.zeros(1, 4, PLACE, dtype=F64))
    assert joint.systematic.shape[-1] == 1
    torch.testing.assert_close(joint.systematic[0, :3, 0].abs(), 1e-3 * t[0].abs(), rtol=1e-4, atol=1e-7)
    assert joint.systematic[0, 3:].abs().max() < 1e-8
    torch.testing.assert_close(
        joint.noise[0, :3, :3], joint.covariance[0, :3, :3] - 1e-6 * t[0, :, None] * t[0], rtol=1e-3, atol=1e-12
    )
