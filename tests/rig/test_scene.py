"""What the cameras of a twin see: geometry of every mounting against 4 x 4 matrices, conditions, sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchpose.camera import Camera
from torchpose.rig.twin.scene import Scene, _flange
from torchpose.sim import render

ROOT = Path(__file__).parents[2]
F64 = torch.float64
CAMERA = Camera(
    160, 120, torch.tensor([[250.0, 0, 79.5], [0, 250.0, 59.5], [0, 0, 1]], dtype=F64), torch.zeros(5, dtype=F64)
)
TOOL = [400.0, 10.0, 300.0, 3.0, 0.2, -0.1]


def matrix(pose: dict[str, Any]) -> NDArray[np.float64]:
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = Rotation.from_rotvec(pose["rotation"]).as_matrix(), pose["translation"]
    return m


def scene(folder: Path, camera: dict[str, Any], target: dict[str, Any], **changes: Any) -> Scene:
    CAMERA.save(folder / "camera.json")
    given = {"cameras": [{"camera": "camera.json", "focal_scale": 1.01, **camera}], "target": "quad40", **target}
    path = folder / "twin.yaml"
    path.write_text(yaml.safe_dump({**given, **changes}))
    return Scene.load(path)


@pytest.mark.parametrize("camera_on", ["base", "tool"])
@pytest.mark.parametrize("target_on", ["base", "tool"])
def test_where_the_target_is(tmp_path: Path, camera_on: str, target_on: str) -> None:
    camera = {"rotation": [0.1, -0.2, 0.3], "translation": [10.0, 20.0, 30.0]}
    target = {"rotation": [-0.3, 0.1, 0.2], "translation": [5.0, -4.0, 3.0]}
    there = scene(tmp_path, {f"{camera_on}_from_camera": camera}, {f"{target_on}_from_target": target})
    tool = matrix({"rotation": TOOL[3:], "translation": TOOL[:3]})
    in_base = {"base": np.eye(4), "tool": tool}
    expected = np.linalg.inv(in_base[camera_on] @ matrix(camera)) @ in_base[target_on] @ matrix(target)
    R, t = there.camera_from_target("camera", TOOL)
    np.testing.assert_allclose(R, expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(t, expected[:3, 3], atol=1e-10)


@pytest.mark.parametrize(("bits", "noise"), [(8, 1.0), (12, 0.5)])
def test_frames_have_the_asked_depth_and_noise(tmp_path: Path, bits: int, noise: float) -> None:
    place = {"rotation": [0.02, 0.01, 0.0], "translation": [0.0, 0.0, 160.0]}
    imaging = {"noise": noise, "psf_sigma": 0.8, "dark": 40.0, "light": 200.0}
    there = scene(
        tmp_path,
        {"base_from_camera": {"rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}},
        {"base_from_target": place},
        imaging=imaging,
    )
    frames = [there.frame("camera", TOOL, number, bits).double() for number in (0, 1)]
    scale = (2**bits - 1) / 255
    R, t = there.camera_from_target("camera", TOOL)
    longer = there.cameras["camera"]
    assert float(longer.matrix[0, 0]) == pytest.approx(252.5)  # focal_scale
    ideal = render(longer, there.target, R[None], t[None], psf_sigma=0.8, dark=40, light=200)[0].double()
    assert float((frames[0] - frames[1]).std()) == pytest.approx(
        2**0.5 * (noise**2 * scale**2 + 1 / 12) ** 0.5, rel=0.05
    )
    assert float((frames[0] - scale * ideal).mean()) == pytest.approx(0, abs=0.1)


def test_the_flange_is_where_the_tool_offset_says() -> None:
    tcp = [10.0, -5.0, 60.0, 0.1, 0.2, -0.3]
    flange = _flange(TOOL, tcp)
    as_matrix = [matrix({"rotation": p[3:], "translation": p[:3]}) for p in (flange, tcp, TOOL)]
    np.testing.assert_allclose(as_matrix[0] @ as_matrix[1], as_matrix[2], atol=1e-10)
    assert _flange(TOOL, None) == TOOL


@pytest.mark.parametrize("size", ["", "_2mp"])
def test_the_shipped_files_belong_together(size: str) -> None:
    from torchpose.datasets.plan import markers_in_view
    from torchpose.rig.plan import load_plan
    from torchpose.rig.settings import load_rig

    folder = ROOT / "configs/rig"
    rig = load_rig(folder / f"ur5_{'20mp' if not size else '2mp'}.yaml")
    there = Scene.load(folder / f"twin{size}.yaml")
    there.check(rig, "twin")
    for name in ("paper_plan", "calibration_plan"):
        plan = load_plan(folder / f"{name}.yaml")
        plan.check(rig.robot.workspace)
        poses = [there.camera_from_target("camera", waypoint.pose) for waypoint in plan.waypoints]
        R, t = (torch.stack(parts) for parts in zip(*poses, strict=True))
        assert bool((markers_in_view(there.cameras["camera"], there.target, R, t) == len(there.target)).all())
