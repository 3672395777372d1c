"""Grey values decide between two poses, and on poses that were rejected for the shapes of their rings."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from tests.exact import F64, exact_ellipses, pinhole, random_poses
from torchpose.pose import PLACE, Evidence, Solutions
from torchpose.refine import Sight, decide_on_grey
from torchpose.results import Reason, Status
from torchpose.sim import add_noise, render
from torchpose.target import Target

CAMERA = pinhole()
QUAD = Target.load("quad40")


def mirrored(r: Tensor, t: Tensor) -> Tensor:
    """The other minimum of a plane far away: its tilt seen in a mirror across the line of sight."""
    line = torch.nn.functional.normalize(t, dim=-1)
    flip = torch.eye(3, dtype=F64) - 2 * line[:, :, None] * line[:, None]
    return flip @ r @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=F64))


def evidence(r: Tensor, t: Tensor) -> Evidence:
    """Exact, of targets wholly seen; only the markers' model and mask count for the grey values."""
    count = len(r)
    shape = exact_ellipses(QUAD, CAMERA, r, t)
    points, normals, radii = (x.expand(count, *x.shape) for x in (QUAD.centers, QUAD.normals, QUAD.radii))
    center, size = shape[:, :, 0, :2], torch.eye(5, dtype=F64).expand(*shape.shape, 5)
    mask = torch.ones(count, len(QUAD), dtype=torch.bool)
    flat = torch.ones(count, dtype=torch.bool)
    return Evidence(
        points,
        normals,
        radii,
        center,
        size[:, :, 0, :2, :2],
        shape,
        size,
        torch.ones_like(mask, dtype=F64),
        mask,
        flat,
        torch.ones(count, dtype=F64),
        torch.zeros(*mask.shape, 2, 2, dtype=F64),
        torch.zeros(*mask.shape, 7, 0, dtype=F64),
        torch.zeros(*mask.shape, 7, 0, dtype=F64),
        torch.zeros(count, dtype=F64),
        CAMERA.matrix,
    )


def solutions(r: Tensor, t: Tensor, r_alt: Tensor, t_alt: Tensor, status: Status, reason: Reason) -> Solutions:
    """Whose rms is 1 and chi2 10, 2 and 20 of the alternative."""
    one = torch.ones(len(r), dtype=F64)
    codes, reasons = (torch.full((len(r),), int(s)) for s in (status, reason))
    mask = torch.ones(len(r), len(QUAD), dtype=torch.bool)
    covariance = torch.eye(6, dtype=F64).repeat(len(r), 1, 1)
    parts = (covariance, covariance, covariance[..., :0])
    rest = (torch.zeros(*mask.shape, PLACE, dtype=F64), 0 * codes, 0 * one, 0 * codes, 0 * one)
    return Solutions(r, t, *parts, one, 10 * one, r_alt, t_alt, 2 * one, 20 * one, codes, reasons, mask, *rest)


def decided(s: Solutions, frames: Tensor, r: Tensor, t: Tensor) -> Solutions:
    """By the frames of the poses ``r``, ``t``."""
    sight = Sight.of(frames, CAMERA, QUAD, torch.arange(len(r)), exact_ellipses(QUAD, CAMERA, r, t))
    return decide_on_grey(s, evidence(r, t), sight)


def unchanged(found: Solutions, s: Solutions) -> bool:
    return all(
        torch.equal(torch.nan_to_num(getattr(found, f.name)), torch.nan_to_num(getattr(s, f.name)))
        for f in dataclasses.fields(s)
    )


def test_the_right_one_of_two_poses_wins() -> None:
    """Whether it comes first or as the alternative; what belongs to it comes with it."""
    r, t = random_poses(6, 40, (700, 800), seed=6)
    frames = add_noise(render(CAMERA, QUAD, r, t, psf_sigma=0.8), 2.0)
    wrong = mirrored(r, t)
    for swap in (False, True):
        one, two = (wrong, r) if swap else (r, wrong)
        found = decided(solutions(one, t, two, t, Status.AMBIGUOUS, Reason.TWO_SOLUTIONS), frames, r, t)
        assert (found.status == Status.OK).all()
        assert (found.reason == Reason.NONE).all()
        assert torch.equal(found.R, r)
        assert torch.equal(found.R_alt, wrong)
        assert (found.rms == (2 if swap else 1)).all()
        assert (found.rms_alt == (1 if swap else 2)).all()
        assert (found.chi2 == (20 if swap else 10)).all()
        assert (found.chi2_alt == (10 if swap else 20)).all()


def test_frames_without_the_target_decide_nothing() -> None:
    r, t = random_poses(4, 40, (700, 800), seed=6)
    frames = add_noise(torch.full((4, CAMERA.height, CAMERA.width), 128.0), 5.0)
    s = solutions(mirrored(r, t), t, r, t, Status.AMBIGUOUS, Reason.TWO_SOLUTIONS)
    assert unchanged(decided(s, frames, r, t), s)


def test_grey_values_overrule_ring_shapes_where_every_marker_agrees() -> None:
    """Not where half of a marker is hidden, nor so much that a ring as light as its paper explains the rest."""
    r, t = random_poses(4, 30, (150, 170), seed=4)
    frames = render(CAMERA, QUAD, r, t, psf_sigma=0.8)
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    rings = exact_ellipses(QUAD, CAMERA, r, t)[2:, 1, 0]
    for frame, (x, y, a, *_), reach in zip(frames[2:], rings, (-0.1, 0.4), strict=True):
        frame[(torch.hypot(u - x, v - y) < 1.4 * a) & (u > x - reach * a)] = 200.0
    frames = add_noise(frames, 2.0)
    none = torch.full_like(r, torch.nan), torch.full_like(t, torch.nan)
    s = solutions(r, t, *none, Status.REJECTED, Reason.RING_SHAPE)
    found = decided(s, frames, r, t)
    assert found.status.tolist() == [Status.OK, Status.OK, Status.REJECTED, Status.REJECTED]
    assert found.reason.tolist() == [Reason.NONE, Reason.NONE, Reason.RING_SHAPE, Reason.RING_SHAPE]
    assert torch.equal(found.R, r)
    residual = dataclasses.replace(s, reason=torch.full_like(s.reason, int(Reason.RESIDUAL)))
    assert unchanged(decided(residual, frames, r, t), residual)
