"""The pose chosen for each row, the other minimum, and the status."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

AMBIGUOUS_CHI2 = 20.0  # contract: two poses are ambiguous where their chi-squared differs by less
MIN_MARKERS = 3  # seen, that a pose needs


@dataclass(frozen=True, eq=False)
class Solutions:
    """Chosen pose of N rows; the fields as in `results.Poses`."""

    R: Tensor
    t: Tensor
    covariance: Tensor
    rms: Tensor
    chi2: Tensor
    R_alt: Tensor
    t_alt: Tensor
    rms_alt: Tensor
    chi2_alt: Tensor
    status: Tensor
    reason: Tensor
    mask: Tensor

    def __getitem__(self, index: Tensor) -> Solutions:
        return Solutions(*(getattr(self, n)[index] for n in self.__dataclass_fields__))

    def replaced(self, index: Tensor, other: Solutions) -> Solutions:
        """These rows, with the rows ``index`` taken from ``other``."""
        return Solutions(*(getattr(self, n).index_copy(0, index, getattr(other, n)) for n in self.__dataclass_fields__))
