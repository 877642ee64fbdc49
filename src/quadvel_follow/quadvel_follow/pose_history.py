"""Where the robot was at the time of a scan, from odometry that comes in between."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KEPT = 3.0  # s of poses


class PoseHistory:
    """Poses x, y (m), yaw (rad) of the robot over time, and those of a sensor that is mounted on it."""

    def __init__(self, mounting: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """mounting: the sensor's pose x, y, yaw on the robot."""
        self._mounting = np.asarray(mounting, float)
        self._times: list[float] = []
        self._poses: list[Array] = []

    @property
    def newest(self) -> float:
        """Time of the newest pose, s; minus infinity where there is none."""
        return self._times[-1] if self._times else -np.inf

    def add(self, time: float, pose: Sequence[float]) -> None:
        """A pose of the robot at `time` (s); one that is older than the newest begins anew, as after a reset."""
        found = np.asarray(pose, float)
        if not (np.isfinite(time) and np.isfinite(found).all()):
            raise ValueError(f"pose is {list(pose)} at {time} s, expected finite numbers")
        if time <= self.newest:
            self._times, self._poses = [], []
        if self._poses:  # turns are counted on, so that they can be interpolated
            found[2] = np.unwrap([self._poses[-1][2], found[2]])[1]
        self._times.append(time)
        self._poses.append(found)
        stale = bisect_left(self._times, time - KEPT)
        del self._times[:stale], self._poses[:stale]

    def sensor_at(self, time: float) -> Array:
        """Pose (3,) of the sensor at `time`. Raises ValueError outside the times that are known."""
        if not self._times or not self._times[0] <= time <= self._times[-1]:
            known = f"{self._times[0]:.3f} to {self._times[-1]:.3f}" if self._times else "none"
            raise ValueError(f"time is {time:.3f} s, expected one of the poses' times, {known}")
        x, y, yaw = (np.interp(time, self._times, column) for column in np.array(self._poses).T)
        c, s = np.cos(yaw), np.sin(yaw)
        ahead, left, turn = self._mounting
        return np.array([x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn])
