"""Straight-line code on numbers, and the C++ loop that runs it for a batch of problems at once."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

# vector of lanes.h, and what it is in memory
TYPES = {
    torch.float32: ("F", "float"),
    torch.float64: ("D", "double"),
    torch.int64: ("J", "int64_t"),
    torch.bool: ("M", "uint8_t"),
}


@dataclass(frozen=True, eq=False)
class Array:
    """A tensor of one problem: which numbers of the program it consists of, int64, and their dtype."""

    numbers: Tensor
    dtype: torch.dtype


class _Operation(NamedTuple):
    text: str
    operands: tuple[int, ...]
    dtype: torch.dtype
    invariant: bool


class Layout(NamedTuple):
    """A tensor in memory: (*shape, B), or (*shape, 1) where it is ``shared`` by all problems.

    Where it is ``strided``, it is not contiguous along the batch.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    shared: bool = False
    strided: bool = False


class Program:
    """Operations on numbers, each after its operands; what is computed already is not computed again."""

    def __init__(self) -> None:
        self._operations: list[_Operation] = []
        self._known: dict[_Operation, int] = {}
        self._tensors: list[Layout] = []
        self._loads: dict[int, tuple[int, tuple[int, ...]]] = {}  # number: tensor, index
        self._stores: list[tuple[int, tuple[int, ...], int]] = []  # tensor, index, number
        self._carried: dict[int, int] = {}  # number: number that takes its place in the next round
        self._going: int | None = None

    def _number(self, text: str, operands: tuple[int, ...], dtype: torch.dtype, invariant: bool = False) -> int:
        operation = _Operation(text, operands, dtype, invariant)
        if operation not in self._known:
            self._known[operation] = len(self._operations)
            self._operations.append(operation)
        return self._known[operation]

    def input(self, layout: Layout) -> Array:
        """The next tensor of the call, to be read."""
        if layout.dtype not in TYPES:
            raise NotImplementedError(f"{layout.dtype} in a compiled function")
        tensor = len(self._tensors)
        self._tensors.append(layout)
        step = f"strides[{self._strides(tensor) + len(layout.shape)}]"
        read = f"gather({{0}} + b * {step}, {step})" if layout.strided else "load({} + b)"
        read = "all(*{})" if layout.shared else read
        numbers = []
        for index in product(*map(range, layout.shape)):
            text = read.format(_pointer(tensor, index))
            numbers.append(self._number(text, (), layout.dtype, layout.shared))
            self._loads[numbers[-1]] = tensor, index
        return Array(torch.tensor(numbers, dtype=torch.int64).view(*layout.shape, 1), layout.dtype)

    def repeat(self, state: Sequence[Array], after: Sequence[Array], going: Array) -> list[Layout]:
        """Makes the program one round of a loop, which ends for a vector of problems when none is ``going``.

        Inputs ``state`` are, in the next round, what they are ``after`` this; in the end they are results.
        """
        for old, new in zip(state, after, strict=True):
            numbers = self.array(new, old.dtype).numbers.expand_as(old.numbers)
            self._carried.update(zip(old.numbers.flatten().tolist(), numbers.flatten().tolist(), strict=True))
        self._going = int(going.numbers[0])
        return [self.output(array) for array in state]

    def output(self, array: Array) -> Layout:
        """Makes numbers (*shape, 1) the next tensor of the call."""
        layout = Layout(array.numbers.shape[:-1], array.dtype)
        self._tensors.append(layout)
        self.write(array, len(self._tensors) - 1)
        return layout

    def write(self, array: Array, tensor: int) -> None:
        """Writes numbers (*shape, 1) to a tensor, which must not be read."""
        shape = self._tensors[tensor].shape
        numbers = array.numbers.expand(*shape, 1).flatten().tolist()
        self._stores += [(tensor, index, k) for index, k in zip(product(*map(range, shape)), numbers, strict=True)]

    def constant(self, value: float, dtype: torch.dtype) -> int:
        if dtype.is_floating_point:
            text = repr(float(value)) if math.isfinite(value) else "NAN" if math.isnan(value) else "INFINITY"
            text = f"-{text}" if value == -math.inf else text
        else:
            text = str(int(value))
        return self._number(f"all({TYPES[dtype][1]}({text}))", (), dtype, True)

    def array(self, value: Array | float, dtype: torch.dtype) -> Array:
        """As numbers of this dtype."""
        if not isinstance(value, Array):
            return Array(torch.tensor(self.constant(value, dtype)), dtype)
        if value.dtype == dtype:
            return value
        return self.each(f"to<{TYPES[dtype][0]}>({{}})", dtype, value)

    def each(self, text: str, dtype: torch.dtype, *operands: Array) -> Array:
        """An operation on every element; operands broadcast against each other."""
        numbers = torch.broadcast_tensors(*(v.numbers for v in operands))
        columns = zip(*(n.flatten().tolist() for n in numbers), strict=True)
        result = [self._number(text, column, dtype) for column in columns]
        return Array(torch.tensor(result, dtype=torch.int64).view(numbers[0].shape), dtype)

    def fold(self, text: str, array: Array, dims: int | Sequence[int], shape: Sequence[int]) -> Array:
        """An operation along dimensions (none: all), one element after the other; ``shape`` is that of the result."""
        dims = (dims,) if isinstance(dims, int) else dims or range(array.numbers.ndim)
        first = array.numbers.movedim(tuple(dims), tuple(range(len(dims))))
        result, *others = (Array(n, array.dtype) for n in first.flatten(0, len(dims) - 1))
        for other in others:
            result = self.each(text, array.dtype, result, other)
        return Array(result.numbers.reshape(shape), array.dtype)

    def source(self) -> str:
        """C++, to follow lanes.h. Its ``kernel`` takes the data and the strides of every tensor."""
        done: set[int] = set()
        shared: list[str] = []  # by all problems
        fixed: list[str] = []  # in all rounds
        work: list[str] = []

        def add(number: int) -> None:
            for k in self._needed(number, done):
                place = work
                if k not in self._carried:
                    if self._operations[k].invariant:
                        place = shared
                    elif k in self._loads and self._going is not None:
                        place = fixed
                place.append(self._line(k))

        def store(tensor: int, index: tuple[int, ...], name: str) -> None:
            pointer, step = _pointer(tensor, index), f"strides[{self._strides(tensor) + len(index)}]"
            if self._tensors[tensor].strided:
                work.append(f"scatter({pointer} + b * {step}, {step}, {name});")
            else:
                work.append(f"store({pointer} + b, {name});")

        if self._going is None:
            for tensor, index, number in self._stores:  # a result is stored as soon as it is known
                add(number)
                store(tensor, index, f"v{number}")
        else:
            for number in (*self._carried.values(), self._going):
                add(number)
            done |= self._carried.keys()
            operations = ((k, self._operations[k]) for k in self._carried)
            fixed += [f"{TYPES[operation.dtype][0]} s{k} = {operation.text};" for k, operation in operations]
            after = [f"s{old} = v{new};" for old, new in self._carried.items()]
            work = [_ROUNDS.format(work="\n".join((*work, *after)), going=f"v{self._going}")]
            for tensor, index, number in self._stores:
                store(tensor, index, f"s{number}")
        pointers = "\n".join(self._pointers(done))
        return _LOOP.format(pointers=pointers, shared="\n".join(shared), work="\n".join((*fixed, *work)))

    def _pointers(self, done: set[int]) -> list[str]:
        """Where the numbers that are read and those that are written lie in memory."""
        read = [self._loads[number] for number in sorted(done & self._loads.keys())]
        written = [(tensor, index) for tensor, index, _ in self._stores]
        if {tensor for tensor, _ in read} & {tensor for tensor, _ in written}:
            raise ValueError("a compiled function cannot read the tensors that it writes")
        pointers = []
        for places, qualifier in ((read, "const "), (written, "")):
            for tensor, index in places:
                memory = qualifier + TYPES[self._tensors[tensor].dtype][1]
                start = self._strides(tensor)
                offset = "".join(f" + {i} * strides[{start + d}]" for d, i in enumerate(index) if i)
                pointers.append(f"{memory}* const {_pointer(tensor, index)} = ({memory}*)data[{tensor}]{offset};")
        return pointers

    def _strides(self, tensor: int) -> int:
        """Where the strides of a tensor begin."""
        return sum(len(layout.shape) + 1 for layout in self._tensors[:tensor])

    def _needed(self, number: int, done: set[int]) -> Iterator[int]:
        """What is not yet ``done`` of all that a number depends on, operands first, and the number itself."""
        stack = [number]
        while stack:
            missing = [k for k in self._operations[stack[-1]].operands if k not in done]
            if missing:
                stack += reversed(missing)
            elif (last := stack.pop()) not in done:
                done.add(last)
                yield last

    def _line(self, number: int) -> str:
        text, operands, dtype, _ = self._operations[number]
        text = f"s{number}" if number in self._carried else text
        return f"const {TYPES[dtype][0]} v{number} = {text.format(*(f'v{k}' for k in operands))};"


def _pointer(tensor: int, index: tuple[int, ...]) -> str:
    return "_".join(map(str, ("p", tensor, *index)))


_ROUNDS = """for (int64_t round = 0; round < limit; ++round) {{
{work}
if (!any({going})) break;
}}"""
# the last block ends with the batch, so problems in two blocks are worked on twice
_LOOP = """
static void solve(void* const* data, const int64_t* strides, int64_t batch, int64_t limit,
                  int64_t first, int64_t last) {{
{pointers}
{shared}
for (int64_t block = first; block < last; ++block) {{
const int64_t b = block * LANES < batch - LANES ? block * LANES : batch - LANES;
{work}
}}
}}
"""
