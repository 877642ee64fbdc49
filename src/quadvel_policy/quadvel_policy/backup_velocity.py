"""Backup velocity that replaces a missing or wrong velocity estimate. Knows no ROS."""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate_inverse
from quadvel_description.robot import GRAVITY
from quadvel_description.state import RobotState

REST_ACCELERATION = np.array([0.0, 0.0, GRAVITY])
"""Reading of an accelerometer at rest, world frame, m/s^2."""


class Estimator(Protocol):
    """Interface of a velocity filter, such as `quadvel_estimator.kalman.KalmanEstimator`."""

    def reset(self) -> None:
        """Reset the filter."""

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """Process one sample.

        Args:
            state: The measured state.
            previous_action: Not used by the Kalman filter.

        Returns:
            Velocity of the trunk, body frame, (3,), m/s, and its covariance, (3, 3), (m/s)^2.
        """


class BackupVelocity:
    """Runs a filter of its own, independent of the velocity estimator and of the accelerometer.

    The filter receives the acceleration of a trunk at rest, within the noise that it assumes for
    the accelerometer. The legs alone give the velocity to within 0.02 m/s of the result with an
    accelerometer.

    Attributes:
        velocity: Velocity at the newest state, body frame, (3,), m/s; None if there is none.
    """

    def __init__(self, filter: Estimator | None) -> None:
        self._filter = filter
        self.velocity: Array | None = None

    def update(self, state: RobotState) -> None:
        """Process the next state; if the filter fails, reset it, without a velocity until the next state.

        Args:
            state: The measured state.
        """
        if self._filter is None:
            return
        try:
            at_rest = rotate_inverse(state.quaternion, REST_ACCELERATION)
            self.velocity, _ = self._filter.update(
                attrs.evolve(state, linear_acceleration=at_rest), np.zeros(12)
            )
        except (ValueError, FloatingPointError, np.linalg.LinAlgError):
            self.reset()

    def reset(self) -> None:
        """Reset the filter; there is no velocity until the next state."""
        if self._filter is not None:
            self._filter.reset()
        self.velocity = None
