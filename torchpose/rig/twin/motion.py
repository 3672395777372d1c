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
    products = np.block(
        [[1 + trace, skew], [skew[:, None], rotation + rotation.T + (1 - trace) * np.eye(3)]]
    )  # 4 q q^T
    w, *xyz = products[products.diagonal().argmax()]
    sine = math.hypot(*xyz)
    angle = 2 * math.atan2(sine, abs(w))
    factor = math.copysign(angle / sine if sine > 1e-12 else 2 / abs(w), w)
    result: Array = factor * np.array(xyz)
    return result


def compose(a: Array, b: Array) -> Array:
    """Pose (6,) of the transform a after b."""
    r = matrix(a[3:])
    return np.concatenate([r @ b[:3] + a[:3], vector(r @ matrix(b[3:]))])


def inverse(a: Array) -> Array:
    """Pose (6,) of the inverse transform."""
    r = matrix(a[3:]).T
    return np.concatenate([-r @ a[:3], -a[3:]])


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

    @property
    def duration(self) -> float:
        """Seconds that the whole move takes when it is not halted."""
        ramp, cruise = self._phases()
        return 2 * ramp + cruise

    def _phases(self) -> tuple[float, float]:
        length = self.length
        ramp = min(self.speed / self.acceleration, math.sqrt(length / self.acceleration))
        return ramp, max(0.0, length / (self.acceleration * ramp) - ramp) if ramp > 0 else 0.0

    def _travelled(self, t: float) -> tuple[float, float]:
        """Distance and speed at `t` seconds after the start, not halted."""
        ramp, cruise = self._phases()
        total = 2 * ramp + cruise
        t = min(max(t, 0.0), total)
        a, top = self.acceleration, self.acceleration * ramp
        if t < ramp:
            return 0.5 * a * t * t, a * t
        if t < ramp + cruise:
            return 0.5 * a * ramp * ramp + top * (t - ramp), top
        left = total - t
        return self.length - 0.5 * a * left * left, a * left

    def fraction(self, now: float) -> float:
        """Share of the path that is done at time `now`, 0 to 1."""
        if self.length == 0:
            return 1.0
        if self.halted is None or now <= self.halted[0]:
            return self._travelled(now - self.begin)[0] / self.length
        at, deceleration = self.halted
        s, v = self._travelled(at - self.begin)
        t = min(now - at, v / deceleration)
        return (s + v * t - 0.5 * deceleration * t * t) / self.length

    def moving(self, now: float) -> bool:
        """Whether the tool still moves at time `now`."""
        if self.halted is None or now <= self.halted[0]:
            return now - self.begin < self.duration
        at, deceleration = self.halted
        return now - at < self._travelled(at - self.begin)[1] / deceleration

    def halt(self, now: float, deceleration: float) -> Motion:
        """The same move, braked from time `now` on; a move that is being braked already stays as it is.

        It brakes at least as hard as the move itself would, so it never runs past its goal.
        """
        return self if self.halted is not None else replace(self, halted=(now, max(deceleration, self.acceleration)))

    def pose(self, now: float) -> Array:
        """Pose (6,) at time `now`."""
        u = self.fraction(now)
        rotation = vector(matrix(self.start[3:]) @ matrix(u * self.turn))
        return np.concatenate([self.start[:3] + u * (self.goal[:3] - self.start[:3]), rotation])
