"""Batch-last small linear algebra against torch.linalg and scipy."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchpose.geometry import rotations
from torchpose.geometry import small_linalg as la

F64 = torch.float64


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def first(x: Tensor) -> Tensor:
    """Batch last to batch first."""
    return x.movedim(-1, 0)


@given(n=st.integers(1, 6), m=st.integers(1, 7), seed=st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_solve_spd_equals_torch(n: int, m: int, seed: int) -> None:
    root = random(n, n, 50, seed=seed)
    a = (root[:, None] * root[None]).sum(2) + 0.1 * torch.eye(n, dtype=F64)[..., None]
    b = random(n, m, 50, seed=seed + 1)
    x, pivots = la.solve_spd(a, b)
    torch.testing.assert_close(first(x), torch.linalg.solve(first(a), first(b)), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(pivots.prod(0), torch.linalg.det(first(a)), rtol=1e-9, atol=1e-12)


def test_solve_spd_reads_the_upper_triangle_only() -> None:
    root = random(6, 6, 20)
    a = (root[:, None] * root[None]).sum(2) + torch.eye(6, dtype=F64)[..., None]
    upper = torch.where(torch.ones(6, 6).triu()[..., None] > 0, a, torch.nan)
    torch.testing.assert_close(la.solve_spd(upper, random(6, 2, 20))[0], la.solve_spd(a, random(6, 2, 20))[0])


def test_damping_is_that_of_marquardt() -> None:
    root, b, damping = random(6, 6, 20), random(6, 1, 20), random(20, seed=3).abs()
    a = (root[:, None] * root[None]).sum(2)
    damped = a * (1 + damping * torch.eye(6, dtype=F64)[..., None])
    rows = [torch.cat([a[i, i:], b[i]]) for i in range(6)]
    torch.testing.assert_close(la.solve_rows(rows, damping)[0], la.solve_spd(damped, b)[0])


def test_a_singular_matrix_shows_in_its_pivots() -> None:
    root = random(6, 5, 20)
    singular = (root[:, None] * root[None]).sum(2)
    _, pivots = la.solve_spd(singular, random(6, 1, 20))
    assert (pivots.abs().amin(0) / singular.diagonal().amax(1)).max() < 1e-12


def test_matrices_of_three_equal_torch() -> None:
    a, b = random(3, 3, 100), random(3, 3, 100, seed=1)
    torch.testing.assert_close(la.det(a), torch.linalg.det(first(a)))
    torch.testing.assert_close(first(la.inverse3(a)), torch.linalg.inv(first(a)), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(first(la.matmul3(a, b)), first(a) @ first(b))
    torch.testing.assert_close(la.cross(a, b), torch.linalg.cross(a, b, dim=0))


def test_cayley_is_a_rotation_and_the_exponential_to_third_order() -> None:
    v = random(3, 200)
    for angle in (1e-3, 1e-2, 0.1):
        w = angle * v / v.norm(dim=0)
        r = first(la.cayley(w))
        torch.testing.assert_close(r @ r.mT, torch.eye(3, dtype=F64).expand_as(r), rtol=0, atol=1e-15)
        assert rotations.angle_between(r, rotations.exp(w.T)).max() < angle**3 / 11


def test_orthonormalise_removes_rounding() -> None:
    r = rotations.exp(random(50, 3))
    rough = (r + 1e-7 * random(50, 3, 3, seed=1)).permute(1, 2, 0)
    clean = first(la.orthonormalise(rough))
    torch.testing.assert_close(clean @ clean.mT, torch.eye(3, dtype=F64).expand_as(clean), rtol=0, atol=1e-15)
    assert rotations.angle_between(clean, r).max() < 1e-6


@pytest.mark.parametrize("function", [la.det, la.inverse3, la.cayley])
def test_gradients(function: object) -> None:
    assert callable(function)
    x = random(3, 2) if function is la.cayley else random(3, 3, 2)
    assert torch.autograd.gradcheck(function, x.requires_grad_())


def test_gradient_of_a_solution() -> None:
    def solve(root: Tensor, b: Tensor) -> Tensor:
        return la.solve_spd((root[:, None] * root[None]).sum(2) + torch.eye(4, dtype=F64)[..., None], b)[0]

    assert torch.autograd.gradcheck(solve, (random(4, 4, 2).requires_grad_(), random(4, 1, 2).requires_grad_()))
