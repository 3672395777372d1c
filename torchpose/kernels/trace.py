"""From a function of tensors to a `Program` for one problem of its batch.

The function is traced once by torch's own tracer, with a batch of one; what it calls is a few dozen operations, each of
them a line or a few here. Tensors become arrays of numbers, so that views and concatenations are torch's own on arrays
of indices and leave nothing behind, and matrix products and sums come down to their terms. What LAPACK does for torch
is done by `geometry.small_linalg`.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import Interpreter
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import GuardOnDataDependentSymNode
from torch.utils._pytree import TreeSpec, tree_flatten, tree_leaves, tree_map

from torchpose.geometry import small_linalg
from torchpose.kernels.program import Array, Layout, Program

_aten = torch.ops.aten


def trace(
    function: Callable[..., Any], inputs: Sequence[Layout], state: int = 0
) -> tuple[Program, list[Layout], TreeSpec | None]:
    """The program of a function of tensors (..., B), its results and how it arranges them.

    Where the first inputs are a ``state``, the function is one round of a loop: it returns the next state, and which
    problems go on; the results are the state in the end.

    Raises:
        NotImplementedError: the function looks at numbers, or does what no lines here are for.
    """
    structures: list[TreeSpec | None] = []

    def flat(*tensors: Tensor) -> list[Tensor]:
        result = function(*tensors)
        leaves, structure = ([], None) if result is None else tree_flatten(result)
        structures.append(structure)
        return leaves

    with torch.inference_mode(False), torch.no_grad():
        examples = [torch.empty((*layout.shape, 1), dtype=layout.dtype) for layout in inputs]
        whole = torch.func.functionalize(flat, remove="mutations")
        try:
            graph = make_fx(whole, decomposition_table=_DECOMPOSED, tracing_mode="fake")(*examples)
        except GuardOnDataDependentSymNode as error:
            raise NotImplementedError("a look at numbers in a compiled function") from error
    graph.graph.eliminate_dead_code()
    program = Program()
    arrays = [program.input(layout) for layout in inputs]
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
        return self._constant(super().get_attr(target, args, kwargs))

    def _constant(self, value: Tensor) -> Array:
        numbers = [self._program.constant(v, value.dtype) for v in value.flatten().tolist()]
        return Array(torch.tensor(numbers, dtype=torch.int64).view(value.shape), value.dtype)

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        assert self._node is not None
        program = self._program
        if target is operator.getitem:
            return args[0][args[1]]
        if target is _aten.copy_.default:  # functionalized, only what the function was given is left to be changed
            array = program.array(args[1], args[0].dtype)
            program.write(array, self._placeholders.index(self._node.args[0]))
            return array
        like: Any = self._node.meta["val"]
        if target in _FILLS:
            value = _FILLS[target]
            return self._constant(torch.full(like.shape, args[-1] if value is None else value, dtype=like.dtype))
        if not any(isinstance(v, Array) for v in tree_leaves((args, kwargs))):
            return self._constant(target(*args, **kwargs))
        if target in _MOVES:
            return _move(program, like, _MOVES[target], args, kwargs)
        if target in _EACH:
            return _each(program, like, _EACH[target], *args, **kwargs)
        if target in _FOLDS:
            array, *rest = program.array(args[0], like.dtype), *args[1:], ()
            return program.fold(_FOLDS[target], array, rest[0], like.shape)
        if target not in _OPERATIONS:
            raise NotImplementedError(f"{target} in a compiled function")
        return _OPERATIONS[target](program, like, *args, **kwargs)


def _move(program: Program, like: Any, move: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    """An operation that puts elements elsewhere, done to their numbers."""
    dtype = (like if isinstance(like, Tensor) else like[0]).dtype
    moved = tree_map(lambda v: program.array(v, dtype).numbers if isinstance(v, Array) else v, (args, kwargs))
    return tree_map(lambda numbers: Array(numbers, dtype), move(*moved[0], **moved[1]))


def _each(program: Program, like: Tensor, text: str, *operands: Any, alpha: int = 1) -> Array:
    if alpha != 1:
        operands = (*operands[:-1], _each(program, like, "{} * {}", operands[-1], alpha))
    return program.each(text, like.dtype, *(program.array(v, like.dtype) for v in operands))


def _compare(name: str) -> Callable[..., Array]:
    def compare(program: Program, like: Tensor, *operands: Any) -> Array:
        examples = [torch.empty([1] * v.numbers.ndim, dtype=v.dtype) if isinstance(v, Array) else v for v in operands]
        dtype = torch.result_type(*examples)
        if dtype == torch.bool:
            raise NotImplementedError("comparing truths in a compiled function")
        return program.each(name + "({}, {})", torch.bool, *(program.array(v, dtype) for v in operands))

    return compare


def _divide(program: Program, like: Tensor, above: Any, below: Any) -> Array:
    """By one reciprocal for all that is divided by a number: a division takes as long as a dozen products."""
    return _each(program, like, "{} * {}", above, _each(program, like, "inverse({})", below))


def _where(program: Program, like: Tensor, condition: Array, yes: Any, no: Any) -> Array:
    return program.each("select({}, {}, {})", like.dtype, condition, *(program.array(v, like.dtype) for v in (yes, no)))


def _pad(program: Program, like: Tensor, array: Array, widths: Sequence[int], value: float = 0) -> Array:
    return Array(_aten.constant_pad_nd(array.numbers, widths, program.constant(value, array.dtype)), array.dtype)


# operations that put elements elsewhere, or nowhere
_MOVES: dict[Any, Callable[..., Any]] = {
    **{operation: lambda numbers, **_: numbers for operation in (
        _aten.clone.default, _aten.detach.default, _aten.alias.default, _aten.lift_fresh_copy.default,
        _aten._to_copy.default,
    )},
    **{operation: operation for operation in (
        _aten.expand.default, _aten.permute.default, _aten.transpose.int, _aten.t.default, _aten.diagonal.default,
        _aten.unsqueeze.default, _aten.squeeze.dim, _aten.squeeze.dims, _aten.select.int, _aten.slice.Tensor,
        _aten.unbind.int, _aten.split.Tensor, _aten.split_with_sizes.default, _aten.stack.default, _aten.cat.default,
        _aten.select_scatter.default, _aten.slice_scatter.default, _aten.diagonal_scatter.default,
        _aten.copy.default, _aten.fill.Tensor, _aten.flip.default,
    )},
    _aten.view.default: torch.reshape,
    _aten._unsafe_view.default: torch.reshape,
}  # fmt: skip
# tensors of one number; None: of the last argument
_FILLS = {
    **dict.fromkeys((_aten.zeros_like.default, _aten.empty_like.default, _aten.empty.memory_format), 0),
    _aten.ones_like.default: 1,
    **dict.fromkeys((_aten.full_like.default, _aten.new_full.default), None),
}
# operations on every element, of operands in the dtype of the result
_EACH = {
    _aten.neg.default: "-{}",
    _aten.abs.default: "magnitude({})",
    _aten.sqrt.default: "root({})",
    _aten.reciprocal.default: "inverse({})",
    _aten.rsqrt.default: "inverse(root({}))",
    _aten.atan.default: "arctangent({})",
    _aten.cos.default: "cosine({})",
    _aten.sin.default: "sine({})",
    _aten.atan2.default: "angle({}, {})",
    _aten.hypot.default: "length({}, {})",
    _aten.pow.Tensor_Tensor: "power({}, {})",
    _aten.remainder.Scalar: "modulo({}, {})",
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
# operations along dimensions
_FOLDS = {
    _aten.sum.dim_IntList: "{} + {}",
    _aten.amin.default: "least({}, {})",
    _aten.amax.default: "most({}, {})",
    _aten.all.dim: "{} & {}",
    _aten.any.dim: "{} | {}",
}
_OPERATIONS: dict[Any, Callable[..., Array]] = {
    _aten.div.Tensor: _divide,
    _aten.where.self: _where,
    _aten.constant_pad_nd.default: _pad,
    **{
        getattr(getattr(_aten, name), kind): _compare(name)
        for name in ("eq", "ne", "lt", "le", "gt", "ge")
        for kind in ("Tensor", "Scalar")
    },
}


def _mean(x: Tensor, dims: Sequence[int], keep: bool = False) -> Tensor:
    total = x.sum(list(dims), keep)
    return total / (x.numel() // total.numel())


def _clamp(x: Tensor, low: float | None = None, high: float | None = None) -> Tensor:
    x = x if low is None else x.clamp_min(low)
    return x if high is None else x.clamp_max(high)


def _matmul(left: Tensor, right: Tensor) -> Tensor:
    return (left[..., :, :, None] * right[..., None, :, :]).sum(-2)


def _solve(matrix: Tensor, right: Tensor, **_: Any) -> tuple[Tensor, ...]:
    vector = right.ndim < matrix.ndim
    x = small_linalg.solve(_first(matrix), _first(right[..., None] if vector else right)).movedim((0, 1), (-2, -1))
    return x.squeeze(-1) if vector else x, matrix, *_unused(matrix)


def _inverse(matrix: Tensor, **_: Any) -> tuple[Tensor, ...]:
    solved = _solve(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype).expand_as(matrix))
    return solved[0], solved[3]


def _det(matrix: Tensor) -> tuple[Tensor, ...]:
    return small_linalg.det(_first(matrix)), matrix, _unused(matrix)[0]


def _unused(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """LAPACK's pivots and codes."""
    pivots = matrix.new_zeros(matrix.shape[:-1], dtype=torch.int32)
    return pivots, pivots[..., 0]


def _eigh(matrix: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    values, vectors = small_linalg.eigh(_first(matrix))
    return values.movedim(0, -1), vectors.movedim((0, 1), (-2, -1))


def _cross(x: Tensor, y: Tensor, *, dim: int = -1) -> Tensor:
    return small_linalg.cross(x.movedim(dim, 0), y.movedim(dim, 0)).movedim(0, dim)


def _first(matrices: Tensor) -> Tensor:
    return matrices.movedim((-2, -1), (0, 1))


# what comes down to the operations above, LAPACK's among it; a singular matrix is no error here
_DECOMPOSED: dict[Any, Callable[..., Any]] = {
    _aten.addcmul.default: lambda x, y, z, *, value=1: (
        x - y * z if value == -1 else x + (y if value == 1 else value * y) * z
    ),
    _aten.pow.Tensor_Scalar: lambda x, exponent: x * x if exponent == 2 else x.pow(torch.full_like(x, exponent)),
    _aten.sign.default: lambda x: (x > 0).to(x.dtype) - (x < 0).to(x.dtype),
    _aten.isinf.default: lambda x: x.abs() == torch.inf,
    _aten.clamp.default: _clamp,
    _aten.mean.dim: _mean,
    _aten.mm.default: _matmul,
    _aten.bmm.default: _matmul,
    _aten.diag_embed.default: lambda x: torch.where(torch.eye(x.shape[-1]) > 0, x[..., None], 0),
    _aten.linalg_cross.default: _cross,
    _aten._linalg_det.default: _det,
    _aten._linalg_eigh.default: _eigh,
    _aten._linalg_solve_ex.default: _solve,
    _aten.linalg_inv_ex.default: _inverse,
    _aten._linalg_check_errors.default: lambda *_, **__: None,
}
