"""Stream of states to velocity estimates: message order, rate, gaps, and dead reckoning.

This module connects the node to an estimator; it depends on neither ROS nor the kind of estimator.
"""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate_one
from quadvel_description.state import RobotState
from quadvel_nodes.messages import MessageError
from quadvel_nodes.tick_grid import TickGrid

from .features import RATE_HZ

MAX_STALE_STATES = 10
"""Number of consecutive ordered states, all older than the newest, after which the clock counts as
set back.
"""


class Estimator(Protocol):
    """Interface of the velocity estimators."""

    def reset(self) -> None:
        """Reset to the state before the first sample."""

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """Process one sample.

        Args:
            state: The measured state.
            previous_action: As in `features.build`, (12,), rad.

        Returns:
            Velocity of the trunk in the body frame, (3,), m/s, and its covariance, (3, 3), (m/s)^2.
        """


@attrs.frozen
class Estimate:
    """Velocity at the time of a state, and the position by integration.

    Attributes:
        velocity: Velocity in the body frame, (3,), m/s.
        covariance: Covariance of `velocity`, body frame, (3, 3), (m/s)^2.
        position: Position since tracking began, in the axes of the IMU's world, (3,), m.
        position_deviation: Standard deviation of `position` if all velocity errors add up, (3,), m.
    """

    velocity: Array
    covariance: Array
    position: Array
    position_deviation: Array


class VelocityTracker:
    """Feeds an estimator with ordered states at its rate, and resets it after a gap.

    Attributes:
        restarts: Number of resets since the first state.
    """

    def __init__(self, estimator: Estimator, reset_gap: float = 0.1) -> None:
        """Create a tracker.

        Args:
            estimator: The estimator.
            reset_gap: Time without a state after which the estimator is reset, s.
        """
        self.restarts = 0
        self._estimator = estimator
        self._reset_gap = reset_gap
        self._grid = TickGrid(1.0 / RATE_HZ)
        self._previous_action = np.zeros(12)
        self._newest: float | None = None  # s, time of the newest state
        self._last_estimated: float | None = None  # s, time of the last estimate since the reset
        self._last_refused = 0.0  # s, time of the last refused state
        self._refused_in_order = 0
        self._position = np.zeros(3)
        self._deviation = np.zeros(3)

    def set_previous_action(self, previous_action: Array) -> None:
        """Set the joint targets that are now in force.

        Args:
            previous_action: As `features.previous_action` returns it, (12,), rad.
        """
        self._previous_action = previous_action

    def reset_position(self) -> None:
        """Reset the estimator and set the position to zero."""
        self._reset_estimator()
        self._position, self._deviation = np.zeros(3), np.zeros(3)

    def process(self, state: RobotState) -> Estimate | None:
        """Process one state and integrate the position.

            p' = p + R v dt,   sigma_p' = sigma_p + sigma_v dt

        Args:
            state: The measured state.

        Returns:
            The estimate, or None if the state lies between two samples of the estimator.

        Raises:
            MessageError: The state is older than an earlier one.
            FloatingPointError: The estimate is not finite; the tracker resets the estimator.
        """
        self._check_order(state.time)
        if not self._grid.periods_due(state.time):
            return None
        try:
            velocity, covariance = self._estimator.update(state, self._previous_action)
        except FloatingPointError:
            self._reset_estimator()
            raise
        dt = 0.0 if self._last_estimated is None else state.time - self._last_estimated
        self._last_estimated = state.time
        self._position = self._position + dt * np.array(
            rotate_one(state.quaternion.tolist(), velocity.tolist())
        )
        self._deviation = self._deviation + dt * np.sqrt(covariance.diagonal())
        return Estimate(velocity, covariance, self._position, self._deviation)

    def _check_order(self, time: float) -> None:
        """Accept `time` (s) as the newest, refuse an older state, or reset the estimator after a gap."""
        if self._newest is not None and time <= self._newest:
            self._refused_in_order = self._refused_in_order + 1 if time > self._last_refused else 1
            self._last_refused = time
            if self._refused_in_order < MAX_STALE_STATES:
                age = 1e3 * (self._newest - time)
                raise MessageError(f"stamp is {age:.0f} ms older than the newest, expected a later one")
            self._reset_estimator()
        elif self._newest is not None and time - self._newest > self._reset_gap:
            self._reset_estimator()
        self._newest = time

    def _reset_estimator(self) -> None:
        """Reset the estimator; the position stays, as an odometry frame must not jump."""
        self.restarts += 1
        self._estimator.reset()
        self._last_estimated = None
