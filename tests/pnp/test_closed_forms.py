"""Every closed form on exact data, on float32 input, with missing points, and beside OpenCV and PoseLib."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.pnp.scenes import CUBOID, F64, GRID, SQUARE, errors, project, views
from torchpose.errors import ArgumentError
from torchpose.geometry import rotations
from torchpose.pnp import Candidates, dlt, epnp, lines, p3p, planar, posit

Solver = Callable[..., Candidates]
ELSEWHERE = rotations.exp(torch.tensor([0.3, -1.0, 0.5], dtype=F64))
CASES = [
    pytest.param(planar, SQUARE, id="planar-4"),
    pytest.param(planar, GRID, id="planar-9"),
    pytest.param(planar, GRID @ ELSEWHERE.T + torch.tensor([5.0, -7, 90], dtype=F64), id="planar-anywhere"),
    pytest.param(dlt, CUBOID, id="dlt"),
    pytest.param(p3p, CUBOID[:4], id="p3p"),
    pytest.param(p3p, SQUARE, id="p3p-plane"),
    pytest.param(epnp, CUBOID, id="epnp"),
    pytest.param(epnp, GRID, id="epnp-plane"),
    pytest.param(posit, CUBOID, id="posit"),
    pytest.param(posit, GRID, id="posit-plane"),
]


@pytest.mark.parametrize(("solver", "points"), CASES)
def test_exact_points_give_the_exact_pose(solver: Solver, points: Tensor) -> None:
    r, t, _ = views(points - points.mean(0), 300)
    t = t - r @ points.mean(0)
    found = solver(points, project(points, r, t))
    angle, distance = errors(found.R[:, 0], found.t[:, 0], r, t)
    assert angle.max() < 1e-9
    assert distance.max() < 1e-9
    assert found.rms[:, 0].max() < 1e-10
    assert bool((found.rms[:, :-1].nan_to_num(9) <= found.rms[:, 1:].nan_to_num(9)).all()), "best first"


@pytest.mark.parametrize(("solver", "points"), CASES)
def test_one_set_of_points_a_pose_is_the_same_as_a_shared_one(solver: Solver, points: Tensor) -> None:
    _, _, xy = views(points, 20)
    shared, own = solver(points, xy), solver(points.expand(20, -1, -1), xy)
    torch.testing.assert_close(own.R[:, 0], shared.R[:, 0], rtol=0, atol=1e-8)


@pytest.mark.parametrize(("solver", "points"), CASES)
def test_float32_input_is_as_accurate_as_its_digits(solver: Solver, points: Tensor) -> None:
    r, t, _ = views(points - points.mean(0), 200, tilt_deg=(20, 60))
    t = t - r @ points.mean(0)
    found = solver(points.float(), project(points, r, t).float())
    angle, distance = errors(found.R[:, 0], found.t[:, 0], r, t)
    assert angle.median() < 2e-5
    assert distance.median() < 2e-5


@pytest.mark.parametrize(
    ("solver", "points"), [(planar, GRID), (dlt, CUBOID), (p3p, CUBOID), (epnp, CUBOID), (epnp, GRID), (posit, CUBOID)]
)
def test_missing_points_may_hold_anything(solver: Solver, points: Tensor) -> None:
    r, t, xy = views(points, 50)
    mask = torch.ones(50, len(points), dtype=torch.bool)
    mask[torch.arange(50), torch.arange(50) % len(points)] = False
    xy = torch.where(mask[..., None], xy, torch.nan)
    found = solver(points, xy, mask)
    angle, distance = errors(found.R[:, 0], found.t[:, 0], r, t)
    assert angle.max() < 1e-8
    assert distance.max() < 1e-8


@given(seed=st.integers(0, 2**31), tilt=st.floats(0.5, 80), far=st.floats(3, 60))
@settings(max_examples=40, deadline=None)
def test_planar_has_the_true_pose_among_its_two(seed: int, tilt: float, far: float) -> None:
    r, t, xy = views(SQUARE, 8, tilt_deg=(tilt, tilt), near=far, far=far, seed=seed)
    found = planar(SQUARE, xy)
    angle, distance = errors(found.R, found.t, r[:, None], t[:, None])
    assert angle.amin(1).max() < 1e-7
    assert distance.amin(1).max() < 1e-7


def test_planar_beside_opencv_with_noise() -> None:
    _, _, xy = views(GRID, 100, tilt_deg=(30, 60), near=3, far=6)
    xy = xy + 1e-4 * torch.randn(xy.shape, generator=torch.Generator().manual_seed(2), dtype=F64)
    found = planar(GRID, xy)
    for i in range(0, 100, 2):  # from the front: OpenCV 5.0 errs on planes seen from behind
        _, rvecs, _, errs = cv2.solvePnPGeneric(GRID.numpy(), xy[i].numpy(), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        ours = found.rms[i] * np.sqrt(1 / 2)  # OpenCV's mean is over both coordinates
        theirs = torch.from_numpy(cv2.Rodrigues(rvecs[0])[0])
        assert float(rotations.angle_between(found.R[i, 0], theirs)) < 2e-3
        assert float(ours[0]) <= float(np.ravel(errs[0])[0]) * 1.05


def test_p3p_finds_what_poselib_finds() -> None:
    poselib = pytest.importorskip("poselib")
    points = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(3), dtype=F64)
    r, t, _ = views(points[0], 200)
    t = t / 20
    xy = project(points, r, t)
    found = p3p(points, xy)
    rays = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    for i in range(200):
        poses = poselib.p3p(list(rays[i].numpy()), list(points[i].numpy()))
        ahead = [p for p in poses if (points[i].numpy() @ p.R.T + p.t)[:, 2].min() > 0]
        ours = found.R[i][~found.rms[i].isnan()]
        assert len(ours) >= len(ahead)
        for pose in ahead:
            assert float(rotations.angle_between(ours, torch.from_numpy(pose.R).expand_as(ours)).min()) < 1e-6


def test_three_points_have_all_their_poses_and_all_are_exact() -> None:
    r, t, xy = views(SQUARE[:3], 300)
    found = p3p(SQUARE[:3], xy)
    angle, _ = errors(found.R, found.t, r[:, None], t[:, None])
    assert angle.nan_to_num(9).amin(1).max() < 1e-8
    assert found.rms.nan_to_num(0).max() < 1e-8
    assert int((~found.rms.isnan()).sum(1).min()) >= 2


@pytest.mark.parametrize("solver", [dlt, epnp])
def test_closed_forms_with_noise_are_near_the_least_squares_pose(solver: Solver) -> None:
    r, t, xy = views(CUBOID, 200, near=3, far=6)
    xy = xy + 1e-4 * torch.randn(xy.shape, generator=torch.Generator().manual_seed(2), dtype=F64)
    found = solver(CUBOID, xy)
    rms = found.rms[:, 0]
    # 16 residuals, of which the six parameters take their share
    assert rms.median() < 2.5 * 1e-4 * np.sqrt(2 * 10 / 16)
    assert errors(found.R[:, 0], found.t[:, 0], r, t)[0].median() < 5e-3


def _images(points: Tensor, r: Tensor, t: Tensor, slide: float) -> Tensor:
    """Image segments (B, N, 2, 2) of object lines (N, 2, 3), their ends moved along the line."""
    batch, count = len(r), len(points)
    ends = project(points.flatten(0, 1), r, t).unflatten(1, (count, 2))
    shift = slide * torch.rand(batch, count, 2, 1, generator=torch.Generator().manual_seed(4), dtype=F64)
    return ends + shift * (ends[:, :, 1:] - ends[:, :, :1])


@pytest.mark.parametrize("points", [CUBOID, GRID[[0, 2, 8, 6, 4]]], ids=["space", "plane"])
@pytest.mark.parametrize("iterations", [0, 30])
def test_exact_lines_give_the_exact_pose(points: Tensor, iterations: int) -> None:
    segments = torch.stack([points, points.roll(1, 0)], 1)
    r, t, _ = views(points, 100)
    found = lines(segments, _images(segments, r, t, slide=0.3), max_iterations=iterations)
    angle, distance = errors(found.R[:, 0], found.t[:, 0], r, t)
    assert angle.max() < (1e-6 if iterations == 0 else 1e-9)
    assert distance.max() < (1e-6 if iterations == 0 else 1e-9)


def test_a_missing_line_may_hold_anything() -> None:
    segments = torch.stack([CUBOID, CUBOID.roll(1, 0)], 1)
    r, t, _ = views(CUBOID, 40)
    image = _images(segments, r, t, slide=0.1)
    mask = torch.ones(40, 8, dtype=torch.bool)
    mask[torch.arange(40), torch.arange(40) % 8] = False
    found = lines(segments, torch.where(mask[..., None, None], image, torch.nan), mask)
    assert errors(found.R[:, 0], found.t[:, 0], r, t)[0].max() < 1e-9


@pytest.mark.parametrize("solver", [planar, epnp, posit])
def test_collinear_points_have_no_pose(solver: Solver) -> None:
    line = torch.tensor([[x, 2 * x, 0.0] for x in (-20, -5, 3, 20)], dtype=F64)
    _, _, xy = views(line, 5)
    assert solver(line, xy).R.isnan().all()


def test_dlt_refuses_a_plane_and_planar_refuses_a_solid() -> None:
    _, _, xy = views(GRID, 4)
    assert dlt(GRID, xy).R.isnan().all()
    _, _, xy = views(CUBOID, 4)
    assert planar(CUBOID, xy).R.isnan().all()


@pytest.mark.parametrize("solver", [planar, dlt, p3p, epnp, posit])
def test_shapes_that_do_not_fit_are_named(solver: Solver) -> None:
    _, _, xy = views(CUBOID, 4)
    with pytest.raises(ArgumentError, match="image_points: has shape"):
        solver(CUBOID, xy[0])
    with pytest.raises(ArgumentError, match="object_points: has shape"):
        solver(CUBOID[:3], xy)
    with pytest.raises(ArgumentError, match="mask: has shape"):
        solver(CUBOID, xy, torch.ones(3, 8, dtype=torch.bool))
