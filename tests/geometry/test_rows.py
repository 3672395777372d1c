"""Tensor rows beside the operations done field by field."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from torchpose.geometry.rows import Rows, shared


@dataclass(frozen=True, eq=False)
class Inner(Rows):
    values: Tensor


@dataclass(frozen=True, eq=False)
class Outer(Rows):
    number: Tensor
    inner: Inner
    planes: tuple[Tensor, Tensor]
    matrix: Tensor = shared()
    extra: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Named(Rows):
    values: Tensor
    names: tuple[str, ...] = shared()


MATRIX = torch.eye(3)


def rows(count: int, start: int = 0) -> Outer:
    number = torch.arange(start, start + count)
    return Outer(number, Inner(number * 1.5), (number.double(), number[:, None].expand(-1, 2) + 0.5), MATRIX)


def same(a: Outer, b: Outer) -> bool:
    pairs = [(a.number, b.number), (a.inner.values, b.inner.values), *zip(a.planes, b.planes, strict=True)]
    return all(torch.equal(x, y) and x.dtype == y.dtype for x, y in pairs) and a.extra is b.extra


@pytest.mark.parametrize("index", [torch.tensor([2, 0]), slice(1, 3), torch.tensor([True, False, True, False])])
def test_rows_are_selected(index: Tensor | slice) -> None:
    some, number = rows(4)[index], torch.arange(4)[index]
    assert torch.equal(some.number, number)
    assert torch.equal(some.inner.values, number * 1.5)
    assert torch.equal(some.planes[1], number[:, None].expand(-1, 2) + 0.5)
    assert some.matrix is MATRIX
    assert len(some) == len(number)


def test_parts_join_in_order() -> None:
    assert same(Outer.cat([rows(2), rows(0), rows(3, 2)]), rows(5))


def test_parts_of_different_wholes_do_not_join() -> None:
    other = replace(rows(1), matrix=torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"Outer\.matrix"):
        Outer.cat([rows(1), other])


def test_rows_are_replaced_and_chosen() -> None:
    index = torch.tensor([3, 1])
    replaced = rows(4).replaced(index, rows(4, 10)[:2])
    assert replaced.number.tolist() == [0, 11, 2, 10]
    assert replaced.planes[1][:, 0].tolist() == [0.5, 11.5, 2.5, 10.5]
    chosen = rows(3).where(torch.tensor([True, False, True]), rows(3, 10))
    assert chosen.number.tolist() == [0, 11, 2]
    assert chosen.inner.values.tolist() == [0.0, 16.5, 3.0]


def test_integers_keep_their_type() -> None:
    moved = rows(3).to(torch.float32)
    assert moved.number.dtype == torch.int64
    assert moved.planes[0].dtype == torch.float32
    assert moved.matrix.dtype == torch.float32
    assert rows(2).to("meta").number.device.type == "meta"
    assert Named(torch.arange(2), ("a", "b")).to("meta").names == ("a", "b")


def test_rows_are_copied_and_pickled() -> None:
    for again in (copy.deepcopy(rows(3)), pickle.loads(pickle.dumps(rows(3)))):
        assert same(again, rows(3))
