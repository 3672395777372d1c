"""The process that holds the connection to the robot, and the only file that imports ur-rtde.

ur-rtde's constructors hold the interpreter and never time out, its calls can hang, and a flapping link can abort the
whole process. So it runs here, alone, and the parent ends this process when an answer is late. mm and rad outside, m
and rad towards ur-rtde. When the parent is done or gone, the robot is stopped.
"""

import os
import threading
import time
from collections.abc import Sequence
from typing import Any

from torchpose.rig import dashboard
from torchpose.rig.child import ChildError, serve

STALE_S = 0.5  # a stream of 10 Hz or more that brings nothing new for so long has stopped
STOP_S = 1.0
VARIABLES = [
    "timestamp", "actual_TCP_pose", "actual_q", "robot_mode", "safety_mode", "safety_status_bits", "runtime_state",
    "target_speed_fraction",
]  # fmt: skip


class Driver:
    """ur-rtde's interfaces, and one method for every request."""

    def __init__(self) -> None:
        self.host = ""
        self.receive: Any = None
        self.control: Any = None

    def load(self) -> None:
        """Imports ur-rtde, so that the deadlines of connecting count the robot's time alone."""
        import rtde_control
        import rtde_receive

        self.rtde_control, self.rtde_receive = rtde_control, rtde_receive

    def connect(self, host: str, frequency_hz: float) -> None:
        """Opens the stream of readings."""
        self.host = host
        self.receive = self.rtde_receive.RTDEReceiveInterface(host, frequency_hz, VARIABLES)

    def upload(self, frequency_hz: float, tcp: Sequence[float] | None) -> list[float]:
        """Uploads and starts the control script, sets the tool; the tool offset that is active then."""
        self.control = self.rtde_control.RTDEControlInterface(self.host, frequency_hz)
        if tcp is not None and not self.control.setTcp(_metres(tcp)):
            raise RuntimeError("the tool offset was not taken")
        return _millimetres(self.control.getTCPOffset())

    def read(self, fresh: int) -> dict[str, Any]:
        """The state after `fresh` further samples have come in."""
        seen, since = self.receive.getTimestamp(), time.monotonic()
        while fresh > 0:
            stamp = self.receive.getTimestamp()
            if stamp != seen:
                fresh, seen, since = fresh - 1, stamp, time.monotonic()
            elif not self.receive.isConnected():
                raise ChildError("no connection", "connection_lost")
            elif time.monotonic() - since > STALE_S:
                raise ChildError("nothing new", "stale_stream")
            else:
                time.sleep(0.001)
        while True:  # all fields of one sample: the stream goes on while they are read
            stamp, host_time = self.receive.getTimestamp(), time.time()
            state = {
                "pose": _millimetres(self.receive.getActualTCPPose()),
                "joints": self.receive.getActualQ(),
                "robot_mode": self.receive.getRobotMode(),
                "safety_mode": self.receive.getSafetyMode(),
                "safety_bits": self.receive.getSafetyStatusBits(),
                "runtime_state": self.receive.getRuntimeState(),
                "speed_fraction": self.receive.getTargetSpeedFraction(),
            }
            if stamp == self.receive.getTimestamp():
                break
        operation = self.control.getAsyncOperationProgressEx() if self.control is not None else None
        return {
            **state,
            "robot_time_s": stamp,
            "host_time_s": host_time,
            "move_running": operation is not None and operation.isAsyncOperationRunning(),
            "move_changes": operation.changeCount() if operation is not None else 0,
        }

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> bool:
        """Starts a straight move; False when the controller does not take it."""
        return bool(self.control.moveL(_metres(pose), speed_mm_s * 1e-3, acceleration_mm_s2 * 1e-3, True))

    def is_reachable(self, pose: Sequence[float]) -> bool:
        """Whether the controller finds the pose within its reach and its safety limits."""
        return bool(self.control.isPoseWithinSafetyLimits(_metres(pose)))

    def close(self) -> None:
        """Ends the program on the robot and disconnects both interfaces; each waits half a second in there."""
        if self.control is not None:
            dashboard.stop(self.host, STOP_S)
        threads = [threading.Thread(target=end.disconnect, daemon=True) for end in (self.control, self.receive) if end]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(STOP_S)


def _metres(pose: Sequence[float]) -> list[float]:
    return [*(v * 1e-3 for v in pose[:3]), *pose[3:]]


def _millimetres(pose: Sequence[float]) -> list[float]:
    return [*(v * 1e3 for v in pose[:3]), *pose[3:]]


def main() -> None:
    """Serves a `Driver` to the parent."""
    driver = Driver()
    serve(lambda request, **arguments: getattr(driver, request)(**arguments))
    driver.close()
    os._exit(0)  # destructors of ur-rtde have aborted here


if __name__ == "__main__":
    main()
