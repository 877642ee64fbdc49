"""Guards of the legs: encoders, drives and feet. No ROS.

`guard` runs the guards, and the supervisor acts on what they find; docs/faults.md lists all of
them.
"""

from __future__ import annotations

import math

import numpy as np
from typing_extensions import override

from quadvel_description.quadruped import JOINT_NAMES, LEGS
from quadvel_description.state import MODE_DAMPING

from ..guard import MOVING_MODES, WALK_MODES, Guard, GuardInput, Level

ENCODER_WINDOW_S = 0.1  # window in which angles and speeds of the joints must agree
TORQUE_WINDOW_S = 0.1  # window in which commanded and reported torques must agree
DRIVE_WATCHDOG_S = 0.02  # time without a command after which driver and board brake the drives
LATE_TICKS = 4  # consecutive missed deadlines, of 5 ms each, that last as long
STUCK_RANGE_RAD = 0.05  # largest motion of a stuck joint
NOTABLE_MOTION_RAD = 0.02  # motion of other joints that makes a constant sensor suspect


class JointOutOfRange(Guard):
    """A joint is beyond its mechanical range by more than `joint_margin`."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.is_sound:
            return None
        q, lower, upper = data.state.q, data.robot.lower, data.robot.upper
        for i in np.flatnonzero(np.maximum(lower - q, q - upper) > data.config.joint_margin):
            return f"{JOINT_NAMES[i]} is at {q[i]:.2f} rad, its range is {lower[i]:.2f} to {upper[i]:.2f}"
        return None


class JointTooFast(Guard):
    """A joint moves faster than `max_joint_speed` times the speed limit of its drive."""

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.is_sound:
            return None
        limit = data.bounds.speed
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
        if data.gap <= 0.01:
            unexplained = data.motion - 0.5 * data.gap * (data.state.dq + data.previous.dq)
        else:  # after a gap the path is unknown; count only motion beyond the largest speed
            unexplained = np.sign(data.motion) * np.maximum(
                np.abs(data.motion) - data.bounds.speed * data.gap, 0.0
            )
        self._error *= math.exp(-data.gap / ENCODER_WINDOW_S)
        self._error += unexplained
        limit = data.config.max_encoder_error
        if np.count_nonzero(np.abs(self._error) <= limit) == 12:
            return None
        i = int(np.argmax(np.abs(self._error)))
        error = self._error[i]
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
        if np.count_nonzero(data.motion) == 12:  # the usual case: every reading has changed
            self._time[:] = 0.0
            return None
        motion = np.abs(data.motion)
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


class DriveDoesNotAnswer(Guard):
    """A drive's torque deviates from the commanded one by more than `max_torque_error` on the mean:
    it has dropped out, commands do not reach it, or its report is wrong. A robot that reports no
    torque at any joint is not checked.

    Both torques pass the same low-pass filter with the time constant TORQUE_WINDOW_S. Drives brake
    by themselves if commands are later than DRIVE_WATCHDOG_S. Such ticks are left out: they say
    nothing about the drives, and the guards of states and deadlines name the cause.
    """

    is_immediate = False

    def __init__(self) -> None:
        self._means = np.zeros((2, 12))  # of the commanded and of the reported torque
        self._now = np.zeros((2, 12))

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.mode not in MOVING_MODES or not np.count_nonzero(data.state.tau):
            self._means[:] = 0.0
            return None
        if data.gap > DRIVE_WATCHDOG_S or data.overruns >= LATE_TICKS:
            return None
        share = -math.expm1(-max(data.gap, 0.0) / TORQUE_WINDOW_S)
        expected, reported = self._means
        limit = data.robot.torque_limit
        np.minimum(np.maximum(data.commanded_torque, -limit), limit, out=self._now[0])
        self._now[1] = data.state.tau
        self._means += share * (self._now - self._means)
        error = np.abs(reported - expected)
        if not np.count_nonzero(error > data.config.max_torque_error):
            return None
        i = int(np.argmax(error))
        return f"{JOINT_NAMES[i]} gives {reported[i]:+.0f} N m, commanded {expected[i]:+.0f} N m"


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
        pushes = np.abs(data.state.tau) > data.config.stuck_torque * data.robot.torque_limit
        if not np.count_nonzero(pushes):  # the usual case
            self._time[:], self._stuck_at = 0.0, q
            return None
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
        self._time = [0.0] * 4

    @override
    def check(self, data: GuardInput) -> str | None:
        if data.previous is None or not data.is_moving or data.mode != "walk":
            self._time = [0.0] * 4
            return None
        forces = data.state.foot_force.tolist()
        pairs = zip(self._time, forces, data.previous.foot_force.tolist(), strict=True)
        self._time = [time + data.gap if force == before else 0.0 for time, force, before in pairs]
        longest = max(self._time)
        if longest <= data.config.frozen_foot_time:
            return None
        i = self._time.index(longest)
        return f"the force of foot {LEGS[i]} has stayed at {forces[i]:.0f} N for {longest:.1f} s"
