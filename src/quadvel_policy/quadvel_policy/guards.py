"""What can go wrong with a robot that moves, who notices it, and what is done then. Knows no ROS.

GUARDS is the table of all guards: `faults` makes the page for people out of it. The limits have a margin of three or more
over what walking shows, on flat and rough ground, on drawn plants and in the logs of a real Go2
(docs/decisions/0046-guards.md).
"""

from __future__ import annotations

import math

import numpy as np

from quadvel_description.kinematics import rotate
from quadvel_description.robot import GRAVITY, JOINT_NAMES, LEGS, LOWER, TORQUE_LIMIT, UPPER, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState
from quadvel_nodes.messages import QUATERNION_TOLERANCE, BackInTimeError, NotFiniteError, NotUnitError

from .guard import MOVING, WALK, Array, Guard, GuardInput, Level

ENCODER_MEMORY = 0.1  # s, over which angles and speeds of the joints have to agree
GYRO_MEMORY = 0.2  # s, over which orientation and angular velocity have to agree
TORQUE_MEMORY = 0.1  # s, over which torques asked for and reported have to agree
ACCELERATION_MEMORY = 0.5  # s, over which a robot on legs cannot gain speed
STANDSTILL = 0.05  # rad, which a joint that is stuck does not leave
NOTABLE = 0.02  # rad, by which other joints moved where a sensor that stood still meanwhile is suspect


class DuplicatePublisher(Guard):
    """More than one simulator or driver reports states."""

    def check(self, see: GuardInput) -> str | None:
        return see.duplicate_publisher


class StateNotFinite(Guard):
    """A number of the state is not finite."""

    def check(self, see: GuardInput) -> str | None:
        if isinstance(refusal := see.refused.get("low_state"), NotFiniteError):
            return f"low_state is refused: {refusal}"
        if see.is_sound:
            return None
        for name in ("q", "dq", "quaternion", "angular_velocity"):
            if not np.isfinite(getattr(see.state, name)).all():
                return f"the state's {name} is not finite"
        return None


class AttitudeNotUnit(Guard):
    """The orientation's quaternion is not of length 1, within 5 %."""

    def check(self, see: GuardInput) -> str | None:
        if isinstance(refusal := see.refused.get("low_state"), NotUnitError):
            return f"low_state is refused: {refusal}"
        length = math.hypot(*see.state.quaternion.tolist())
        return (
            f"the state's quaternion has length {length:.2f}, expected 1"
            if abs(length - 1.0) > QUATERNION_TOLERANCE
            else None
        )


class StateBackInTime(Guard):
    """The time of the states went back."""

    def check(self, see: GuardInput) -> str | None:
        if isinstance(refusal := see.refused.get("low_state"), BackInTimeError):
            return f"low_state is refused: {refusal}"
        return f"the state's time went back by {-1e3 * see.gap:.0f} ms" if see.gap < 0.0 else None


class ControllerStopped(Guard):
    """The controller itself did not run for longer than `max_state_age`, and the robot went on without it."""

    def check(self, see: GuardInput) -> str | None:
        limit = see.config.max_state_age
        if min(see.stopped, see.gap) <= limit:
            return None
        stopped = f"the controller did not run for {1e3 * see.stopped:.0f} ms while the robot went on"
        return f"{stopped}, limit {1e3 * limit:.0f} ms"


class StateStale(Guard):
    """The state is older than `max_state_age`, or none fit to use came for so long; `max_standstill` where the process of a
    simulated robot is silent, whose time stands still then."""

    def check(self, see: GuardInput) -> str | None:
        if refusal := see.refused.get("low_state"):
            return f"low_state is refused: {refusal}"
        limit = see.config.max_silence
        if see.age > limit:
            return f"the state is {1e3 * see.age:.0f} ms old, limit {1e3 * limit:.0f} ms"
        if see.gap > limit:
            return f"no state came for {1e3 * see.gap:.0f} ms, limit {1e3 * limit:.0f} ms"
        return None


class StateFrozen(Guard):
    """States come, but the robot's tick has stood still for `frozen_tick_time`."""

    def __init__(self) -> None:
        self._time = 0.0

    def check(self, see: GuardInput) -> str | None:
        repeats = see.before is not None and see.state.tick == see.before.tick and see.gap > 0.0
        self._time = self._time + see.gap if repeats else 0.0
        if self._time < see.config.frozen_tick_time:
            return None
        return f"the robot's tick has stood at {see.state.tick} for {1e3 * self._time:.0f} ms"


class Tilted(Guard):
    """The trunk is tilted by more than `max_tilt`: the robot has fallen or is about to."""

    def check(self, see: GuardInput) -> str | None:
        _, x, y, _ = see.state.quaternion.tolist()
        tilt = math.acos(max(-1.0, min(1.0 - 2.0 * (x * x + y * y), 1.0)))
        limit = see.config.max_tilt
        return f"the trunk is tilted by {tilt:.2f} rad, limit {limit:.2f}" if tilt > limit else None


class JointOutOfRange(Guard):
    """A joint is beyond its mechanical range by more than `joint_margin`."""

    def check(self, see: GuardInput) -> str | None:
        if see.is_sound:
            return None
        q = see.state.q
        for i in np.flatnonzero(np.maximum(LOWER - q, q - UPPER) > see.config.joint_margin):
            return f"{JOINT_NAMES[i]} is at {q[i]:.2f} rad, its range is {LOWER[i]:.2f} to {UPPER[i]:.2f}"
        return None


class JointTooFast(Guard):
    """A joint moves faster than `max_joint_speed` of what its drive can do."""

    def check(self, see: GuardInput) -> str | None:
        if see.is_sound:
            return None
        limit = see.config.max_joint_speed * VELOCITY_LIMIT
        for i in np.flatnonzero(np.abs(see.state.dq) > limit):
            return f"{JOINT_NAMES[i]} moves at {see.state.dq[i]:.0f} rad/s, limit {limit[i]:.0f}"
        return None


class EncoderInconsistent(Guard):
    """A joint's angle is off what its speed adds up to by more than `max_encoder_error`: a jump, a slip, a reading that is
    stuck, or a robot that was put elsewhere."""

    at_once = False

    def __init__(self) -> None:
        self._error = np.zeros(12)

    def check(self, see: GuardInput) -> str | None:
        if see.mode not in MOVING or see.before is None or see.gap <= 0.0 or not see.is_sound:
            self._error[:] = 0.0
            return None
        moved = see.state.q - see.before.q
        if see.gap <= 0.01:
            unexplained = moved - 0.5 * see.gap * (see.state.dq + see.before.dq)
        else:  # too long to know the way in between; what no joint can do is wrong all the same
            unexplained = np.sign(moved) * np.maximum(
                np.abs(moved) - see.config.max_joint_speed * VELOCITY_LIMIT * see.gap, 0.0
            )
        self._error = self._error * math.exp(-see.gap / ENCODER_MEMORY) + unexplained
        i = int(np.argmax(np.abs(self._error)))
        error, limit = self._error[i], see.config.max_encoder_error
        if abs(error) <= limit:
            return None
        return (
            f"{JOINT_NAMES[i]}'s angle is {error:+.2f} rad off what its speed adds up to, limit {limit:.2f}"
        )


class EncoderFrozen(Guard):
    """Angle and speed of a joint repeat themselves to the bit for `frozen_time` while it is asked to move and others do."""

    at_once = False

    def __init__(self) -> None:
        self._time, self._asked, self._others = np.zeros(12), np.zeros(12), np.zeros(12)

    def check(self, see: GuardInput) -> str | None:
        if see.before is None or see.asked.mode == MODE_DAMPING:
            self._time[:] = 0.0
            return None
        moved = np.abs(see.state.q - see.before.q)
        same = (moved == 0.0) & (see.state.dq == see.before.dq)
        since = same & (self._time > 0.0)
        self._time = np.where(same, self._time + see.gap, 0.0)
        self._asked = np.where(since, self._asked, see.asked.q)  # where it was asked to be when it last moved
        self._others = np.where(since, self._others + moved.max(), 0.0)
        suspect = (np.abs(see.asked.q - self._asked) > STANDSTILL) & (self._others > NOTABLE)
        for i in np.flatnonzero(suspect & (self._time > see.config.frozen_time)):
            return f"{JOINT_NAMES[i]}'s encoder has repeated itself for {1e3 * self._time[i]:.0f} ms"
        return None


class ImuInconsistent(Guard):
    """The orientation is off what the gyroscope adds up to by more than `max_attitude_error`."""

    at_once = False

    def __init__(self) -> None:
        self._error = np.zeros(3)

    def check(self, see: GuardInput) -> str | None:
        if see.mode not in MOVING or see.before is None or not 0.0 < see.gap <= 0.01 or not see.is_sound:
            self._error[:] = 0.0
            return None
        turned = _rotation_between(see.before.quaternion, see.state.quaternion)
        gyro = 0.5 * see.gap * (see.state.angular_velocity + see.before.angular_velocity)
        self._error = self._error * math.exp(-see.gap / GYRO_MEMORY) + turned - gyro
        error, limit = math.hypot(*self._error.tolist()), see.config.max_attitude_error
        if error <= limit:
            return None
        return f"the orientation is {error:.2f} rad off what the gyroscope adds up to, limit {limit:.2f}"


class ImuFrozen(Guard):
    """Orientation and angular velocity, which is not zero, repeat themselves to the bit for `frozen_time` while the joints
    move."""

    at_once = False
    level = Level.STANCE

    def __init__(self) -> None:
        self._time = self._way = 0.0

    def check(self, see: GuardInput) -> str | None:
        if see.before is None:
            return None
        gyro = see.state.angular_velocity
        same = (
            np.array_equal(gyro, see.before.angular_velocity)
            and np.array_equal(see.state.quaternion, see.before.quaternion)
            and gyro.any()
        )
        self._time = self._time + see.gap if same else 0.0
        self._way = self._way + float(np.abs(see.state.q - see.before.q).max()) if same else 0.0
        if self._time <= see.config.frozen_time or self._way <= NOTABLE:
            return None
        return f"the IMU has repeated itself for {1e3 * self._time:.0f} ms while the joints moved"


class AccelerometerImplausible(Guard):
    """The accelerometer shows more than `max_acceleration_error` on the mean of half a second: no robot on legs does that.
    One that shows zeros alone is not judged."""

    at_once = False
    level = Level.STANCE

    def __init__(self) -> None:
        self._mean = np.zeros(3)

    def check(self, see: GuardInput) -> str | None:
        if not np.isfinite(see.state.linear_acceleration).all():
            return "the state's linear_acceleration is not finite"
        if not see.state.linear_acceleration.any():
            return None
        now = rotate(see.state.quaternion, see.state.linear_acceleration)
        now[2] -= GRAVITY
        self._mean += (now - self._mean) * -math.expm1(-max(see.gap, 0.0) / ACCELERATION_MEMORY)
        mean, limit = math.hypot(*self._mean.tolist()), see.config.max_acceleration_error
        if mean <= limit:
            return None
        return f"the accelerometer shows {mean:.1f} m/s^2 on the mean of half a second, limit {limit:.1f}"


class DriveDoesNotAnswer(Guard):
    """A drive's torque is off the one asked for by more than `max_torque_error` on the mean: it has dropped out, commands
    do not reach it, or it reports nonsense. A robot that reports no torque at any joint is not judged."""

    at_once = False

    def __init__(self) -> None:
        self._asked, self._told = np.zeros(12), np.zeros(12)

    def check(self, see: GuardInput) -> str | None:
        if see.mode not in MOVING or not see.state.tau.any():
            self._asked[:] = self._told[:] = 0.0
            return None
        share = -math.expm1(-max(see.gap, 0.0) / TORQUE_MEMORY)
        self._asked += share * (torque_of(see.asked, see.state) - self._asked)
        self._told += share * (see.state.tau - self._told)
        error = np.abs(self._told - self._asked)
        i = int(np.argmax(error))
        if not error[i] > see.config.max_torque_error:
            return None
        return (
            f"{JOINT_NAMES[i]} gives {self._told[i]:+.0f} N m where {self._asked[i]:+.0f} N m were asked for"
        )


class JointStuck(Guard):
    """A joint has pushed with more than `stuck_torque` of what its drive can for `stuck_time` and did not move."""

    at_once = False

    def __init__(self) -> None:
        self._time, self._place = np.zeros(12), np.zeros(12)

    def check(self, see: GuardInput) -> str | None:
        q = see.state.q
        pushes = np.abs(see.state.tau) > see.config.stuck_torque * TORQUE_LIMIT
        stays = pushes & (np.abs(q - self._place) < STANDSTILL)
        self._time = np.where(stays, self._time + max(see.gap, 0.0), 0.0)
        self._place = np.where(stays, self._place, q)
        for i in np.flatnonzero(self._time > see.config.stuck_time):
            return f"{JOINT_NAMES[i]} is stuck at {q[i]:.2f} rad: it pushes with {see.state.tau[i]:+.0f} N m"
        return None


class MotorDroppedOut(Guard):
    """The board has switched off a motor."""

    def check(self, see: GuardInput) -> str | None:
        if see.motors is None or not see.motors.dropped_out.any():
            return None
        return f"{JOINT_NAMES[int(np.argmax(see.motors.dropped_out))]} was switched off by the board"


class MotorHot(Guard):
    """A motor is hotter than `max_temperature`."""

    level = Level.STANCE

    def check(self, see: GuardInput) -> str | None:
        if see.motors is None:
            return None
        i, limit = int(np.argmax(see.motors.temperature)), see.config.max_temperature
        if see.motors.temperature[i] <= limit:
            return None
        return f"{JOINT_NAMES[i]} is at {see.motors.temperature[i]:.0f} deg C, limit {limit:.0f}: let it cool down"


class FootForceFrozen(Guard):
    """The force of a foot does not change for `frozen_foot_time` while the robot walks. Nothing that drives uses it."""

    at_once = False
    level = Level.NOTICE
    modes = WALK

    def __init__(self) -> None:
        self._time = np.zeros(4)

    def check(self, see: GuardInput) -> str | None:
        if see.before is None or not see.moves or see.mode != "walk":
            self._time[:] = 0.0
            return None
        same = see.state.foot_force == see.before.foot_force
        self._time = np.where(same, self._time + see.gap, 0.0)
        for i in np.flatnonzero(self._time > see.config.frozen_foot_time):
            return f"the force of foot {LEGS[i]} has stood at {see.state.foot_force[i]:.0f} N for {self._time[i]:.1f} s"
        return None


class Overruns(Guard):
    """More than `max_overruns` deadlines were missed in a row (on a robot; a simulated one waits)."""

    level = Level.STANCE

    def check(self, see: GuardInput) -> str | None:
        if see.overruns <= see.config.max_overruns:
            return None
        return f"{see.overruns} deadlines were missed in a row, limit {see.config.max_overruns}"


class EstimateStale(Guard):
    """There is no fresh velocity estimate, or it is not finite: the Kalman filter's is followed."""

    level = Level.LIMIT
    modes = WALK

    def check(self, see: GuardInput) -> str | None:
        return _lost(see)


class EstimateWrong(Guard):
    """The velocity estimate is off the Kalman filter's by more than `max_velocity_error`: the Kalman filter's is followed
    until they have agreed for `velocity_trust_time`."""

    level = Level.LIMIT
    modes = WALK

    def __init__(self) -> None:
        self._right = 0.0
        self._found: str | None = None

    def check(self, see: GuardInput) -> str | None:
        if see.velocity is None or see.backup is None:
            return self._found
        c, error = see.config, math.dist(see.velocity.tolist(), see.backup.tolist())
        if not error <= c.max_velocity_error:
            self._right = 0.0
            self._found = f"the velocity estimate is {error:.1f} m/s off the Kalman filter's, limit {c.max_velocity_error:.1f}"
        else:
            self._right += see.gap
            if self._right > c.velocity_trust_time:
                self._found = None
        return self._found


class NoVelocity(Guard):
    """Neither the velocity estimate nor the Kalman filter's is there."""

    level = Level.STANCE
    modes = WALK

    def check(self, see: GuardInput) -> str | None:
        lost = _lost(see)
        return f"{lost}, nor has the Kalman filter one" if lost and see.backup is None else None


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
"""In the order in which the first of several at once is told: causes before what follows from them."""


def torque_of(command: JointCommand, state: RobotState) -> Array:
    """The torque (12,) N m that a drive without flaws gives for `command` where the joints are, within its limit."""
    asked = command.torque(state.q, state.dq)
    torque: Array = np.minimum(np.maximum(asked, -TORQUE_LIMIT), TORQUE_LIMIT)
    return torque


def _lost(see: GuardInput) -> str | None:
    """Why the velocity estimate cannot be followed, a sentence, or None."""
    if see.velocity is None:
        refusal = see.refused.get("velocity_estimate")
        return (
            f"velocity_estimate is refused: {refusal}" if refusal else "there is no fresh velocity estimate"
        )
    return None if all(map(math.isfinite, see.velocity.tolist())) else "the velocity estimate is not finite"


def _rotation_between(before: Array, after: Array) -> Array:
    """The rotation vector (3,), rad, body frame, of a small turn from one quaternion to the other: twice the vector part of
    conj(before) * after."""
    w, x, y, z = before.tolist()
    a, b, c, d = after.tolist()
    sign = 2.0 if w * a + x * b + y * c + z * d >= 0.0 else -2.0
    return sign * np.array(
        [w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a]
    )
