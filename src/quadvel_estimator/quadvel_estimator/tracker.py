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
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_DAMPING, RobotState
from quadvel_nodes.messages import MessageError
from quadvel_nodes.tick_grid import TickGrid

from .features import RATE_HZ, previous_action

MAX_STALE_STATES = 10
"""Number of consecutive ordered states, all older than the newest, after which the clock counts as
set back.
"""

REST_S, REST_RAD_S = 0.2, 0.05
"""Time constant of the mean speeds, s, and their largest value at rest, rad/s: the robot then stands or lies still.

With links of 0.25 m, a trunk that moves faster than some 15 mm/s moves a joint faster than this.
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
        stays: Whether the position stays: joints and trunk are still, or the joints are damped.
    """

    velocity: Array
    covariance: Array
    position: Array
    position_deviation: Array
    stays: bool


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
        self._previous_action, self._is_damped = np.zeros(12), False
        self._newest: float | None = None  # s, time of the newest state
        self._last_estimated: float | None = None  # s, time of the last estimate since the reset
        self._last_refused = 0.0  # s, time of the last refused state
        self._refused_in_order = 0
        self._position = np.zeros(3)
        self._deviation = np.zeros(3)
        self._joint_speeds, self._turn_rates = np.ones(12), np.ones(3)  # rad/s, means over REST_S

    def set_command(self, robot: Robot, q_target: ArrayLike, mode: int) -> None:
        """Set the joint command that is now in force.

        Args:
            robot: The robot.
            q_target: Joint targets, (12,), rad.
            mode: Mode of the command.
        """
        self._previous_action = previous_action(robot, q_target, mode)
        self._is_damped = mode == MODE_DAMPING

    def reset_position(self) -> None:
        """Reset the estimator and set the position to zero."""
        self._reset_estimator()
        self._position, self._deviation = np.zeros(3), np.zeros(3)

    def process(self, state: RobotState) -> Estimate | None:
        """Process one state and integrate the position.

            p' = p + R v dt,   sigma_p' = sigma_p + sigma_v dt

        At rest both stay, as an estimate that is a few mm/s off would add up, and with damped joints,
        as the estimate of a robot that falls or lies is wrong.

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
        stays = self._is_at_rest(state, dt) or self._is_damped
        if not stays:
            self._position = self._position + dt * np.array(
                rotate_one(state.quaternion.tolist(), velocity.tolist())
            )
            self._deviation = self._deviation + dt * np.sqrt(covariance.diagonal())
        return Estimate(velocity, covariance, self._position, self._deviation, stays)

    def _is_at_rest(self, state: RobotState, dt: float) -> bool:
        """Return whether the mean speeds of joints and trunk are those of rest."""
        share = min(dt / REST_S, 1.0)
        self._joint_speeds = self._joint_speeds + share * (state.dq - self._joint_speeds)
        self._turn_rates = self._turn_rates + share * (state.angular_velocity - self._turn_rates)
        fastest = max(map(abs, self._joint_speeds.tolist() + self._turn_rates.tolist()))
        return fastest < REST_RAD_S

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
