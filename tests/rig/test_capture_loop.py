"""Parts of the capture loop that need no rig: what is missing, poses between readings, a robot that does not rest."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchpose.rig.cameras import Cameras, Frame
from torchpose.rig.capture import _expose, frame_id, missing
from torchpose.rig.faults import RobotFault, RobotReason
from torchpose.rig.plan import CapturePlan, Waypoint
from torchpose.rig.poses import Pose, as_pose, difference, middle
from torchpose.rig.robot import Robot, RobotReading
from torchpose.rig.settings import CameraSettings, Rig, RobotSettings, Workspace

POSE = (400.0, 0.0, 300.0, math.pi, 0.0, 0.0)
ROBOT = RobotSettings(host="127.0.0.2", workspace=Workspace(min=[0.0, -9.0, 0.0], max=[500.0, 9.0, 500.0]))
WAYPOINTS = tuple(Waypoint(id=f"{i:04d}", pose=POSE, kind="static", origin=True) for i in range(3))
PLAN = CapturePlan("p", "p.yaml", POSE, WAYPOINTS)


def rig(*names: str) -> Rig:
    return Rig(robot=ROBOT, cameras=[CameraSettings(name=n, width=8, height=6, exposure_us=1.0) for n in names])


def test_what_is_missing() -> None:
    one, two = rig("camera"), rig("left", "right")
    assert [frame_id(w, "camera", one) for w in PLAN.waypoints] == ["0000", "0001", "0002"]
    assert [w.id for w, _ in missing(PLAN, one, {"0001"})] == ["0000", "0002"]
    done = {"0000_left", "0001_left", "0001_right"}
    assert [(w.id, names) for w, names in missing(PLAN, two, done)] == [
        ("0000", ["right"]),
        ("0002", ["left", "right"]),
    ]


small = st.lists(st.floats(-1e-3, 1e-3), min_size=3, max_size=3)
vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@given(rotation=vectors, shift=small, turn=small)
@settings(max_examples=50, deadline=None)
def test_the_middle_of_two_poses(rotation: list[float], shift: list[float], turn: list[float]) -> None:
    first = (1.0, 2.0, 3.0, *rotation)
    turned = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(rotation)).as_rotvec()
    second = (*(a + b for a, b in zip(first[:3], shift, strict=True)), *turned)
    distance, angle = difference(first, second)
    assert distance == pytest.approx(math.hypot(*shift), abs=1e-12)
    assert math.radians(angle) == pytest.approx(math.hypot(*turn), abs=1e-12)
    for end in (first, second):
        half = difference(middle(first, second), end)
        assert half == pytest.approx((0.5 * distance, 0.5 * angle), abs=1e-9)


def test_the_middle_of_two_names_of_one_rotation() -> None:
    """A tool that points down may be reported as +pi or -pi about x."""
    found = middle(POSE, (*POSE[:3], -math.pi, 0.0, 0.0))
    assert difference(found, POSE) == pytest.approx((0, 0), abs=1e-12)


class Drifting(Robot):
    """A robot whose readings are the given poses."""

    def __init__(self, poses: Sequence[Pose]) -> None:
        super().__init__(ROBOT)
        self.poses = iter(poses)

    def read(self, fresh: int = 1) -> RobotReading:
        return RobotReading(
            pose=next(self.poses),
            joints=POSE,
            robot_time_s=0.0,
            host_time_s=0.0,
            robot_mode=7,
            safety_mode=1,
            safety_bits=1,
            runtime_state=2,
        )


class NoCameras(Cameras):
    def __init__(self) -> None:
        super().__init__([])

    def grab(self, names: Collection[str]) -> list[Frame]:
        return []


def moved(mm: float = 0.0, deg: float = 0.0) -> Pose:
    turned = Rotation.from_euler("z", deg, degrees=True) * Rotation.from_rotvec(POSE[3:])
    return as_pose([POSE[0] + mm, *POSE[1:3], *turned.as_rotvec()])


@pytest.mark.parametrize(
    "readings", [[moved(mm=0.06)], [moved(deg=0.03)], [moved(mm=0.04), moved(mm=-0.02)], [moved(), moved(deg=-0.03)]]
)
def test_a_robot_that_does_not_rest(readings: list[Pose]) -> None:
    with pytest.raises(RobotFault, match=r"around the exposure of waypoint 0000 \(static\)") as caught:
        _expose(PLAN.waypoints[0], ["camera"], rig("camera"), Drifting(readings), NoCameras())
    assert caught.value.reason == RobotReason.NOT_SETTLED


def test_a_robot_that_rests_well_enough() -> None:
    poses = [moved(mm=0.04), moved(mm=-0.005, deg=0.01)]
    before, frames, after = _expose(PLAN.waypoints[0], ["camera"], rig("camera"), Drifting(poses), NoCameras())
    assert ([before.pose, after.pose], frames) == (poses, [])
