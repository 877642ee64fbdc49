"""From a stream of states as messages bring them to estimates: order, rate, gaps, and where the robot got to.

Between the node and an estimator; it knows neither ROS nor how velocity is estimated.
"""

from __future__ import annotations

from typing import Protocol

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.kinematics import rotate
from quadvel_description.state import RobotState
from quadvel_nodes.messages import MessageError
from quadvel_nodes.tick_grid import TickGrid

from .features import RATE_HZ

Array = NDArray[np.float64]

PATIENCE = 10  # states in order, all older than the newest, that show that time was set back


class Estimator(Protocol):
    """What both estimators are."""

    def reset(self) -> None:
        """Forget what was seen so far."""

    def update(self, state: RobotState, previous_action: ArrayLike) -> tuple[Array, Array]:
        """Take one sample; returns velocity (3,) and its covariance (3, 3), body frame."""


@attrs.frozen
class Estimate:
    """Velocity at the time of a state, and the position that it adds up to."""

    velocity: Array  # (3,) m/s, body frame
    covariance: Array  # (3, 3) (m/s)^2, body frame
    position: Array  # (3,) m, from where tracking began; axes of the IMU's world
    position_deviation: Array  # (3,) m, of `position` where the errors of the velocity all add up


class VelocityTracker:
    """Feeds an estimator at its rate with what comes in order, and resets it where the stream broke.

    restarts: how often it did since the first state.
    """

    def __init__(self, estimator: Estimator, reset_gap: float = 0.1) -> None:
        """`reset_gap`: s without a state after which the estimator starts anew."""
        self.restarts = 0
        self._estimator = estimator
        self._reset_gap = reset_gap
        self._grid = TickGrid(1.0 / RATE_HZ)
        self._previous_action = np.zeros(12)
        self._newest: float | None = None  # s, of all states
        self._taken: float | None = None  # s, of the last state given to the estimator since its reset
        self._refused = 0.0  # s, of the last state refused
        self._refused_in_order = 0
        self._position = np.zeros(3)
        self._deviation = np.zeros(3)

    def command(self, previous_action: Array) -> None:
        """The joint targets now in force, as `features.previous_action` gives them."""
        self._previous_action = previous_action

    def start_again(self) -> None:
        """Count the position from here on, where the robot was put to another place."""
        self._restart()
        self._position, self._deviation = np.zeros(3), np.zeros(3)

    def take(self, state: RobotState) -> Estimate | None:
        """The estimate at this state, or None where the state comes between two samples of the estimator.

        Raises MessageError for a state that is older than one seen before, and FloatingPointError where the
        estimate is not finite; the estimator is reset then.
        """
        self._follow(state.time)
        if not self._grid.periods(state.time):
            return None
        try:
            velocity, covariance = self._estimator.update(state, self._previous_action)
        except FloatingPointError:
            self._restart()
            raise
        dt = 0.0 if self._taken is None else state.time - self._taken
        self._taken = state.time
        self._position = self._position + dt * rotate(state.quaternion, velocity)
        self._deviation = self._deviation + dt * np.sqrt(covariance.diagonal())
        return Estimate(velocity, covariance, self._position, self._deviation)

    def _follow(self, time: float) -> None:
        """Move on to `time`; refuse it, or start anew, where it does not follow the states before."""
        if self._newest is not None and time <= self._newest:
            self._refused_in_order = self._refused_in_order + 1 if time > self._refused else 1
            self._refused = time
            if self._refused_in_order < PATIENCE:
                age = 1e3 * (self._newest - time)
                raise MessageError(f"stamp is {age:.0f} ms older than the newest, expected a later one")
            self._restart()
        elif self._newest is not None and time - self._newest > self._reset_gap:
            self._restart()
        self._newest = time

    def _restart(self) -> None:
        """The position stays: an odometry frame does not jump by itself."""
        self.restarts += 1
        self._estimator.reset()
        self._taken = None
