"""Centre refinement against exact conics, finite differences, and poses from compensated centres."""

from __future__ import annotations

import dataclasses

import torch

import torchpose as tp
from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.geometry import rotations
from torchpose.identify import MarkerTable
from torchpose.pose import Evidence, gather_evidence, solve_poses
from torchpose.refine import decide, refine_centers
from torchpose.refine.centers import ellipse_centers
from torchpose.results import Status

CAMERA = pinhole()
QUAD = tp.Target.load("quad40")


def evidence(r: torch.Tensor, t: torch.Tensor, sigma: float) -> Evidence:
    count, markers = len(r), len(QUAD)
    ellipses = exact_ellipses(QUAD, CAMERA, r, t).flatten(0, 1)
    rings = rings_of(ellipses, torch.arange(count).repeat_interleave(markers), sigma, seed=3)
    every = MarkerTable.of([QUAD])[torch.zeros(count, dtype=torch.int64)]
    return gather_evidence(rings, torch.arange(count * markers).view(count, markers), every, CAMERA)


def errors(found_r: torch.Tensor, found_t: torch.Tensor, r: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    return torch.cat([found_t - t, rotations.log(found_r @ r.mT)], -1)


def test_ellipse_centers_are_those_of_the_conics() -> None:
    r, t = random_poses(20, 70, (120, 400))
    center, _ = ellipse_centers(r, t, *(x.expand(20, *x.shape) for x in (QUAD.centers, QUAD.normals, QUAD.radii)))
    px = CAMERA.matrix.diagonal()[:2] * center + CAMERA.matrix[:2, 2]
    torch.testing.assert_close(px, exact_ellipses(QUAD, CAMERA, r, t)[..., :2], rtol=0, atol=1e-8)


def test_derivatives() -> None:
    r, t = random_poses(1, 60, (120, 200))
    model = [x[None] for x in (QUAD.centers, QUAD.normals, QUAD.radii)]
    numeric = torch.func.jacfwd(
        lambda d: ellipse_centers(rotations.exp(d[3:]) @ r, t + d[:3], *model)[0]
    )(torch.zeros(6, dtype=F64))  # fmt: skip
    torch.testing.assert_close(ellipse_centers(r, t, *model)[1], numeric, rtol=1e-9, atol=1e-12)


def test_exact_centers_give_the_exact_pose() -> None:
    r, t = random_poses(20, 60, (120, 300))
    off = rotations.exp(torch.full((3,), 2e-3, dtype=F64))
    found = refine_centers(evidence(r, t, 1e-9), off @ r, t + 0.1)
    assert found.good.all()
    assert errors(found.R, found.t, r, t).abs().max() < 1e-6


def test_better_than_compensated_centers_and_says_so() -> None:
    r, t = random_poses(400, 60, (130, 200))
    e = evidence(r, t, 0.02)
    s = solve_poses(e, (r, t))
    found = refine_centers(e, s.R, s.t)
    assert found.good.all()
    error = errors(found.R, found.t, r, t)
    before = errors(s.R, s.t, r, t).square().mean(0).sqrt()
    assert (error.square().mean(0).sqrt() < 0.7 * before).all()
    nees = (error[:, None] @ torch.linalg.inv(found.covariance) @ error[..., None]).flatten()
    assert 5.5 < nees.mean() < 6.5  # 400 poses: 6, deviation 0.17


def test_markers_not_seen_do_not_count() -> None:
    r, t = random_poses(8, 45, (130, 200))
    e = evidence(r, t, 0.01)
    hidden = e.without(torch.zeros(8, dtype=torch.int64))
    wrong = dataclasses.replace(hidden, shape=hidden.shape.clone())
    wrong.shape[:, 0] += 50.0
    a, b = refine_centers(hidden, r, t), refine_centers(wrong, r, t)
    assert torch.equal(a.R, b.R)
    assert torch.equal(a.t, b.t)


def far_and_noisy(count: int) -> tuple[torch.Tensor, torch.Tensor, Evidence]:
    """Poses whose compensated centres leave two solutions open now and then; the shapes tell nothing."""
    r, t = random_poses(count, 35, (700, 900), seed=7)
    e = evidence(r, t, 0.6)
    covariance = e.shape_covariance.clone()
    covariance[..., 2:, 2:] += 100 * torch.eye(3, dtype=F64)
    return r, t, dataclasses.replace(e, shape_covariance=covariance)


def test_decides_between_two_solutions() -> None:
    """The ellipses' own centres tell which is right."""
    r, t, e = far_and_noisy(400)
    s = solve_poses(e, (r, t))
    open_ones = s.status == Status.AMBIGUOUS
    found = decide(s, e)
    decided = open_ones & (found.status == Status.OK)
    assert open_ones.sum() > 20
    assert decided.sum() > 0.5 * open_ones.sum()
    error = errors(found.R, found.t, r, t)
    nees = (error[:, None] @ torch.linalg.solve(found.covariance, error[..., None])).flatten()
    assert (nees[decided] < 30).all()  # a wrong one would have hundreds
    assert (found.chi2_alt - found.chi2)[decided].min() > 20
    for name in ("R", "t", "status", "chi2"):
        assert torch.equal(getattr(found, name)[~decided], getattr(s, name)[~decided])


def test_what_no_pose_explains_stays_open() -> None:
    """Centres that are a pixel off by something else than noise decide nothing."""
    r, t, e = far_and_noisy(400)
    s = solve_poses(e, (r, t))
    shape = e.shape.clone()
    shape[..., :2] += torch.randn(shape[..., :2].shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    found = decide(s, dataclasses.replace(e, shape=shape))
    assert (s.status == Status.AMBIGUOUS).any()
    assert torch.equal(found.status, s.status)
