"""What can go wrong with a robot that moves, who notices it, and what is done then. Knows no ROS.

A guard looks at every control tick and says in one sentence what is wrong, or nothing. Its `level` says what follows, and
GUARDS is the table of them all: `faults` makes the page for people out of it. What an operator has to clear is the
supervisor's matter. The limits have a margin of three or more over what walking shows, on flat and rough ground, on drawn
plants and in the logs of a real Go2 (docs/decisions/0046-guards.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import IntEnum
from functools import cached_property

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.kinematics import rotate
from quadvel_description.robot import GRAVITY, JOINT_NAMES, LEGS, LOWER, TORQUE_LIMIT, UPPER, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING, JointCommand, RobotState

from .settings import setting

Array = NDArray[np.float64]

MOVING = ("stand_up", "stance", "walk", "lie_down")
"""The modes in which the joints do more than brake"""
WALK = ("walk",)

ENCODER_MEMORY = 0.1  # s, over which angles and speeds of the joints have to agree
GYRO_MEMORY = 0.2  # s, over which orientation and angular velocity have to agree
TORQUE_MEMORY = 0.1  # s, over which torques asked for and reported have to agree
ACCELERATION_MEMORY = 0.5  # s, over which a robot on legs cannot gain speed
STANDSTILL = 0.05  # rad, which a joint that is stuck does not leave
NOTABLE = 0.02  # rad, by which other joints moved where a sensor that stood still meanwhile is suspect


class Level(IntEnum):
    """What follows when a guard finds something; the higher one wins."""

    NOTICE = 0  # it is told, as nothing depends on it
    LIMIT = 1  # the robot goes on within bounds, or on a substitute, and comes back by itself
    STANCE = 2  # the policy brakes the robot, then it stands until the operator clears it
    DAMPING = 3  # every joint brakes at once, until the operator clears it


@attrs.frozen(kw_only=True)
class GuardConfig:
    """The limits beyond which a guard finds something."""

    max_state_age: float = setting(0.05, "oldest state, and longest time without one, before a fault, s")
    max_tilt: float = setting(1.05, "largest angle between the trunk's and the world's vertical, rad")
    max_joint_speed: float = setting(
        1.25, "largest measured joint speed, as a share of what the drive can do"
    )
    joint_margin: float = setting(0.2, "how far a measured angle may lie outside the mechanical range, rad")
    max_encoder_error: float = setting(
        0.35, "by how much a joint's angle may be off what its speed adds up to over 0.1 s, rad"
    )
    max_attitude_error: float = setting(
        0.15, "by how much the orientation may be off what the gyroscope adds up to over 0.2 s, rad"
    )
    max_torque_error: float = setting(
        12.0, "by how much a drive's torque may be off the one asked for, on the mean of 0.1 s, N m"
    )
    max_acceleration_error: float = setting(
        5.0, "largest mean acceleration of the trunk over 0.5 s, gravity left out, m/s^2"
    )
    frozen_time: float = setting(0.1, "after which a sensor that repeats itself to the bit is at fault, s")
    frozen_tick_time: float = setting(0.025, "after which a robot whose tick stands still is at fault, s")
    frozen_foot_time: float = setting(1.0, "the same for a foot's force while walking, s")
    stuck_time: float = setting(0.5, "after which a joint that pushes hard and does not move is stuck, s")
    stuck_torque: float = setting(0.8, "what pushing hard is, as a share of the drive's largest torque")
    max_velocity_error: float = setting(
        0.8, "by how much the velocity estimate may be off the Kalman filter's, m/s"
    )
    velocity_trust_time: float = setting(
        1.0, "after which an estimate that is right again is followed again, s"
    )
    max_temperature: float = setting(80.0, "hottest motor before the robot has to stand, deg C")
    max_overruns: int = setting(20, "deadlines missed in a row before the robot has to stand")


@attrs.frozen
class MotorStatus:
    """What a board tells of its motors now and then."""

    temperature: Array  # (12,) deg C
    dropped_out: NDArray[np.bool_]  # (12,) whether the board has switched it off


@attrs.define
class Sight:
    """What a guard sees at one tick."""

    config: GuardConfig
    mode: str
    state: RobotState
    before: RobotState | None
    """the state of the tick before"""
    age: float
    """s, of the state"""
    gap: float
    """s between the two states, 0 where there is one alone"""
    asked: JointCommand
    """what the joints were asked for at the tick before"""
    velocity: Array | None
    """(3,) m/s, body frame: the velocity estimate; None without a fresh one"""
    backup: Array | None
    """(3,) m/s, body frame: the Kalman filter's; None where there is none"""
    moves: bool
    """whether a velocity other than zero is followed"""
    overruns: int
    """deadlines missed in a row"""
    motors: MotorStatus | None
    obstacle: str | None
    """what somebody else found that forbids moving, a sentence"""

    @cached_property
    def is_sound(self) -> bool:
        """Whether every number is finite and every joint within its limits: all in one look, as it mostly is."""
        state, c = self.state, self.config
        low, high = LOWER - c.joint_margin, UPPER + c.joint_margin
        return bool(
            np.count_nonzero((state.q >= low) & (state.q <= high)) == 12
            and np.count_nonzero(np.abs(state.dq) <= c.max_joint_speed * VELOCITY_LIMIT) == 12
            and all(map(math.isfinite, (*state.quaternion.tolist(), *state.angular_velocity.tolist())))
        )


class Guard:
    """Finds one kind of fault. `modes`: in which it acts; it looks in every mode. `at_once`: whether it looks before the
    tick is answered; one that compares over a time does so after that, and acts at the next tick, 5 ms later.

    The docstring of each is its row in the table of faults.
    """

    level = Level.DAMPING
    at_once = True
    modes: tuple[str, ...] = MOVING

    def look(self, see: Sight) -> str | None:
        """What is wrong, in one sentence, or None."""
        raise NotImplementedError

    @classmethod
    def name(cls) -> str:
        """The name in the table, in lower case with underscores."""
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")


class Obstacle(Guard):
    """More than one simulator or driver reports states."""

    def look(self, see: Sight) -> str | None:
        return see.obstacle


class StateNotFinite(Guard):
    """A number of the state is not finite."""

    def look(self, see: Sight) -> str | None:
        if see.is_sound:
            return None
        for name in ("q", "dq", "quaternion", "angular_velocity"):
            if not np.isfinite(getattr(see.state, name)).all():
                return f"the state's {name} is not finite"
        return None


class StateStale(Guard):
    """The state is older than `max_state_age`, or none came for so long."""

    def look(self, see: Sight) -> str | None:
        limit = see.config.max_state_age
        if see.age > limit:
            return f"the state is {1e3 * see.age:.0f} ms old, limit {1e3 * limit:.0f} ms"
        if see.gap > limit:
            return f"no state came for {1e3 * see.gap:.0f} ms, limit {1e3 * limit:.0f} ms"
        return None


class StateBackInTime(Guard):
    """The time of the states went back."""

    def look(self, see: Sight) -> str | None:
        return f"the state's time went back by {-1e3 * see.gap:.0f} ms" if see.gap < 0.0 else None


class StateFrozen(Guard):
    """States come, but the robot's tick has stood still for `frozen_tick_time`."""

    def __init__(self) -> None:
        self._time = 0.0

    def look(self, see: Sight) -> str | None:
        repeats = see.before is not None and see.state.tick == see.before.tick and see.gap > 0.0
        self._time = self._time + see.gap if repeats else 0.0
        if self._time < see.config.frozen_tick_time:
            return None
        return f"the robot's tick has stood at {see.state.tick} for {1e3 * self._time:.0f} ms"


class AttitudeNotUnit(Guard):
    """The orientation's quaternion is not of length 1, within 5 %."""

    def look(self, see: Sight) -> str | None:
        length = math.hypot(*see.state.quaternion.tolist())
        return (
            f"the state's quaternion has length {length:.2f}, expected 1"
            if abs(length - 1.0) > 0.05
            else None
        )


class Tilted(Guard):
    """The trunk is tilted by more than `max_tilt`: the robot has fallen or is about to."""

    def look(self, see: Sight) -> str | None:
        _, x, y, _ = see.state.quaternion.tolist()
        tilt = math.acos(max(-1.0, min(1.0 - 2.0 * (x * x + y * y), 1.0)))
        limit = see.config.max_tilt
        return f"the trunk is tilted by {tilt:.2f} rad, limit {limit:.2f}" if tilt > limit else None


class JointOutOfRange(Guard):
    """A joint is beyond its mechanical range by more than `joint_margin`."""

    def look(self, see: Sight) -> str | None:
        if see.is_sound:
            return None
        q = see.state.q
        for i in np.flatnonzero(np.maximum(LOWER - q, q - UPPER) > see.config.joint_margin):
            return f"{JOINT_NAMES[i]} is at {q[i]:.2f} rad, its range is {LOWER[i]:.2f} to {UPPER[i]:.2f}"
        return None


class JointTooFast(Guard):
    """A joint moves faster than `max_joint_speed` of what its drive can do."""

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
        if see.motors is None or not see.motors.dropped_out.any():
            return None
        return f"{JOINT_NAMES[int(np.argmax(see.motors.dropped_out))]} was switched off by the board"


class MotorHot(Guard):
    """A motor is hotter than `max_temperature`."""

    level = Level.STANCE

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
        if see.overruns <= see.config.max_overruns:
            return None
        return f"{see.overruns} deadlines were missed in a row, limit {see.config.max_overruns}"


class EstimateStale(Guard):
    """There is no fresh velocity estimate, or it is not finite: the Kalman filter's is followed."""

    level = Level.LIMIT
    modes = WALK

    def look(self, see: Sight) -> str | None:
        return _lost(see.velocity)


class EstimateWrong(Guard):
    """The velocity estimate is off the Kalman filter's by more than `max_velocity_error`: the Kalman filter's is followed
    until they have agreed for `velocity_trust_time`."""

    level = Level.LIMIT
    modes = WALK

    def __init__(self) -> None:
        self._right = 0.0
        self._found: str | None = None

    def look(self, see: Sight) -> str | None:
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

    def look(self, see: Sight) -> str | None:
        lost = _lost(see.velocity)
        return f"{lost}, nor has the Kalman filter one" if lost and see.backup is None else None


GUARDS: tuple[type[Guard], ...] = (
    Obstacle,
    StateNotFinite,
    StateStale,
    StateBackInTime,
    StateFrozen,
    AttitudeNotUnit,
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
"""In the order in which the first of several at once is told."""


@attrs.frozen
class Finding:
    """What is wrong at this tick: the name in the table of faults, what follows, in which modes, and a sentence."""

    name: str
    level: Level
    modes: tuple[str, ...]
    sentence: str


class Watch:
    """All guards over one robot."""

    def __init__(self, guards: Iterable[type[Guard]] = GUARDS) -> None:
        made = [guard() for guard in guards]
        self._at_once = [guard for guard in made if guard.at_once]
        self._later = [guard for guard in made if not guard.at_once]
        self._found_later: list[Finding] = []

    def look(self, see: Sight) -> list[Finding]:
        """What is wrong now, and what `look_again` found at the tick before, whatever the mode."""
        return _findings(self._at_once, see) + self._found_later

    def look_again(self, see: Sight) -> None:
        """After the answer: let those look at the same tick that take their time."""
        self._found_later = _findings(self._later, see)


def _findings(guards: Iterable[Guard], see: Sight) -> list[Finding]:
    found = []
    for guard in guards:
        sentence = guard.look(see)
        if sentence:
            found.append(Finding(guard.name(), guard.level, guard.modes, sentence))
    return found


def torque_of(command: JointCommand, state: RobotState) -> Array:
    """The torque (12,) N m that a drive without flaws gives for `command` where the joints are, within its limit."""
    asked = command.torque(state.q, state.dq)
    torque: Array = np.minimum(np.maximum(asked, -TORQUE_LIMIT), TORQUE_LIMIT)
    return torque


def _lost(velocity: Array | None) -> str | None:
    """Why a velocity estimate (3,) cannot be followed, a sentence, or None."""
    if velocity is None:
        return "there is no fresh velocity estimate"
    return None if all(map(math.isfinite, velocity.tolist())) else "the velocity estimate is not finite"


def _rotation_between(before: Array, after: Array) -> Array:
    """The rotation vector (3,), rad, body frame, of a small turn from one quaternion to the other: twice the vector part of
    conj(before) * after."""
    w, x, y, z = before.tolist()
    a, b, c, d = after.tolist()
    sign = 2.0 if w * a + x * b + y * c + z * d >= 0.0 else -2.0
    return sign * np.array(
        [w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a]
    )
