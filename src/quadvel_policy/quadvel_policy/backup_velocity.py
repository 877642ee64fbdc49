"""The velocity that is followed where the estimator's is missing or wrong. Knows no ROS."""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.kinematics import rotate_inverse
from quadvel_description.robot import GRAVITY
from quadvel_description.state import RobotState

Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, GRAVITY])
"""m/s^2, what an accelerometer at rest shows, world"""


class Estimator(Protocol):
    """What a filter has to be; `quadvel_estimator.kalman.KalmanEstimator` is one."""

    def reset(self) -> None: ...

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]: ...


class BackupVelocity:
    """Follows the states with a filter of its own, beside the estimator and independent of it, and of the accelerometer.

    The filter is told that the trunk does not accelerate, within the noise that it ascribes to the accelerometer: the legs
    alone give the velocity to within 0.02 m/s of what they give with it.
    velocity: (3,) m/s, body frame, at the newest state that was followed; None where there is none.
    """

    def __init__(self, filter: Estimator | None) -> None:
        self._filter = filter
        self.velocity: Array | None = None

    def follow(self, state: RobotState) -> None:
        """Take the next state. Where that fails the filter starts anew, without a velocity until the next one."""
        if self._filter is None:
            return
        try:
            at_rest = rotate_inverse(state.quaternion, UP)
            self.velocity, _ = self._filter.update(
                attrs.evolve(state, linear_acceleration=at_rest), np.zeros(12)
            )
        except (ValueError, FloatingPointError, np.linalg.LinAlgError):
            self.reset()

    def reset(self) -> None:
        """Start anew."""
        if self._filter is not None:
            self._filter.reset()
        self.velocity = None
