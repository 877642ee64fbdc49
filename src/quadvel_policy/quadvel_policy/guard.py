"""What a guard is: it looks at every control tick and says in one sentence what is wrong, or nothing. Knows no ROS.

Its `level` says what follows. All of them are in `guards`; what an operator has to clear is the supervisor's matter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from enum import IntEnum
from functools import cached_property

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description.robot import LOWER, TORQUE_LIMIT, UPPER, VELOCITY_LIMIT
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError

from .settings import setting

Array = NDArray[np.float64]

MOVING = ("stand_up", "stance", "walk", "lie_down")
"""The modes in which the joints do more than brake"""
WALK = ("walk",)
FALL_TIME = 5.0
"""s after which a robot lies that was going to fall: a limit that waits longer protects nothing"""


class Level(IntEnum):
    """What follows when a guard finds something; the higher one wins."""

    NOTICE = 0  # it is told, as nothing depends on it
    LIMIT = 1  # the robot goes on within bounds, or on a substitute, and comes back by itself
    STANCE = 2  # the policy brakes the robot, then it stands until the operator clears it
    DAMPING = 3  # every joint brakes at once, until the operator clears it


@attrs.frozen(kw_only=True)
class GuardConfig:
    """The limits beyond which a guard finds something."""

    max_state_age: float = setting(
        0.05, "oldest state, and longest time without one, before a fault, s", at_most=FALL_TIME
    )
    max_standstill: float = setting(
        1.0,
        "the same for a simulated robot, whose time stands still while its process does, s",
        at_most=FALL_TIME,
    )
    robot_waits: bool = setting(
        False,
        "whether the robot's time stands still until a late answer comes, as a simulator's does: then lateness is no fault",
    )
    max_tilt: float = setting(
        1.05, "largest angle between the trunk's and the world's vertical, rad", at_most=0.5 * math.pi
    )
    max_joint_speed: float = setting(
        1.25, "largest measured joint speed, as a share of what the drive can do", at_most=2.0
    )
    joint_margin: float = setting(
        0.2, "how far a measured angle may lie outside the mechanical range, rad", at_most=1.0
    )
    max_encoder_error: float = setting(
        0.35, "by how much a joint's angle may be off what its speed adds up to over 0.1 s, rad", at_most=1.5
    )
    max_attitude_error: float = setting(
        0.15,
        "by how much the orientation may be off what the gyroscope adds up to over 0.2 s, rad",
        at_most=0.5 * math.pi,
    )
    max_torque_error: float = setting(
        12.0,
        "by how much a drive's torque may be off the one asked for, on the mean of 0.1 s, N m",
        at_most=float(TORQUE_LIMIT.max()),
    )
    max_acceleration_error: float = setting(
        5.0, "largest mean acceleration of the trunk over 0.5 s, gravity left out, m/s^2", at_most=50.0
    )
    frozen_time: float = setting(
        0.1, "after which a sensor that repeats itself to the bit is at fault, s", at_most=FALL_TIME
    )
    frozen_tick_time: float = setting(
        0.025, "after which a robot whose tick stands still is at fault, s", at_most=FALL_TIME
    )
    frozen_foot_time: float = setting(1.0, "the same for a foot's force while walking, s", at_most=60.0)
    stuck_time: float = setting(
        0.5, "after which a joint that pushes hard and does not move is stuck, s", at_most=FALL_TIME
    )
    stuck_torque: float = setting(
        0.8, "what pushing hard is, as a share of the drive's largest torque", at_most=1.0
    )
    max_velocity_error: float = setting(
        0.8, "by how much the velocity estimate may be off the Kalman filter's, m/s", at_most=5.0
    )
    velocity_trust_time: float = setting(
        1.0, "after which an estimate that is right again is followed again, s", at_most=60.0
    )
    max_temperature: float = setting(
        80.0, "hottest motor before the robot has to stand, deg C", at_most=120.0
    )
    max_overruns: int = setting(20, "deadlines missed in a row before the robot has to stand", at_most=1000)

    @property
    def max_silence(self) -> float:
        """The longest time (s) without a state, and the oldest state: longer ones for a robot whose time may stand still."""
        return self.max_standstill if self.robot_waits else self.max_state_age


@attrs.frozen
class MotorStatus:
    """What a board tells of its motors now and then."""

    temperature: Array  # (12,) deg C
    dropped_out: NDArray[np.bool_]  # (12,) whether the board has switched it off


@attrs.define
class GuardInput:
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
    duplicate_publisher: str | None
    """what somebody else found that forbids moving, a sentence"""
    refused: Mapping[str, MessageError] = attrs.field(factory=dict)
    """by topic, why the messages that came since the last fit one were refused"""
    stopped: float = 0.0
    """s in which the controller did not run between the two states"""

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

    def check(self, see: GuardInput) -> str | None:
        """What is wrong, in one sentence, or None."""
        raise NotImplementedError

    @classmethod
    def name(cls) -> str:
        """The name in the table, in lower case with underscores."""
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")


@attrs.frozen
class Finding:
    """What is wrong at this tick: the name in the table of faults, what follows, in which modes, and a sentence."""

    name: str
    level: Level
    modes: tuple[str, ...]
    sentence: str


class GuardSet:
    """Guards over one robot."""

    def __init__(self, guards: Iterable[type[Guard]]) -> None:
        made = [guard() for guard in guards]
        self._at_once = [guard for guard in made if guard.at_once]
        self._later = [guard for guard in made if not guard.at_once]
        self._found_later: list[Finding] = []

    def check(self, see: GuardInput) -> list[Finding]:
        """What is wrong now, and what `look_again` found at the tick before, whatever the mode."""
        return _findings(self._at_once, see) + self._found_later

    def check_deferred(self, see: GuardInput) -> None:
        """After the answer: let those look at the same tick that take their time."""
        self._found_later = _findings(self._later, see)


def _findings(guards: Iterable[Guard], see: GuardInput) -> list[Finding]:
    found = []
    for guard in guards:
        sentence = guard.check(see)
        if sentence:
            found.append(Finding(guard.name(), guard.level, guard.modes, sentence))
    return found
