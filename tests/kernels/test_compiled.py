"""Compiled functions against the same functions in eager mode."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchpose import ConfigError
from torchpose.kernels import LEAST, build, compiled, functions, has_compiler, mapped, padded, repeated, tracing
from torchpose.kernels.build import Kernel

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler (apt-get install g++)")
F32, F64 = torch.float32, torch.float64
AWKWARD = (0.0, 1.0, -1.0, 2.5, math.inf, -math.inf, math.nan)


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """One for the tests of this file, so that none depends on what was compiled before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "kernels"))
    build._folder.cache_clear()
    yield
    build._folder.cache_clear()


def numbers(*shape: int, dtype: torch.dtype = F64, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def awkward(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Every pair of `AWKWARD` numbers."""
    a, b = torch.meshgrid(*2 * [torch.tensor(AWKWARD, dtype=dtype)], indexing="ij")
    return a.flatten(), b.flatten()


ELEMENTWISE: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "sums": lambda a, b: (a + b, a - b, a + 2, 2 - a, -a, a - 0.5, torch.add(a, b, alpha=2)),
    "products": lambda a, b: (a * b, a.square(), 3 * a, torch.addcmul(a, a, b), torch.addcmul(a, a, b, value=-1)),
    "comparisons": lambda a, b: (a < b, a <= b, a > b, a >= b, a == b, a != b, a < 1, a == 0, a.isinf(), a.isfinite()),
    "truths": lambda a, b: ((a < b) & (a < 1), (a < b) | (b > 1), ~(a < b), (a < b).to(a) + 1),
    "choices": lambda a, b: (torch.where(a < b, a, b), torch.where(a < b, a, 0), torch.where(a > 0, torch.nan, b)),
    "bounds": lambda a, b: (
        torch.minimum(a, b),
        torch.maximum(a, b),
        a.clamp_min(0.5),
        a.clamp_max(0.5),
        a.clamp(-1, 1),
    ),
    "dtypes": lambda a, b: (a.float(), a.double(), a.float().double() * b, (a * 0 == 0).double()),
    "integers": lambda a, b: (
        torch.where(a < b, 3, torch.full_like(a, 2, dtype=torch.int64)) + (a < b),
        (a < b).long(),
    ),
}


@pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", ELEMENTWISE)
def test_operations_are_those_of_torch_whatever_the_number(name: str, dtype: torch.dtype) -> None:
    function, arguments = ELEMENTWISE[name], awkward(dtype)
    for ours, theirs in zip(compiled(function)(*arguments), function(*arguments), strict=True):
        assert ours.dtype == theirs.dtype
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0, equal_nan=True)


def test_divisions_and_roots_are_right_to_rounding() -> None:
    def function(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        return a / b, 1 / a, a / 3, (a * a).sqrt(), (b * b).rsqrt(), b.atan()

    for dtype in (F32, F64):
        a, b = numbers(100, dtype=dtype), numbers(100, dtype=dtype, seed=1)
        for ours, theirs in zip(compiled(function)(a, b), function(a, b), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=4 * torch.finfo(dtype).eps, atol=0)


SHAPES: dict[str, Callable[[Tensor], Any]] = {
    "sums": lambda a: (a.sum(0), a.sum((0, 1)), a.sum(1, keepdim=True), a.mean(0), a.mean((0, 1))),
    "extremes": lambda a: (a.amin(0), a.amax((0, 1)), (a > 0).all(0), (a > 1).any(1)),
    "views": lambda a: (a[1], a[:, 1:], a[None], a.transpose(0, 1), a.flatten(0, 1), a[:, None, -1], a[0:1].squeeze(0)),
    "joins": lambda a: (torch.cat([a, a[:1]]), torch.stack([a[0], a[1]], 1), torch.stack(a.unbind()), a.flip(1)),
    "parts": lambda a: (a.flatten(0, 1).split([5, 1, 6]), a.split(2), a.unbind(1), a.unflatten(1, (2, 2))),
    "new": lambda a: (
        torch.zeros_like(a),
        a.new_full((2, a.shape[-1]), 7),
        torch.ones_like(a[0]),
        a.expand(2, 3, 4, -1),
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_those_of_torch(name: str) -> None:
    function, a = SHAPES[name], numbers(3, 4, 19)
    ours, theirs = (torch.utils._pytree.tree_leaves(f(a)) for f in (compiled(function), function))
    for x, y in zip(ours, theirs, strict=True):
        assert x.shape == y.shape
        torch.testing.assert_close(x, y, rtol=1e-15, atol=1e-15)


def test_matrix_products_and_diagonals() -> None:
    def function(shared: Tensor, own: Tensor) -> tuple[Tensor, ...]:
        matrices = own.permute(2, 0, 1)
        diagonal = own.diagonal(dim1=0, dim2=1).movedim(-1, 0)
        return shared[..., 0] @ own.transpose(0, 1), diagonal, (matrices @ matrices).permute(1, 2, 0)

    shared, own = numbers(5, 3, 1), numbers(3, 3, 21)
    ours, theirs = compiled(function)(shared, own), function(shared, own)
    for x, y in zip(ours, theirs, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-14, atol=1e-14)


def test_the_batch_may_lie_anywhere_in_memory() -> None:
    for dtype in (F32, F64, torch.int64, torch.bool):
        a = (3 * numbers(20, 3)).to(dtype)
        for view in (a.T, a[::2].T, a.T.contiguous()[:, 3:], a.T.contiguous()[:2, 1:18]):
            torch.testing.assert_close(compiled(_chosen)(view), _chosen(view), rtol=0, atol=0)


def _chosen(a: Tensor) -> Tensor:
    return torch.where(a[1] > 0 if a.dtype != torch.bool else a[1], a[0], a[-1])


def test_writing_in_place_is_followed() -> None:
    def function(a: Tensor) -> Tensor:
        b = torch.empty_like(a)
        b[:] = 1
        b[1] = a[0]
        b[2:, 1] -= a[0, 2]
        b[:3].diagonal(dim1=0, dim2=1).mul_(2)
        torch.mul(a[0], a[1], out=b[3])
        b[-1, 0] = a[0, 0]
        b[0, 1:3].addcmul_(a[1, 0], a[1, 1:3])
        return b

    a = numbers(5, 4, 16)
    torch.testing.assert_close(compiled(function)(a), function(a), rtol=1e-15, atol=1e-15)


@settings(deadline=None, max_examples=30)
@given(batch=st.integers(LEAST, 700), threads=st.integers(1, 2))
def test_a_problem_depends_neither_on_its_batch_nor_on_threads(batch: int, threads: int) -> None:
    function = compiled(_mixed)
    shared, own, truth = numbers(3, 1, dtype=F32), numbers(3, 700), numbers(700) > 0
    whole = function(shared, own, truth)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        part = function(shared, own[:, -batch:].contiguous(), truth[-batch:].contiguous())
    finally:
        torch.set_num_threads(before)
    for x, y in zip(part, whole, strict=True):
        torch.testing.assert_close(x, y[..., -batch:], rtol=0, atol=0)
    for x, y in zip(whole, _mixed(shared, own, truth), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-14, atol=1e-14)


def _mixed(shared: Tensor, own: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    product = shared.double() * own
    return product.sum(0), torch.where(truth, own, 0 * own - 1), truth & (own[0] > 0)


class Pair(NamedTuple):
    first: Tensor
    second: tuple[Tensor, float]


@dataclasses.dataclass(frozen=True)
class Lens:
    matrix: Tensor
    name: str

    def __post_init__(self) -> None:
        assert bool(self.matrix.isfinite().all())  # cannot be said of what is traced


def test_arguments_and_results_are_arranged_as_they_are_in_python() -> None:
    def function(pair: Pair, lens: Lens, missing: Tensor | None) -> dict[str, Any]:
        scale = pair.second[1] * lens.matrix[0, 1]
        return {lens.name: Pair(pair.first * scale, (pair.second[0] + (0 if missing is None else missing), 1.0))[:1]}

    pair = Pair(numbers(8), (numbers(2, 8, seed=1), 3.0))
    for factor in (2.0, 5.0):  # one kernel for both: what the lens holds is not compiled in
        lens = Lens(torch.tensor([[0, factor]]), "left")
        result = compiled(function)(pair, lens, None)
        torch.testing.assert_close(result["left"][0], 3 * factor * pair.first)
    other = compiled(function)(
        pair._replace(second=(pair.second[0], 7.0)), Lens(torch.tensor([[0, 2.0]]), "right"), None
    )
    torch.testing.assert_close(other["right"][0], 14 * pair.first)


def test_numbers_are_no_reason_to_compile_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def counted(source: str) -> Kernel:
        made.append(source)
        return build.build(source)

    monkeypatch.setattr(functions, "build", counted)

    def function(pair: Pair, scale: float) -> Tensor:
        return torch.where(pair.first > scale, pair.second[1] * pair.first, pair.second[0])

    for dtype in (F32, F64):
        first, second = numbers(12, dtype=dtype), numbers(12, dtype=dtype, seed=1)
        for scale, factor in ((0.5, 2.0), (-0.5, 3.0), (0.0, math.inf)):
            args = Pair(first, (second, factor)), scale
            ours, theirs = compiled(function)(*args), function(*args)
            assert ours.dtype == theirs.dtype == dtype
            torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert len(made) == 2, "one for each dtype"


@pytest.mark.parametrize("by_problem", [False, True])
def test_results_are_written_where_the_caller_wants_them(by_problem: bool) -> None:
    def function(target: Tensor, count: Tensor, truth: Tensor, a: Tensor) -> None:
        truth.copy_(a > 0)
        for part, value in zip(target.split([1, 2]), (a[:1], 2 * a), strict=True):
            part.copy_(value)
        count.copy_(torch.where(a[0] > 0, 1, 0))

    table = torch.full((30, 5), -1.0, dtype=F64).T if by_problem else torch.full((5, 30), -1.0, dtype=F64)
    count, a = torch.full((30,), -1), numbers(2, 20)
    truth = torch.zeros(30, 2, dtype=torch.bool).T if by_problem else torch.zeros(2, 30, dtype=torch.bool)
    assert compiled(function)(table[1:4, 5:25], count[5:25], truth[:, 5:25], a) is None
    assert truth.view(torch.uint8)[:, 5:25].tolist() == (a > 0).int().tolist()
    expected = torch.full((5, 30), -1.0, dtype=F64)
    expected[1:4, 5:25] = torch.cat([a[:1], 2 * a])
    torch.testing.assert_close(table, expected, rtol=0, atol=0)
    assert count.tolist() == 5 * [-1] + (a[0] > 0).long().tolist() + 5 * [-1]


def test_rounds_are_made_until_every_problem_is_done() -> None:
    class State(NamedTuple):
        value: Tensor
        other: Tensor
        rounds: Tensor

    def halve(state: State, limit: Tensor) -> tuple[State, Tensor]:
        going = state.value > limit
        value = torch.where(going, 0.5 * state.value, state.value)
        other = torch.where(going, state.value, state.other)  # what it was before
        return State(value, other, state.rounds + going), value > limit

    value = (8 * numbers(1000).exp()).clamp_min(1.0)
    start = State(value, torch.zeros_like(value), torch.zeros(1000, dtype=torch.int64))
    end = repeated(halve)(100, start, torch.full((1,), 0.5, dtype=F64))
    expected = (value / 0.5).log2().ceil()
    torch.testing.assert_close(end.rounds, expected.long())
    torch.testing.assert_close(end.value, value * 0.5**expected, rtol=0, atol=0)
    torch.testing.assert_close(end.other, 2 * end.value, rtol=0, atol=0)
    few = repeated(halve)(3, start, torch.full((1,), 0.5, dtype=F64))
    torch.testing.assert_close(few.rounds, end.rounds.clamp_max(3))


def test_what_it_cannot_do_it_says() -> None:
    a = numbers(3, 16)
    with pytest.raises(NotImplementedError, match=r"aten\.cumsum"):
        compiled(lambda a: a.cumsum(0))(a)
    with pytest.raises(ValueError, match="cannot read the tensors that it writes"):
        compiled(lambda a: a[:1].mul_(2))(a)
    with pytest.raises(NotImplementedError, match="int32"):
        compiled(lambda a: a + 1)(a.int())
    with pytest.raises(ValueError, match=r"a tensor \(3, 9\) on cpu; expected \(..., 16\) or \(..., 1\) on the CPU"):
        compiled(lambda a, b: a + b[:, :1])(a, a[:, :9])
    with pytest.raises(ValueError, match=r"a tensor \(3, 16\) on meta"):
        compiled(lambda a: a + 1)(a.to("meta"))
    with pytest.raises(ValueError, match=f"5 problems; a compiled function needs {LEAST}"):
        compiled(lambda a: 2 * a)(numbers(3, 5))
    assert not tracing()


DENSE: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "solve": lambda a, b: (torch.linalg.solve(a, b), torch.linalg.solve_ex(a, b[..., 0]).result),
    "inverse": lambda a, b: (torch.linalg.inv(a), torch.linalg.inv_ex(a).inverse, a.det()),
    "eigh": lambda a, b: (
        torch.linalg.eigh(a + a.mT).eigenvalues,
        torch.linalg.eigh(a + a.mT).eigenvectors.abs(),
    ),
    "embedded": lambda a, b: (torch.diag_embed(b[..., 0]) @ a, torch.linalg.cross(b[:, :3, 0], b[:, :3, 1])),
    "angles": lambda a, b: (a.cos(), a.sin(), torch.atan2(a, a.mT), torch.hypot(a, a.mT), a.remainder(torch.pi)),
    "powers": lambda a, b: (a.abs() ** (1 / 3), a.sign(), a.square()),
}


@pytest.mark.parametrize("count", [1, 5, 8, 100])
@pytest.mark.parametrize("name", DENSE)
def test_problems_first_and_what_lapack_does(name: str, count: int) -> None:
    function = DENSE[name]
    matrices, right = numbers(count, 3, 3), numbers(count, 3, 2, seed=1)
    ours, theirs = mapped(function)(matrices, right), function(matrices, right)
    for x, y in zip(ours, theirs, strict=True):
        assert x.shape == y.shape
        torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-11)


def test_larger_systems_and_shared_arguments() -> None:
    root, shared = numbers(20, 7, 7), numbers(1, 7, 3)

    def function(root: Tensor, shared: Tensor, ridge: float) -> Tensor:
        return torch.linalg.solve(root @ root.mT + ridge * torch.eye(7), shared.expand(len(root), 7, 3))

    for ridge in (0.1, 1.0):
        torch.testing.assert_close(mapped(function)(root, shared, ridge), function(root, shared, ridge))


def test_eager_where_it_cannot_be_compiled(monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder) -> None:
    a = numbers(4, 3)

    def sorted_rows(a: Tensor) -> Tensor:
        return a.sort(1).values

    def by_number(a: Tensor) -> Tensor:
        return a if bool((a > 0).any()) else -a

    def doubled(a: Tensor) -> Tensor:
        return 2 * a

    for function, why in ((sorted_rows, r"aten\.sort"), (by_number, "a look at numbers")):
        with pytest.warns(UserWarning, match=f"{function.__name__} is not compiled: {why}"):
            torch.testing.assert_close(mapped(function)(a), function(a))
        torch.testing.assert_close(mapped(function)(a), function(a))
    with pytest.warns(UserWarning, match="doubled is not compiled: a tensor is on meta"):
        assert mapped(doubled)(a.to("meta")).shape == a.shape
    assert mapped(doubled)(a[:0]).shape == (0, 3)
    leaf = a.clone().requires_grad_()
    mapped(doubled)(leaf).sum().backward()
    assert leaf.grad is not None
    torch.testing.assert_close(mapped(doubled)(a), 2 * a)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    mapped.cache_clear()
    with pytest.warns(UserWarning, match=r"doubled is not compiled: needs a C\+\+ compiler"):
        torch.testing.assert_close(mapped(doubled)(a), 2 * a)
    mapped.cache_clear()
    assert not recwarn.list, "each is said once"


def test_threads_may_compile_and_run_at_the_same_time() -> None:
    function = compiled(lambda a: (a * 3.5).sum(0))
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda n: (n, function(numbers(n, 600))), (2, 3, 4, 5, 2, 3, 4, 5)))
    for n, result in results:
        torch.testing.assert_close(result, (numbers(n, 600) * 3.5).sum(0))


def test_lists_of_problems_are_filled_up() -> None:
    assert padded(torch.tensor([4, 2])).tolist() == [4, 2] + (LEAST - 2) * [4]
    assert padded(torch.arange(20)).tolist() == list(range(20))
    assert padded(torch.tensor([], dtype=torch.int64)).tolist() == []


def test_a_compiler_that_fails_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "broken-g++"
    broken.write_text("#!/bin/sh\necho 'kernel.cpp:1:1: error: no such thing as a vector' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    with pytest.raises(
        ConfigError, match=r"compile: .*broken-g\+\+ failed: .*no such thing as a vector; use compile=False"
    ):
        compiled(lambda a: a + 11)(numbers(16))


def test_what_was_compiled_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    run = subprocess.run

    def count(command: list[str], **options: Any) -> Any:
        calls.append(command)
        return run(command, **options)

    torch.testing.assert_close(compiled(lambda a: a - 17)(numbers(16)), numbers(16) - 17)
    monkeypatch.setattr(subprocess, "run", count)
    torch.testing.assert_close(compiled(lambda b: b - 17)(numbers(16)), numbers(16) - 17)  # another, with the same code
    assert calls == []


def test_what_was_cut_short_is_compiled_again_and_a_full_disk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def plain(a: Tensor) -> Tensor:
        return a - 19

    compiled(plain)(numbers(16))
    before = set(build._folder().glob("*.so"))
    for library in before:
        library.unlink()
        library.write_bytes(b"\x7fELF")
    torch.testing.assert_close(compiled(lambda a: a - 19)(numbers(16)), numbers(16) - 19)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(ConfigError, match=r"compile: .*\.so: No space left on device; make room or use compile=False"):
        compiled(lambda a: a - 23)(numbers(16))


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code = """
import torch
from torchpose.kernels import compiled
print(compiled(lambda a: a + 1)(torch.zeros(9)).sum().item())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "file")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "9.0"
