"""Backup velocity that replaces a missing or wrong velocity estimate. Knows no ROS.

The supervisor selects it when a guard rejects the estimate; `guards.velocity` holds those checks. The trim of
the velocity command uses it as well (`velocity_trim`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate_inverse
from quadvel_description.quadruped import GRAVITY
from quadvel_description.state import RobotState

REST_ACCELERATION = np.array([0.0, 0.0, GRAVITY])
"""Reading of an accelerometer at rest, world frame, m/s^2."""


BATCH = 8
"""States that wait for the filter while its velocity is not needed: 40 ms."""
THINNING = 2
"""Of them the filter then processes every second one. In 11 walks of two robots, up to 3 m/s, it differs from the
estimate by at most 0.42 m/s (decision 54).
"""
_ARRAYS = [field.name for field in attrs.fields(RobotState) if field.name not in ("time", "tick")]


class Estimator(Protocol):
    """Interface of a velocity filter, such as `quadvel_estimator.kalman.KalmanEstimator`."""

    def reset(self) -> None:
        """Reset the filter."""

    def update_series(self, times: Sequence[float], states: RobotState) -> tuple[Array, Array]:
        """Process samples one after the other.

        Args:
            times: Times of the samples, s.
            states: The samples, with a leading axis in all arrays, (n, ...).

        Returns:
            Velocity of the trunk at the last sample, body frame, (3,), m/s, and its covariance, (3,
            3), (m/s)^2.
        """


class BackupVelocity:
    """Runs a filter of its own, independent of the velocity estimator and of the accelerometer.

    The filter receives the acceleration of a trunk at rest, within the noise that it assumes for
    the accelerometer. The legs alone give the velocity to within 0.02 m/s of the result with an
    accelerometer.

    While its velocity only confirms the estimate, the filter processes every THINNING-th of BATCH
    states at once, which costs less. As soon as the velocity matters, it catches up, and
    processes every state.

    Attributes:
        velocity: Velocity at the newest processed state, body frame, (3,), m/s; None if there is
            none.
    """

    def __init__(self, filter: Estimator | None) -> None:
        self._filter = filter
        self._waiting: list[RobotState] = []
        self._is_needed = False
        self.velocity: Array | None = None

    def add(self, state: RobotState) -> None:
        """Take the next state.

        Args:
            state: The measured state.
        """
        self._waiting.append(state)
        if self._is_needed or self.velocity is None:
            self._catch_up()
        elif len(self._waiting) == BATCH:
            self._waiting = self._waiting[THINNING - 1 :: THINNING]
            self._catch_up()

    def confirm(self, estimate: Array | None, tolerance: float) -> None:
        """Make `velocity` that of the newest state, unless it confirms an estimate anyway.

        Args:
            estimate: The velocity estimate, body frame, (3,), m/s; None if there is none.
            tolerance: Largest difference at which the estimate is confirmed, m/s.
        """
        self._is_needed = (
            estimate is None
            or self.velocity is None
            or not math.dist(estimate.tolist(), self.velocity.tolist()) <= tolerance
        )
        if self._is_needed:
            self._catch_up()

    def newest(self) -> Array | None:
        """Return the velocity at the newest state, because it is used."""
        self._is_needed = True
        self._catch_up()
        return self.velocity

    def _catch_up(self) -> None:
        """Process the waiting states; if the filter fails, reset it, without a velocity until the next state."""
        waiting, self._waiting = self._waiting, []
        if self._filter is None or not waiting:
            return
        arrays: dict[str, Any] = {
            name: np.array([getattr(state, name) for state in waiting]) for name in _ARRAYS
        }
        states = attrs.evolve(waiting[0], **arrays)
        states.linear_acceleration = rotate_inverse(states.quaternion, REST_ACCELERATION)
        try:
            self.velocity, _ = self._filter.update_series([state.time for state in waiting], states)
        except (ValueError, FloatingPointError, np.linalg.LinAlgError):
            self.reset()

    def reset(self) -> None:
        """Reset the filter; there is no velocity until the next state."""
        self._waiting.clear()
        if self._filter is not None:
            self._filter.reset()
        self.velocity = None
