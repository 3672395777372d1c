"""The capture loop: move, settle, read the pose, expose all cameras, read the pose again, store, next."""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

from torchpose.rig.cameras import Cameras, Frame
from torchpose.rig.faults import RigFault, RobotFault, RobotReason
from torchpose.rig.plan import CapturePlan, Waypoint
from torchpose.rig.poses import Pose, difference, middle
from torchpose.rig.robot import Robot, RobotReading
from torchpose.rig.session import Session
from torchpose.rig.settings import Rig

OnFrame = Callable[[Waypoint, Frame], None]


def frame_id(waypoint: Waypoint, camera: str, rig: Rig) -> str:
    """Id of a frame, and name of its image: that of the waypoint, with the camera's where there are several."""
    return waypoint.id if len(rig.cameras) == 1 else f"{waypoint.id}_{camera}"


def image_origin(rig: Rig) -> dict[str, Any]:
    """What the images of a session depend on, so that a resumed one goes on with the same."""
    return {c.name: [c.width, c.height, c.pixel_format] for c in rig.cameras}


def missing(plan: CapturePlan, rig: Rig, done: set[str]) -> list[tuple[Waypoint, list[str]]]:
    """Waypoints still to be taken, each with the cameras whose frame is not there."""
    names = [camera.name for camera in rig.cameras]
    left = [(w, [name for name in names if frame_id(w, name, rig) not in done]) for w in plan.waypoints]
    return [(waypoint, cameras) for waypoint, cameras in left if cameras]


def capture(
    plan: CapturePlan,
    rig: Rig,
    session: Session,
    *,
    scene: Callable[[str], Path] | None = None,
    on_frame: OnFrame | None = None,
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Takes every frame of the plan that the session lacks and closes the session with an ``end`` record.

    On the way out the robot is stopped and disconnected first, then the cameras are given back, then the ``end`` record
    is written. While this runs, SIGINT and SIGTERM stop the robot at once.

    Args:
        plan: where to take frames.
        rig: with what.
        session: where to, entered.
        scene: what emulated cameras see, see `Cameras`.
        on_frame: called for every frame once it is stored.
        notes: further entries of the session record.

    Raises:
        CameraFault, RobotFault, SessionFault: with the reason, which the ``end`` record names too.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    robot = Robot(rig.robot)
    sizes = {camera.name: camera.width * camera.height * camera.dtype.itemsize for camera in rig.cameras}
    try:
        session.check_space(sum(sizes[name] for _, names in missing(plan, rig, session.done) for name in names))
        with stopped_by_signals(robot), Cameras(rig.cameras, scene) as cameras, robot:
            preflight = robot.preflight([waypoint.pose for waypoint in plan.waypoints])
            described = cameras.descriptions
            session.begin(
                emulated=scene is not None or preflight["emulated"] or any(c["emulated"] for c in described),
                plan=plan.name,
                waypoints=len(plan.waypoints),
                robot=preflight,
                cameras=described,
                **(notes or {}),
            )
            _take_all(plan, rig, session, robot, cameras, on_frame)
    except RigFault as fault:
        session.end(fault.reason.value, str(fault))
        raise
    except KeyboardInterrupt:
        session.end("interrupted")
        raise
    except BaseException as error:
        session.end("internal_error", f"{type(error).__name__}: {error}")
        raise
    session.end("complete")


def _take_all(
    plan: CapturePlan, rig: Rig, session: Session, robot: Robot, cameras: Cameras, on_frame: OnFrame | None
) -> None:
    """The loop itself."""
    at: Pose | None = None
    for waypoint, names in missing(plan, rig, session.done):
        if waypoint.pose != at:
            robot.move(waypoint.pose)
            at = waypoint.pose
            time.sleep(rig.dwell_s)
        before, frames, after = _expose(waypoint, names, rig, robot, cameras)
        for frame in frames:
            session.write(
                frame_id(waypoint, frame.camera, rig),
                frame.image,
                camera=frame.camera,
                waypoint=waypoint,
                commanded_pose=waypoint.pose,
                robot_pose=middle(before.pose, after.pose),
                before=before,
                after=after,
                trigger_time_s=frame.trigger_time_s,
                camera_time=frame.camera_time,
                attempts=frame.attempts,
                failures=frame.failures,
            )
            if on_frame is not None:
                on_frame(waypoint, frame)


def _expose(
    waypoint: Waypoint, names: list[str], rig: Rig, robot: Robot, cameras: Cameras
) -> tuple[RobotReading, list[Frame], RobotReading]:
    """Frames of the named cameras between two fresh readings of the robot at rest on the waypoint."""

    def read_at(pose: Pose) -> RobotReading:
        reading, settle = robot.read(fresh=2), rig.robot.settle
        distance, angle = difference(reading.pose, pose)
        if distance > settle.tolerance_mm or angle > settle.tolerance_deg:
            why = f"moved by {distance:.3f} mm and {angle:.3f} deg around the exposure of waypoint {waypoint}"
            fix = "look for vibration, or raise robot.settle of the rig file"
            raise RobotFault(RobotReason.NOT_SETTLED, f"robot: {why}; {fix}")
        return reading

    before = read_at(waypoint.pose)
    frames = cameras.grab(names)
    return before, frames, read_at(before.pose)


@contextlib.contextmanager
def stopped_by_signals(robot: Robot) -> Iterator[None]:
    """While the block runs, SIGINT or SIGTERM stops the robot and raises KeyboardInterrupt; further ones are ignored.

    In a thread that is not the main one, which gets no signals, this does nothing.
    """

    def stop(_number: int, _frame: FrameType | None) -> None:
        for number in previous:
            signal.signal(number, signal.SIG_IGN)
        robot.stop()
        raise KeyboardInterrupt

    previous: dict[signal.Signals, Any] = {}
    with contextlib.suppress(ValueError):  # not the main thread
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
