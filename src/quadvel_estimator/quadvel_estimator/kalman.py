"""Trunk velocity from inertia and planted feet: a contact-aided linear Kalman filter, the classical way.

The state has the 18 numbers of Bloesch et al. (2012, "State estimation for legged robots") and of the MIT
Cheetah's estimator, in the world frame: trunk position p, trunk velocity v, foot centres f_1..f_4. The
orientation is the IMU's. Every noise is taken as the same in all directions; then the axes x, y, z are
independent and share one covariance, so that the state is kept as (..., 6, 3), the covariance as (..., 6, 6),
and a rotation does not change it. No accelerometer bias is estimated: the legs bound its effect.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.kinematics import foot_kinematics, rotation_matrix
from quadvel_description.robot import GRAVITY
from quadvel_description.state import RobotState

from .odometry import against_trunk, rolling

Array = NDArray[np.float64]

V = 1  # row of v in the state; row 0 is p, rows 2 to 5 are the feet
FEET = slice(2, 6)
SWING_SPEED = 10.0  # m/s, standard deviation of the speed of a foot in the air: nothing is known of it
SPEED_MEMORY = 1.0  # s, turns the variance of an unknown foot speed into that of a foot's random walk
FIRST_VARIANCE = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # m^2, (m/s)^2, m^2: the first p is the origin
# What is measured: the four feet against the trunk, and the velocity of the trunk.
MEASURED = np.zeros((5, 6))
MEASURED[:4, 0], MEASURED[:4, FEET], MEASURED[4, V] = -1.0, np.eye(4), 1.0


def _positive(low: float, default: float, high: float) -> Any:
    """A positive parameter and the bounds within which it may be tuned."""
    return attrs.field(default=default, validator=attrs.validators.gt(0.0), metadata={"bounds": (low, high)})


@attrs.frozen
class KalmanConfig:
    """Noise (standard deviations) and contact thresholds; the defaults are tuned on the training walks
    by `python -m quadvel_training kalman`.

    accelerometer: m/s^2, of one sample, impacts included
    foot_position: m, of a foot against the trunk (encoders, elasticity)
    foot_velocity: m/s, of a planted foot
    foot_walk: m/sqrt(s), random walk of a planted foot
    slip_gate: the foot speed, in standard deviations, beyond which a foot is taken to slip
    contact_force: N, below it a foot is in the air
    contact_ramp: N, so much above `contact_force` a foot is trusted fully
    contact_source: what tells the force on a foot, its own sensor or the joint torques, which every robot has
    """

    accelerometer: float = _positive(0.05, 16.2, 50.0)
    foot_position: float = _positive(1e-4, 0.0102, 0.2)
    foot_velocity: float = _positive(0.01, 0.465, 2.0)
    foot_walk: float = _positive(1e-4, 0.00296, 0.5)
    slip_gate: float = _positive(0.1, 0.564, 10.0)
    contact_force: float = _positive(0.5, 2.42, 60.0)
    contact_ramp: float = _positive(0.5, 3.34, 150.0)
    contact_source: Literal["foot_force", "torque"] = attrs.field(
        default="torque", validator=attrs.validators.in_(("foot_force", "torque"))
    )

    @classmethod
    def bounds(cls) -> dict[str, tuple[float, float]]:
        """Name, least and greatest value of each parameter that `vector` holds, in its order."""
        return {f.name: f.metadata["bounds"] for f in attrs.fields(cls) if "bounds" in f.metadata}

    def vector(self) -> Array:
        """The natural logarithms of the parameters in `bounds`, (n,)."""
        return np.log([getattr(self, name) for name in self.bounds()])

    def with_vector(self, vector: ArrayLike) -> KalmanConfig:
        """This configuration with the parameters that `vector` (n,) gives."""
        values: dict[str, Any] = {
            name: math.exp(x) for name, x in zip(self.bounds(), np.asarray(vector, float), strict=True)
        }
        return attrs.evolve(self, **values)


class KalmanEstimator:
    """Filters one robot, or many sampled at the same instants: then all arrays lead with the axes `shape`."""

    def __init__(self, config: KalmanConfig | None = None, shape: tuple[int, ...] = ()) -> None:
        self.config = config or KalmanConfig()
        self._state = np.zeros((*shape, 6, 3))
        self._covariance = np.zeros((*shape, 6, 6))
        self._speed_variance = np.zeros((*shape, 4))
        self.reset()

    def reset(self, ids: Any = None) -> None:
        """Forget everything, or only what is known of the robots `ids`, an index into the leading axes."""
        if ids is None:
            self._time: float | None = None
        where = ... if ids is None else ids
        self._state[where] = 0.0
        self._covariance[where] = FIRST_VARIANCE
        self._speed_variance[where] = SWING_SPEED**2

    def update(self, state: RobotState, previous_action: ArrayLike | None = None) -> tuple[Array, Array]:
        """Take one sample; returns velocity (..., 3) in m/s and its covariance (..., 3, 3), body frame.

        `previous_action` is not used; the learned estimator has the same signature. Raises ValueError where
        time runs backwards, FloatingPointError where the result is not finite.
        """
        dt = 0.0 if self._time is None else state.time - self._time
        if dt < 0.0:
            raise ValueError(f"state.time is {state.time}, expected {self._time} or later, or a reset")
        self._time = state.time
        rotation = rotation_matrix(state.quaternion)
        feet, jacobians = foot_kinematics(state.q)
        to_world = rotation.swapaxes(-1, -2)  # for rows of vectors
        foot_rolling = rolling(state, rotation) @ to_world
        leg_velocity = foot_rolling - against_trunk(state, feet, jacobians) @ to_world
        trust = self._contact_trust(state, rotation, jacobians)

        self._predict(state, rotation, dt)
        speed_variance = self._unknown_speed(leg_velocity, trust)
        self._move_feet(foot_rolling, speed_variance, dt)
        self._correct(feet @ to_world, leg_velocity, speed_variance)

        velocity = (self._state[..., V : V + 1, :] @ rotation)[..., 0, :]
        if not np.isfinite(velocity).all():
            raise FloatingPointError("the Kalman filter's velocity is not finite")
        return velocity, self._covariance[..., V, V, None, None] * np.eye(3)

    def _contact_trust(self, state: RobotState, rotation: Array, jacobians: Array) -> Array:
        """0 for a foot in the air to 1 for a planted one, (..., 4), from the normal force."""
        if self.config.contact_source == "foot_force":
            force = np.asarray(state.foot_force)
        else:
            force = _ground_force(state.tau, rotation, jacobians)
        return np.clip((force - self.config.contact_force) / self.config.contact_ramp, 0.0, 1.0)

    def _predict(self, state: RobotState, rotation: Array, dt: float) -> None:
        """p' = p + v dt + a dt^2 / 2, v' = v + a dt with a = R a_measured - g e_z."""
        gain = np.array([0.5 * dt * dt, dt, 0.0, 0.0, 0.0, 0.0])
        transition = np.eye(6)
        transition[0, V] = dt
        acceleration = rotation @ np.asarray(state.linear_acceleration)[..., None]
        acceleration[..., 2, 0] -= GRAVITY
        self._state = transition @ self._state + gain[:, None] * acceleration.swapaxes(-1, -2)
        noise = gain[:, None] * gain * self.config.accelerometer**2
        self._covariance = transition @ self._covariance @ transition.T + noise

    def _unknown_speed(self, leg_velocity: Array, trust: Array) -> Array:
        """Variance (..., 4) of each foot's own speed: anything in the air, apparent slip on the ground."""
        known = self._covariance[..., V, V, None] + self.config.foot_velocity**2
        surprise = np.square(leg_velocity - self._state[..., V, None, :]).sum(-1) / 3.0
        excess = surprise / (self.config.slip_gate**2 * known)
        slip: Array = known * np.maximum(excess**2 - 1.0, 0.0)
        return slip + (1.0 - trust) * SWING_SPEED**2

    def _move_feet(self, rolling: Array, speed_variance: Array, dt: float) -> None:
        """The feet roll, and walk at random; only a foot planted at both ends of `dt` stayed in between."""
        self._state[..., FEET, :] += rolling * dt
        before, self._speed_variance = self._speed_variance, speed_variance
        walk = self.config.foot_walk**2 + np.maximum(before, speed_variance) * SPEED_MEMORY
        diagonal = np.einsum("...ii->...i", self._covariance)  # a view
        diagonal[..., FEET] += walk * dt

    def _correct(self, feet: Array, leg_velocity: Array, speed_variance: Array) -> None:
        """Kalman correction; the legs' velocities enter as their weighted mean, which comes to the same."""
        weight = 1.0 / (self.config.foot_velocity**2 + speed_variance)
        total = weight.sum(-1, keepdims=True)
        mean = (weight[..., None, :] @ leg_velocity) / total[..., None]

        measured = MEASURED @ self._covariance  # (..., 5, 6)
        innovation_covariance = measured @ MEASURED.T
        diagonal = np.einsum("...ii->...i", innovation_covariance)  # a view
        diagonal[..., :4] += self.config.foot_position**2
        diagonal[..., 4:] += 1.0 / total
        gain = np.linalg.solve(innovation_covariance, measured).swapaxes(-1, -2)
        innovation = np.concatenate([feet, mean], axis=-2) - MEASURED @ self._state
        self._state = self._state + gain @ innovation
        covariance = self._covariance - gain @ measured
        self._covariance = 0.5 * (covariance + covariance.swapaxes(-1, -2))


def _ground_force(tau: ArrayLike, rotation: Array, jacobians: Array) -> Array:
    """Vertical force of the ground on each foot, N, (..., 4), for legs without mass: tau = -J^T f.

    Damped least squares, so that a straight leg gives a small force, not a huge one.
    """
    torque = np.reshape(tau, (*jacobians.shape[:-1], 1))
    damped = jacobians @ jacobians.swapaxes(-1, -2) + 1e-4 * np.eye(3)
    force = np.linalg.solve(damped, jacobians @ torque)[..., 0]
    vertical: Array = -(force * rotation[..., 2, None, :]).sum(-1)
    return vertical
