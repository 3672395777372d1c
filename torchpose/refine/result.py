"""What every refinement returns."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Refined:
    """Refined poses of N rows.

    Attributes:
        R: (N, 3, 3), t: (N, 3) mm, covariance: (N, 6, 6) as in `results.Poses`.
        blur: (N,) px, standard deviation of the point-spread function with the pixel.
        noise: (N,) grey levels, standard deviation of the residuals kept.
        kept: (N,) fraction of the pixels kept.
        good: (N,) bool; where False the refinement failed and the other fields mean nothing.
    """

    R: Tensor
    t: Tensor
    covariance: Tensor
    blur: Tensor
    noise: Tensor
    kept: Tensor
    good: Tensor

    def __getitem__(self, index: Tensor) -> Refined:
        return Refined(*(getattr(self, n)[index] for n in self.__dataclass_fields__))

    def replaced(self, index: Tensor, other: Refined) -> Refined:
        """These rows, with the rows ``index`` taken from ``other``."""
        return Refined(*(getattr(self, n).index_copy(0, index, getattr(other, n)) for n in self.__dataclass_fields__))
