"""Orientation, gyroscope and accelerometer against each other, under hypotheses about their conventions.

Over a window the turn of the orientation equals the integral of the gyroscope, and on the mean the accelerometer shows
the vertical:

    log(q_k^-1 q_k+m) = sum w dt,    mean(a) / |mean(a)| = R^T e_z
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from itertools import permutations, product
from operator import attrgetter

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate, rotate_inverse

from .run import Run

WINDOW_S = 0.05
"""Window of a turn: so long that the noise of the orientation is small, and shorter than a step."""
VERTICAL_WINDOW_S = 0.4
"""Window of the mean acceleration: longer than a step."""
TURN_SCALE_RAD, VERTICAL_SCALE_RAD = 0.01, 0.1
"""Errors of turn and vertical that count alike, ten times what a healthy walk shows."""
CLEARLY_BETTER = 1.5
"""The best reading of one sensor must fit better by this factor than the best of the other one; else the
diagnosis is ambiguous.
"""
DEGREES = 180.0 / np.pi
QUATERNIONS: Mapping[str, Callable[[Array], Array]] = {
    "w, x, y, z": lambda q: q,
    "x, y, z, w": lambda q: q[..., [3, 0, 1, 2]],
    "z, w, x, y": lambda q: q[..., [1, 2, 3, 0]],
    "y, z, w, x": lambda q: q[..., [2, 3, 0, 1]],
    "w, x, y, z from world to body": lambda q: q * np.array([1.0, -1.0, -1.0, -1.0]),
    "x, y, z, w from world to body": lambda q: q[..., [3, 0, 1, 2]] * np.array([1.0, -1.0, -1.0, -1.0]),
}
"""How a recording may store orientations, and the function that makes them right."""
AXES = "xyz"


def _gyro_conventions() -> dict[str, Array]:
    """Matrices that turn what a gyroscope may report into the body frame, rad/s."""
    found = {}
    for scale, unit in ((1.0, ""), (1.0 / DEGREES, " in deg/s")):
        for order in permutations(range(3)):
            for signs in product((1.0, -1.0), repeat=3):
                matrix = np.zeros((3, 3))
                for axis, (source, sign) in enumerate(zip(order, signs, strict=True)):
                    matrix[axis, source] = sign * scale
                text = ", ".join(
                    f"{'-' if s < 0 else ''}{AXES[o]}" for o, s in zip(order, signs, strict=True)
                )
                found[f"({text}){unit}"] = matrix
    return found


GYROSCOPES = _gyro_conventions()
USUAL_QUATERNION, USUAL_GYROSCOPE = next(iter(QUATERNIONS)), next(iter(GYROSCOPES))
IN_WORLD = "in the world frame"


@attrs.frozen
class Hypothesis:
    """Conventions of an IMU and how badly they fit.

    Attributes:
        quaternion: Key of QUATERNIONS.
        gyroscope: Key of GYROSCOPES, or IN_WORLD.
        turn: Root mean square of turn minus integrated gyroscope, rad.
        vertical: Median angle between accelerometer and vertical, rad.
    """

    quaternion: str
    gyroscope: str
    turn: float
    vertical: float

    @property
    def error(self) -> float:
        """Both errors in units of their scales."""
        return float(np.hypot(self.turn / TURN_SCALE_RAD, self.vertical / VERTICAL_SCALE_RAD))

    def __str__(self) -> str:
        """How badly the conventions fit, in words."""
        return (
            f"turns differ by {1e3 * self.turn:.1f} mrad in 50 ms and the vertical by {self.vertical:.2f} rad"
        )

    @property
    def is_usual(self) -> bool:
        """Whether these are the conventions of this stack."""
        return (self.quaternion, self.gyroscope) == (USUAL_QUATERNION, USUAL_GYROSCOPE)


class ImuHypotheses:
    """All hypotheses on one run with an IMU."""

    def __init__(self, run: Run) -> None:
        assert run.imu is not None
        self._run, self._imu = run, run.imu
        self._m = max(2, round(WINDOW_S / run.period))
        self._turns: dict[str, Array] = {}

    @cached_property
    def usual(self) -> Hypothesis:
        """The conventions of this stack."""
        return self._hypothesis(USUAL_QUATERNION, USUAL_GYROSCOPE)

    @cached_property
    def best(self) -> Hypothesis:
        """The hypothesis that fits best; only one sensor deviates from the usual convention."""
        return min(self._best_quaternion, self._best_gyroscope, key=attrgetter("error"))

    @property
    def is_ambiguous(self) -> bool:
        """Whether a reading of the quaternion and one of the gyroscope fit about equally."""
        low, high = sorted((self._best_quaternion.error, self._best_gyroscope.error))
        return high < CLEARLY_BETTER * low

    @cached_property
    def _best_quaternion(self) -> Hypothesis:
        tried = (self._hypothesis(name, USUAL_GYROSCOPE) for name in QUATERNIONS)
        return min(tried, key=attrgetter("error"))

    @cached_property
    def _best_gyroscope(self) -> Hypothesis:
        tried = (self._hypothesis(USUAL_QUATERNION, name) for name in (*GYROSCOPES, IN_WORLD))
        return min(tried, key=attrgetter("error"))

    def turns(self, quaternion: str) -> Array:
        """Return the turns of the trunk over windows of m states.

        Args:
            quaternion: Key of QUATERNIONS.

        Returns:
            Rotation vectors, (n - m, 3), rad, body frame.
        """
        if quaternion not in self._turns:
            self._turns[quaternion] = self._compute_turns(quaternion)
        return self._turns[quaternion]

    def _compute_turns(self, quaternion: str) -> Array:
        q = QUATERNIONS[quaternion](self._imu.quaternion)
        w0, v0, w1, v1 = q[: -self._m, :1], q[: -self._m, 1:], q[self._m :, :1], q[self._m :, 1:]
        vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)  # of q0^-1 q1
        scalar = w0[:, 0] * w1[:, 0] + (v0 * v1).sum(axis=1)
        vector *= np.where(scalar < 0.0, -1.0, 1.0)[:, None]
        length = np.linalg.norm(vector, axis=1)
        angle = 2.0 * np.arctan2(length, np.abs(scalar))
        return np.asarray(vector * (angle / np.maximum(length, 1e-12))[:, None])

    def integrals(self, gyroscope: str) -> Array:
        """Integrate the gyroscope over the windows of `turns`.

        Args:
            gyroscope: Key of GYROSCOPES, or IN_WORLD.

        Returns:
            Rotation vectors, (n - m, 3), rad, body frame.
        """
        w = self._imu.angular_velocity
        rates = (
            rotate_inverse(self._imu.quaternion, w) if gyroscope == IN_WORLD else w @ GYROSCOPES[gyroscope].T
        )
        steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(self._run.time)[:, None]
        total = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        return np.asarray(total[self._m :] - total[: -self._m])

    def _hypothesis(self, quaternion: str, gyroscope: str) -> Hypothesis:
        off = self.turns(quaternion) - self.integrals(gyroscope)
        whole = np.linalg.norm(off, axis=1)
        turn = float(np.sqrt(np.mean(np.minimum(whole, 3.0) ** 2)))
        return Hypothesis(quaternion, gyroscope, turn, self._vertical_error(quaternion))

    def _vertical_error(self, quaternion: str) -> float:
        """Median angle between mean acceleration in the world frame and the vertical, rad."""
        width = max(2, round(VERTICAL_WINDOW_S / self._run.period))
        world = rotate(QUATERNIONS[quaternion](self._imu.quaternion), self._imu.linear_acceleration)
        if len(world) <= width:
            return 0.0
        total = np.vstack([np.zeros(3), np.cumsum(world, axis=0)])
        mean = total[width:] - total[:-width]
        return float(np.median(np.arctan2(np.linalg.norm(mean[:, :2], axis=1), mean[:, 2])))
