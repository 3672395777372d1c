"""``torchpose evaluate`` on made-up estimates, whose errors are known."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from torchpose.analysis.evaluation import SCALE, estimates_of, evaluate
from torchpose.cli.main import main
from torchpose.geometry import rotations
from torchpose.io.truth import Truth, write_truth

F64 = torch.float64
POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
STD = ("sx", "sy", "sz", "srx", "sry", "srz")


def case(
    count: int = 400, seed: int = 0, statuses: list[str] | None = None
) -> tuple[Truth, list[dict[str, Any]], torch.Tensor]:
    """A truth, and rows of estimates drawn from a known covariance with a bias of 1 um in z."""
    g = torch.Generator().manual_seed(seed)
    w, t = torch.randn(count, 3, dtype=F64, generator=g) * 0.2, torch.randn(count, 3, dtype=F64, generator=g) * 10
    t[:, 2] += 160
    sigma = torch.tensor([1e-4, 1e-4, 6e-4, 2e-5, 2e-5, 4e-6], dtype=F64)
    root = torch.diag(sigma) @ torch.linalg.cholesky(torch.eye(6, dtype=F64) + 0.4 * torch.ones(6, 6, dtype=F64))
    covariance = root @ root.T
    error = torch.randn(count, 6, dtype=F64, generator=g) @ root.T
    bound = dict(zip(STD, (sigma * 0.9).expand(count, 6).unbind(1), strict=True))
    view = torch.full((count,), 4.0, dtype=F64)
    view[:3] = 2
    truth = Truth([f"{i:04d}.png" for i in range(count)], ["quad40"] * count, t, w, {**bound, "markers_in_view": view})
    estimate_t = t + error[:, :3]
    estimate_w = rotations.log(rotations.exp(error[:, 3:]) @ rotations.exp(w))
    statuses = statuses or ["ok"] * count
    rows = []
    for i in range(count):
        row: dict[str, Any] = {"frame": truth.frame[i], "target": "quad40", "status": statuses[i]}
        pose = [*estimate_t[i].tolist(), *estimate_w[i].tolist()]
        empty = statuses[i] in ("no_target", "rejected")
        row |= dict.fromkeys((*POSE, *STD)) if empty else dict(zip(POSE, pose, strict=True))
        if not empty:
            row |= dict(zip(STD, covariance.diagonal().sqrt().tolist(), strict=True))
        row["covariance"] = None if empty else covariance.tolist()
        rows.append(row)
    return truth, rows, error


def write(folder: Path, truth: Truth, rows: list[dict[str, Any]], name: str = "poses.jsonl") -> Path:
    write_truth(folder / "truth.csv", truth)
    path = folder / name
    if name.endswith(".csv"):
        columns = ["frame", "target", "status", *POSE, *STD]
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows([row[c] for c in columns] for row in rows)
    else:
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def run(*words: Path | str) -> str | int | None:
    with pytest.raises(SystemExit) as end:
        main(["evaluate", *map(str, words)])
    return end.value.code


def test_statistics_are_those_of_the_errors() -> None:
    truth, rows, error = case()
    result = evaluate(estimates_of(rows), truth)
    shown = error * SCALE
    for i, axis in enumerate(result.axes):
        assert axis.bias == pytest.approx(float(shown[:, i].mean()), rel=1e-5, abs=1e-6)
        assert axis.spread == pytest.approx(float(shown[:, i].std(correction=0)), rel=1e-5)
        assert axis.rms == pytest.approx(float(shown[:, i].square().mean().sqrt()), rel=1e-5)
        assert axis.worst == pytest.approx(float(shown[:, i].abs().max()), rel=1e-5)
        assert axis.bound == pytest.approx(0.9 * axis.predicted / math.sqrt(1.4), rel=1e-6)
    low, high = result.nees_interval
    assert low < 6 < high
    assert low - 0.3 < result.nees < high + 0.3
    assert result.visible == 397
    assert result.found == 397


def test_a_bias_is_told_from_spread() -> None:
    truth, rows, _ = case()
    for row in rows:
        row["tz"] += 0.002
    z = evaluate(estimates_of(rows), truth).axes[2]
    assert z.bias == pytest.approx(2.0, abs=0.15)
    assert z.spread == pytest.approx(0.6 * math.sqrt(1.4), rel=0.15)
    assert evaluate(estimates_of(rows), truth).nees > 8


def test_only_ok_rows_count() -> None:
    statuses = ["ok"] * 5 + ["no_target", "rejected", "ambiguous"]
    truth, rows, error = case(8, statuses=statuses)
    result = evaluate(estimates_of(rows), truth)
    assert result.counts == {"ok": 5, "no_target": 1, "rejected": 1, "ambiguous": 1}
    assert result.error[:, 0].isfinite().tolist() == [True] * 5 + [False] * 3
    assert result.axes[0].worst == pytest.approx(float(error[:5, 0].abs().max()) * 1e3, rel=1e-6)
    assert (result.visible, result.found) == (5, 2)


def test_table_files_and_plots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rows, error = case(40)
    poses = write(tmp_path, truth, rows)
    assert run(poses, tmp_path, "--out", tmp_path / "errors.csv", "--plots", tmp_path / "plots") == 0
    printed = capsys.readouterr().out
    for word in ("pitch", "mdeg", "bound", "40 ok", "NEES"):
        assert word in printed
    with (tmp_path / "errors.csv").open() as file:
        table = list(csv.DictReader(file))
    assert float(table[7]["z_um"]) == pytest.approx(float(error[7, 2]) * 1e3, rel=1e-5)
    assert float(table[7]["roll_mdeg"]) == pytest.approx(math.degrees(float(error[7, 5])) * 1e3, rel=1e-4)
    for name in ("errors", "consistency", "conditions"):
        picture = cv2.imread(str(tmp_path / "plots" / f"{name}.png"))
        assert picture is not None
        assert picture.shape[1] > 1000
        assert picture.std() > 5


def test_csv_has_no_correlations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rows, _ = case(30)
    assert run(write(tmp_path, truth, rows, "poses.csv"), tmp_path / "truth.csv") == 0
    assert "without correlations" in capsys.readouterr().out


def test_no_pose_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rows, _ = case(4, statuses=["no_target"] * 4)
    assert run(write(tmp_path, truth, rows), tmp_path, "--plots", tmp_path / "plots") == 0
    assert "4 no_target" in capsys.readouterr().out


def test_frames_named_from_the_data_set(tmp_path: Path) -> None:
    truth, rows, _ = case(4)
    for row in rows:
        row["frame"] = f"frames/{row['frame']}"
    assert run(write(tmp_path, truth, rows), tmp_path) == 0


@pytest.mark.parametrize("wrong", ["missing", "rows", "columns", "suffix", "broken", "truth"])
def test_mistakes_are_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str) -> None:
    truth, rows, _ = case(4)
    poses = write(tmp_path, truth, rows)
    if wrong == "missing":
        poses = tmp_path / "none.csv"
    elif wrong == "rows":
        poses = write(tmp_path, truth, rows[:2])
    elif wrong == "columns":
        for row in rows:
            del row["sx"]
        poses = write(tmp_path, truth, rows)
    elif wrong == "suffix":
        poses = poses.rename(tmp_path / "poses.txt")
    elif wrong == "broken":
        poses.write_text("{]\n")
    else:
        (tmp_path / "truth.csv").unlink()
    assert run(poses, tmp_path) == 2
    message = capsys.readouterr().err
    assert message.startswith("torchpose: error: ")
    assert message.count("\n") == 1
