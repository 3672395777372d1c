"""One check of covariances for camera, target and hand-eye files."""

import pytest
import torch

from torchpose.geometry.covariance import covariance_fault

ROOT = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
UNITS = torch.tensor([1e-4, 1.0, 1e3, 1e-6, 1e-3, 1.0], dtype=torch.float64)
GOOD = UNITS[:, None] * (ROOT @ ROOT.T) * UNITS


def changed(i: int, j: int, factor: float, *, both: bool = True) -> torch.Tensor:
    table = GOOD.clone()
    table[i, j] *= factor
    if both:
        table[j, i] = table[i, j]
    return table


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        (GOOD, ""),
        (GOOD.float(), ""),
        (GOOD.float().double(), ""),  # a file of single precision
        (torch.zeros(4, 4, dtype=torch.float64), ""),
        (torch.outer(UNITS, UNITS), ""),  # of rank one
        (torch.diag(torch.tensor([0.0, 1e-20, 1e20])), ""),
        (changed(0, 3, 1.001, both=False), "is not symmetric"),  # of entries of 1e-10 in a table of 1e6
        (changed(0, 0, -1.0), "has a negative eigenvalue"),
        (changed(3, 3, 1e-3), "has a negative eigenvalue"),
        (torch.tensor([[0.0, 1e-3], [1e-3, 1.0]]), "has a negative eigenvalue"),
        (torch.tensor([[1e-300, 1e300], [1e300, 1.0]], dtype=torch.float64), "has a negative eigenvalue"),
    ],
)
def test_faults_are_found_whatever_the_units(table: torch.Tensor, fault: str) -> None:
    assert covariance_fault(table) == fault
