"""Guards of the trunk: its tilt, and the IMU. No ROS.

`guard.GuardSet` runs them; the supervisor acts on what they find. Angles are in rad, rates in rad/s.
"""

from __future__ import annotations

import math

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate_one
from quadvel_description.quadruped import GRAVITY

from ..guard import MOVING_MODES, Guard, GuardInput, Level
from .legs import NOTABLE_MOTION_RAD

GYRO_WINDOW_S = 0.2  # window in which orientation and angular velocity must agree
ACCELERATION_WINDOW_S = 0.5  # window of the mean acceleration, which is small for a legged robot


class Tilted(Guard):
    """The trunk is tilted by more than `max_tilt`: the robot has fallen or is about to."""

    @override
    def check(self, data: GuardInput) -> str | None:
        _, x, y, _ = data.state.quaternion.tolist()
        tilt = math.acos(max(-1.0, min(1.0 - 2.0 * (x * x + y * y), 1.0)))
        limit = data.config.max_tilt
        return f"the trunk is tilted by {tilt:.2f} rad, limit {limit:.2f}" if tilt > limit else None


class ImuInconsistent(Guard):
    """The orientation deviates from the integrated gyroscope by more than `max_attitude_error`.

    e' = e exp(-dt / GYRO_WINDOW_S) + log(R^T R') - dt (w' + w) / 2
    """

    is_immediate = False

    def __init__(self) -> None:
        self._error = (0.0, 0.0, 0.0)

    @override
    def check(self, data: GuardInput) -> str | None:
        if (
            data.mode not in MOVING_MODES
            or data.previous is None
            or not 0.0 < data.gap <= 0.01
            or not data.is_sound
        ):
            self._error = (0.0, 0.0, 0.0)
            return None
        kept, half = math.exp(-data.gap / GYRO_WINDOW_S), 0.5 * data.gap
        x, y, z = (
            e * kept + angle - half * (now + before)
            for e, angle, now, before in zip(
                self._error,
                _rotation_between(data.previous.quaternion, data.state.quaternion),
                data.state.angular_velocity.tolist(),
                data.previous.angular_velocity.tolist(),
                strict=True,
            )
        )
        self._error = x, y, z
        error, limit = math.hypot(x, y, z), data.config.max_attitude_error
        if error <= limit:
            return None
        return f"the orientation is {error:.2f} rad off the integrated gyroscope, limit {limit:.2f}"


class ImuFrozen(Guard):
    """Orientation and angular velocity, which is not zero, do not change a bit for `frozen_time`,
    while the joints move.
    """

    is_immediate = False
    level = Level.STANCE

    def __init__(self) -> None:
        self._time = self._joint_travel = 0.0

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.previous is None:
            return None
        gyro = data.state.angular_velocity.tolist()
        is_same = (
            gyro == data.previous.angular_velocity.tolist()
            and data.state.quaternion.tolist() == data.previous.quaternion.tolist()
            and any(gyro)
        )
        self._time = self._time + data.gap if is_same else 0.0
        self._joint_travel = self._joint_travel + float(np.abs(data.motion).max()) if is_same else 0.0
        if self._time <= data.config.frozen_time or self._joint_travel <= NOTABLE_MOTION_RAD:
            return None
        return f"the IMU has not changed for {1e3 * self._time:.0f} ms while the joints moved"


class AccelerometerImplausible(Guard):
    """The acceleration is more than `max_acceleration_error` on the mean of half a second: no robot
    on legs does that. An accelerometer that shows only zeros is not checked.

        a_mean' = a_mean + (1 - exp(-dt / ACCELERATION_WINDOW_S)) (R a - g - a_mean)
    """

    is_immediate = False
    level = Level.STANCE

    def __init__(self) -> None:
        self._mean = (0.0, 0.0, 0.0)

    @override
    def check(self, data: GuardInput) -> str | None:
        measured = data.state.linear_acceleration.tolist()
        if not all(map(math.isfinite, measured)):
            return "the state's linear_acceleration is not finite"
        if not any(measured):
            return None
        x, y, z = rotate_one(data.state.quaternion.tolist(), measured)
        share = -math.expm1(-max(data.gap, 0.0) / ACCELERATION_WINDOW_S)
        a, b, c = self._mean
        self._mean = a + (x - a) * share, b + (y - b) * share, c + (z - GRAVITY - c) * share
        mean, limit = math.hypot(*self._mean), data.config.max_acceleration_error
        if mean <= limit:
            return None
        return f"the accelerometer shows {mean:.1f} m/s^2 on the mean of half a second, limit {limit:.1f}"


def _rotation_between(before: Array, after: Array) -> tuple[float, float, float]:
    """Return the rotation vector of a small rotation between two orientations, rad, body frame.

    Twice the vector part of conj(before) * after; the sign selects the shorter rotation.
    """
    w, x, y, z = before.tolist()
    a, b, c, d = after.tolist()
    sign = 2.0 if w * a + x * b + y * c + z * d >= 0.0 else -2.0
    return (
        sign * (w * b - x * a - y * d + z * c),
        sign * (w * c + x * d - y * a - z * b),
        sign * (w * d - x * c + y * b - z * a),
    )
