"""Contact-aided linear Kalman filter for the trunk velocity, from inertia and planted feet.

The filter is that of Bloesch et al. (2012, "State estimation for legged robots") and of the MIT
Cheetah's estimator (Bledt et al. 2018), in the axes of the world. Their state holds the trunk's
position p and the foot centres f_i. Legs measure only r_i = f_i - p, so the state here is the trunk
velocity v and r_1..r_4, with the same result for v. The orientation R (body to world) comes from
the IMU.

All noise is isotropic. The axes x, y, z are then independent and share one covariance, which a
rotation does not change. So the state x is an array (..., 5, 3) and the covariance P is (..., 5,
5). The filter does not estimate the accelerometer bias; the legs bound its effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field, positive
from quadvel_description.kinematics import foot_kinematics, rotation_matrix
from quadvel_description.quadruped import GRAVITY
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState

from .odometry import foot_velocity_in_trunk, rolling_velocity

SWING_SPEED_STD = 10.0  # m/s, standard deviation of the unknown speed of a foot in the air
SPEED_CORRELATION_S = 1.0  # from the variance of a foot's speed to its random walk
INITIAL_VARIANCE = 1.0  # (m/s)^2 of the velocity, m^2 of the feet
_IDENTITY = np.eye(3)


@attrs.frozen
class KalmanConfig:
    """Noise (standard deviations) and contact thresholds of the filter.

    `python -m quadvel_training kalman` tuned the defaults on the training walks.

    Attributes:
        accelerometer: Noise of one acceleration sample, impacts included, m/s^2.
        foot_position: Noise of a foot position relative to the trunk (encoders, elasticity), m.
        foot_velocity: Noise of the velocity of a planted foot, m/s.
        foot_walk: Random walk of a planted foot, m/sqrt(s).
        slip_gate: Foot speed, in standard deviations, above which a foot is assumed to slip.
        contact_force: Force below which a foot is in the air, N.
        contact_ramp: Force above `contact_force` at which a foot is fully trusted, N.
        contact_source: Source of the foot force: "foot_force" (its own sensor) or "torque" (joint
            torques, which every robot has).
    """

    accelerometer: float = positive(16.2, tuning=(0.05, 50.0))
    foot_position: float = positive(0.0102, tuning=(1e-4, 0.2))
    foot_velocity: float = positive(0.465, tuning=(0.01, 2.0))
    foot_walk: float = positive(0.00296, tuning=(1e-4, 0.5))
    slip_gate: float = positive(0.564, tuning=(0.1, 10.0))
    contact_force: float = positive(2.42, tuning=(0.5, 60.0))
    contact_ramp: float = positive(3.34, tuning=(0.5, 150.0))
    contact_source: Literal["foot_force", "torque"] = field("torque", one_of=("foot_force", "torque"))

    @classmethod
    def bounds(cls) -> dict[str, tuple[float, float]]:
        """Return the tuning bounds of the parameters.

        Returns:
            Least and greatest value by name, in the order of `vector`.
        """
        return {f.name: f.metadata["tuning"] for f in attrs.fields(cls) if "tuning" in f.metadata}

    def vector(self) -> Array:
        """Return the parameters as a vector for an optimiser.

        Returns:
            Natural logarithms of the parameters in `bounds`, (n,).
        """
        return np.log([getattr(self, name) for name in self.bounds()])

    def with_vector(self, vector: ArrayLike) -> KalmanConfig:
        """Return a copy with other parameters.

        Args:
            vector: Natural logarithms of the parameters in `bounds`, (n,).

        Returns:
            The configuration.
        """
        values: dict[str, Any] = {
            name: math.exp(x) for name, x in zip(self.bounds(), np.asarray(vector, float), strict=True)
        }
        return attrs.evolve(self, **values)


class KalmanEstimator:
    """Kalman filter of one robot, or of many robots that are sampled at the same times.

    Attributes:
        config: Noise and thresholds.
    """

    def __init__(self, robot: Robot, config: KalmanConfig | None = None, shape: tuple[int, ...] = ()) -> None:
        """Create a filter.

        Args:
            robot: The robot.
            config: Noise and thresholds; None for the defaults.
            shape: Leading axes of all arrays; () for one robot.
        """
        self._robot = robot
        self.config = config or KalmanConfig()
        # The sixth row of state and covariance is the acceleration, an input of each sample.
        self._state, self._covariance = np.zeros((*shape, 6, 3)), np.zeros((*shape, 6, 6))
        self._initial_covariance = np.diag([INITIAL_VARIANCE] * 5 + [self.config.accelerometer**2])
        self._transition = np.eye(5, 6)  # [F | G] of `_predict`
        self._speed_variance = np.zeros((*shape, 4))
        # Variances of what `_correct` measures; 1 / (3 gate^2) of `_foot_speed_variance`, for each axis.
        self._noise = np.full((*shape, 5), self.config.foot_position**2)
        self._gate_weights = np.full(3, 1.0 / (3.0 * self.config.slip_gate**2))
        self.reset()

    def reset(self, ids: Any = None) -> None:
        """Reset the state and the covariance.

        Args:
            ids: Robots to reset, an index into the leading axes; None resets all robots and the
                time.
        """
        if ids is None:
            self._time: float | None = None
        where = ... if ids is None else ids
        self._state[where] = 0.0
        self._covariance[where] = self._initial_covariance
        self._speed_variance[where] = SWING_SPEED_STD**2

    def update(self, state: RobotState, previous_action: ArrayLike | None = None) -> tuple[Array, Array]:
        """Process one sample: predict to its time, then correct.

        Args:
            state: The measured state, arrays (..., 12), (..., 4), (..., 3).
            previous_action: Not used; the learned estimator has the same signature.

        Returns:
            Velocity of the trunk in the body frame, (..., 3), m/s, and its covariance, (..., 3, 3),
            (m/s)^2.

        Raises:
            ValueError: Time went back.
            FloatingPointError: The result is not finite.
        """
        rotation, *measured = self._measure(state)
        self._process(state.time, *measured)
        return self._result(rotation)

    def update_series(self, times: Sequence[float], states: RobotState) -> tuple[Array, Array]:
        """Process samples of one robot one after the other, faster than by `update`.

        Args:
            times: Times of the samples, s; at least one.
            states: The samples, with a leading axis in all arrays, (n, ...).

        Returns:
            As `update`, at the last sample.

        Raises:
            ValueError: Time went back.
            FloatingPointError: The result is not finite.
        """
        rotation, *measured = self._measure(states)
        for k, time in enumerate(times):
            self._process(time, *(values[k] for values in measured))
        return self._result(rotation[k])

    def _measure(self, state: RobotState) -> tuple[Array, ...]:
        """Return what does not depend on the past.

        These are the rotation R (..., 3, 3), and in the world's axes: the measured state (..., 5, 3),
        whose first row, the velocity, is still empty; velocity of rolling feet (..., 4, 3); the
        trunk's velocity from each leg, with a 1 after it (..., 4, 4); variance of the speed of feet
        that are in the air (..., 4); and the trunk's acceleration (..., 3).
        """
        rotation = rotation_matrix(state.quaternion)
        feet, jacobians = foot_kinematics(self._robot, state.q)
        to_world = rotation.swapaxes(-1, -2)  # R^T, as vectors are rows: s_world = s_body R^T
        # With the foot s_i relative to the trunk, v = v_roll,i - d/dt (R s_i) for a planted foot.
        rolling = rolling_velocity(self._robot, state, rotation) @ to_world
        leg_velocity = np.ones((*feet.shape[:-1], 4))
        leg_velocity[..., :3] = rolling - foot_velocity_in_trunk(state, feet, jacobians) @ to_world
        measured = np.empty((*feet.shape[:-2], 5, 3))
        measured[..., 1:, :] = feet @ to_world
        swing_variance = (1.0 - self._contact_trust(state, rotation, jacobians)) * SWING_SPEED_STD**2
        acceleration = (rotation @ np.asarray(state.linear_acceleration)[..., None])[..., 0]
        acceleration[..., 2] -= GRAVITY
        return rotation, measured, rolling, leg_velocity, swing_variance, acceleration

    def _process(
        self, time: float, measured: Array, rolling: Array, leg_velocity: Array, swing_variance: Array,
        acceleration: Array,
    ) -> None:  # fmt: skip
        """Process the results of `_measure` at a time, s."""
        dt = 0.0 if self._time is None else time - self._time
        if dt < 0.0:
            raise ValueError(f"state.time is {time}, expected {self._time} or later, or a reset")
        self._time = time
        state, covariance = self._predict(acceleration, dt)
        speed_variance = self._foot_speed_variance(state, covariance, leg_velocity, swing_variance)
        self._predict_feet(state, covariance, rolling, speed_variance, dt)
        self._correct(state, covariance, measured, leg_velocity, speed_variance)

    def _result(self, rotation: Array) -> tuple[Array, Array]:
        """Return what `update` returns."""
        velocity = (self._state[..., :1, :] @ rotation)[..., 0, :]
        if not np.isfinite(velocity).all():
            raise FloatingPointError("the Kalman filter's velocity is not finite")
        return velocity, self._covariance[..., 0, 0, None, None] * _IDENTITY

    def _contact_trust(self, state: RobotState, rotation: Array, jacobians: Array) -> Array:
        """Return the contact confidence of each foot, (..., 4): 0 in the air, 1 planted, linear in the force."""
        if self.config.contact_source == "foot_force":
            force = np.asarray(state.foot_force)
        else:
            force = _ground_force(state.tau, rotation, jacobians)
        return np.clip((force - self.config.contact_force) / self.config.contact_ramp, 0.0, 1.0)

    def _predict(self, acceleration: Array, dt: float) -> tuple[Array, Array]:
        """Predict the velocity and the feet relative to the trunk over `dt` (s).

        v' = v + a dt,   r_i' = r_i - v dt - a dt^2 / 2, that is x' = F x + G a
        P' = F P F^T + sigma_a^2 G G^T = [F | G] diag(P, sigma_a^2) [F | G]^T
        """
        transition = self._transition
        transition[1:, 0], transition[0, 5], transition[1:, 5] = -dt, dt, -0.5 * dt * dt
        self._state[..., 5, :] = acceleration
        return transition @ self._state, transition @ self._covariance @ transition.T

    def _foot_speed_variance(
        self, state: Array, covariance: Array, leg_velocity: Array, swing_variance: Array
    ) -> Array:
        """Return the variance of each foot's unmodelled speed, (..., 4), (m/s)^2: swing, or slip on the ground.

        sigma^2 = P_vv + sigma_foot^2            (expected variance of v_leg - v)
        e = |v_leg - v|^2 / (3 gate^2 sigma^2)   (excess over the slip gate)
        result = sigma^2 max(e^2 - 1, 0) + (1 - trust) SWING_SPEED_STD^2
        """
        expected_variance = covariance[..., :1, 0] + self.config.foot_velocity**2
        difference = leg_velocity[..., :3] - state[..., :1, :]
        excess = (difference * difference) @ self._gate_weights / expected_variance
        slip: Array = expected_variance * np.maximum(excess * excess - 1.0, 0.0)
        return slip + swing_variance

    def _predict_feet(
        self, state: Array, covariance: Array, rolling: Array, speed_variance: Array, dt: float
    ) -> None:
        """Move the feet by rolling and add their random walk over `dt` (s), in place.

            r_i' = r_i + v_roll,i dt
            P_ii' = P_ii + (sigma_walk^2 + max(s_i before, s_i now) SPEED_CORRELATION_S) dt

        The larger of the two speed variances counts: only a foot that is planted at both ends of
        `dt` stayed in place in between.
        """
        state[..., 1:, :] += rolling * dt
        before, self._speed_variance = self._speed_variance, speed_variance
        walk = self.config.foot_walk**2 + np.maximum(before, speed_variance) * SPEED_CORRELATION_S
        _diagonal(covariance)[..., 1:] += walk * dt

    def _correct(
        self, state: Array, covariance: Array, measured: Array, leg_velocity: Array, speed_variance: Array
    ) -> None:
        """Correct with the trunk velocity from the legs (z_0) and the feet (z_1..z_4).

        The four leg velocities enter as their weighted mean, w_i = 1 / (sigma_foot^2 + s_i), which
        is equivalent to four measurements. The measurement is that of the whole state, H = I, with
        the gain K = P S^-1 = I - R S^-1:

            S = P + R,   R = diag(1 / sum(w), sigma_r^2, ..., sigma_r^2)
            x' = x + K (z - x) = z - R S^-1 (z - x),   P' = P - K P = R - R S^-1 R
        """
        weight = 1.0 / (self.config.foot_velocity**2 + speed_variance)
        weighted = (weight[..., None, :] @ leg_velocity)[..., 0, :]  # of the velocities, and sum(w)
        total, noise = weighted[..., 3:], self._noise
        measured[..., 0, :] = weighted[..., :3] / total
        noise[..., :1] = 1.0 / total
        diagonal = _diagonal(covariance)
        diagonal += noise
        scaled = noise[..., None] * np.linalg.inv(covariance)  # R S^-1
        self._state[..., :5, :] = measured - scaled @ (measured - state)
        corrected = scaled * -noise[..., None, :]
        diagonal = _diagonal(corrected)
        diagonal += noise
        self._covariance[..., :5, :5] = corrected


def _diagonal(matrices: Array) -> Array:
    """Return a view of the diagonals of contiguous matrices (..., n, n)."""
    size = matrices.shape[-1]
    return matrices.reshape(*matrices.shape[:-2], size * size)[..., :: size + 1]


def _ground_force(tau: ArrayLike, rotation: Array, jacobians: Array) -> Array:
    """Return the vertical ground force on each foot, (..., 4), N, for massless legs: tau = -J^T f.

    Damped least squares, (J J^T + lambda I) f = -J tau, bounds the force near a straight leg.
    """
    torque = np.reshape(tau, (*jacobians.shape[:-1], 1))
    damped = jacobians @ jacobians.swapaxes(-1, -2) + 1e-4 * np.eye(3)
    force = np.linalg.solve(damped, jacobians @ torque)[..., 0]
    vertical: Array = -(force * rotation[..., 2, None, :]).sum(-1)
    return vertical
