"""The least-squares core beside SciPy, joint solutions and exact answers."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares as scipy_least_squares
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry.least_squares import (
    Code,
    Eliminated,
    Normal,
    Pose,
    Unknowns,
    Vector,
    geman_mcclure,
    minimise,
    scaled_inverse,
    solve_scaled,
)
from torchpose.geometry.segments import segment_sum

F64 = torch.float64
TIME = torch.linspace(0, 3, 25, dtype=F64)


def decays(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Noisy decays a exp(-k t) (N, 25) and a start (N, 2) off their parameters."""
    g = torch.Generator().manual_seed(seed)
    truth = torch.rand(count, 2, dtype=F64, generator=g) * torch.tensor([900.0, 2.0]) + torch.tensor([100.0, 0.2])
    clean = truth[:, :1] * torch.exp(-truth[:, 1:] * TIME)
    noisy = clean + torch.randn(clean.shape, dtype=F64, generator=g)
    return noisy, truth * torch.tensor([0.3, 2.5])


def decay_problem(measured: Tensor, known: Tensor | None = None, start: Tensor | None = None):  # type: ignore[no-untyped-def]
    def problem(unknowns: Unknowns) -> Normal:
        a, k = unknowns.values("decay").unbind(-1)
        shape = torch.exp(-k[:, None] * TIME)
        residual = measured - a[:, None] * shape
        jacobian = torch.stack([shape, -a[:, None] * TIME * shape], -1)
        normal = Normal(jacobian.mT @ jacobian, (jacobian.mT @ residual[..., None])[..., 0], residual.square().sum(-1))
        if known is None or start is None:
            return normal
        return normal.with_prior(known, unknowns.values("decay") - start)

    return problem


def scipy_fit(measured: Tensor, start: Tensor, root: Tensor | None = None) -> Any:
    """Of one decay; ``root`` of the information of a prior at the start."""
    data, first, time = measured.numpy(), start.numpy(), TIME.numpy()

    def residual(p: Any) -> Any:
        of_data = p[0] * np.exp(-p[1] * time) - data
        return of_data if root is None else np.concatenate([of_data, root.numpy() * (p - first)])

    return scipy_least_squares(residual, first, x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15)


def test_levenberg_marquardt_agrees_with_scipy() -> None:
    measured, start = decays(40)
    found = minimise(
        decay_problem(measured), Unknowns({"decay": Vector(start)}), 100, damping=1e-3, adaptive=True, tolerance=1e-14
    )
    assert (found.code == Code.CONVERGED).all()
    covariance, determined = found.covariance()
    assert determined.all()
    for row in range(40):
        fit = scipy_fit(measured[row], start[row])
        np.testing.assert_allclose(found.unknowns.values("decay")[row], fit.x, rtol=1e-7)
        np.testing.assert_allclose(covariance[row], np.linalg.inv(fit.jac.T @ fit.jac), rtol=1e-5)


def test_every_problem_has_its_own_damping() -> None:
    """A hard start beside an easy one does not change what happens to the easy one."""
    measured, start = decays(2)
    start[0] = measured.new_tensor([1.0, 30.0])
    together, alone = (
        minimise(decay_problem(m), Unknowns({"decay": Vector(s)}), 6, damping=1e-3, adaptive=True)
        for m, s in ((measured, start), (measured[1:], start[1:]))
    )
    assert torch.equal(together.unknowns.values("decay")[1:], alone.unknowns.values("decay"))


def test_cost_never_rises_with_adaptive_damping() -> None:
    measured, start = decays(30, 3)
    problem, costs = decay_problem(measured), []
    for steps in range(1, 8):
        start_at = Unknowns({"decay": Vector(10 * start)})
        costs.append(minimise(problem, start_at, steps, damping=1e-3, adaptive=True).normal.cost)
    assert all((later <= earlier).all() for earlier, later in pairwise(costs))


def test_prior_is_one_more_measurement() -> None:
    measured, start = decays(5)
    known = torch.diag(torch.tensor([1e-2, 1e6], dtype=F64)).expand(5, 2, 2)
    found = minimise(
        decay_problem(measured, known, start), Unknowns({"decay": Vector(start)}), 50, damping=1e-3, adaptive=True
    )
    for row in range(5):
        fit = scipy_fit(measured[row], start[row], known[row].diagonal().sqrt())
        np.testing.assert_allclose(found.unknowns.values("decay")[row], fit.x, rtol=1e-6)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.booleans())
def test_elimination_is_the_joint_solution(seed: int, damped: bool) -> None:
    """Three problems of 4 unknowns with items of 3 each, against one dense system."""
    g = torch.Generator().manual_seed(seed)
    owner = torch.tensor([0, 0, 1, 2, 2, 2])
    own = torch.randn(6, 12, 4, dtype=F64, generator=g) * torch.tensor([1, 1e3, 1e-3, 1], dtype=F64)
    item = torch.randn(6, 12, 3, dtype=F64, generator=g)
    residual = torch.randn(6, 12, dtype=F64, generator=g)

    def over(x: Tensor) -> Tensor:
        return segment_sum(x, owner, 3)

    right = (residual[:, None] @ own)[:, 0]
    part = Eliminated(own.mT @ item, item.mT @ item, (residual[:, None] @ item)[:, 0], owner)
    normal = Normal(over(own.mT @ own), over(right), over(residual.square().sum(-1)), part)
    share = torch.tensor([0.1, 1.0, 3.0], dtype=F64) if damped else None
    step = normal.solve(share)
    for problem in range(3):
        mine = (owner == problem).nonzero()[:, 0]
        dense = torch.zeros(12 * len(mine), 4 + 3 * len(mine), dtype=F64)
        for i, k in enumerate(mine.tolist()):
            dense[12 * i : 12 * i + 12, :4] = own[k]
            dense[12 * i : 12 * i + 12, 4 + 3 * i : 7 + 3 * i] = item[k]
        matrix = dense.T @ dense
        if share is not None:
            matrix = matrix + share[problem] * torch.diag(matrix.diagonal())
        gradient = dense.T @ residual[mine].flatten()
        scale = matrix.diagonal().rsqrt()
        joint = scale * torch.linalg.solve(matrix * scale[:, None] * scale, gradient * scale)
        torch.testing.assert_close(step.own[problem], joint[:4], rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(step.eliminated[mine].flatten(), joint[4:], rtol=1e-6, atol=1e-9)
        # the cost of the linear problem falls by what the step promises
        left = (residual[mine].flatten() - dense @ joint).square().sum()
        fall = residual[mine].square().sum() - left
        torch.testing.assert_close(normal.promised(step, share)[problem], fall, rtol=1e-6, atol=1e-6)
        if share is None:
            covariance = torch.linalg.inv(matrix * scale[:, None] * scale) * scale[:, None] * scale
            torch.testing.assert_close(
                scaled_inverse(step.information)[0][problem], covariance[:4, :4], rtol=1e-5, atol=0
            )


def test_pose_moves_from_the_left() -> None:
    w = torch.tensor([[0.1, -0.2, 0.3]], dtype=F64)
    R, t = rotations.exp(-2 * w), torch.ones(1, 3, dtype=F64)
    moved = Pose(R, t).moved(torch.cat([t, w], -1))
    torch.testing.assert_close(moved.R, rotations.exp(w) @ R)
    torch.testing.assert_close(moved.t, 2 * t)


def test_numbers_stay_within_their_bounds() -> None:
    limits = [torch.tensor([x], dtype=F64) for x in (0.3, 4.0, 0.5)]
    vector = Vector(torch.tensor([[1.0], [3.9], [0.4]], dtype=F64), *limits)
    assert vector.moved(torch.tensor([[2.0], [0.4], [-0.3]], dtype=F64)).values[:, 0].tolist() == [1.5, 4.0, 0.3]


def test_nothing_seen_is_told_not_raised() -> None:
    nothing = torch.zeros(2, 3, 3, dtype=F64)
    assert solve_scaled(nothing, torch.zeros(2, 3, dtype=F64)).tolist() == [[0.0] * 3] * 2
    assert not scaled_inverse(nothing)[1].any()


@pytest.mark.parametrize("deviation", [0.0, 1.0, 30.0])
def test_weights_of_geman_and_mcclure(deviation: float) -> None:
    """The weight is rho'(d) / d of rho = d^2 / (2 (1 + d^2))."""
    d = torch.tensor(deviation, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(0.5 * d.square() / (1 + d.square()), d)
    expected = 1.0 if deviation == 0 else float(slope) / deviation
    assert float(geman_mcclure(d.detach())) == pytest.approx(expected)
