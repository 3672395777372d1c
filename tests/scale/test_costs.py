"""The arithmetic of `scripts/bench_scale.py costs`."""

import json
import math
from argparse import Namespace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

MEASURED = {
    "engines": {
        "local, 2 cores": {"frames/s": 80.0, "of the whole command": 70.0, "start and end, s": 2.0, "MB": 400},
        "ray, 1 worker": {"frames/s": 37.0, "of the whole command": 30.0, "start and end, s": 11.0, "MB": 500},
        "ray, 2 workers": {"frames/s": 72.0, "of the whole command": 50.0, "start and end, s": 12.0, "MB": 500},
    },
    "frames": 100,
    "rows equal to the last digit": 100,
    "load before": 0.1,
    "megapixels": 2.2,
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
    assert 2 + frames / (16 * 40) == pytest.approx(12 + frames / (machines * 16 * 36))
    assert bench.pays_from(1, 16, MEASURED) == math.inf


def test_a_page_is_written_anew_between_its_marks(bench: ModuleType, tmp_path: Path) -> None:
    page, figures = tmp_path / "page.md", tmp_path / "figures.json"
    figures.write_text(json.dumps(MEASURED))
    mark = "<!-- made by scripts/bench_scale.py: {} -->\nold\n<!-- end -->"
    page.write_text(f"# Page\n\n{mark.format('throughput')}\n\nbetween\n\n{mark.format('costs')}\n\nbehind\n")
    for _ in range(2):
        bench.costs(tmp_path, Namespace(figures=figures, price=0.5, into=page))
        text = page.read_text()
        assert [text.count(word) for word in ("# Page", "old", "between", "behind", "a billion", "<!-- end -->")] == [
            1, 0, 1, 1, 1, 2,
        ]  # fmt: skip
    assert "| ray, 2 workers | 72.0 | 50.0 | 12.0 | 500 |" in text
    assert "two workers over one 1.95 (at least" in text
