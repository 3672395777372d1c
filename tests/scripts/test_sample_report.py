"""The report on the sample: passes and fails when it should, in one line where its input is wrong."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from torchpose.io.truth import read_truth

ROOT = Path(__file__).parents[2]
TRUTH = ROOT / "data" / "sample" / "truth.csv"


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """The truth itself as rows of ``torchpose estimate``, 1 um beside in x, with 1 um and 0.1 mrad of sigma."""
    truth = read_truth(TRUTH)
    covariance = torch.diag(torch.tensor([1e-6] * 3 + [1e-8] * 3, dtype=torch.float64)).tolist()
    names = ("tx", "ty", "tz", "rx", "ry", "rz")
    return [
        {"frame": frame, "target": target, "status": "ok", "covariance": covariance}
        | dict(zip(names, [t[0] + 1e-3, *t[1:], *r], strict=True))
        for frame, target, t, r in zip(
            truth.frame, truth.target, truth.t.tolist(), truth.rotation_vector.tolist(), strict=True
        )
    ]


def report(
    tmp_path: Path, rows: list[dict[str, Any]], *options: str, truth: Path = TRUTH
) -> subprocess.CompletedProcess[str]:
    poses = tmp_path / "poses.jsonl"
    poses.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    command = [sys.executable, "scripts/sample_report.py", "--poses", str(poses), "--truth", str(truth), *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_within(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    done = report(tmp_path, rows, "--markdown")
    assert done.returncode == 0, done.stderr
    total = next(line for line in done.stdout.splitlines() if line.startswith("| RMS"))
    lateral, depth, rotation = (cell.split(" / ")[:2] for cell in total.split("|")[5:8])
    # 1 um of error; sigma sqrt(2) um lateral, 1 um in depth, sqrt(3) 0.1 mrad = 9.92 mdeg
    assert (lateral, depth, rotation) == ([" 1.00", "1.41"], [" 0.00", "1.00"], [" 0.00", "9.92"])
    assert "12 of 12 frames ok; errors within" in done.stdout
    assert "mean NEES 1.0" in done.stdout


@pytest.mark.parametrize(("column", "error"), [("ty", 3e-3), ("tz", 7e-3), ("rx", 2e-4)])
def test_errors_beyond(tmp_path: Path, rows: list[dict[str, Any]], column: str, error: float) -> None:
    done = report(tmp_path, [row | {column: row[column] + error} for row in rows])
    assert done.returncode == 1
    assert "BEYOND" in done.stdout


def test_a_frame_without_a_pose(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    nothing = dict.fromkeys(("tx", "ty", "tz", "rx", "ry", "rz", "covariance"))
    done = report(tmp_path, [rows[0] | nothing | {"status": "no_target"}, *rows[1:]])
    assert done.returncode == 1
    assert "11 of 12 frames ok" in done.stdout
    assert "no_target" in done.stdout


def test_wrong_input_is_one_line(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    header = TRUTH.read_text(encoding="utf-8").splitlines()[0]
    for name, text in (("few_columns", "frame,target,tx,ty,tz,rx,ry,rz\n"), ("no_row", header + "\n")):
        (tmp_path / name).write_text(text, encoding="utf-8")
    wrong = [report(tmp_path, rows, truth=tmp_path / name) for name in ("few_columns", "no_row", "missing")]
    for done in (report(tmp_path, rows[1:]), *wrong):
        assert done.returncode == 2
        assert done.stderr.startswith("sample_report: error: ")
        assert done.stderr.count("\n") == 1
