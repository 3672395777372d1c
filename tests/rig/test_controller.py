"""The twin of the controller: its state machine with a clock of the test's own, and its sockets with ur-rtde."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchpose.errors import ConfigError
from torchpose.rig import dashboard
from torchpose.rig.twin import wire
from torchpose.rig.twin.controller import Fault, TwinController, TwinErrors
from torchpose.rig.twin.machine import DONE, READY, Machine, Safety

START = np.array([0.4, 0.0, 0.3, math.pi, 0.0, 0.0])
MOVE_L, SET_TCP, STOP_SCRIPT = 3, 29, 255


def machine(**errors: float) -> Machine:
    result = Machine(START, errors, seed=1)
    result.upload(0.0)
    return result


def command(m: Machine, number: int, doubles: np.ndarray, now: float, asynchronous: bool = True) -> None:
    """What the client does for one command: clear, then number and arguments."""
    m.write({"input_int_register_0": 0}, now)
    assert m.registers["output_int_register_0"] == READY
    arguments = {f"input_double_register_{i}": float(v) for i, v in enumerate(doubles)}
    m.write({**arguments, "input_int_register_1": int(asynchronous), "input_int_register_0": number}, now)


def move(m: Machine, goal: np.ndarray, now: float, asynchronous: bool = True) -> float:
    """Starts a move at 0.1 m/s; the time of its arrival."""
    command(m, MOVE_L, np.array([*goal, 0.1, 1.0]), now, asynchronous)
    return now + m.motion.duration


def is_running(m: Machine) -> bool:
    return bool(int(m.registers["output_int_register_2"]) >> 15 & 1)


def test_asynchronous_move_is_done_at_once_and_runs_until_it_arrives() -> None:
    m, goal = machine(), START + np.array([0.02, 0, 0, 0, 0, 0])
    end = move(m, goal, 1.0)
    assert m.registers["output_int_register_0"] == DONE
    m.advance(end - 0.01)
    assert is_running(m)
    m.advance(end + 0.001)
    assert not is_running(m)
    np.testing.assert_allclose(m.pose(end + 1), goal, atol=1e-12)
    changes = int(m.registers["output_int_register_2"]) >> 16 & 127
    assert changes == 3  # ready, started, finished


def test_synchronous_move_is_done_when_it_arrives() -> None:
    m = machine()
    end = move(m, START + np.array([0, 0.02, 0, 0, 0, 0]), 1.0, asynchronous=False)
    m.advance(end - 0.01)
    assert m.registers["output_int_register_0"] == READY
    m.advance(end + 0.001)
    assert m.registers["output_int_register_0"] == DONE


def test_tool_offset_changes_the_reported_pose_but_not_the_flange() -> None:
    m = machine()
    command(m, SET_TCP, np.array([0, 0, 0.1, 0, 0, 0]), 1.0)
    np.testing.assert_allclose(m.pose(1.0)[:3], [0.4, 0, 0.2], atol=1e-12)  # the tool points downwards
    command(m, SET_TCP, np.array([0.05, 0, 0.1, 0, 0, 0]), 1.0)
    np.testing.assert_allclose(m.pose(1.0)[:3], [0.45, 0, 0.2], atol=1e-12)
    assert m.reachable(np.array([0.89, 0, 0.0, math.pi, 0, 0]))
    assert not m.reachable(np.array([0.90, 0, 0.0, math.pi, 0, 0]))


@pytest.mark.parametrize("fault", [Fault.PROTECTIVE_STOP, Fault.SAFEGUARD_STOP, Fault.EMERGENCY_STOP])
def test_safety_stop_brakes_at_its_place_on_the_path(fault: Fault) -> None:
    m = machine()
    m.inject(fault, 0.4, 0.0)
    end = move(m, START + np.array([0.1, 0, 0, 0, 0, 0]), 1.0)
    for now in np.arange(1.0, end + 1, 0.004):
        m.advance(now)
    x = m.pose(end + 1)[0] - START[0]
    assert 0.04 <= x <= 0.04 + 0.1 * 0.004 + 0.1**2 / (2 * 5.0) + 1e-9  # the fraction, one tick, the braking distance
    assert m.safety is Safety[fault.name]
    assert m.value("safety_status_bits", end) & (1 << 2 | 1 << 4 | 1 << 7)
    assert m.value("robot_mode", end) == (3 if fault is Fault.EMERGENCY_STOP else 7)
    m.clear()
    assert (m.safety, m.program) == (Safety.NORMAL, False)


def test_end_of_the_program_brakes_and_takes_no_more_commands() -> None:
    m = machine()
    move(m, START + np.array([0.1, 0, 0, 0, 0, 0]), 1.0)
    m.stop_program(1.5)
    assert m.value("runtime_state", 1.5) == 1
    assert not m.motion.moving(1.6)
    before = m.pose(2.0)
    m.write({"input_int_register_0": 0}, 2.0)
    m.write({"input_int_register_0": MOVE_L}, 2.0)
    np.testing.assert_array_equal(m.pose(5.0), before)


def test_true_pose_repeats_with_the_given_spread_and_is_continuous() -> None:
    m = machine(repeatability_mm=0.05, repeatability_deg=0.02)
    goals = [START + np.array([0.01, 0, 0, 0.1, 0, 0]), START]
    now, errors = 1.0, []
    for i in range(600):
        goal = goals[i % 2]
        before = m.true_pose(now)
        end = move(m, goal, now)
        np.testing.assert_allclose(m.true_pose(now), before, atol=1e-9)
        now = end + 1
        m.advance(now)
        true = m.true_pose(now)
        turn = (Rotation.from_rotvec(true[3:]) * Rotation.from_rotvec(goal[3:]).inv()).as_rotvec(degrees=True)
        errors.append([*(1e3 * (true[:3] - goal[:3])), *turn])
    spread = np.std(errors, axis=0)
    # 600 samples: relative standard deviation of a standard deviation 1 / sqrt(1200) = 0.029, four of them allowed
    np.testing.assert_allclose(spread, [0.05] * 3 + [0.02] * 3, rtol=0.12)
    np.testing.assert_allclose(np.mean(errors, axis=0) / spread, 0, atol=4 / math.sqrt(600))


def test_scale_stretches_displacements_from_the_start() -> None:
    m = machine(scale=1e-3)
    end = move(m, START + np.array([0.05, 0, -0.02, 0, 0, 0]), 1.0)
    np.testing.assert_allclose(m.true_pose(end)[:3] - START[:3], [0.05005, 0, -0.02002], atol=1e-12)
    np.testing.assert_allclose(m.pose(end)[:3] - START[:3], [0.05, 0, -0.02], atol=1e-12)


def test_packets_carry_what_their_types_say() -> None:
    recipe = wire.Recipe(7, ("timestamp", "actual_TCP_pose", "robot_mode", "input_int_register_3"))
    assert recipe.types == ["DOUBLE", "VECTOR6D", "INT32", "INT32"]
    data = recipe.pack([1.5, range(6), 7, -2])
    assert data[:4] == bytes([0, 4 + 8 + 48 + 8, ord("U"), 7])
    assert data[4:12] == np.array([1.5], ">f8").tobytes()
    assert data[12:60] == np.arange(6, dtype=">f8").tobytes()
    assert wire.Recipe(1, ("robot_mode", "timestamp")).unpack(
        b"\xff\xff\xff\xfe" + np.array([0.25], ">f8").tobytes()
    ) == {"robot_mode": -2, "timestamp": 0.25}
    assert wire.Recipe(1, ("no_such_variable",)).types == ["NOT_FOUND"]
    assert wire.names(b"a,b,") == ("a", "b")


CLIENTS = """
import json, sys, time
import dashboard_client, rtde_control, rtde_receive
host = sys.argv[1]
board = dashboard_client.DashboardClient(host)
board.connect(2000)
out = {"remote": board.isInRemoteControl(), "serial": board.getSerialNumber(), "version": board.polyscopeVersion()}
receive = rtde_receive.RTDEReceiveInterface(host)
control = rtde_control.RTDEControlInterface(host)
out["tcp"] = control.setTcp([0, 0, 0.1, 0, 0, 0]) and control.getTCPOffset()
pose = receive.getTargetTCPPose()
goal = [pose[0] + 0.005, *pose[1:]]
out["moved"] = control.moveL(goal, 0.1, 1.0)
receive_wait = [receive.waitPeriod(receive.initPeriod()) for _ in range(3)]
out["steady"], out["pose"] = control.isSteady(), receive.getActualTCPPose()
out["asynchronous"] = control.moveL(pose, 0.01, 1.0, True)
control.stopL(5.0)
out["running"] = control.isProgramRunning()
out["reach"] = [control.isPoseWithinSafetyLimits(p) for p in (goal, [2.0, 0, 0, 0, 0, 0])]
control.stopScript()
out["stopped"] = not control.isProgramRunning()
out["again"] = control.reuploadScript()
while not control.isProgramRunning():
    time.sleep(0.01)
out["again"] = out["again"] and control.moveL(goal, 0.1, 1.0)
control.disconnect()
receive.disconnect()
board.disconnect()
print(json.dumps(out))
"""


def test_real_clients_work_against_it(loopback: str) -> None:
    pytest.importorskip("rtde_control", reason="needs ur-rtde: pip install '.[rig]'")
    with TwinController(loopback, errors=TwinErrors()) as twin:
        done = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(CLIENTS), loopback], capture_output=True, text=True, timeout=30
        )
        assert done.returncode == 0, done.stderr
        out = json.loads(done.stdout.splitlines()[-1])
        assert out["remote"] is True
        assert out["serial"].isdigit()
        assert out["version"].startswith("5.")
        assert out["tcp"] == [0, 0, 0.1, 0, 0, 0]
        for name in ("moved", "steady", "asynchronous", "running", "stopped", "again"):
            assert out[name] is True, name
        np.testing.assert_allclose(out["pose"], [0.405, 0, 0.2, math.pi, 0, 0], atol=1e-9)
        assert out["reach"] == [True, False]
        assert twin.state()["moves"] == 3
        assert twin.true_pose() == pytest.approx([405, 0, 200, math.pi, 0, 0], abs=1e-6)


def test_an_address_in_use_is_one_line(loopback: str) -> None:
    with (
        TwinController(loopback),
        pytest.raises(ConfigError, match=r"^127[^\n]*: twin: cannot serve there .*; end the"),
    ):
        TwinController(loopback)


def test_by_hand(loopback: str) -> None:
    command = [sys.executable, "-m", "torchpose.rig.twin.controller", "--host", loopback]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == f"a UR controller's twin answers at {loopback}; Ctrl-C ends it\n"
    assert dashboard.ask(loopback, ["get robot model"], 5.0) == ["UR5 torchpose twin"]
    second = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert second.returncode == 1
    assert re.fullmatch(rf"error: {loopback}: twin: cannot serve there .*; end the other twin .*\n", second.stderr)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=10)
    assert process.returncode == 0


def test_it_ends_with_its_parent(loopback: str) -> None:
    code = f"import time; from torchpose.rig.twin.controller import TwinController as T; t = T('{loopback}'); print(1)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert done.stdout == "1\n", done.stderr
    with TwinController(loopback):  # its ports are free again
        pass
