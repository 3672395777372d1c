"""The pose chosen for each row, the other minimum, and the status."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.geometry.rows import Rows, replace
from torchpose.results import Status

PLACE = 5  # of a marker: x, y, z beside its place, dark edges outwards, both edges from its centre; mm
AMBIGUOUS_CHI2 = 20.0  # contract: two poses are ambiguous where their chi-squared differs by less


@dataclass(frozen=True, eq=False)
class Solutions(Rows):
    """Chosen pose of N rows; the fields as in `results.Poses`, and the markers (N, M) that it explains.

    larger: how far both edges of the rings lie further from their centres than the file says, mm, where it is certain.
    """

    R: Float[Tensor, "N 3 3"]
    t: Float[Tensor, "N 3"]
    covariance: Float[Tensor, "N 6 6"]
    noise: Float[Tensor, "N 6 6"]
    systematic: Float[Tensor, "N 6 L"]
    rms: Float[Tensor, " N"]
    chi2: Float[Tensor, " N"]
    R_alt: Float[Tensor, "N 3 3"]
    t_alt: Float[Tensor, "N 3"]
    rms_alt: Float[Tensor, " N"]
    chi2_alt: Float[Tensor, " N"]
    status: Int[Tensor, " N"]
    reason: Int[Tensor, " N"]
    mask: Bool[Tensor, "N M"]
    place: Float[Tensor, "N M 5"]
    misfit: Int[Tensor, " N"]
    residual_chi2: Float[Tensor, " N"]
    freedom: Int[Tensor, " N"]
    larger: Float[Tensor, " N"]

    @property
    def solved(self) -> Tensor:
        """(N,) bool, rows that have a pose."""
        return self.status != Status.REJECTED

    @property
    def ok(self) -> Tensor:
        """(N,) bool, rows whose pose nothing speaks against."""
        return self.status == Status.OK

    def swapped(self, condition: Tensor) -> Solutions:
        """With both minima exchanged where the condition (N,) bool holds; the covariance is left as it is."""
        other = {name: getattr(self, f"{name}_alt") for name in ("R", "t", "rms", "chi2")}
        other |= {f"{name}_alt": getattr(self, name) for name in ("R", "t", "rms", "chi2")}
        return replace(self, **other).where(condition, self)

    def marked(self, condition: Tensor, status: int, reason: int) -> Solutions:
        """With this status and reason where the condition (N,) bool holds."""
        return replace(
            self,
            status=torch.where(condition, status, self.status),
            reason=torch.where(condition, reason, self.reason),
        )
