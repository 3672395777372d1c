"""Tables that are kept, and what stands for `torch.where` and `torch.isfinite`: the same answers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchpose.geometry.constants import constant, either, eye, finite, numbers

F64 = torch.float64
AWKWARD = torch.tensor([[1.0, -2, 3], [math.nan, 0, 1], [math.inf, -math.inf, 0], [0, 0, math.inf]], dtype=F64)


def test_constants_are_made_once_for_each_kind() -> None:
    like, table = torch.zeros(2, dtype=F64), ((1.0, 2.0), (3.0, 4.5))
    made = constant(table, like)
    assert torch.equal(made, torch.tensor([[1.0, 2], [3, 4.5]], dtype=F64))
    assert constant(table, like) is made
    assert constant(((1.0, 2.0), (3.0, 4.5 * len(like) / 2)), like) is made  # the same numbers, written elsewhere
    assert constant(table, like.float()).dtype == torch.float32
    assert torch.equal(constant((3, 1), like, torch.int64), torch.tensor([3, 1]))
    assert torch.equal(eye(3, like, 2.0), 2 * torch.eye(3, dtype=F64))


def test_constants_made_in_inference_mode_serve_autograd() -> None:
    with torch.inference_mode():
        made = constant((5.0, 7.0), torch.zeros((), dtype=F64))
    x = torch.ones(2, dtype=F64, requires_grad=True)
    (x * made).square().sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad, 2 * made.square())


def test_constants_within_transforms_of_functions_leave_nothing_behind() -> None:
    def cube(x: Tensor) -> Tensor:
        return (x**3 * constant((2.0, 0.25), x)).sum()

    at = torch.tensor([1.0, 2.0], dtype=F64)
    assert torch.equal(torch.func.grad(cube)(at), torch.tensor([6.0, 3.0], dtype=F64))
    assert torch.equal(cube(at), torch.tensor(4.0, dtype=F64))


@pytest.mark.parametrize("value", [0.0, torch.nan, -torch.inf, 3])
@pytest.mark.parametrize("values", [AWKWARD, AWKWARD.float(), torch.arange(12).view(4, 3)], ids=["f64", "f32", "int"])
def test_either_is_where(values: Tensor, value: float) -> None:
    condition = torch.tensor([[True], [False], [True], [False]])
    for one, other in ((values, value), (value, values), (values, values + 1), (4, 7), (0.5, 2.0)):
        wanted = torch.where(condition, one, other)
        found = either(condition, one, other)
        assert found.dtype == wanted.dtype
        assert torch.equal(found.nan_to_num(nan=-9.0), wanted.nan_to_num(nan=-9.0))


def test_what_are_numbers() -> None:
    assert torch.equal(numbers(AWKWARD), AWKWARD.isfinite())
    assert torch.equal(finite(AWKWARD, 1), AWKWARD.isfinite().all(1))
    assert torch.equal(finite(AWKWARD, (0, 1)), torch.tensor(False))
    assert torch.equal(finite(AWKWARD, 1, keepdim=True), AWKWARD.isfinite().all(1, keepdim=True))
