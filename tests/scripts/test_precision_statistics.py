"""The faults of scripts/precision_statistics.py: what a file may state of a print; every case has its fault."""

from __future__ import annotations

import pytest
import torch

from scripts import precision_statistics as statistics
from torchpose.sim import PrintErrors, add_noise


@pytest.mark.parametrize(
    "errors", [PrintErrors(center_sigma=[0.01, 0.02, 0.03]), PrintErrors(warp=0.05), PrintErrors(0.01, 0.03, warp=0.02)]
)
def test_a_file_states_the_errors_of_its_prints(errors: PrintErrors) -> None:
    case = statistics.Case(statistics.tilted(40), errors=errors)
    prints = statistics.printed_anew(case, 4000, torch.Generator().manual_seed(1))
    assert prints is not None
    off = (prints.centers - statistics.TARGET.centers).flatten(1)
    covariance = statistics.stated(errors).covariance
    assert covariance is not None
    found, told = off.square().mean(0).view(4, 3).mean(0), covariance.diagonal()[:-1].view(4, 3).mean(0)
    torch.testing.assert_close(found, told, rtol=0.06, atol=1e-12)
    assert float(covariance[-1, -1].sqrt()) == float(errors.gain)


@pytest.mark.parametrize("name", statistics.FAULTS)
def test_every_case_has_its_fault(name: str) -> None:
    case = statistics.FAULTS[name]
    g = torch.Generator().manual_seed(2)
    camera = statistics.camera_of(case.k1)
    r, t = case.poses(1, g)
    prints = statistics.printed_anew(case, 1, g)
    clean = statistics.picture(case, camera, statistics.TARGET if prints is None else prints, r, t)
    frame = statistics.photographed(case, clean, 5, torch.tensor([3]))
    plain = statistics.Case(case.poses)
    nominal = statistics.picture(plain, camera, statistics.TARGET, r, t)
    expected = add_noise(nominal, case.noise, seed=5, index=torch.tensor([3]))
    difference = (frame.float() - expected.float()).abs()
    assert frame.dtype == torch.uint8
    if name in ("as-filed", "k1-off"):
        assert difference.max() == 0
        assert (name == "k1-off") == (case.k1_error != 0)
    else:
        assert float(difference.max()) > 3
        assert float(difference.median()) < 80  # still a picture of the target
