"""Capture plans: the expanded poses against their definition, bounds, one clear line for every mistake."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchpose.errors import ConfigError
from torchpose.rig.plan import load_plan
from torchpose.rig.settings import Workspace

ROOT = Path(__file__).parents[2]
DOWN = [math.pi, 0.0, 0.0]
AXIS: dict[str | None, int] = {"x": 0, "y": 1, "z": 2, "pitch": 0, "yaw": 1, "roll": 2}


def written(folder: Path, steps: list[Any], axes: str | list[float] = "tool", rotation: list[float] = DOWN) -> Path:
    origin = {"translation": [400.0, 0.0, 300.0], "rotation": rotation}
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump({"name": "try", "origin": origin, "axes": axes, "steps": steps}))
    return path


def test_the_paper_plan() -> None:
    plan = load_plan(ROOT / "configs/rig/paper_plan.yaml")
    assert [w.id for w in plan.waypoints[:2]] == ["0000", "0001"]
    assert [w.kind for w in plan.waypoints] == ["static"] * 20 + ["translation"] * 18 + ["rotation"] * 33
    assert all(w.origin == (w.value == 0) for w in plan.waypoints)
    for w in plan.waypoints:
        shift = torch.tensor(w.pose[:3]) - torch.tensor(plan.origin[:3])
        expected = torch.zeros(3)
        if w.kind == "translation":
            expected[AXIS[w.axis]] = w.value  # its axes are those of the base
        torch.testing.assert_close(shift, expected, atol=1e-5, rtol=0)
        turn = Rotation.from_rotvec(w.pose[3:]) * Rotation.from_rotvec(plan.origin[3:]).inv()
        turned = [0.0, 0.0, 0.0]
        if w.kind == "rotation":
            turned[AXIS[w.axis]] = math.radians(w.value)
        assert turn.as_rotvec() == pytest.approx(turned, abs=1e-9)


vectors = st.lists(st.floats(-2, 2), min_size=3, max_size=3)


@given(rotation=vectors, axes=st.one_of(st.just("tool"), vectors), value=st.floats(-20, 20))
@settings(max_examples=30, deadline=None)
def test_moves_and_turns_are_about_the_given_axes(
    tmp_path_factory: pytest.TempPathFactory, rotation: list[float], axes: str | list[float], value: float
) -> None:
    steps = [{"translation": {"axes": ["y"], "values_mm": [value]}}, {"rotation": {"values_deg": [value]}}]
    plan = load_plan(written(tmp_path_factory.mktemp("plan"), steps, axes, rotation))
    frame = Rotation.from_rotvec(rotation if axes == "tool" else axes)
    start = Rotation.from_rotvec(rotation)
    for w in plan.waypoints:
        along = [0.0, 0.0, 0.0]
        along[AXIS[w.axis]] = w.value
        shift = [a - b for a, b in zip(w.pose[:3], (400, 0, 300), strict=True)]
        moved = w.kind == "translation"
        assert shift == pytest.approx(frame.apply(along if moved else [0, 0, 0]), abs=1e-9)
        turn = [0, 0, 0] if moved else [math.radians(v) for v in along]
        expected = frame * Rotation.from_rotvec(turn) * frame.inv() * start
        assert (Rotation.from_rotvec(w.pose[3:]) * expected.inv()).magnitude() < 1e-9


def test_spread_sets_cover_their_ranges(tmp_path: Path) -> None:
    ranges = {"x_mm": [-50, 50], "y_mm": [-30, 30], "z_mm": [-40, 0], "tilt_deg": [10, 30], "roll_deg": [-90, 90]}
    plan = load_plan(written(tmp_path, [{"calibration": {"count": 32, **ranges}}], "base"))
    shift = plan.positions() - torch.tensor([400.0, 0, 300])
    for axis, (low, high) in enumerate(([-50, 50], [-30, 30], [-40, 0])):
        inside = shift[:, axis]
        assert bool(((inside >= low) & (inside <= high)).all())
        assert float(inside.max() - inside.min()) > 0.9 * (high - low)
    for w in plan.waypoints:
        # the tool's z axis, down at the origin, leans by the tilt
        lean = Rotation.from_rotvec(w.pose[3:]).apply([0, 0, 1]) @ [0, 0, -1]
        assert 10 - 1e-6 <= math.degrees(math.acos(lean)) <= 30 + 1e-6
        assert (w.kind, w.axis, w.origin) == ("calibration", None, False)
    again = load_plan(written(tmp_path, [{"calibration": {"count": 32, **ranges}}], "base"))
    assert again.digest == plan.digest
    other = load_plan(written(tmp_path, [{"calibration": {"count": 32, "seed": 1, **ranges}}], "base"))
    assert other.digest != plan.digest


def test_explicit_poses_and_repeats(tmp_path: Path) -> None:
    pose = [410.0, 1.0, 290.0, 3.0, 0.1, 0.0]
    plan = load_plan(written(tmp_path, [{"poses": [pose]}, {"rotation": {"values_deg": [0, 2], "repeats": 2}}]))
    assert plan.waypoints[0].pose == tuple(pose)
    assert [w.value for w in plan.waypoints[1:5]] == [0, 0, 2, 2]
    assert len({w.id for w in plan.waypoints}) == len(plan.waypoints) == 13


def test_a_waypoint_out_of_the_workspace(tmp_path: Path) -> None:
    plan = load_plan(written(tmp_path, [{"translation": {"axes": ["z"], "values_mm": [1, 9]}}], "base"))
    plan.check(Workspace(min=[390, -5, 295], max=[405, 5, 309]))
    with pytest.raises(ConfigError, match=r"plan.yaml: steps: waypoint 0002 \(translation z 9 mm\) has z = 309.0 mm"):
        plan.check(Workspace(min=[390, -5, 295], max=[405, 5, 308]))


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([], "steps"),
        ([{}], "steps[0]: holds 0 kinds"),
        ([{"static": {"repeats": 1}, "poses": [[0.0] * 6]}], "steps[0]: holds 2 kinds"),
        ([{"poses": []}], "steps[0].poses: is empty; give at least 1"),
        ([{"static": None}], "steps[0]: holds 1 kinds"),
        ([{"static": {"repeats": 10000}}] * 3, "steps: has 30000 waypoints; give at most 20000"),
        (
            [{"translation": {"values_mm": [1e9]}}],
            "values_mm[0]: is 1000000000.0; give at most 1e+07",
        ),
        ([{"static": {"repeats": 0}}], "steps[0].static.repeats"),
        ([{"rotation": {"axes": ["x"], "values_deg": [1]}}], "steps[0].rotation.axes[0]: is 'x'"),
        ([{"translation": {"values_mm": [float("nan")]}}], "is not finite"),
        ([{"translation": {"value_mm": [1]}}], "did you mean values_mm?"),
        ([{"handeye": {"count": 2, "x_mm": [3, -3]}}], "limits 3 > -3"),
        ([{"poses": [[1, 2, 3]]}], "steps[0].poses[0]: has 3 entries; give 6"),
        ([{"poses": [[400, 0, 300, 0, 0, 90]]}], "steps[0].poses[0]: turns by 90 rad, more than once around"),
    ],
)
def test_mistakes(tmp_path: Path, steps: list[Any], words: str) -> None:
    path = written(tmp_path, steps)
    with pytest.raises(ConfigError) as caught:
        load_plan(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message
