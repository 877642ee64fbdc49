"""Contact-aided linear Kalman filter for the trunk velocity, from inertia and planted feet.

The state has the 18 numbers of Bloesch et al. (2012, "State estimation for legged robots") and of
the MIT Cheetah's estimator (Bledt et al. 2018), in the world frame: trunk position p, trunk
velocity v, foot centres f_1..f_4. The orientation R (body to world) comes from the IMU.

All noise is isotropic. The axes x, y, z are then independent and share one covariance, which a
rotation does not change. So the state x is an array (..., 6, 3) and the covariance P is (..., 6,
6). The filter does not estimate the accelerometer bias; the legs bound its effect.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array
from quadvel_description.fields import field
from quadvel_description.kinematics import foot_kinematics, rotation_matrix
from quadvel_description.robot import GRAVITY
from quadvel_description.state import RobotState

from .odometry import foot_velocity_in_trunk, rolling_velocity

VELOCITY_ROW = 1  # row of v in the state; row 0 is p, rows 2 to 5 are f_1..f_4
FOOT_ROWS = slice(2, 6)
SWING_SPEED_STD = 10.0  # m/s, standard deviation of the unknown speed of a foot in the air
SPEED_CORRELATION_S = 1.0  # from the variance of a foot's speed to its random walk
INITIAL_COVARIANCE = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # m^2, (m/s)^2, 4 m^2
# H, with z = H x: z_1..z_4 = f_i - p (feet relative to the trunk), z_5 = v.
MEASUREMENT_MATRIX = np.zeros((5, 6))
MEASUREMENT_MATRIX[:4, 0], MEASUREMENT_MATRIX[:4, FOOT_ROWS], MEASUREMENT_MATRIX[4, VELOCITY_ROW] = (
    -1.0,
    np.eye(4),
    1.0,
)


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

    accelerometer: float = field(16.2, above=0.0, tuning=(0.05, 50.0))
    foot_position: float = field(0.0102, above=0.0, tuning=(1e-4, 0.2))
    foot_velocity: float = field(0.465, above=0.0, tuning=(0.01, 2.0))
    foot_walk: float = field(0.00296, above=0.0, tuning=(1e-4, 0.5))
    slip_gate: float = field(0.564, above=0.0, tuning=(0.1, 10.0))
    contact_force: float = field(2.42, above=0.0, tuning=(0.5, 60.0))
    contact_ramp: float = field(3.34, above=0.0, tuning=(0.5, 150.0))
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

    def __init__(self, config: KalmanConfig | None = None, shape: tuple[int, ...] = ()) -> None:
        """Create a filter.

        Args:
            config: Noise and thresholds; None for the defaults.
            shape: Leading axes of all arrays; () for one robot.
        """
        self.config = config or KalmanConfig()
        self._state = np.zeros((*shape, 6, 3))
        self._covariance = np.zeros((*shape, 6, 6))
        self._speed_variance = np.zeros((*shape, 4))
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
        self._covariance[where] = INITIAL_COVARIANCE
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
        dt = 0.0 if self._time is None else state.time - self._time
        if dt < 0.0:
            raise ValueError(f"state.time is {state.time}, expected {self._time} or later, or a reset")
        self._time = state.time
        rotation = rotation_matrix(state.quaternion)
        feet, jacobians = foot_kinematics(state.q)
        to_world = rotation.swapaxes(-1, -2)  # R^T, as vectors are rows: s_world = s_body R^T
        # With the foot s_i relative to the trunk, v = v_roll,i - d/dt (R s_i) for a planted foot.
        foot_rolling = rolling_velocity(state, rotation) @ to_world
        leg_velocity = foot_rolling - foot_velocity_in_trunk(state, feet, jacobians) @ to_world
        trust = self._contact_trust(state, rotation, jacobians)

        self._predict(state, rotation, dt)
        speed_variance = self._foot_speed_variance(leg_velocity, trust)
        self._predict_feet(foot_rolling, speed_variance, dt)
        self._correct(feet @ to_world, leg_velocity, speed_variance)

        velocity = (self._state[..., VELOCITY_ROW : VELOCITY_ROW + 1, :] @ rotation)[..., 0, :]
        if not np.isfinite(velocity).all():
            raise FloatingPointError("the Kalman filter's velocity is not finite")
        return velocity, self._covariance[..., VELOCITY_ROW, VELOCITY_ROW, None, None] * np.eye(3)

    def _contact_trust(self, state: RobotState, rotation: Array, jacobians: Array) -> Array:
        """Return the contact confidence of each foot, (..., 4): 0 in the air, 1 planted, linear in the force."""
        if self.config.contact_source == "foot_force":
            force = np.asarray(state.foot_force)
        else:
            force = _ground_force(state.tau, rotation, jacobians)
        return np.clip((force - self.config.contact_force) / self.config.contact_ramp, 0.0, 1.0)

    def _predict(self, state: RobotState, rotation: Array, dt: float) -> None:
        """Predict position and velocity over `dt` (s).

        a = R a_measured - g e_z
        p' = p + v dt + a dt^2 / 2,   v' = v + a dt
        P' = F P F^T + sigma_a^2 G G^T,   G = (dt^2 / 2, dt, 0, 0, 0, 0)
        """
        gain = np.array([0.5 * dt * dt, dt, 0.0, 0.0, 0.0, 0.0])
        transition = np.eye(6)
        transition[0, VELOCITY_ROW] = dt
        acceleration = rotation @ np.asarray(state.linear_acceleration)[..., None]
        acceleration[..., 2, 0] -= GRAVITY
        self._state = transition @ self._state + gain[:, None] * acceleration.swapaxes(-1, -2)
        noise = gain[:, None] * gain * self.config.accelerometer**2
        self._covariance = transition @ self._covariance @ transition.T + noise

    def _foot_speed_variance(self, leg_velocity: Array, trust: Array) -> Array:
        """Return the variance of each foot's unmodelled speed, (..., 4), (m/s)^2: swing, or slip on the ground.

        sigma^2 = P_vv + sigma_foot^2            (expected variance of v_leg - v)
        e = |v_leg - v|^2 / (3 gate^2 sigma^2)   (excess over the slip gate)
        result = sigma^2 max(e^2 - 1, 0) + (1 - trust) SWING_SPEED_STD^2
        """
        expected_variance = (
            self._covariance[..., VELOCITY_ROW, VELOCITY_ROW, None] + self.config.foot_velocity**2
        )
        deviation = np.square(leg_velocity - self._state[..., VELOCITY_ROW, None, :]).sum(-1) / 3.0
        excess = deviation / (self.config.slip_gate**2 * expected_variance)
        slip: Array = expected_variance * np.maximum(excess**2 - 1.0, 0.0)
        return slip + (1.0 - trust) * SWING_SPEED_STD**2

    def _predict_feet(self, rolling: Array, speed_variance: Array, dt: float) -> None:
        """Move the feet by rolling and add their random walk over `dt` (s).

            f_i' = f_i + v_roll,i dt
            P_ii' = P_ii + (sigma_walk^2 + max(s_i before, s_i now) SPEED_CORRELATION_S) dt

        The larger of the two speed variances counts: only a foot that is planted at both ends of
        `dt` stayed in place in between.
        """
        self._state[..., FOOT_ROWS, :] += rolling * dt
        before, self._speed_variance = self._speed_variance, speed_variance
        walk = self.config.foot_walk**2 + np.maximum(before, speed_variance) * SPEED_CORRELATION_S
        diagonal = np.einsum("...ii->...i", self._covariance)  # a view
        diagonal[..., FOOT_ROWS] += walk * dt

    def _correct(self, feet: Array, leg_velocity: Array, speed_variance: Array) -> None:
        """Correct with the feet (z_1..z_4) and the trunk velocity from the legs (z_5).

        The four leg velocities enter as their weighted mean, w_i = 1 / (sigma_foot^2 + s_i), which
        is equivalent to four measurements:

            S = H P H^T + R,   K = P H^T S^-1
            x' = x + K (z - H x),   P' = P - K H P
        """
        weight = 1.0 / (self.config.foot_velocity**2 + speed_variance)
        total = weight.sum(-1, keepdims=True)
        mean = (weight[..., None, :] @ leg_velocity) / total[..., None]

        measured = MEASUREMENT_MATRIX @ self._covariance  # (..., 5, 6)
        innovation_covariance = measured @ MEASUREMENT_MATRIX.T
        diagonal = np.einsum("...ii->...i", innovation_covariance)  # a view
        diagonal[..., :4] += self.config.foot_position**2
        diagonal[..., 4:] += 1.0 / total
        gain = np.linalg.solve(innovation_covariance, measured).swapaxes(-1, -2)
        innovation = np.concatenate([feet, mean], axis=-2) - MEASUREMENT_MATRIX @ self._state
        self._state = self._state + gain @ innovation
        covariance = self._covariance - gain @ measured
        self._covariance = 0.5 * (covariance + covariance.swapaxes(-1, -2))


def _ground_force(tau: ArrayLike, rotation: Array, jacobians: Array) -> Array:
    """Return the vertical ground force on each foot, (..., 4), N, for massless legs: tau = -J^T f.

    Damped least squares, (J J^T + lambda I) f = -J tau, bounds the force near a straight leg.
    """
    torque = np.reshape(tau, (*jacobians.shape[:-1], 1))
    damped = jacobians @ jacobians.swapaxes(-1, -2) + 1e-4 * np.eye(3)
    force = np.linalg.solve(damped, jacobians @ torque)[..., 0]
    vertical: Array = -(force * rotation[..., 2, None, :]).sum(-1)
    return vertical
