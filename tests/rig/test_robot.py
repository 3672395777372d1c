"""The robot client against the twin, with the real ur-rtde: every fault ends within its deadline, with its name."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchpose.config import validate
from torchpose.errors import ConfigError
from torchpose.rig.robot import Robot, RobotFault, RobotReason, RobotSettings, Settle, Workspace
from torchpose.rig.twin.controller import START_POSE, Fault, TwinController

WORKSPACE = Workspace(min=[200.0, -200.0, 100.0], max=[600.0, 200.0, 800.0])
FAR = (430.0, 0.0, 300.0, math.pi, 0.0, 0.0)  # 30 mm from the start: 0.85 s at the speed of these tests

needs_ur_rtde = pytest.mark.skipif(
    importlib.util.find_spec("rtde_control") is None, reason="needs ur-rtde: pip install '.[rig]'"
)


def settings(host: str, **changes: object) -> RobotSettings:
    values = {
        "host": host,
        "workspace": WORKSPACE,
        "speed_mm_s": 40.0,
        "acceleration_mm_s2": 400.0,
        "settle": Settle(samples=5, timeout_s=0.5),
        "connect_timeout_s": 2.0,
        "move_margin_s": 0.5,
    }
    return RobotSettings.model_validate({**values, **changes})


@pytest.fixture
def twin(loopback: str) -> Iterator[TwinController]:
    with TwinController(loopback) as running:
        yield running


@pytest.fixture
def robot(twin: TwinController) -> Iterator[Robot]:
    with Robot(settings(twin.host)) as ready:
        ready.preflight()
        yield ready


@contextlib.contextmanager
def fault_within(seconds: float, reason: RobotReason) -> Iterator[None]:
    """The block raises a `RobotFault` of this reason, in one line, within the time."""
    begin = time.monotonic()
    with pytest.raises(RobotFault) as caught:
        yield
    assert caught.value.reason == reason, caught.value
    assert time.monotonic() - begin < seconds
    message = str(caught.value)
    assert re.fullmatch(r"robot 127[.0-9]+: .+; .+", message), message


def stands(twin: TwinController, within_s: float) -> bool:
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if not twin.state()["moving"]:
            return True
        time.sleep(0.002)
    return False


def wait_for_motion(twin: TwinController) -> None:
    deadline = time.monotonic() + 5
    while not (twin.state()["moving"] and twin.state()["fraction"] > 0.1):
        assert time.monotonic() < deadline
        time.sleep(0.005)


# settings and checks that need no robot


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hosts": "a"}, r"^rig.yaml: hosts: unknown key; did you mean host\?"),
        ({"speed_mm_s": 251.0}, "^rig.yaml: speed_mm_s: is 251.0; give at most 250"),
        ({"acceleration_mm_s2": 0.0}, "^rig.yaml: acceleration_mm_s2: is 0.0; give more than 0"),
        ({"workspace": {"min": [0, 0, 0.0], "max": [1, 0, 1.0]}}, "^rig.yaml: workspace: is empty along y .*; give"),
        ({"workspace": {"min": [0, 0, float("nan")], "max": [1, 1, 1]}}, "workspace.min.*is not finite"),
        ({"tcp": [0, 0, 100.0, 0, 0]}, "^rig.yaml: tcp: has 5 entries; give 6"),
        ({"host": ""}, "^rig.yaml: host: "),
    ],
)
def test_settings_name_the_field(change: dict[str, object], message: str) -> None:
    data = {"host": "ur5", "workspace": {"min": [0.0, 0, 0], "max": [1.0, 1, 1]}, **change}
    with pytest.raises(ConfigError, match=message):
        validate(RobotSettings, data, "rig.yaml")


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        ([400, 0, 300, math.nan, 0, 0], RobotReason.INVALID_POSE),
        ([math.inf, 0, 300, 0, 0, 0], RobotReason.INVALID_POSE),
        ([400, 0, 300, 0, 0], RobotReason.INVALID_POSE),
        ([400, 0, 300, 0, 0, 0, 0], RobotReason.INVALID_POSE),
        (["a", 0, 300, 0, 0, 0], RobotReason.INVALID_POSE),
        (None, RobotReason.INVALID_POSE),
        ([600.001, 0, 300, 0, 0, 0], RobotReason.OUTSIDE_WORKSPACE),
        ([400, -200.001, 300, 0, 0, 0], RobotReason.OUTSIDE_WORKSPACE),
        ([400, 0, 99.999, 0, 0, 0], RobotReason.OUTSIDE_WORKSPACE),
    ],
)
def test_wrong_poses_are_rejected_without_a_robot(pose: list[float], reason: RobotReason) -> None:
    robot = Robot(settings("127.0.0.1"))
    for call in (robot.check, robot.move, lambda p: robot.preflight([p])):
        with fault_within(0.5, reason):
            call(pose)


@given(st.lists(st.floats() | st.floats(150.0, 250.0), min_size=6, max_size=6))
def test_a_pose_passes_exactly_when_it_is_finite_and_inside(pose: list[float]) -> None:
    robot = Robot(settings("127.0.0.1"))
    finite = all(map(math.isfinite, pose))
    inside = all(a <= v <= b for v, a, b in zip(pose, WORKSPACE.min, WORKSPACE.max, strict=False))
    if finite and inside:
        assert robot.check(pose) == tuple(pose)
    else:
        with fault_within(0.5, RobotReason.OUTSIDE_WORKSPACE if finite else RobotReason.INVALID_POSE):
            robot.check(pose)


def test_poses_on_the_edge_of_the_workspace_are_inside() -> None:
    robot = Robot(settings("127.0.0.1"))
    for corner in (WORKSPACE.min, WORKSPACE.max):
        assert robot.check([*corner, 0, 0, 1]) == (*corner, 0, 0, 1)


@needs_ur_rtde
def test_nobody_there() -> None:
    with fault_within(2.5, RobotReason.UNREACHABLE):
        Robot(settings("127.0.0.1", connect_timeout_s=1.0)).preflight()


# the good case


@needs_ur_rtde
def test_moves_settle_and_readings_are_fresh(twin: TwinController) -> None:
    tool = [0.0, 0.0, 100.0, 0.0, 0.0, 0.0]
    start = [400.0, 0.0, 200.0, math.pi, 0.0, 0.0]  # what the start pose becomes with this tool
    goals = [[405.0, 2.0, 201.0, math.pi, 0.0, 0.0], [405.0, 2.0, 201.0, math.pi - 0.02, 0.01, 0.0], start]
    with Robot(settings(twin.host, tcp=tool)) as robot:
        report = robot.preflight(goals)
        assert report["emulated"] is True
        assert report["remote"] is True
        assert report["serial"].isdigit()
        assert report["tcp_offset"] == pytest.approx(tool)
        assert report["pose"] == pytest.approx(start, abs=1e-6)
        assert twin.state()["moves"] == 0
        for goal in goals:
            before = time.time()
            reading = robot.move(goal)
            assert reading.pose == pytest.approx(goal, abs=1e-6)
            assert before < reading.host_time_s < time.time()
            assert (reading.robot_mode, reading.safety_mode, reading.safety_bits, reading.runtime_state) == (7, 1, 1, 2)
        assert twin.true_pose() == pytest.approx(start, abs=1e-6)
        first, second = robot.read(), robot.read(fresh=10)
        assert second.robot_time_s - first.robot_time_s > 9 / 125
        assert twin.state()["moves"] == 3
    assert twin.state()["program"] is False
    robot.close()  # a second time is nothing
    with fault_within(0.5, RobotReason.CONNECTION_LOST):
        robot.read()


# the fault table


@needs_ur_rtde
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault.PROTECTIVE_STOP, RobotReason.PROTECTIVE_STOP),
        (Fault.SAFEGUARD_STOP, RobotReason.SAFETY_STOP),
        (Fault.EMERGENCY_STOP, RobotReason.EMERGENCY_STOP),
    ],
)
def test_safety_stop_in_mid_move(robot: Robot, twin: TwinController, fault: Fault, reason: RobotReason) -> None:
    twin.inject(fault, at_fraction=0.4)
    with fault_within(1.5, reason):
        robot.move(FAR)
    with fault_within(1.0, reason):  # nothing has been unlocked, nothing moves again
        robot.move(FAR)
    with fault_within(1.0, reason):
        Robot(robot.settings).preflight()
    state = twin.state()
    assert 0.4 <= state["fraction"] < 0.5
    assert (state["moves"], state["unlocks"], state["moving"]) == (1, 0, False)


@needs_ur_rtde
def test_controller_killed_in_mid_move(robot: Robot, twin: TwinController) -> None:
    twin.inject(Fault.KILL, at_fraction=0.4)
    with fault_within(2.0, RobotReason.CONNECTION_LOST):
        robot.move(FAR)


@needs_ur_rtde
def test_stalled_stream_in_mid_move(robot: Robot, twin: TwinController) -> None:
    twin.inject(Fault.STALL, at_fraction=0.2)
    with fault_within(2.0, RobotReason.STALE_STREAM):
        robot.move(FAR)
    assert twin.state()["program"] is False
    assert twin.state()["fraction"] < 1


@needs_ur_rtde
@pytest.mark.parametrize("fault", [Fault.SILENT, Fault.SILENT_STREAM])
def test_silent_server(loopback: str, fault: Fault) -> None:
    robot = Robot(settings(loopback, connect_timeout_s=0.5))
    with TwinController(loopback, faults=[fault]), robot, fault_within(1.5, RobotReason.TIMED_OUT):
        robot.preflight()


@needs_ur_rtde
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault.REFUSE_SCRIPT, RobotReason.REFUSED_SCRIPT),
        (Fault.NOT_REMOTE, RobotReason.NOT_REMOTE),
        (Fault.REGISTERS_IN_USE, RobotReason.REGISTERS_IN_USE),
    ],
)
def test_refusals_while_connecting(loopback: str, fault: Fault, reason: RobotReason) -> None:
    with TwinController(loopback, faults=[fault]) as twin:
        robot = Robot(settings(loopback, connect_timeout_s=1.0))
        with fault_within(2.5, reason), robot:
            robot.preflight()
        twin.clear()
        with robot:  # the same object connects once the cause is gone
            assert robot.preflight()["safety_status"] == "NORMAL"


@needs_ur_rtde
@pytest.mark.slow
def test_refused_script_as_ur_rtde_itself_reports_it(loopback: str) -> None:
    robot = Robot(settings(loopback, connect_timeout_s=9.0))
    twin = TwinController(loopback, faults=[Fault.REFUSE_SCRIPT])
    with twin, robot, fault_within(9.0, RobotReason.REFUSED_SCRIPT):
        robot.preflight()


@needs_ur_rtde
def test_a_program_of_somebody_else_is_left_alone(robot: Robot, twin: TwinController) -> None:
    with fault_within(2.0, RobotReason.NOT_READY):
        Robot(robot.settings).preflight()
    assert twin.state()["program"] is True
    assert robot.move(FAR).pose == pytest.approx(FAR, abs=1e-6)


@needs_ur_rtde
def test_poses_that_cannot_be_reached_fail_before_anything_moves(robot: Robot, twin: TwinController) -> None:
    for pose, reason in (
        ([590.0, 0.0, 790.0, 0.0, 0.0, 0.0], RobotReason.UNREACHABLE_POSE),
        ([610.0, 0.0, 300.0, 0.0, 0.0, 0.0], RobotReason.OUTSIDE_WORKSPACE),
        ([math.nan] * 6, RobotReason.INVALID_POSE),
    ):
        with fault_within(2.0, reason):
            robot.preflight([FAR, pose])
    assert twin.state()["moves"] == 0


@needs_ur_rtde
def test_tool_outside_the_workspace_at_the_start(loopback: str) -> None:
    outside = (400.0, 0.0, 50.0, *START_POSE[3:])
    with TwinController(loopback, start_pose=outside) as twin, Robot(settings(loopback)) as robot:
        with fault_within(2.0, RobotReason.OUTSIDE_WORKSPACE):
            robot.preflight()
        with fault_within(2.0, RobotReason.OUTSIDE_WORKSPACE):
            robot.move(FAR)
        assert twin.state()["moves"] == 0


@needs_ur_rtde
def test_driver_process_killed_in_mid_move(robot: Robot, twin: TwinController) -> None:
    assert robot._child is not None
    threading.Timer(0.3, os.kill, (robot._child.pid, signal.SIGKILL)).start()
    with fault_within(1.5, RobotReason.CHILD_DIED):
        robot.move(FAR)
    assert stands(twin, 0.2)
    assert twin.state()["fraction"] < 1


@needs_ur_rtde
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault.SLOW, RobotReason.TIMED_OUT),
        (Fault.OFF_TARGET, RobotReason.NOT_SETTLED),
        (Fault.IGNORE_MOVE, RobotReason.PROGRAM_STOPPED),
    ],
)
def test_moves_that_do_not_arrive(robot: Robot, twin: TwinController, fault: Fault, reason: RobotReason) -> None:
    twin.inject(fault)
    with fault_within(2.5, reason):
        robot.move(FAR)
    assert twin.state()["program"] is False
    assert stands(twin, 0.2)


@needs_ur_rtde
def test_stop_from_another_thread(robot: Robot, twin: TwinController) -> None:
    stopped: list[tuple[bool, float, bool]] = []

    def stop() -> None:
        wait_for_motion(twin)
        begin = time.monotonic()
        confirmed = robot.stop()
        took = time.monotonic() - begin
        stopped.append((confirmed, took, stands(twin, 0.2 - took)))

    thread = threading.Thread(target=stop)
    thread.start()
    with fault_within(2.0, RobotReason.STOPPED):
        robot.move(FAR)
    thread.join()
    confirmed, took, standing = stopped[0]
    assert confirmed
    assert standing
    assert took < 0.2
    with fault_within(0.5, RobotReason.STOPPED):
        robot.move(FAR)
    assert twin.state()["moves"] == 1


@needs_ur_rtde
def test_stop_returns_in_time_when_nobody_answers(robot: Robot, twin: TwinController) -> None:
    twin.inject(Fault.SILENT)
    begin = time.monotonic()
    assert robot.stop() is False
    assert time.monotonic() - begin < 0.3


MOVING = """
import sys
from torchpose.rig.robot import Robot, RobotSettings
with Robot(RobotSettings.model_validate_json(sys.argv[1])) as robot:
    robot.preflight()
    print("ready", flush=True)
    robot.move([430.0, 0.0, 300.0, 3.141592653589793, 0.0, 0.0])
"""


@needs_ur_rtde
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_program_interrupted_or_killed_in_mid_move(twin: TwinController, number: signal.Signals) -> None:
    slow = settings(twin.host, speed_mm_s=10.0).model_dump_json()
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(MOVING), slow], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    wait_for_motion(twin)
    process.send_signal(number)
    assert stands(twin, 0.2)
    assert twin.state()["fraction"] < 1
    _, errors = process.communicate(timeout=10)
    assert process.returncode != 0
    assert number == signal.SIGKILL or "KeyboardInterrupt" in errors


@needs_ur_rtde
def test_program_ended_at_the_pendant_in_mid_move(robot: Robot, twin: TwinController) -> None:
    from torchpose.rig import dashboard

    threading.Timer(0.3, dashboard.stop, (twin.host, 1.0)).start()
    with fault_within(1.5, RobotReason.PROGRAM_STOPPED):
        robot.move(FAR)
