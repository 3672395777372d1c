"""Evaluation of the experiment: against moves and noise that are known, and as a user runs the script."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.rig.experiment import evaluate_experiment

F64 = torch.float64
ROOT = Path(__file__).parents[2]
SIGMA = torch.tensor([2e-4, 3e-4, 1e-3, 3e-5, 3e-5, 1e-5], dtype=F64)  # mm, rad
BASE_FROM_CAMERA = (
    rotations.exp(torch.tensor([3.0, 0.1, -0.2], dtype=F64)),
    torch.tensor([450.0, -80, 600], dtype=F64),
)
TOOL_FROM_TARGET = (rotations.exp(torch.tensor([0.1, 0.05, 0.7], dtype=F64)), torch.tensor([5.0, -10, 60], dtype=F64))
START = (rotations.exp(torch.tensor([0.1, -0.05, 0.3], dtype=F64)), torch.tensor([3.0, -2, 165], dtype=F64))
TURN = {"pitch": 0, "yaw": 1, "roll": 2}


def waypoints() -> list[dict[str, object]]:
    plan: list[dict[str, object]] = [{"kind": "static", "axis": None, "value": 0.0, "origin": True} for _ in range(12)]
    for axis in "xyz":
        plan += [{"kind": "translation", "axis": axis, "value": float(v), "origin": v == 0} for v in range(6)]
    for axis in TURN:
        values = (0, *(v for v in range(-5, 6) if v))
        plan += [{"kind": "rotation", "axis": axis, "value": float(v), "origin": v == 0} for v in values]
    return [*plan, {"kind": "handeye", "axis": None, "value": 0.0, "origin": False}]


def write(folder: Path, *, seed: int = 0, depth_scale: float = 1.0, suffix: str = ".jsonl") -> tuple[Path, Path]:
    """A manifest of the paper's experiment, and poses with noise SIGMA in camera axes; robot in metres."""
    plan = waypoints()
    g = torch.Generator().manual_seed(seed)
    records: list[dict[str, object]] = [{"record": "session", "units": {"length": "m"}, "emulated": True}]
    rows = []
    base = rotations.compose(*BASE_FROM_CAMERA, *START)
    tool0 = rotations.compose(*base, *rotations.inverse(*TOOL_FROM_TARGET))
    for k, waypoint in enumerate(plan):
        r, t = tool0
        step = torch.zeros(3, dtype=F64)
        value = float(waypoint["value"])  # type: ignore[arg-type]
        if waypoint["kind"] == "translation":
            step["xyz".index(str(waypoint["axis"]))] = value
            t = t + BASE_FROM_CAMERA[0] @ step  # along the camera's axes
        elif waypoint["kind"] == "rotation":
            step[TURN[str(waypoint["axis"])]] = math.radians(value)
            r = BASE_FROM_CAMERA[0] @ rotations.exp(step) @ BASE_FROM_CAMERA[0].T @ r
        seen = rotations.compose(*rotations.inverse(*BASE_FROM_CAMERA), *rotations.compose(r, t, *TOOL_FROM_TARGET))
        e = SIGMA * torch.randn(6, dtype=F64, generator=g)
        rotation, translation = rotations.exp(e[3:]) @ seen[0], seen[1] + e[:3]
        translation = translation * torch.tensor([1, 1, depth_scale], dtype=F64)
        name = f"images/{k:03d}.png"
        pose = [*(t / 1000).tolist(), *rotations.log(r).tolist()]
        records.append({"record": "frame", "id": k, "image": name, "robot_pose": pose, "waypoint": waypoint})
        cells = [*translation.tolist(), *rotations.log(rotation).tolist(), *SIGMA.tolist()]
        columns = ("tx", "ty", "tz", "rx", "ry", "rz", "sx", "sy", "sz", "srx", "sry", "srz")
        row = {"frame": name, "target": "quad40", "status": "ok", **dict(zip(columns, cells, strict=True))}
        rows.append(row | {"covariance": torch.diag(SIGMA**2).tolist()})
    manifest, poses = folder / "manifest.jsonl", folder / f"poses{suffix}"
    manifest.write_text("".join(json.dumps(record) + "\n" for record in records))
    if suffix == ".jsonl":
        poses.write_text("".join(json.dumps(row) + "\n" for row in rows))
    else:
        with poses.open("w", newline="") as file:
            writer = csv.DictWriter(file, [c for c in rows[0] if c != "covariance"], extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
    return manifest, poses


@pytest.mark.parametrize("suffix", [".jsonl", ".csv"])
def test_errors_are_the_noise_and_the_claim_covers_them(tmp_path: Path, suffix: str) -> None:
    spreads, chi2 = [], []
    for seed in range(12):
        e = evaluate_experiment(*write(tmp_path, seed=seed, suffix=suffix))
        assert e.static is not None
        assert len(e.static.deviation) == 12
        spreads.append((e.static.spread / SIGMA).square())
        assert torch.allclose(e.static.claimed, SIGMA)
        assert [m.axis for m in e.moves] == ["x", "y", "z", "roll", "pitch", "yaw"]
        assert [len(m.error) for m in e.moves] == [5, 5, 5, 10, 10, 10]
        chi2.append([m.reduced_chi2 for m in e.moves])
        assert e.moves[0].robot.tolist() == pytest.approx([1, 2, 3, 4, 5])
        assert e.moves[3].robot.rad2deg().tolist() == pytest.approx([-5, -4, -3, -2, -1, 1, 2, 3, 4, 5])
        # a difference of two poses, of which the axis fixes the part
        assert float(e.moves[2].sigma[0]) == pytest.approx(math.sqrt(2) * float(SIGMA[2]), rel=1e-3)
    # 792 and 540 degrees of freedom: 4 standard deviations
    assert float(torch.stack(spreads).mean()) == pytest.approx(1, abs=4 * math.sqrt(2 / 792))
    degrees = torch.tensor([5.0, 5, 5, 10, 10, 10])
    pooled = float((torch.tensor(chi2) * degrees).sum() / (12 * degrees.sum()))
    assert pooled == pytest.approx(1, abs=4 * math.sqrt(2 / 540))


def test_scale_along_the_axis_shows_a_wrong_focal_length(tmp_path: Path) -> None:
    e = evaluate_experiment(*write(tmp_path, depth_scale=1.0025))
    scale, sigma = next(m for m in e.moves if m.axis == "z").scale
    assert scale == pytest.approx(0.0025, abs=4 * sigma)
    scale, sigma = next(m for m in e.moves if m.axis == "x").scale
    assert scale == pytest.approx(0, abs=4 * sigma)


def test_bound_stands_beside_the_claim(tmp_path: Path) -> None:
    def half(r: Tensor, t: Tensor) -> Tensor:
        return torch.diag(SIGMA**2 / 4).expand(len(t), 6, 6)

    e = evaluate_experiment(*write(tmp_path), bound=half)
    assert e.bound is not None
    assert e.bound.static is not None
    assert torch.allclose(e.bound.static.claimed, SIGMA / 2)
    assert torch.allclose(e.bound.moves[1].sigma, e.moves[1].sigma / 2)


def test_what_does_not_belong_together_is_one_line(tmp_path: Path) -> None:
    manifest, poses = write(tmp_path)
    rows = [json.loads(line) for line in poses.read_text().splitlines()]
    other = tmp_path / "other.jsonl"
    other.write_text("".join(json.dumps(row | {"frame": "x" + row["frame"]}) + "\n" for row in rows))
    with pytest.raises(ConfigError, match="no pose of a static, translation or rotation frame"):
        evaluate_experiment(manifest, other)
    other.write_text("".join(json.dumps(row | {"target": f"t{k % 2}"}) + "\n" for k, row in enumerate(rows)))
    with pytest.raises(ConfigError, match="holds t0, t1"):
        evaluate_experiment(manifest, other)
    other.write_text("".join(json.dumps({k: v for k, v in row.items() if k != "srz"}) + "\n" for row in rows))
    with pytest.raises(ConfigError, match="srz: column is missing"):
        evaluate_experiment(manifest, other)
    with pytest.raises(ConfigError, match="cannot be read"):
        evaluate_experiment(manifest, tmp_path / "none.jsonl")
    lost = [row | ({"status": "no_target"} if row["frame"] == "images/012.png" else {}) for row in rows]
    other.write_text("".join(json.dumps(row) + "\n" for row in lost))
    with pytest.raises(ConfigError, match="x: has no frame at the origin"):
        evaluate_experiment(manifest, other)


def test_script_writes_tables_and_plot(tmp_path: Path) -> None:
    manifest, poses = write(tmp_path)
    command = [sys.executable, str(ROOT / "scripts/fig13_experiment.py"), str(manifest), str(poses)]
    done = subprocess.run([*command, "--out", str(tmp_path / "out")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"static.csv", "moves.csv", "focal.csv", "fig13.png"} <= {p.name for p in (tmp_path / "out").iterdir()}
    assert "emulated" in done.stdout
    with (tmp_path / "out" / "focal.csv").open() as file:
        paper = list(csv.DictReader(file))[-1]
    # eq. (5): 0.25 % of the distance, to the difference between 1 / f and 1 / f_true
    assert float(paper["error_of_z_um"]) == pytest.approx(1e3 * 165 * 0.0025, rel=0.02)
    done = subprocess.run([*command[:-1], str(tmp_path / "none.csv")], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
