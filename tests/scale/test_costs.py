"""The arithmetic of `scripts/bench_scale.py costs`."""

import math
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

MEASURED = {
    "frames/s and core": 40.0,
    "share of it on Ray": 0.9,
    "start s": 10.0,
    "worker MB": 500.0,
    "bytes a picture": 800000.0,
    "bytes a row": 1000.0,
}


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """`scripts/bench_scale.py`."""
    spec = spec_from_file_location("bench_scale", Path(__file__).parents[2] / "scripts" / "bench_scale.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_day_of_frames(bench: ModuleType) -> None:
    need = bench.needs(86400 * 360, MEASURED, 0.5)  # 360 frames/s, 36 of them a core
    assert need.cores == 10
    assert need[1:] == pytest.approx((5.0, 288.0, 360.0, 31.104, 120.0))


@pytest.mark.parametrize("machines", [2, 5])
def test_several_machines_are_as_quick_as_one_at_the_number_told(bench: ModuleType, machines: int) -> None:
    frames = bench.pays_from(machines, 16, MEASURED)
    assert frames / (16 * 40) == pytest.approx(10 + frames / (machines * 0.9 * 16 * 40))
    assert bench.pays_from(1, 16, MEASURED) == math.inf
