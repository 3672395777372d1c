"""Normal equations and curvature against automatic differentiation; minima."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.pnp.scenes import F64
from torchpose.camera import Camera
from torchpose.geometry import rotations
from torchpose.geometry.small_linalg import matmul3
from torchpose.pnp.iterative import _proposal, minimise
from torchpose.pnp.normal_equations import (
    COST,
    STARTS,
    Observations,
    camera_points,
    damped_step,
    differentiate,
    moved,
    normal_equations,
    residuals,
    sums_of,
)

BATCH, COUNT = 3, 5
LENS = Camera(1280, 960, [[1111.0, 0, 640], [0, 1115, 480], [0, 0, 1]], [-0.2, 0.05, 1e-3, -5e-4, 0.01])


def setting(kind: str) -> tuple[Observations, Tensor]:
    """Observations with residuals of about 0.1, and poses (3, 4, B)."""
    g = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=F64)

    r = rotations.exp(0.3 * normal(BATCH, 3)).permute(1, 2, 0)
    t = torch.tensor([0.1, 0.2, 6.0], dtype=F64)[:, None].expand(3, BATCH)
    points, xy = normal(3, COUNT, 1), 0.1 * normal(2, COUNT, BATCH)
    diagonal, full = normal(2, COUNT, 1).abs(), normal(2, 2, COUNT, BATCH)
    obs = {
        "shared": Observations(points, xy, diagonal, sums=sums_of(points)),
        "own": Observations(points + 0.1 * normal(3, COUNT, BATCH), xy, diagonal),
        "full": Observations(points, xy, full, sums=sums_of(points)),
        "huber": Observations(points, xy, diagonal, huber=0.1),
        "lens": Observations(points, 1111 * xy + 500, 1e-3 * diagonal, camera=LENS, sums=sums_of(points)),
    }[kind]
    return obs, torch.cat([r, t[:, None]], 1)


def moving(obs: Observations, pose: Tensor, step: Tensor) -> Tensor:
    """Residuals (2 N, B), by formulas of their own."""
    r = matmul3(pose[:, :3], rotations.exp(step[3:].T).permute(1, 2, 0))
    t = pose[:, 3] + (pose[:, :3] * step[:3]).sum(1)
    x = matmul3(r, obs.points.expand(3, COUNT, BATCH)) + t[:, None]
    return residuals(obs, x[:2] / x[2]).flatten(0, 1)


@pytest.mark.parametrize("kind", ["shared", "own", "full", "lens"])
def test_normal_equations_and_curvature_are_the_derivatives(kind: str) -> None:
    obs, pose = setting(kind)
    at = differentiate(obs, pose)
    packed = normal_equations(obs, pose)
    bent = normal_equations(obs, pose, newton=True) - packed
    torch.testing.assert_close(moving(obs, pose, torch.zeros(6, BATCH, dtype=F64)), at.rows[3].flatten(0, 1))
    for b in range(BATCH):

        def of_one(s: Tensor, b: int = b) -> Tensor:
            step = torch.zeros(6, BATCH, dtype=F64)
            return moving(obs, pose, torch.cat([step[:, :b], s[:, None], step[:, b + 1 :]], 1))[:, b]

        zero = torch.zeros(6, dtype=F64)
        j, r = torch.autograd.functional.jacobian(of_one, zero), of_one(zero)
        full = torch.cat([j.T @ j, (j.T @ r)[:, None]], 1)
        torch.testing.assert_close(packed[:COST, b], torch.stack([full[i, k] for i in range(6) for k in range(i, 7)]))
        torch.testing.assert_close(packed[COST, b], r.square().sum())
        if kind != "lens":  # there the second derivatives of the distortion are left out
            beyond = torch.autograd.functional.hessian(lambda s: 0.5 * of_one(s).square().sum(), zero) - j.T @ j
            for i in range(6):
                torch.testing.assert_close(bent[STARTS[i] : STARTS[i] + 6 - i, b], beyond[i, i:], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", ["shared", "own", "full"])
def test_float32_with_fine_residuals_steps_as_float64_does(kind: str) -> None:
    obs, pose = setting(kind)
    # residuals of 1e-7, below the rounding of float32
    p = camera_points(obs, pose)
    obs = obs._replace(xy=p[:2] / p[2] + 1e-6 * obs.xy)
    mixed = normal_equations(obs.to(torch.float32), pose, newton=True, fine=obs)
    plain = normal_equations(obs.to(torch.float32), pose.float(), newton=True)
    exact, _, _ = damped_step(normal_equations(obs, pose, newton=True))
    steps = [damped_step(normal)[0].double() for normal in (mixed, plain)]
    assert mixed.dtype == torch.float32
    errors = [float(((step - exact).norm(dim=0) / exact.norm(dim=0)).max()) for step in steps]
    assert errors[0] < 1e-3
    assert errors[1] > 10 * errors[0], "float32 alone could not"


def test_minima_out_of_the_question_are_left_where_this_is_sure() -> None:
    obs, pose = setting("own")
    p = camera_points(obs, pose)
    obs = obs._replace(xy=p[:2] / p[2] + 1e-2 * obs.xy)
    start = moved(pose, torch.full((6, BATCH), 0.05, dtype=F64))
    cost = normal_equations(obs, start)[COST]
    found = minimise(obs, start, max_iterations=50)
    assert bool(found.converged.all())
    least = found.normal[COST]
    assert bool((least < 0.9 * cost).all())
    left = minimise(obs, start, max_iterations=50, enough=torch.stack([0 * cost[0] - 1e9, *least[1:] + 1]))
    assert bool(left.converged.all())
    torch.testing.assert_close(left.pose[..., 0], start[..., 0], rtol=0, atol=0)
    torch.testing.assert_close(left.normal[COST, 0], cost[0])
    torch.testing.assert_close(left.normal[COST, 1:], least[1:])


def test_a_minimum_is_not_ruled_out_by_a_step_cut_short() -> None:
    """Rejected steps raise the damping until they promise little: such a pose went round in a circle."""
    obs, pose = setting("own")
    p = camera_points(obs, pose)
    obs = obs._replace(xy=p[:2] / p[2] + 1e-2 * obs.xy)
    normal = normal_equations(obs, moved(pose, torch.full((6, BATCH), 0.05, dtype=F64)), newton=True)
    damping = torch.full((BATCH,), 1e4, dtype=F64)
    step, decrease, _ = damped_step(normal, damping)
    enough = normal[COST] - 100 * decrease
    trial, promised, done = _proposal(
        pose, normal[COST], damping, step, decrease, 1e-12, 0 * damping, enough - decrease
    )
    assert not bool(done.any())
    assert bool((promised > 0).all())
    assert not torch.equal(trial, pose)
    _, promised, done = _proposal(pose, normal[COST], 1e-4 * damping, step, decrease, 1e-12, 0 * damping, enough)
    assert bool(done.all())
    assert not bool(promised.any())


def test_step_of_few_and_of_many_poses_is_the_same() -> None:
    obs, pose = setting("own")
    normal = normal_equations(obs, pose)
    few, many = damped_step(normal), damped_step(normal.repeat(1, 50))
    for a, b in zip(few, many, strict=True):
        torch.testing.assert_close(a, b[..., :BATCH], rtol=1e-9, atol=1e-12)


def test_a_point_behind_the_camera_costs_infinitely_much() -> None:
    obs, pose = setting("own")
    pose[2, 3, 1] = -6.0
    assert normal_equations(obs, pose)[COST].isinf().tolist() == [False, True, False]
    assert camera_points(obs, pose)[2, :, 1].amax() < 0
