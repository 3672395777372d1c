"""The names of the robot's faults, against Universal Robots' RTDE guide, and the page that explains them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from torchpose.config import validate
from torchpose.rig.robot import RobotReason, RobotSettings
from torchpose.rig.robot_faults import of_dashboard, of_safety_bits

PAGE = (Path(__file__).parents[2] / "docs" / "robot.md").read_text()
# safety_status_bits: normal mode, reduced mode, protective stopped, recovery mode, safeguard stopped, system emergency
# stopped, robot emergency stopped, emergency stopped, violation, fault, stopped due to safety
BITS = [
    None, None, "protective_stop", "safety_stop", "safety_stop", "emergency_stop", "emergency_stop", "emergency_stop",
    "safety_stop", "safety_stop", "safety_stop",
]  # fmt: skip


def test_every_safety_bit_has_its_name() -> None:
    for bit, name in enumerate(BITS):
        cause = of_safety_bits(1 << bit)
        assert (cause and cause[0]) == name, bit
    stopped = 1 << 10  # set beside the bit that says why
    assert (of_safety_bits(stopped | 1 << 2) or ("",))[0] == "protective_stop"
    assert (of_safety_bits(stopped | 1 << 6 | 1 << 7) or ("",))[0] == "emergency_stop"


@pytest.mark.parametrize(
    ("mode", "safety", "remote", "running", "reason"),
    [
        ("RUNNING", "NORMAL", "true", "false", None),
        ("RUNNING", "REDUCED", "true", "false", None),
        ("RUNNING", "NORMAL", "could not understand: 'is in remote control'", "false", None),  # before 5.6
        ("RUNNING", "NORMAL", "false", "false", "not_remote"),
        ("RUNNING", "NORMAL", "true", "true", "not_ready"),
        ("IDLE", "NORMAL", "true", "false", "not_ready"),
        ("POWER_OFF", "ROBOT_EMERGENCY_STOP", "true", "false", "emergency_stop"),
        ("RUNNING", "SYSTEM_EMERGENCY_STOP", "true", "false", "emergency_stop"),
        ("RUNNING", "PROTECTIVE_STOP", "true", "true", "protective_stop"),
        ("RUNNING", "AUTOMATIC_MODE_SAFEGUARD_STOP", "true", "false", "safety_stop"),
        ("RUNNING", "VIOLATION", "true", "false", "not_ready"),
    ],
)
def test_answers_of_the_dashboard(mode: str, safety: str, remote: str, running: str, reason: str | None) -> None:
    cause = of_dashboard(mode, safety, remote, running)
    assert (cause and cause[0]) == reason
    assert cause is None or "; " in cause[1]


def test_the_page_names_every_reason_and_only_those() -> None:
    table = PAGE[PAGE.index("| reason |") : PAGE.index("`tests/rig")]
    named = [name for row in table.strip().splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(named) == sorted(RobotReason)


def test_the_page_shows_the_defaults() -> None:
    block = yaml.safe_load(re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[0])["robot"]
    shown = validate(RobotSettings, block, "docs/robot.md")
    least = RobotSettings(host=shown.host, workspace=shown.workspace)
    assert shown.model_copy(update={"tcp": None}) == least
    assert set(block) == set(RobotSettings.model_fields)
