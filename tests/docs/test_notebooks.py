"""Notebooks run from their first cell to their last, and are stored with the outputs that they had then.

Needs the extra `notebooks`; skips without it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
MOST_BYTES = 300_000  # of a notebook with its pictures


def named(path: Path) -> str:
    return path.stem


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the kernel and its transport
@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_notebook_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(path.parent)}}
    client.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=where).execute()  # raises


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_stored_with_outputs_and_pictures(path: Path) -> None:
    assert path.stat().st_size < MOST_BYTES
    cells = [c for c in json.loads(path.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"]
    counts = [cell["execution_count"] for cell in cells]
    assert counts == list(range(1, len(cells) + 1)), "run all cells in order and store them"
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)


def test_there_are_three() -> None:
    assert len(NOTEBOOKS) == 3
