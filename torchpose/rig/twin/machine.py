"""What the twin's controller does: the control program's handshake, motion, safety, and the faults on request.

The handshake is the one between ur-rtde's client and the script that it uploads: the client writes a command number to
``input_int_register_0``; the program reports 1 (ready) or 2 (done) in ``output_int_register_0``, a result in
``output_int_register_1`` and the state of an asynchronous move in ``output_int_register_2``. Poses in m and rad.
"""

import math
import os
import sys
from collections import defaultdict
from enum import Enum, StrEnum
from typing import Any

import numpy as np

from torchpose.rig.twin import motion
from torchpose.rig.twin.motion import Array, Motion

READY, DONE = 1, 2
MOVE_L, SET_TCP, STOP_L, STOP_J, IS_POSE_SAFE, GET_TCP, IS_STEADY, STOP_SCRIPT = 3, 29, 33, 34, 36, 40, 47, 255
STOP_DECELERATION = 5.0  # m/s^2 and rad/s^2, when the program or safety ends a move
REACH_M = 0.85  # of a UR5, from the base to the flange


class Safety(Enum):
    """Safety states: mode, bits of safety_status_bits, word of the dashboard."""

    NORMAL = (1, 1 << 0, "NORMAL")
    PROTECTIVE_STOP = (3, 1 << 2 | 1 << 10, "PROTECTIVE_STOP")
    SAFEGUARD_STOP = (5, 1 << 4 | 1 << 10, "SAFEGUARD_STOP")
    EMERGENCY_STOP = (7, 1 << 6 | 1 << 7 | 1 << 10, "ROBOT_EMERGENCY_STOP")


class Fault(StrEnum):
    """What can be made to go wrong."""

    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    EMERGENCY_STOP = "emergency_stop"
    KILL = "kill"  # the process ends at once
    STALL = "stall"  # the stream sends nothing more, its sockets stay open
    SILENT = "silent"  # connections are accepted and never answered
    SILENT_STREAM = "silent_stream"  # those of the stream only; the dashboard answers
    NOT_REMOTE = "not_remote"
    REFUSE_SCRIPT = "refuse_script"
    REGISTERS_IN_USE = "registers_in_use"  # a fieldbus owns the input registers
    SLOW = "slow"  # moves take 20 times as long
    OFF_TARGET = "off_target"  # moves end 0.5 mm beside their goal
    IGNORE_MOVE = "ignore_move"  # the program ends when a move is sent, as after an error in it


class Machine:
    """One controller. Times are seconds of any steady clock, passed in.

    Args:
        start: (6,) pose of the tool in the base.
        errors: those of `torchpose.rig.twin.controller.TwinErrors` that are not 0, by name.
        seed: of their random numbers.
    """

    def __init__(self, start: Array, errors: dict[str, float], seed: int) -> None:
        self.motion = Motion(start, start)
        self.origin = start
        self.tcp = np.zeros(6)
        self.errors = defaultdict(float, errors)
        self.random = np.random.default_rng(seed)
        self.offset_from = self.offset_to = np.zeros(6)  # error of the true pose at the start and the end of the move
        self.registers: dict[str, float] = {}
        self.program = False
        self.executing = False
        self.blocking = False  # a synchronous move holds its command until it has arrived
        self.safety = Safety.NORMAL
        self.faults: set[Fault] = set()
        self.pending: list[tuple[float, Fault]] = []  # at which share of a path
        self.async_running = False
        self.async_writes = self.async_operation = 0
        self.moves = self.unlocks = 0

    def upload(self, now: float) -> None:
        """The client's script has arrived and starts."""
        if self.safety is Safety.NORMAL and not self.faults & {Fault.REFUSE_SCRIPT, Fault.NOT_REMOTE}:
            self.program = True
            self.executing = self.async_running = self.blocking = False
            self._write_async(running=False)
            self._step(now)

    def stop_program(self, now: float) -> None:
        """Ends the program and brakes."""
        self.motion = self.motion.halt(now, STOP_DECELERATION)
        self.program = self.blocking = False

    def write(self, values: dict[str, float], now: float) -> None:
        """Input registers from a client."""
        self.registers.update(values)
        self.advance(now)
        self._step(now)

    def _step(self, now: float) -> None:
        if not self.program:
            return
        command = int(self.registers.get("input_int_register_0", 0))
        if command == 0:
            self.executing = False
            self.registers["output_int_register_0"] = READY
        elif not self.executing:
            self.executing = True
            self._execute(command, now)
            if self.program and not self.blocking:
                self.registers["output_int_register_0"] = DONE

    def _execute(self, command: int, now: float) -> None:
        numbers = np.array([self.registers.get(f"input_double_register_{i}", 0.0) for i in range(8)])
        if command == MOVE_L:
            self._move(numbers, now)
        elif command == SET_TCP:
            change = motion.compose(motion.inverse(self.tcp), numbers[:6])  # new tool in the old one
            here = motion.compose(self.motion.pose(now), change)
            self.motion, self.origin = Motion(here, here), motion.compose(self.origin, change)
            self.tcp = numbers[:6]
        elif command in (STOP_L, STOP_J):
            self.motion = self.motion.halt(now, float(numbers[0]))
        elif command == IS_POSE_SAFE:
            self.registers["output_int_register_1"] = self.reachable(numbers[:6])
        elif command == GET_TCP:
            self.registers.update({f"output_double_register_{i}": float(v) for i, v in enumerate(self.tcp)})
        elif command == IS_STEADY:
            self.registers["output_int_register_1"] = not self.motion.moving(now)
        else:
            if command != STOP_SCRIPT:
                print(f"twin: command {command} is not emulated; the program ends", file=sys.stderr)
            self.stop_program(now)

    def reachable(self, pose: Array) -> bool:
        """Whether the flange gets to the tool pose (6,): a sphere stands for the robot's kinematics."""
        flange = motion.compose(pose, motion.inverse(self.tcp))
        return float(np.linalg.norm(flange[:3])) <= REACH_M

    def _move(self, numbers: Array, now: float) -> None:
        goal, (speed, acceleration) = numbers[:6].copy(), numbers[6:].tolist()
        if Fault.IGNORE_MOVE in self.faults or not self.reachable(goal):
            self.stop_program(now)  # the real program ends with an error of the inverse kinematics
            return
        if Fault.OFF_TARGET in self.faults:
            goal[0] += 0.5e-3
        if Fault.SLOW in self.faults:
            speed, acceleration = speed / 20, acceleration / 400
        self.offset_from = self._offset(now)
        spread = [1e-3 * self.errors["repeatability_mm"], math.radians(self.errors["repeatability_deg"])]
        self.offset_to = self.random.normal(size=6) * np.repeat(spread, 3)
        self.motion = Motion(self.motion.pose(now), goal, speed, acceleration, now)
        self.moves += 1
        if int(self.registers.get("input_int_register_1", 0)):
            self._write_async(running=True)
        else:
            self.blocking = True

    def _write_async(self, running: bool) -> None:
        """Bits of the register: 0-14 progress, 15 running, 16-22 count of changes, 24-30 number of the operation."""
        self.async_running = running
        self.async_writes = (self.async_writes + 1) % 128
        self.async_operation = (self.async_operation + running) % 128
        self.registers["output_int_register_2"] = self.async_writes << 16 | self.async_operation << 24 | running << 15

    def advance(self, now: float) -> None:
        """What has become due at time `now`: faults at their place on the path, arrivals."""
        for share, fault in list(self.pending):
            if self.motion.moving(now) and self.motion.fraction(now) >= share:
                self.pending.remove((share, fault))
                self._fail(fault, now)
        if not self.motion.moving(now):
            if self.async_running and self.program:
                self._write_async(running=False)
            if self.blocking and self.program:
                self.blocking = False
                self.registers["output_int_register_0"] = DONE

    def inject(self, fault: Fault, at_fraction: float | None, now: float) -> None:
        """A fault now, or at a share (0 to 1) of the path of the present or the next move."""
        if at_fraction is None:
            self._fail(fault, now)
        else:
            self.pending.append((at_fraction, fault))

    def _fail(self, fault: Fault, now: float) -> None:
        if fault is Fault.KILL:
            os._exit(9)
        self.faults.add(fault)
        if fault.name in Safety.__members__:
            self.safety, self.blocking = Safety[fault.name], False
            self.motion = self.motion.halt(now, STOP_DECELERATION)
        if fault is Fault.EMERGENCY_STOP:
            self.stop_program(now)

    def clear(self) -> None:
        """Normal operation again, as after a person has seen to the robot at its pendant; the program has ended."""
        self.faults.clear()
        self.pending.clear()
        self.safety, self.program = Safety.NORMAL, False

    def pose(self, now: float) -> Array:
        """(6,) pose that the controller believes."""
        return self.motion.pose(now)

    def true_pose(self, now: float) -> Array:
        """(6,) pose in which the tool really is."""
        pose, offset = self.motion.pose(now), self._offset(now)
        place = pose[:3] + self.errors["scale"] * (pose[:3] - self.origin[:3]) + offset[:3]
        return np.append(place, motion.vector(motion.matrix(offset[3:]) @ motion.matrix(pose[3:])))

    def _offset(self, now: float) -> Array:
        share = self.motion.fraction(now)
        return (1 - share) * self.offset_from + share * self.offset_to

    def value(self, name: str, now: float) -> Any:
        """One variable of the stream; what has no counterpart in the twin (joints, forces, currents) is zero."""
        if name in self.registers:
            return int(self.registers[name]) if "_int_" in name else self.registers[name]
        if name == "actual_TCP_pose":
            noise = self.random.normal(size=3) * 1e-3 * self.errors["reading_noise_mm"]
            return self.pose(now) + np.append(noise, [0, 0, 0])
        if name == "target_TCP_pose":
            return self.pose(now)
        powered, paused = self.safety is not Safety.EMERGENCY_STOP, self.safety is not Safety.NORMAL
        simple = {
            "timestamp": now,
            "robot_mode": 7 if powered else 3,
            "safety_mode": self.safety.value[0],
            "safety_status_bits": self.safety.value[1],
            "robot_status_bits": powered | self.program << 1,
            "runtime_state": (4 if paused else 2) if self.program else 1,
            "speed_scaling": 1.0,
            "target_speed_fraction": 1.0,
        }
        return simple.get(name, 0)

    def state(self, now: float) -> dict[str, Any]:
        """For `TwinController.state`: poses in mm and rad, and what has happened."""
        scale = [1e3, 1e3, 1e3, 1, 1, 1]
        return {
            "pose": (self.pose(now) * scale).tolist(),
            "true_pose": (self.true_pose(now) * scale).tolist(),
            "moving": self.motion.moving(now),
            "fraction": self.motion.fraction(now),
            "program": self.program,
            "safety": self.safety.value[2],
            "faults": sorted(self.faults),
            "moves": self.moves,
            "unlocks": self.unlocks,
        }
