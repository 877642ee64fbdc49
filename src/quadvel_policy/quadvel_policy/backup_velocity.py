"""The velocity that is followed where the estimator's is missing or wrong. Knows no ROS."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.state import RobotState

Array = NDArray[np.float64]


class Estimator(Protocol):
    """What a filter has to be; `quadvel_estimator.kalman.KalmanEstimator` is one."""

    def reset(self) -> None: ...

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]: ...


class BackupVelocity:
    """Follows the states with a filter of its own, beside the estimator and independent of it.

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
            self.velocity, _ = self._filter.update(state, np.zeros(12))
        except (ValueError, FloatingPointError, np.linalg.LinAlgError):
            self.forget()

    def forget(self) -> None:
        """Start anew."""
        if self._filter is not None:
            self._filter.reset()
        self.velocity = None
