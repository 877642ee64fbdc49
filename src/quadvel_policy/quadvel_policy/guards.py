"""Guards: detection of faults of a moving robot. Knows no ROS.

GUARDS lists all guards; `faults` prints their table. The limits have a margin of at least three
over the values of walking on flat and rough ground, on randomised plants, and in logs of a real Go2
(docs/decisions/0046-guards.md).
"""

from __future__ import annotations

import math

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.kinematics import rotate
from quadvel_description.robot import GRAVITY, JOINT_NAMES, LEGS, LOWER, TORQUE_LIMIT, UPPER, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_nodes.messages import QUATERNION_TOLERANCE, BackInTimeError, NotFiniteError, NotUnitError

from .guard import MOVING_MODES, WALK_MODES, Guard, GuardInput, Level

ENCODER_WINDOW_S = 0.1  # window in which angles and speeds of the joints must agree
GYRO_WINDOW_S = 0.2  # window in which orientation and angular velocity must agree
TORQUE_WINDOW_S = 0.1  # window in which commanded and reported torques must agree
ACCELERATION_WINDOW_S = 0.5  # window of the mean acceleration, which is small for a legged robot
STUCK_RANGE_RAD = 0.05  # largest motion of a stuck joint
NOTABLE_MOTION_RAD = 0.02  # motion of other joints that makes a constant sensor suspect


class DuplicatePublisher(Guard):
    """More than one simulator or driver reports states."""

    @override
    def check(self, data: GuardInput) -> str | None:
        return data.duplicate_publisher


class StateNotFinite(Guard):
    """A number of the state is not finite."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), NotFiniteError):
            return f"low_state is refused: {refusal}"
        if data.is_sound:
            return None
        for name in ("q", "dq", "quaternion", "angular_velocity"):
            if not np.isfinite(getattr(data.state, name)).all():
                return f"the state's {name} is not finite"
        return None


class AttitudeNotUnit(Guard):
    """The norm of the orientation's quaternion is not 1, within 5 %."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), NotUnitError):
            return f"low_state is refused: {refusal}"
        length = math.hypot(*data.state.quaternion.tolist())
        return (
            f"the state's quaternion has length {length:.2f}, expected 1"
            if abs(length - 1.0) > QUATERNION_TOLERANCE
            else None
        )


class StateBackInTime(Guard):
    """The time of the states went back."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if isinstance(refusal := data.refused.get("low_state"), BackInTimeError):
            return f"low_state is refused: {refusal}"
        return f"the state's time went back by {-1e3 * data.gap:.0f} ms" if data.gap < 0.0 else None


class ControllerStopped(Guard):
    """The controller did not run for longer than `max_state_age`, while the robot continued."""

    @override
    def check(self, data: GuardInput) -> str | None:
        limit = data.config.max_state_age
        if min(data.stopped, data.gap) <= limit:
            return None
        stopped = f"the controller did not run for {1e3 * data.stopped:.0f} ms while the robot continued"
        return f"{stopped}, limit {1e3 * limit:.0f} ms"


class StateStale(Guard):
    """The state is older than `max_state_age`, or no valid state came for so long; `max_standstill`
    if the process of a simulated robot, whose time stands still then, is silent.
    """

    @override
    def check(self, data: GuardInput) -> str | None:
        if refusal := data.refused.get("low_state"):
            return f"low_state is refused: {refusal}"
        limit = data.config.silence_limit
        if data.age > limit:
            return f"the state is {1e3 * data.age:.0f} ms old, limit {1e3 * limit:.0f} ms"
        if data.gap > limit:
            return f"no state came for {1e3 * data.gap:.0f} ms, limit {1e3 * limit:.0f} ms"
        return None


class StateFrozen(Guard):
    """States arrive, but the robot's tick has not changed for `frozen_tick_time`."""

    def __init__(self) -> None:
        self._time = 0.0

    @override
    def check(self, data: GuardInput) -> str | None:
        repeats = data.previous is not None and data.state.tick == data.previous.tick and data.gap > 0.0
        self._time = self._time + data.gap if repeats else 0.0
        if self._time < data.config.frozen_tick_time:
            return None
        return f"the robot's tick has stayed at {data.state.tick} for {1e3 * self._time:.0f} ms"


class Tilted(Guard):
    """The trunk is tilted by more than `max_tilt`: the robot has fallen or is about to."""

    @override
    def check(self, data: GuardInput) -> str | None:
        _, x, y, _ = data.state.quaternion.tolist()
        tilt = math.acos(max(-1.0, min(1.0 - 2.0 * (x * x + y * y), 1.0)))
        limit = data.config.max_tilt
        return f"the trunk is tilted by {tilt:.2f} rad, limit {limit:.2f}" if tilt > limit else None


class JointOutOfRange(Guard):
    """A joint is beyond its mechanical range by more than `joint_margin`."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.is_sound:
            return None
        q = data.state.q
        for i in np.flatnonzero(np.maximum(LOWER - q, q - UPPER) > data.config.joint_margin):
            return f"{JOINT_NAMES[i]} is at {q[i]:.2f} rad, its range is {LOWER[i]:.2f} to {UPPER[i]:.2f}"
        return None


class JointTooFast(Guard):
    """A joint moves faster than `max_joint_speed` times the speed limit of its drive."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.is_sound:
            return None
        limit = data.config.max_joint_speed * VELOCITY_LIMIT
        for i in np.flatnonzero(np.abs(data.state.dq) > limit):
            return f"{JOINT_NAMES[i]} moves at {data.state.dq[i]:.0f} rad/s, limit {limit[i]:.0f}"
        return None


class EncoderInconsistent(Guard):
    """A joint's angle deviates from its integrated speed by more than `max_encoder_error`: a jump,
    a slip, a constant reading, or a robot that was moved to another place.

        e' = e exp(-dt / ENCODER_WINDOW_S) + (q' - q) - dt (dq' + dq) / 2

    After a gap of more than 10 ms, only the part of q' - q beyond the joint's largest speed counts.
    """

    is_immediate = False

    def __init__(self) -> None:
        self._error = np.zeros(12)

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.mode not in MOVING_MODES or data.previous is None or data.gap <= 0.0 or not data.is_sound:
            self._error[:] = 0.0
            return None
        motion = data.state.q - data.previous.q
        if data.gap <= 0.01:
            unexplained = motion - 0.5 * data.gap * (data.state.dq + data.previous.dq)
        else:  # after a gap the path is unknown; count only motion beyond the largest speed
            unexplained = np.sign(motion) * np.maximum(
                np.abs(motion) - data.config.max_joint_speed * VELOCITY_LIMIT * data.gap, 0.0
            )
        self._error = self._error * math.exp(-data.gap / ENCODER_WINDOW_S) + unexplained
        i = int(np.argmax(np.abs(self._error)))
        error, limit = self._error[i], data.config.max_encoder_error
        if abs(error) <= limit:
            return None
        return f"{JOINT_NAMES[i]}'s angle is {error:+.2f} rad off its integrated speed, limit {limit:.2f}"


class EncoderFrozen(Guard):
    """Angle and speed of a joint do not change a bit for `frozen_time`, while its target and other joints move."""

    is_immediate = False

    def __init__(self) -> None:
        self._time, self._target, self._others_travel = np.zeros(12), np.zeros(12), np.zeros(12)

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.previous is None or data.command.mode == MODE_DAMPING:
            self._time[:] = 0.0
            return None
        motion = np.abs(data.state.q - data.previous.q)
        is_same = (motion == 0.0) & (data.state.dq == data.previous.dq)
        since = is_same & (self._time > 0.0)
        self._time = np.where(is_same, self._time + data.gap, 0.0)
        self._target = np.where(
            since, self._target, data.command.q
        )  # the target when the reading last changed
        self._others_travel = np.where(since, self._others_travel + motion.max(), 0.0)
        suspect = (np.abs(data.command.q - self._target) > STUCK_RANGE_RAD) & (
            self._others_travel > NOTABLE_MOTION_RAD
        )
        for i in np.flatnonzero(suspect & (self._time > data.config.frozen_time)):
            return f"{JOINT_NAMES[i]}'s encoder has not changed for {1e3 * self._time[i]:.0f} ms"
        return None


class ImuInconsistent(Guard):
    """The orientation deviates from the integrated gyroscope by more than `max_attitude_error`.

    e' = e exp(-dt / GYRO_WINDOW_S) + log(R^T R') - dt (w' + w) / 2
    """

    is_immediate = False

    def __init__(self) -> None:
        self._error = np.zeros(3)

    @override
    def check(self, data: GuardInput) -> str | None:
        if (
            data.mode not in MOVING_MODES
            or data.previous is None
            or not 0.0 < data.gap <= 0.01
            or not data.is_sound
        ):
            self._error[:] = 0.0
            return None
        turned = _rotation_between(data.previous.quaternion, data.state.quaternion)
        gyro = 0.5 * data.gap * (data.state.angular_velocity + data.previous.angular_velocity)
        self._error = self._error * math.exp(-data.gap / GYRO_WINDOW_S) + turned - gyro
        error, limit = math.hypot(*self._error.tolist()), data.config.max_attitude_error
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
        gyro = data.state.angular_velocity
        is_same = (
            np.array_equal(gyro, data.previous.angular_velocity)
            and np.array_equal(data.state.quaternion, data.previous.quaternion)
            and gyro.any()
        )
        self._time = self._time + data.gap if is_same else 0.0
        self._joint_travel = (
            self._joint_travel + float(np.abs(data.state.q - data.previous.q).max()) if is_same else 0.0
        )
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
        self._mean = np.zeros(3)

    @override
    def check(self, data: GuardInput) -> str | None:
        if not np.isfinite(data.state.linear_acceleration).all():
            return "the state's linear_acceleration is not finite"
        if not data.state.linear_acceleration.any():
            return None
        now = rotate(data.state.quaternion, data.state.linear_acceleration)
        now[2] -= GRAVITY
        self._mean += (now - self._mean) * -math.expm1(-max(data.gap, 0.0) / ACCELERATION_WINDOW_S)
        mean, limit = math.hypot(*self._mean.tolist()), data.config.max_acceleration_error
        if mean <= limit:
            return None
        return f"the accelerometer shows {mean:.1f} m/s^2 on the mean of half a second, limit {limit:.1f}"


class DriveDoesNotAnswer(Guard):
    """A drive's torque deviates from the commanded one by more than `max_torque_error` on the mean:
    it has dropped out, commands do not reach it, or its report is wrong. A robot that reports no
    torque at any joint is not checked.

    Both torques pass the same low-pass filter with the time constant TORQUE_WINDOW_S.
    """

    is_immediate = False

    def __init__(self) -> None:
        self._expected, self._reported = np.zeros(12), np.zeros(12)

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.mode not in MOVING_MODES or not data.state.tau.any():
            self._expected[:] = self._reported[:] = 0.0
            return None
        share = -math.expm1(-max(data.gap, 0.0) / TORQUE_WINDOW_S)
        self._expected += share * (ideal_torque(data.command, data.state) - self._expected)
        self._reported += share * (data.state.tau - self._reported)
        error = np.abs(self._reported - self._expected)
        i = int(np.argmax(error))
        if not error[i] > data.config.max_torque_error:
            return None
        return f"{JOINT_NAMES[i]} gives {self._reported[i]:+.0f} N m, commanded {self._expected[i]:+.0f} N m"


class JointStuck(Guard):
    """A joint has pushed with more than `stuck_torque` of its drive's largest torque for
    `stuck_time` and did not move.
    """

    is_immediate = False

    def __init__(self) -> None:
        self._time, self._stuck_at = np.zeros(12), np.zeros(12)

    @override
    def check(self, data: GuardInput) -> str | None:
        q = data.state.q
        pushes = np.abs(data.state.tau) > data.config.stuck_torque * TORQUE_LIMIT
        stays = pushes & (np.abs(q - self._stuck_at) < STUCK_RANGE_RAD)
        self._time = np.where(stays, self._time + max(data.gap, 0.0), 0.0)
        self._stuck_at = np.where(stays, self._stuck_at, q)
        for i in np.flatnonzero(self._time > data.config.stuck_time):
            return f"{JOINT_NAMES[i]} is stuck at {q[i]:.2f} rad: it pushes with {data.state.tau[i]:+.0f} N m"
        return None


class MotorDroppedOut(Guard):
    """The board has switched off a motor."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.motors is None or not data.motors.dropped_out.any():
            return None
        return f"{JOINT_NAMES[int(np.argmax(data.motors.dropped_out))]} was switched off by the board"


class MotorHot(Guard):
    """A motor is hotter than `max_temperature`."""

    level = Level.STANCE

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.motors is None:
            return None
        i, limit = int(np.argmax(data.motors.temperature)), data.config.max_temperature
        if data.motors.temperature[i] <= limit:
            return None
        return f"{JOINT_NAMES[i]} is at {data.motors.temperature[i]:.0f} deg C, limit {limit:.0f}: let it cool down"


class FootForceFrozen(Guard):
    """The force of a foot does not change for `frozen_foot_time` while the robot walks. The
    controller does not use it.
    """

    is_immediate = False
    level = Level.NOTICE
    modes = WALK_MODES

    def __init__(self) -> None:
        self._time = np.zeros(4)

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.previous is None or not data.is_moving or data.mode != "walk":
            self._time[:] = 0.0
            return None
        is_same = data.state.foot_force == data.previous.foot_force
        self._time = np.where(is_same, self._time + data.gap, 0.0)
        for i in np.flatnonzero(self._time > data.config.frozen_foot_time):
            return f"the force of foot {LEGS[i]} has stayed at {data.state.foot_force[i]:.0f} N for {self._time[i]:.1f} s"
        return None


class Overruns(Guard):
    """More than `max_overruns` consecutive deadlines were missed (on a robot; a simulated one waits)."""

    level = Level.STANCE

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.overruns <= data.config.max_overruns:
            return None
        return f"{data.overruns} consecutive deadlines were missed, limit {data.config.max_overruns}"


class EstimateStale(Guard):
    """There is no fresh velocity estimate, or it is not finite: the Kalman filter replaces it."""

    level = Level.LIMIT
    modes = WALK_MODES

    @override
    def check(self, data: GuardInput) -> str | None:
        return _estimate_problem(data)


class EstimateWrong(Guard):
    """The velocity estimate deviates from the Kalman filter by more than `max_velocity_error`: the
    Kalman filter replaces it until both have agreed for `velocity_trust_time`.
    """

    level = Level.LIMIT
    modes = WALK_MODES

    def __init__(self) -> None:
        self._agreement_time = 0.0
        self._found: str | None = None

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.velocity is None or data.backup is None:
            return self._found
        config, error = data.config, math.dist(data.velocity.tolist(), data.backup.tolist())
        if not error <= config.max_velocity_error:
            self._agreement_time = 0.0
            self._found = f"the velocity estimate is {error:.1f} m/s off the Kalman filter's, limit {config.max_velocity_error:.1f}"
        else:
            self._agreement_time += data.gap
            if self._agreement_time > config.velocity_trust_time:
                self._found = None
        return self._found


class NoVelocity(Guard):
    """Neither the velocity estimate nor the Kalman filter has a velocity."""

    level = Level.STANCE
    modes = WALK_MODES

    @override
    def check(self, data: GuardInput) -> str | None:
        lost = _estimate_problem(data)
        return f"{lost}, nor has the Kalman filter one" if lost and data.backup is None else None


GUARDS: tuple[type[Guard], ...] = (
    DuplicatePublisher,
    StateNotFinite,
    AttitudeNotUnit,
    StateBackInTime,
    ControllerStopped,
    StateStale,
    StateFrozen,
    Tilted,
    JointOutOfRange,
    JointTooFast,
    EncoderInconsistent,
    EncoderFrozen,
    ImuInconsistent,
    DriveDoesNotAnswer,
    JointStuck,
    MotorDroppedOut,
    ImuFrozen,
    AccelerometerImplausible,
    MotorHot,
    Overruns,
    NoVelocity,
    EstimateStale,
    EstimateWrong,
    FootForceFrozen,
)
"""Guards in priority order: the first active one is reported, so causes precede their consequences.
"""


def ideal_torque(command: JointCommand, state: RobotState) -> Array:
    """Compute the torque that an ideal drive gives for a command at the present joint state.

        tau = clip(kp (q_des - q) + kd (dq_des - dq) + tau_ff, -TORQUE_LIMIT, TORQUE_LIMIT)

    Args:
        command: The joint command.
        state: Present angles and speeds.

    Returns:
        Torques, (12,), N m.
    """
    asked = command.torque(state.q, state.dq)
    torque: Array = np.minimum(np.maximum(asked, -TORQUE_LIMIT), TORQUE_LIMIT)
    return torque


def _estimate_problem(data: GuardInput) -> str | None:
    """Return why the velocity estimate cannot be used, in one sentence, or None."""
    if data.velocity is None:
        refusal = data.refused.get("velocity_estimate")
        return (
            f"velocity_estimate is refused: {refusal}" if refusal else "there is no fresh velocity estimate"
        )
    return None if all(map(math.isfinite, data.velocity.tolist())) else "the velocity estimate is not finite"


def _rotation_between(before: Array, after: Array) -> Array:
    """Return the rotation vector of a small rotation between two orientations, (3,), rad, body frame.

    Twice the vector part of conj(before) * after; the sign selects the shorter rotation.
    """
    w, x, y, z = before.tolist()
    a, b, c, d = after.tolist()
    sign = 2.0 if w * a + x * b + y * c + z * d >= 0.0 else -2.0
    return sign * np.array(
        [w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a]
    )
