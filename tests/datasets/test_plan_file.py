"""Fields of plan files have ranges: what no camera does is refused where it is read."""

from pathlib import Path
from typing import Any

import pytest

from torchpose.config import validate
from torchpose.datasets.plan_file import PlanFile
from torchpose.errors import ConfigError

RANDOM = {"random": {"count": 4, "x": 0, "y": 0, "z": 160}}
LENS = {"f_number": 4, "focal_length": 8, "focus_distance": 150}
ABSURD = [
    ("imaging", {"flicker": 2}, "imaging.flicker: is 2; give a share"),
    ("imaging", {"ghost": 500}, "imaging.ghost: is 500; give grey levels of 0..255, 0 or more, at most 255"),
    ("imaging", {"light": [200, 1e9]}, "imaging.light: is 1e+09; give a grey level"),
    ("imaging", {"psf_sigma": 1e6}, "imaging.psf_sigma: is 1e+06; the blur"),
    ("imaging", {"clutter": 10**12}, "imaging.clutter: is 1000000000000; give at most 10000"),
    ("imaging", {"defocus": LENS, "disc_px": [0, 2]}, "imaging: has both defocus and disc_px"),
    ("imaging", {"psf_deg": 1e9}, "imaging.psf_deg: is 1e+09; give degrees, at most 3600"),
    ("imaging", {"motion_mm": [1, "x"]}, "imaging.motion_mm: is [1, 'x']; give a number"),
    ("processing", {"denoise": 1e9}, "processing.denoise: is 1000000000.0; give at most 255"),
    ("processing", {"sharpen": 1e9}, "processing.sharpen: is 1000000000.0; give at most 100"),
    ("print", {"seed": -1}, "print.seed: is -1; give at least 0"),
    ("print", {"scale": 1e9}, "print.scale: is 1e+09; give the relative error"),
    ("print", {"dpi": 1e12}, "print.dpi: is 1000000000000.0; give at most 20000"),
    ("sensor", {"full_well": 1e300}, "sensor.full_well: is 1e+300; give at most 1e+09"),
    ("sensor", {"gamma": 1e9}, "sensor.gamma"),
    ("poses", {"random": RANDOM["random"] | {"count": 10**12}}, "poses.random.count: is 1000000000000; give at most"),
    (
        "poses",
        {"grid": {"distance": 150, "angles_deg": [0.1 * i for i in range(50)]}},
        "has 125000 frames; give",
    ),
    ("poses", {"axes": {"start": [0, 0, 150], "translations": [1.0] * 40000}}, "has 120000 frames; give at most"),
    ("poses", [], "poses: is not a mapping"),
    ("poses", {}, "poses: holds 0 kinds"),
    ("seed", -1, "seed: is -1; give at least 0"),
    (
        "faults",
        {"RandomGaussianNoise": {"std": 1e9}},
        "faults: has RandomGaussianNoise.std = 1000000000.0; give",
    ),
    ("faults", {"RandomGaussianNoise": {"std": {}}}, "faults: has RandomGaussianNoise.std = {}; give numbers"),
    ("camera", "a\x1b[2J.yaml", r"camera: has the character '\x1b'; write the text without it"),
]


@pytest.mark.parametrize(("section", "value", "message"), ABSURD, ids=[row[2][:40] for row in ABSURD])
def test_absurd_values_are_refused_by_field(section: str, value: Any, message: str) -> None:
    plan = {"camera": "camera.yaml", "target": "quad40", "poses": RANDOM, section: value}
    with pytest.raises(ConfigError) as caught:
        validate(PlanFile, plan, Path("plan.yaml"))
    assert str(caught.value).startswith("plan.yaml: ")
    assert message in str(caught.value)
