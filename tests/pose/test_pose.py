"""Choice among solutions, status and covariance, on exact rings."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.identify import MarkerTable
from torchpose.pose import Evidence, Solutions, compensate, gather_evidence, solve_poses
from torchpose.pose import solve as pose
from torchpose.pose.outcome import _vouched
from torchpose.results import Misfit, Reason, Status
from torchpose.target import Target

CAMERA = pinhole()
QUAD = Target.load("quad40")
HEXA = Target.load("hexa50")


def evidence(
    target: Target,
    r: Tensor,
    t: Tensor,
    camera: Camera = CAMERA,
    sigma: float = 0.005,
    seed: int = 0,
    shift: Tensor | None = None,
) -> Evidence:
    """Noisy measurements of all markers; ``shift`` (B, M, 2) px moves rings away."""
    count, markers = len(r), len(target)
    ellipses = exact_ellipses(target, camera, r, t)
    if shift is not None:
        ellipses[..., :2] += shift[:, :, None]
    rings = rings_of(ellipses.flatten(0, 1), torch.arange(count).repeat_interleave(markers), sigma, seed=seed)
    table = MarkerTable.of([target])[torch.zeros(count, dtype=torch.int64)]
    ring = torch.arange(count * len(target)).view(count, len(target))
    return gather_evidence(rings, ring, table, camera, compensate)


def hide(e: Evidence, marker: int) -> Evidence:
    return e.without(torch.full((len(e.mask),), marker))


def errors(s: Solutions, r: Tensor, t: Tensor) -> Tensor:
    return torch.cat([s.t - t, rotations.log(s.R @ r.mT)], -1)


def test_consistent_over_tilt_and_noise() -> None:
    """NEES of 400 poses: mean 6 with standard deviation sqrt(12 / 400) = 0.17."""
    r, t = random_poses(400, 30, (150, 190))
    s = solve_poses(evidence(QUAD, r, t, sigma=0.05), (r, t))
    assert (s.status == Status.OK).all()
    e = errors(s, r, t)
    nees = (e[:, None] @ torch.linalg.inv(s.covariance) @ e[..., None]).mean()
    assert 5.2 < nees < 6.8


@pytest.mark.parametrize("hidden", range(4))
def test_three_markers_the_rings_decide(hidden: int) -> None:
    r, t = random_poses(100, 50, (150, 190), seed=hidden)
    e = hide(evidence(QUAD, r, t), hidden)
    wrong = pose._starts(e, (r, t))  # the mirror image of the truth comes second
    s = solve_poses(e, (wrong[0][:, 1], wrong[1][:, 1]))
    decided = s.status == Status.OK
    assert decided.double().mean() > 0.9  # near a frontal view both coincide or the rings cannot tell
    assert rotations.angle_between(s.R, r)[decided].max() < 0.01
    # where both solutions nearly merge, three centres leave one direction open
    refused = s.reason[s.status == Status.REJECTED]
    assert len(refused) <= 2
    assert set(refused.tolist()) <= {int(Reason.NOT_CONVERGED), int(Reason.DEGENERATE)}


def test_far_small_target_is_ambiguous() -> None:
    """A target of 12 px in coarse noise has two poses that explain all evidence."""
    r, t = random_poses(30, 1, (150, 190))
    r = rotations.exp(torch.tensor([0.35, 0.1, 0.0], dtype=F64)).expand(30, 3, 3)
    t = t * 30
    s = solve_poses(evidence(QUAD, r, t, sigma=0.3), (r, t))
    ambiguous = s.status == Status.AMBIGUOUS
    assert ambiguous.double().mean() > 0.8
    assert (s.reason[ambiguous] == Reason.TWO_SOLUTIONS).all()
    assert (s.chi2_alt - s.chi2)[ambiguous].max() < 20
    best = torch.minimum(rotations.angle_between(s.R, r), rotations.angle_between(s.R_alt, r))
    assert best[ambiguous].median() < 0.15


def test_frontal_view_is_not_ambiguous() -> None:
    r = torch.eye(3, dtype=F64).expand(5, 3, 3)
    t = torch.tensor([0.0, 0.0, 160.0], dtype=F64).expand(5, 3)
    s = solve_poses(evidence(QUAD, r, t), (r, t))
    assert (s.status == Status.OK).all()


def test_a_displaced_marker_is_left_out() -> None:
    r, t = random_poses(60, 40, (150, 190))
    shift = torch.zeros(60, 6, 2, dtype=F64)
    shift[torch.arange(60), torch.arange(60) % 6] = torch.tensor([4.0, -3.0], dtype=F64)
    s = solve_poses(evidence(HEXA, r, t, shift=shift), (r, t))
    assert (s.status == Status.OK).all()
    assert (s.mask.sum(-1) == 5).all()
    assert not s.mask[torch.arange(60), torch.arange(60) % 6].any()
    assert rotations.angle_between(s.R, r).max() < 1e-3


def test_contradicting_centres_are_rejected() -> None:
    r, t = random_poses(20, 40, (150, 190))
    shift = 6.0 * torch.randn(20, 6, 2, dtype=F64, generator=torch.Generator().manual_seed(0))
    s = solve_poses(evidence(HEXA, r, t, shift=shift), (r, t))
    assert (s.status == Status.REJECTED).all()
    assert (s.reason == Reason.RESIDUAL).all()


def test_rings_of_another_tilt_are_rejected() -> None:
    """Centres of one pose, ring shapes of another: three markers would fit any centres."""
    r, t = random_poses(20, 20, (150, 190))
    e = hide(evidence(QUAD, r, t), 0)
    shape = e.shape.clone()
    shape[..., 3] *= 0.7
    s = solve_poses(dataclasses.replace(e, shape=shape), (r, t))
    assert (s.status == Status.REJECTED).all()
    assert (s.reason == Reason.RING_SHAPE).all()


def test_no_row() -> None:
    r, t = random_poses(3, 30, (150, 190))
    none = torch.zeros(0, dtype=torch.int64)
    s = solve_poses(evidence(QUAD, r, t)[none], (r[none], t[none]))
    assert s.R.shape == (0, 3, 3)
    assert s.status.shape == (0,)


def test_rows_do_not_depend_on_each_other() -> None:
    """The same measurements give the same pose alone and in a batch, to 1e-9 mm and rad."""
    r, t = random_poses(24, 50, (150, 190))
    e = evidence(QUAD, r, t, sigma=0.05)
    together = solve_poses(e, (r, t))
    for k in range(len(r)):
        one = torch.tensor([k])
        alone = solve_poses(e[one], (r[one], t[one]))
        assert (alone.t[0] - together.t[k]).abs().max() < 1e-9
        assert (alone.R[0] - together.R[k]).abs().max() < 1e-9


def test_three_markers_whose_rims_scatter_do_not_say_which_fourth_is_wrong() -> None:
    """A marker was left out: scatter among the others is told, or counts as noise that chi-squared contradicts."""
    numbers = {"status": torch.int64, "reason": torch.int64, "misfit": torch.int64, "freedom": torch.int64}
    wide = {"R": (3, 3), "R_alt": (3, 3), "t": (3,), "t_alt": (3,), "covariance": (6, 6), "noise": (6, 6)}
    wide |= {"systematic": (6, 1), "mask": (4,), "place": (4, 5)}
    blank = {
        field.name: torch.zeros(6, *wide.get(field.name, ()), dtype=numbers.get(field.name, F64))
        for field in dataclasses.fields(Solutions)
    }
    mask = torch.tensor([True, True, True, False]).repeat(6, 1)
    mask[4, 3] = True  # a row with all four, in which nothing was left out
    misfit = torch.tensor([Misfit.NONE, Misfit.NONE, Misfit.SCATTER, Misfit.PRINT, Misfit.NONE, Misfit.NONE])
    chi2 = torch.tensor([7.0, 170, 170, 170, 170, torch.nan], dtype=F64)
    given = {"mask": mask, "misfit": misfit, "chi2": chi2, "freedom": torch.full((6,), 6)}
    found = _vouched(Solutions(**{**blank, **given}), torch.ones(6, 4, dtype=torch.bool))
    rejected = (found.status == Status.REJECTED).tolist()
    assert rejected == [False, True, True, False, False, False]
