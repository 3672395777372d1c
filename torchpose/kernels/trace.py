"""From a function of tensors to a `Program` for one problem of its batch.

The function is traced once by torch's own tracer, with a batch of one; what it calls is a few dozen operations, each of
them a few lines here. Tensors become arrays of numbers, so that views and concatenations are NumPy's and leave nothing
behind, and matrix products and sums come down to their terms.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import Interpreter
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._pytree import TreeSpec, tree_flatten

from torchpose.kernels.program import Array, Program, Rows

_aten = torch.ops.aten


def trace(
    function: Callable[..., Any], inputs: Sequence[Rows], state: int = 0
) -> tuple[Program, list[Rows], TreeSpec | None]:
    """The program of a function of tensors (..., B), its results and how it arranges them.

    Where the first inputs are a ``state``, the function is one round of a loop: it returns the next state, and which
    problems go on; the results are the state in the end.

    Raises:
        NotImplementedError: the function does what no lines here are for.
    """
    examples = [torch.empty((*rows.shape, 1), dtype=rows.dtype) for rows in inputs]
    structures: list[TreeSpec | None] = []

    def flat(*tensors: Tensor) -> list[Tensor]:
        result = function(*tensors)
        leaves, structure = ([], None) if result is None else tree_flatten(result)
        structures.append(structure)
        return leaves

    with torch.inference_mode(False), torch.no_grad():
        graph = make_fx(torch.func.functionalize(flat, remove="mutations"), tracing_mode="fake")(*examples)
    program = Program()
    arrays = [program.input(rows) for rows in inputs]
    results = _Translator(graph, program).run(*arrays)
    if state:
        *after, going = results
        return program, program.repeat(arrays[:state], after, going), structures[0]
    return program, [program.output(array) for array in results], structures[0]


class _Translator(Interpreter):
    """Runs the graph on arrays of numbers."""

    def __init__(self, graph: torch.fx.GraphModule, program: Program) -> None:
        super().__init__(graph)
        self._program = program
        self._placeholders = [node for node in graph.graph.nodes if node.op == "placeholder"]
        self._node: torch.fx.Node | None = None

    def run_node(self, n: torch.fx.Node) -> Any:
        self._node = n
        return super().run_node(n)

    def get_attr(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Array:
        """A tensor that the function holds of itself."""
        value: Tensor = super().get_attr(target, args, kwargs)
        numbers = [self._program.constant(v, value.dtype) for v in value.flatten().tolist()]
        return Array(np.array(numbers, int).reshape(value.shape), value.dtype)

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        assert self._node is not None
        if target is _aten.copy_.default:  # functionalized, only what the function was given is left to be changed
            array = self._program.array(args[1], args[0].dtype)
            self._program.write(array, self._placeholders.index(self._node.args[0]))
            return array
        if target is operator.getitem:
            return args[0][args[1]]
        if target in _EACH:
            return _each(self._program, self._node.meta["val"], _EACH[target], *args, **kwargs)
        if target not in _OPERATIONS:
            raise NotImplementedError(f"{target} in a compiled function")
        return _OPERATIONS[target](self._program, self._node.meta.get("val"), *args, **kwargs)


# operations on every element, of operands in the dtype of the result
_EACH = {
    _aten.neg.default: "-{}",
    _aten.abs.default: "magnitude({})",
    _aten.sqrt.default: "root({})",
    _aten.atan.default: "arctangent({})",
    _aten.add.Tensor: "{} + {}",
    _aten.sub.Tensor: "{} - {}",
    _aten.mul.Tensor: "{} * {}",
    _aten.rsub.Scalar: "{1} - {0}",
    _aten.minimum.default: "least({}, {})",
    _aten.maximum.default: "most({}, {})",
    _aten.clamp_min.default: "most({}, {})",
    _aten.clamp_max.default: "least({}, {})",
    _aten.bitwise_and.Tensor: "{} & {}",
    _aten.bitwise_or.Tensor: "{} | {}",
    _aten.bitwise_not.default: "~{}",
    _aten.logical_and.default: "{} & {}",
    _aten.logical_not.default: "~{}",
}
_Operation = Callable[..., Any]
_OPERATIONS: dict[Any, _Operation] = {}


def _of(*targets: Any) -> Callable[[_Operation], _Operation]:
    def register(operation: _Operation) -> _Operation:
        _OPERATIONS.update(dict.fromkeys(targets, operation))
        return operation

    return register


def _each(program: Program, like: Tensor, text: str, *operands: Any, alpha: int = 1) -> Array:
    if alpha != 1:
        raise NotImplementedError("a factor in a sum of a compiled function")
    return program.each(text, like.dtype, *(program.array(v, like.dtype) for v in operands))


def _compare(name: str) -> _Operation:
    def compare(program: Program, like: Tensor, *operands: Any) -> Array:
        examples = [torch.empty([1] * v.numbers.ndim, dtype=v.dtype) if isinstance(v, Array) else v for v in operands]
        dtype = torch.result_type(*examples)
        if dtype == torch.bool:
            raise NotImplementedError("comparing truths in a compiled function")
        return program.each(name + "({}, {})", torch.bool, *(program.array(v, dtype) for v in operands))

    return compare


for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    for _kind in ("Tensor", "Scalar"):
        _OPERATIONS[getattr(getattr(_aten, _name), _kind)] = _compare(_name)


@_of(_aten.reciprocal.default)
def _reciprocal(program: Program, like: Tensor, a: Array) -> Array:
    return _each(program, like, "{} / {}", 1, a)


@_of(_aten.div.Tensor)
def _divide(program: Program, like: Tensor, a: Any, b: Any) -> Array:
    """By one reciprocal for all that is divided by a number: a division takes as long as a dozen products."""
    return _each(program, like, "{} * {}", a, _each(program, like, "{} / {}", 1, b))


@_of(_aten.rsqrt.default)
def _inverse_root(program: Program, like: Tensor, a: Array) -> Array:
    return _reciprocal(program, like, _each(program, like, "root({})", a))


@_of(_aten.pow.Tensor_Scalar)
def _square(program: Program, like: Tensor, a: Array, exponent: float) -> Array:
    if exponent != 2:
        raise NotImplementedError(f"power {exponent} in a compiled function")
    return _each(program, like, "{} * {}", a, a)


@_of(_aten.addcmul.default)
def _add_product(program: Program, like: Tensor, a: Array, b: Array, c: Array, *, value: float = 1) -> Array:
    if value not in (1, -1):
        raise NotImplementedError(f"factor {value} in a compiled function")
    return _each(program, like, "{} + {}" if value == 1 else "{} - {}", a, _each(program, like, "{} * {}", b, c))


@_of(_aten.where.self)
def _where(program: Program, like: Tensor, condition: Array, a: Any, b: Any) -> Array:
    a, b = (program.array(v, like.dtype) for v in (a, b))
    return program.each("select({}, {}, {})", like.dtype, condition, a, b)


@_of(_aten.clamp.default)
def _clamp(program: Program, like: Tensor, a: Array, low: float | None = None, high: float | None = None) -> Array:
    a = a if low is None else _each(program, like, "most({}, {})", a, low)
    return a if high is None else _each(program, like, "least({}, {})", a, high)


@_of(_aten.isinf.default)
def _isinf(program: Program, like: Tensor, a: Array) -> Array:
    ends = [program.each("eq({}, {})", torch.bool, a, program.array(v, a.dtype)) for v in (torch.inf, -torch.inf)]
    return program.each("{} | {}", torch.bool, *ends)


@_of(_aten.sum.dim_IntList)
def _sum(program: Program, like: Tensor, a: Array, dims: Sequence[int], keep: bool = False) -> Array:
    return program.fold("{} + {}", program.array(a, like.dtype), dims, keep)


@_of(_aten.mean.dim)
def _mean(program: Program, like: Tensor, a: Array, dims: Sequence[int], keep: bool = False) -> Array:
    total = program.fold("{} + {}", a, dims, keep)
    return _divide(program, like, total, a.numbers.size // total.numbers.size)


@_of(_aten.amin.default)
def _amin(program: Program, like: Tensor, a: Array, dims: Sequence[int], keep: bool = False) -> Array:
    return program.fold("least({}, {})", a, dims, keep)


@_of(_aten.amax.default)
def _amax(program: Program, like: Tensor, a: Array, dims: Sequence[int], keep: bool = False) -> Array:
    return program.fold("most({}, {})", a, dims, keep)


@_of(_aten.all.dim)
def _all(program: Program, like: Tensor, a: Array, dim: int, keep: bool = False) -> Array:
    return program.fold("{} & {}", a, (dim,), keep)


@_of(_aten.any.dim)
def _any(program: Program, like: Tensor, a: Array, dim: int, keep: bool = False) -> Array:
    return program.fold("{} | {}", a, (dim,), keep)


@_of(_aten.mm.default, _aten.bmm.default)
def _matmul(program: Program, like: Tensor, a: Array, b: Array) -> Array:
    left, right = a.numbers[..., :, :, None], b.numbers[..., None, :, :]
    return program.fold("{} + {}", _each(program, like, "{} * {}", Array(left, a.dtype), Array(right, b.dtype)), (-2,))


@_of(_aten._to_copy.default)
def _convert(program: Program, like: Tensor, a: Array, **_: Any) -> Array:
    return program.array(a, like.dtype)


@_of(_aten.clone.default, _aten.detach.default, _aten.alias.default, _aten.lift_fresh_copy.default)
def _same(program: Program, like: Tensor, a: Array, **_: Any) -> Array:
    return a


def _full(program: Program, like: Tensor, value: float) -> Array:
    return Array(np.full(like.shape, program.constant(value, like.dtype)), like.dtype)


@_of(_aten.zeros_like.default, _aten.empty_like.default, _aten.empty.memory_format, _aten.zeros.default)
def _zeros(program: Program, like: Tensor, *_: Any, **__: Any) -> Array:
    return _full(program, like, 0)


@_of(_aten.ones_like.default, _aten.ones.default)
def _ones(program: Program, like: Tensor, *_: Any, **__: Any) -> Array:
    return _full(program, like, 1)


@_of(_aten.full_like.default, _aten.full.default)
def _filled(program: Program, like: Tensor, _: Any, value: float, **__: Any) -> Array:
    return _full(program, like, value)


@_of(_aten.new_full.default)
def _new_full(program: Program, like: Tensor, _: Any, __: Any, value: float, **___: Any) -> Array:
    return _full(program, like, value)


@_of(_aten.scalar_tensor.default)
def _scalar(program: Program, like: Tensor, value: float, **_: Any) -> Array:
    return _full(program, like, value)


@_of(_aten.stack.default)
def _stack(program: Program, like: Tensor, arrays: Sequence[Array], dim: int = 0) -> Array:
    return Array(np.stack([program.array(a, like.dtype).numbers for a in arrays], dim), like.dtype)


@_of(_aten.cat.default)
def _cat(program: Program, like: Tensor, arrays: Sequence[Array], dim: int = 0) -> Array:
    return Array(np.concatenate([program.array(a, like.dtype).numbers for a in arrays], dim), like.dtype)


@_of(_aten.view.default, _aten._unsafe_view.default, _aten.unsqueeze.default, _aten.squeeze.dim, _aten.squeeze.dims)
def _view(program: Program, like: Tensor, a: Array, *_: Any) -> Array:
    return Array(a.numbers.reshape(like.shape), a.dtype)


@_of(_aten.expand.default)
def _expand(program: Program, like: Tensor, a: Array, *_: Any) -> Array:
    return Array(np.broadcast_to(a.numbers, like.shape), a.dtype)


@_of(_aten.transpose.int)
def _transpose(program: Program, like: Tensor, a: Array, first: int, second: int) -> Array:
    return Array(np.swapaxes(a.numbers, first, second), a.dtype)


@_of(_aten.t.default)
def _t(program: Program, like: Tensor, a: Array) -> Array:
    return Array(a.numbers.T, a.dtype)


@_of(_aten.permute.default)
def _permute(program: Program, like: Tensor, a: Array, dims: Sequence[int]) -> Array:
    return Array(np.transpose(a.numbers, dims), a.dtype)


def _part(ndim: int, dim: int, part: int | slice) -> tuple[int | slice, ...]:
    index: list[int | slice] = [slice(None)] * ndim
    index[dim] = part
    return tuple(index)


@_of(_aten.select.int)
def _select(program: Program, like: Tensor, a: Array, dim: int, index: int) -> Array:
    return Array(np.asarray(a.numbers[_part(a.numbers.ndim, dim, index)]), a.dtype)


@_of(_aten.slice.Tensor)
def _slice(program: Program, like: Tensor, a: Array, dim: int = 0, *part: int) -> Array:
    return Array(a.numbers[_part(a.numbers.ndim, dim, slice(*part))], a.dtype)


@_of(_aten.unbind.int)
def _unbind(program: Program, like: Sequence[Tensor], a: Array, dim: int = 0) -> list[Array]:
    return [Array(np.asarray(part), a.dtype) for part in np.moveaxis(a.numbers, dim, 0)]


@_of(_aten.split_with_sizes.default)
def _split(program: Program, like: Sequence[Tensor], a: Array, sizes: Sequence[int], dim: int = 0) -> list[Array]:
    return [Array(part, a.dtype) for part in np.split(a.numbers, np.cumsum(sizes)[:-1], dim)]


@_of(_aten.split.Tensor)
def _split_evenly(program: Program, like: Sequence[Tensor], a: Array, size: int, dim: int = 0) -> list[Array]:
    return [Array(part, a.dtype) for part in np.split(a.numbers, range(size, a.numbers.shape[dim], size), dim)]


@_of(_aten.constant_pad_nd.default)
def _pad(program: Program, like: Tensor, a: Array, widths: Sequence[int], value: float = 0) -> Array:
    pairs = [(0, 0)] * (a.numbers.ndim - len(widths) // 2) + list(zip(widths[::2], widths[1::2], strict=True))[::-1]
    return Array(np.pad(a.numbers, pairs, constant_values=program.constant(value, a.dtype)), a.dtype)


@_of(_aten.diagonal.default)
def _diagonal(program: Program, like: Tensor, a: Array, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Array:
    return Array(np.diagonal(a.numbers, offset, dim1, dim2), a.dtype)


@_of(_aten.copy.default, _aten.fill.Tensor)
def _copy(program: Program, like: Tensor, a: Array, b: Array) -> Array:
    return Array(np.broadcast_to(program.array(b, a.dtype).numbers, like.shape), a.dtype)


def _scatter(program: Program, a: Array, view: Callable[[np.ndarray], np.ndarray], b: Array) -> Array:
    """What writing to a view of a tensor makes of it."""
    numbers = a.numbers.copy()
    view(numbers)[...] = program.array(b, a.dtype).numbers
    return Array(numbers, a.dtype)


@_of(_aten.select_scatter.default)
def _select_scatter(program: Program, like: Tensor, a: Array, b: Array, dim: int, index: int) -> Array:
    return _scatter(program, a, lambda n: n[_part(n.ndim, dim, slice(index, index + 1 or None))].squeeze(dim), b)


@_of(_aten.slice_scatter.default)
def _slice_scatter(program: Program, like: Tensor, a: Array, b: Array, dim: int = 0, *part: int) -> Array:
    return _scatter(program, a, lambda n: n[_part(n.ndim, dim, slice(*part))], b)


@_of(_aten.diagonal_scatter.default)
def _diagonal_scatter(
    program: Program, like: Tensor, a: Array, b: Array, offset: int = 0, dim1: int = 0, dim2: int = 1
) -> Array:
    def view(numbers: np.ndarray) -> np.ndarray:
        diagonal = np.diagonal(numbers, offset, dim1, dim2)
        diagonal.flags.writeable = True
        return diagonal

    return _scatter(program, a, view, b)
