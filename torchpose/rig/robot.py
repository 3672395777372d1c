"""A UR robot, driven through a child process so that no call can hang or crash the program that takes the pictures.

Lengths mm, angles rad; a pose is ``(x, y, z, rx, ry, rz)`` of the tool in the robot base, with a rotation vector.
A protective stop is never unlocked here: a person looks at the robot first.
"""

from __future__ import annotations

import importlib.util
import math
import threading
import time
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ConfigDict

from torchpose.errors import ConfigError
from torchpose.rig import dashboard, robot_faults
from torchpose.rig.child import Child, ChildError
from torchpose.rig.faults import RobotFault, RobotReason
from torchpose.rig.poses import Pose, as_pose, difference
from torchpose.rig.settings import RobotSettings, Settle, Workspace

__all__ = ["Robot", "RobotFault", "RobotReading", "RobotReason", "RobotSettings", "Settle", "Workspace"]

STOP_S = 0.2  # within which `stop` returns
_START_S = 20.0  # a loaded computer may take long to start Python
_CLOSE_S = 3.0
_CALL_S = 3.0  # for a request that the controller answers at once
_STOPPED_STATES = (0, 1)  # of runtime_state: stopping, stopped


class RobotReading(BaseModel):
    """One sample of the controller's stream; modes, bits and states as the controller numbers them (RTDE guide)."""

    model_config = ConfigDict(frozen=True)
    pose: Pose  # tool in the base
    joints: Pose  # rad
    robot_time_s: float  # the controller's clock
    host_time_s: float  # this computer's (Unix time) when the sample came in
    robot_mode: int
    safety_mode: int
    safety_bits: int
    runtime_state: int


class _State(RobotReading):
    """A reading with what `Robot.move` needs besides."""

    speed_fraction: float
    move_running: bool
    move_changes: int


class Robot:
    """One robot, for use in a ``with`` block: `preflight` first, then `move` and `read`, `close` at the end.

    Every method ends within a deadline. After a fault other than a rejected pose the robot has been told to stop.
    """

    def __init__(self, settings: RobotSettings) -> None:
        self.settings = settings
        self._child: Child | None = None
        self._stopped = threading.Event()

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def preflight(self, poses: Iterable[Any] = ()) -> dict[str, Any]:
        """Looks at the robot, connects and asks whether all poses can be reached, before anything moves.

        Args:
            poses: every pose of the plan.

        Returns:
            The answers to `robot_faults.QUESTIONS` (remote is None where the controller cannot say), host,
            tcp_offset (mm, rad), pose (mm, rad), emulated (the controller is torchpose's twin).

        Raises:
            RobotFault: whatever is in the way.
            ConfigError: ur-rtde is not installed.
        """
        plan = [self.check(pose) for pose in poses]
        if importlib.util.find_spec("rtde_control") is None:
            raise ConfigError("ur-rtde: package: is not installed; pip install 'torchpose[rig]'")
        self.close()
        report = self._look()
        self._child = Child("torchpose.rig.robot_child", quiet=True)
        self._call("load", _START_S)
        limit, frequency = self.settings.connect_timeout_s, self.settings.frequency_hz
        self._call("connect", limit, host=self.settings.host, frequency_hz=frequency)
        tcp = self._call("upload", limit, frequency_hz=frequency, tcp=self.settings.tcp)
        reading = self.read()
        self._require_inside(reading.pose, "the tool stands", self.settings.settle.tolerance_mm)
        for pose in dict.fromkeys(plan):  # each once
            if not self._call("is_reachable", _CALL_S, pose=pose):
                self._state()  # a stop or the end of the program explains it better
                which = f"pose {plan.index(pose)} of the plan, {_shown(pose)},"
                why = f"{which} is beyond its reach or its safety limits; move the plan"
                raise self._fault(RobotReason.UNREACHABLE_POSE, why)
        return {**report, "tcp_offset": tcp, "pose": list(reading.pose)}

    def check(self, pose: Any) -> Pose:
        """The pose, whatever it is, as six floats (mm, rad).

        Raises:
            RobotFault: it is not six finite numbers (`invalid_pose`) or leaves the workspace (`outside_workspace`).
        """
        try:
            numbers = as_pose(pose)
        except (TypeError, ValueError):
            numbers = as_pose([math.nan] * 6)
        if not all(map(math.isfinite, numbers)):
            why = f"pose {_shown(pose)} is not six finite numbers; give x, y, z (mm), rx, ry, rz (rad)"
            raise self._fault(RobotReason.INVALID_POSE, why)
        self._require_inside(numbers, "the commanded pose lies", 0.0)
        return numbers

    def read(self, fresh: int = 1) -> RobotReading:
        """The state of the robot after `fresh` more samples have come in.

        The stream lags by a sample or two: ask for more than one where the robot has just moved.

        Raises:
            RobotFault: the stream has stopped or the connection is lost, or the robot is not in normal operation.
        """
        return self._state(fresh)

    def move(self, pose: Any) -> RobotReading:
        """Moves the tool on a straight line, waits until it has settled, and returns the last reading.

        Raises:
            RobotFault: with the robot told to stop, except where the pose was rejected before anything was sent.
        """
        goal = self.check(pose)
        state = self._state()
        self._require_inside(state.pose, "the tool stands", self.settings.settle.tolerance_mm)
        try:
            self._travel(goal, state)
            return self._settle(goal)
        except BaseException:  # KeyboardInterrupt too: nothing may leave a moving robot behind
            dashboard.stop(self.settings.host, STOP_S)
            raise

    def stop(self) -> bool:
        """Stops the robot now and for good; whether the controller confirmed it. Returns within 0.2 s.

        May be called from a signal handler or another thread; a running `move` then raises `RobotFault` (`stopped`).
        """
        self._stopped.set()
        return dashboard.stop(self.settings.host, STOP_S)

    def close(self) -> None:
        """Ends the program on the robot, disconnects and ends the child process; never hangs."""
        child, self._child = self._child, None
        if child is not None:
            dashboard.stop(self.settings.host, STOP_S)
            child.close(_CLOSE_S)

    def _look(self) -> dict[str, Any]:
        """What the dashboard says, before the robot is touched."""
        host, limit = self.settings.host, self.settings.connect_timeout_s
        try:
            answers = dashboard.ask(host, list(robot_faults.QUESTIONS.values()), limit)
        except TimeoutError:
            why = f"does not answer within {limit:g} s; check the address, restart the controller"
            raise self._fault(RobotReason.TIMED_OUT, why) from None
        except OSError as error:
            why = f"cannot be reached ({error.strerror or error}); check address, cable and power"
            raise self._fault(RobotReason.UNREACHABLE, why) from None
        said = dict(zip(robot_faults.QUESTIONS, (answer.split(": ", 1)[-1] for answer in answers), strict=True))
        running, remote = said.pop("running"), said.pop("remote")
        if cause := robot_faults.of_dashboard(said["robot_mode"], said["safety_status"], remote, running):
            raise self._fault(*cause)
        emulated = "torchpose twin" in said["model"]
        return {"host": host, **said, "remote": True if remote == "true" else None, "emulated": emulated}

    def _travel(self, goal: Pose, state: _State) -> None:
        """Sends the move and waits until the controller reports its end."""
        speed, acceleration = self.settings.speed_mm_s, self.settings.acceleration_mm_s2
        # the slider at the pendant slows the robot down; the controller takes the same number as m/s and rad/s
        distance, turn_deg = difference(state.pose, goal)
        expected = max(distance, 1e3 * math.radians(turn_deg)) / speed + speed / acceleration
        limit = expected / max(state.speed_fraction, 0.01) + self.settings.move_margin_s
        deadline, before = time.monotonic() + limit, state.move_changes
        if not self._call("move", _CALL_S, pose=goal, speed_mm_s=speed, acceleration_mm_s2=acceleration):
            self._raise_if_stopped()
            self._state(fresh=2)  # a safety stop or the end of the program explains it
            raise self._fault(RobotReason.PROGRAM_STOPPED, "does not take the move; see the log at the pendant")
        while state.move_changes == before or state.move_running:
            if time.monotonic() > deadline:
                why = f"has not finished a move of {_words(distance, turn_deg)} within {limit:.3g} s"
                fix = "see what slows it down, or raise move_margin_s"
                raise self._fault(RobotReason.TIMED_OUT, f"{why}; {fix}")
            state = self._state()
            if state.runtime_state in _STOPPED_STATES:
                raise self._fault(RobotReason.PROGRAM_STOPPED, "has ended the program; see the log at the pendant")

    def _settle(self, goal: Pose) -> RobotReading:
        """Waits for enough samples in a row at the goal."""
        rule = self.settings.settle
        deadline, good = time.monotonic() + rule.timeout_s, 0
        while True:
            reading = self.read()
            distance, turn_deg = difference(reading.pose, goal)
            good = good + 1 if distance <= rule.tolerance_mm and turn_deg <= rule.tolerance_deg else 0
            if good >= rule.samples:
                return reading
            if time.monotonic() > deadline:
                why = f"stands {_words(distance, turn_deg)} from the commanded pose {rule.timeout_s:g} s after the move"
                fix = "check the tool offset and the payload, or widen settle"
                raise self._fault(RobotReason.NOT_SETTLED, f"{why}; {fix}")

    def _fault(self, reason: RobotReason, what: str) -> RobotFault:
        return RobotFault(reason, f"robot {self.settings.host}: {what}")

    def _raise_if_stopped(self) -> None:
        if self._stopped.is_set():
            raise self._fault(RobotReason.STOPPED, "was stopped; start anew")

    def _require_inside(self, pose: Pose, what: str, slack_mm: float) -> None:
        if left := self.settings.workspace.left_by(pose, slack_mm):
            axis, value, low, high = left
            why = f"{what} at {axis} = {value:.6g} mm, outside the workspace ({low:g} to {high:g} mm)"
            raise self._fault(RobotReason.OUTSIDE_WORKSPACE, f"{why}; change the pose or the workspace")

    def _state(self, fresh: int = 1) -> _State:
        """The child's state after `fresh` more samples, with safety looked at."""
        state = self._call("read", _CALL_S + fresh / self.settings.frequency_hz, fresh=fresh)
        self._raise_if_stopped()
        if cause := robot_faults.of_safety_bits(state["safety_bits"]):
            raise self._fault(*cause)
        return _State.model_validate(state)

    def _call(self, name: str, timeout_s: float, **arguments: Any) -> Any:
        """A request to the child; where it fails, the child ends, and the program too, if one was uploaded."""
        self._raise_if_stopped()
        if self._child is None:
            raise self._fault(RobotReason.CONNECTION_LOST, "is not connected; call preflight first")
        try:
            return self._child.call(name, timeout_s, **arguments)
        except ChildError as error:
            answers = name not in ("load", "connect") and dashboard.stop(self.settings.host, STOP_S)
            if self._child is not None:  # closed by another thread meanwhile
                self._child.kill()
            self._raise_if_stopped()
            raise self._fault(*robot_faults.of_child(name, error, answers)) from None


def _shown(pose: object) -> str:
    """A pose for a message, on one line and not too long."""
    return " ".join(repr(pose).split())[:100]


def _words(distance_mm: float, turn_deg: float) -> str:
    return f"{distance_mm:.3g} mm and {turn_deg:.3g} deg"
