"""Straight moves of a tool with a trapezoidal speed profile, as a function of time. Poses in m and rad, numpy only."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrix(rotation_vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in rad (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    x, y, z = rotation_vector
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    half = np.sinc(angle / (2 * math.pi))
    result: Array = np.eye(3) + np.sinc(angle / math.pi) * k + 0.5 * half**2 * (k @ k)
    return result


def vector(rotation: Array) -> Array:
    """Rotation vector (3,) in rad, of length 0 to pi, of a rotation matrix (3, 3).

    Its quaternion q is read from the row of 4 q q^T with the largest diagonal, which loses no digits (Shepperd 1978).
    """
    skew = rotation[[2, 0, 1], [1, 2, 0]] - rotation[[1, 2, 0], [2, 0, 1]]
    trace = np.trace(rotation)
    vectors = rotation + rotation.T + (1 - trace) * np.eye(3)
    products = np.block([[1 + trace, skew], [skew[:, None], vectors]])
    w, *xyz = products[products.diagonal().argmax()]
    sine = math.hypot(*xyz)
    angle = 2 * math.atan2(sine, abs(w))
    factor = math.copysign(angle / sine if sine > 1e-12 else 2 / abs(w), w)
    result: Array = factor * np.array(xyz)
    return result


def compose(a: Array, b: Array) -> Array:
    """Pose (6,) of the transform a after b."""
    turn = matrix(a[3:])
    return np.append(turn @ b[:3] + a[:3], vector(turn @ matrix(b[3:])))


def inverse(a: Array) -> Array:
    """Pose (6,) of the inverse transform."""
    return np.append(-matrix(a[3:]).T @ a[:3], -a[3:])


@dataclass(frozen=True)
class Motion:
    """A move from `start` to `goal`, begun at time `begin`: translation straight, rotation about one axis.

    `speed` and `acceleration` hold for the longer of the path in m and the turn in rad, as the controller takes one
    number for both. `halted` ends it early: (time, deceleration).
    """

    start: Array
    goal: Array
    speed: float = 1.0
    acceleration: float = 1.0
    begin: float = 0.0
    halted: tuple[float, float] | None = None

    @cached_property
    def turn(self) -> Array:
        """Rotation vector (3,) from the start to the goal, in the tool's axes."""
        return vector(matrix(self.start[3:]).T @ matrix(self.goal[3:]))

    @cached_property
    def length(self) -> float:
        """The longer of the path in m and the turn in rad."""
        return max(float(np.linalg.norm(self.goal[:3] - self.start[:3])), float(np.linalg.norm(self.turn)))

    @cached_property
    def phases(self) -> list[tuple[float, float]]:
        """Seconds and acceleration of each part: faster, steady, slower; when halted, up to then and braking."""
        ramp = min(self.speed / self.acceleration, math.sqrt(self.length / self.acceleration))
        steady = max(0.0, self.length / (self.acceleration * ramp) - ramp) if ramp > 0 else 0.0
        phases = [(ramp, self.acceleration), (steady, 0.0), (ramp, -self.acceleration)]
        if self.halted is None:
            return phases
        at, deceleration = self.halted
        left, speed, done = at - self.begin, 0.0, []
        for seconds, acceleration in phases:
            done.append((min(seconds, left), acceleration))
            left, speed = left - done[-1][0], speed + acceleration * done[-1][0]
        return [*done, (speed / deceleration, -deceleration)]

    @property
    def duration(self) -> float:
        """Seconds from the beginning until the tool stands."""
        return sum(seconds for seconds, _ in self.phases)

    def fraction(self, now: float) -> float:
        """Share of the path that is done at time `now`, 0 to 1."""
        left, speed, distance = max(0.0, now - self.begin), 0.0, 0.0
        for seconds, acceleration in self.phases:
            t = min(seconds, left)
            distance += speed * t + 0.5 * acceleration * t * t
            left, speed = left - t, speed + acceleration * t
        return distance / self.length if self.length > 0 else 1.0

    def moving(self, now: float) -> bool:
        """Whether the tool still moves at time `now`."""
        return bool(now - self.begin < self.duration)

    def halt(self, now: float, deceleration: float) -> Motion:
        """The same move, braked from time `now` on; one that is being braked already, or has ended, stays as it is.

        It brakes at least as hard as the move itself would, so it never runs past its goal.
        """
        if self.halted is not None or not self.moving(now):
            return self
        return replace(self, halted=(now, max(deceleration, self.acceleration)))

    def pose(self, now: float) -> Array:
        """Pose (6,) at time `now`."""
        share = self.fraction(now)
        rotation = vector(matrix(self.start[3:]) @ matrix(share * self.turn))
        return np.append(self.start[:3] + share * (self.goal[:3] - self.start[:3]), rotation)
