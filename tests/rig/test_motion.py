"""The twin's motion against numerical integration and scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchpose.rig.twin import motion
from torchpose.rig.twin.motion import Motion

components = st.floats(-3.0, 3.0, allow_subnormal=False)
poses = st.lists(components, min_size=6, max_size=6).map(np.array)


@given(poses, poses)
def test_rigid_transforms_agree_with_scipy(a: np.ndarray, b: np.ndarray) -> None:
    ra, rb = Rotation.from_rotvec(a[3:]), Rotation.from_rotvec(b[3:])
    np.testing.assert_allclose(motion.matrix(a[3:]), ra.as_matrix(), atol=1e-14)
    c = motion.compose(a, b)
    np.testing.assert_allclose(c[:3], ra.apply(b[:3]) + a[:3], atol=1e-13)
    np.testing.assert_allclose(motion.matrix(c[3:]), (ra * rb).as_matrix(), atol=1e-13)
    identity = motion.compose(a, motion.inverse(a))
    np.testing.assert_allclose(identity, 0, atol=1e-12)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, -1, 0], [0.6, 0, 0.8], [0.36, 0.48, -0.8]])
@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-8, 1e-3, 1.0, np.pi - 1e-9, np.pi])
def test_vector_inverts_matrix(axis: list[float], angle: float) -> None:
    v = angle * np.array(axis)
    got = motion.vector(motion.matrix(v))
    np.testing.assert_allclose(motion.matrix(got), motion.matrix(v), atol=1e-14)
    assert np.linalg.norm(got) == pytest.approx(angle, abs=1e-14, rel=1e-12)


@given(st.floats(1e-4, 1.0), st.floats(1e-2, 1.0), st.floats(1e-2, 5.0), st.floats(0.0, 1.2), st.floats(0.1, 10.0))
def test_speed_and_acceleration_stay_in_their_limits(
    length: float, speed: float, acceleration: float, halt_at: float, deceleration: float
) -> None:
    goal = np.array([length, 0, 0, 0, 0, 0])
    move = Motion(np.zeros(6), goal, speed, acceleration, begin=5.0)
    assert move.fraction(5.0) == 0
    assert move.fraction(5.0 + move.duration) == pytest.approx(1, abs=1e-12)
    # the textbook durations of the triangular and the trapezoidal profile
    ramp = speed / acceleration
    full = length >= speed * ramp
    expected = length / speed + ramp if full else 2 * np.sqrt(length / acceleration)
    assert move.duration == pytest.approx(expected, rel=1e-9)
    halted = move.halt(5.0 + halt_at * move.duration, deceleration)
    for m, brake in ((move, acceleration), (halted, max(acceleration, deceleration))):
        t = np.linspace(5, 5 + 1.5 * move.duration + 2 * speed / deceleration, 400)
        s = np.array([m.fraction(x) for x in t]) * length
        v = np.diff(s) / np.diff(t)
        assert v.min() >= -1e-9
        assert v.max() <= speed * (1 + 1e-9)
        assert np.abs(np.diff(v) / np.diff(t)[1:]).max() <= brake * (1 + 1e-6) + 1e-6
        assert not m.moving(t[-1])


def test_path_is_straight_and_turns_about_one_axis() -> None:
    start, goal = np.array([0.1, 0, 0, 0, 0, 0.0]), np.array([0.1, 0.2, 0, 0, 0.8, 0])
    move = Motion(start, goal, 0.4, 1.0)
    for t in np.linspace(0, move.duration, 7):
        pose, u = move.pose(t), move.fraction(t)
        np.testing.assert_allclose(pose[:3], [0.1, 0.2 * u, 0], atol=1e-12)
        np.testing.assert_allclose(pose[3:], [0, 0.8 * u, 0], atol=1e-12)
    assert move.length == pytest.approx(0.8)  # the turn in rad is longer than the path in m
