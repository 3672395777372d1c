"""Functions of many small problems, compiled to one loop in C++ on request.

Eager mode makes a pass over the memory for every operation, and so, between its few fusions, does the code that
torch.compile makes. But where every problem is worked on by itself, no number of it need ever leave the registers:
`compiled` (`functions`) traces a function for one problem, down to single numbers (`trace`, `program`), and has a
compiler make one loop over the problems of it, a lane of a vector for each (`build`, lanes.h). `mapped` is the same for
functions of tensors with the problems first, and does without where it must. docs/decisions/0007 has the figures.
"""

from torchpose.kernels.build import find_compiler, has_compiler
from torchpose.kernels.functions import LEAST, compiled, mapped, padded, repeated, tracing

__all__ = ["LEAST", "compiled", "find_compiler", "has_compiler", "mapped", "padded", "repeated", "tracing"]
