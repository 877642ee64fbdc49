"""Interpolated poses of robot and sensor from recent odometry.

It keeps the last seconds only. Poses are x, y in m and yaw in rad, in the odometry frame.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from quadvel_description.arrays import Array

MAX_AGE_S = 3.0
"""Time for which poses are kept."""


class PoseHistory:
    """Recent poses of the robot, and of a sensor mounted on it."""

    def __init__(self, mounting: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Create an empty history.

        Args:
            mounting: Pose of the sensor on the robot, (3,): x, y in m, yaw in rad.
        """
        self._mounting = np.asarray(mounting, float)
        self._times: list[float] = []
        self._poses: list[Array] = []

    @property
    def newest(self) -> float:
        """Time of the newest pose, s; minus infinity if there is none."""
        return self._times[-1] if self._times else -np.inf

    def add(self, time: float, pose: Sequence[float]) -> None:
        """Add a pose; one that is not newer clears the history, as after a reset.

        Args:
            time: Time of the pose, s.
            pose: Pose of the robot, (3,): x, y in m, yaw in rad.

        Raises:
            ValueError: A number is not finite.
        """
        found = np.asarray(pose, float)
        if not (np.isfinite(time) and np.isfinite(found).all()):
            raise ValueError(f"pose is {list(pose)} at {time} s, expected finite numbers")
        if time <= self.newest:
            self._times, self._poses = [], []
        if self._poses:  # unwrapped yaw can be interpolated
            found[2] = np.unwrap([self._poses[-1][2], found[2]])[1]
        self._times.append(time)
        self._poses.append(found)
        stale = bisect_left(self._times, time - MAX_AGE_S)
        del self._times[:stale], self._poses[:stale]

    def sensor_at(self, time: float) -> Array:
        """Interpolate the pose of the sensor.

        Args:
            time: Time, s.

        Returns:
            Pose of the sensor, (3,): x, y in m, yaw in rad (not wrapped).

        Raises:
            ValueError: The time is outside the history.
        """
        if not self._times or not self._times[0] <= time <= self._times[-1]:
            known = f"{self._times[0]:.3f} to {self._times[-1]:.3f}" if self._times else "none"
            raise ValueError(f"time is {time:.3f} s, expected one of the poses' times, {known}")
        x, y, yaw = (np.interp(time, self._times, column) for column in np.array(self._poses).T)
        c, s = np.cos(yaw), np.sin(yaw)
        ahead, left, turn = self._mounting
        return np.array([x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn])
