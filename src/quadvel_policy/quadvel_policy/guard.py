"""Interface of guards: each checks every control tick for one kind of fault. Knows no ROS.

A guard returns one sentence about the fault, or None. Its `level` determines the response. `guards`
holds all guards; the supervisor latches faults until the operator clears them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from enum import IntEnum
from functools import cached_property

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.fields import field, positive
from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand, RobotState
from quadvel_nodes.messages import MessageError

from .command_limits import MAX_TORQUE_NM
from .tick_input import MotorStatus

MOVING_MODES = ("stand_up", "stance", "walk", "lie_down")
"""Modes in which the joints do more than brake."""
WALK_MODES = ("walk",)
FALL_TIME_S = 5.0
"""Duration of a fall, s; a limit that waits longer protects nothing."""


class Level(IntEnum):
    """Response to a fault; the highest level wins.

    Attributes:
        NOTICE: The fault is only reported.
        LIMIT: The robot continues within limits or on a substitute, and recovers automatically.
        STANCE: The policy brakes the robot, then it stands until the operator clears the fault.
        DAMPING: All joints brake immediately, until the operator clears the fault.
    """

    NOTICE = 0
    LIMIT = 1
    STANCE = 2
    DAMPING = 3


@attrs.frozen(eq=False)
class JointBounds:
    """Measured joint positions and speeds that guards accept.

    Attributes:
        lower: Smallest angles, (12,), rad.
        upper: Largest angles, (12,), rad.
        speed: Largest speeds, (12,), rad/s.
    """

    lower: Array
    upper: Array
    speed: Array


@attrs.frozen(kw_only=True)
class GuardConfig:
    """Limits of the guards; each field is a parameter of the node `controller`, with its description and unit."""

    max_state_age: float = positive(
        0.05, "oldest state, and longest time without one, before a fault, s", at_most=FALL_TIME_S
    )
    max_standstill: float = positive(
        1.0,
        "the same for a simulated robot, whose time stands still while its process does, s",
        at_most=FALL_TIME_S,
    )
    robot_waits: bool = field(
        False,
        "whether the robot's time stands still until a late answer comes, as in a simulator; then lateness is no fault",
    )
    max_tilt: float = positive(
        1.05, "largest angle between the trunk's and the world's vertical, rad", at_most=0.5 * math.pi
    )
    max_joint_speed: float = positive(
        1.25, "largest measured joint speed, as a share of what the drive can do", at_most=2.0
    )
    joint_margin: float = positive(
        0.2, "how far a measured angle may lie outside the mechanical range, rad", at_most=1.0
    )
    max_encoder_error: float = positive(
        0.35, "largest deviation of a joint's angle from its integrated speed over 0.1 s, rad", at_most=1.5
    )
    max_attitude_error: float = positive(
        0.15,
        "largest deviation of the orientation from the integrated gyroscope over 0.2 s, rad",
        at_most=0.5 * math.pi,
    )
    max_torque_error: float = positive(
        12.0,
        "largest deviation of a drive's torque from the commanded one, mean over 0.1 s, N m",
        at_most=MAX_TORQUE_NM,
    )
    max_acceleration_error: float = positive(
        5.0, "largest mean acceleration of the trunk over 0.5 s, without gravity, m/s^2", at_most=50.0
    )
    frozen_time: float = positive(
        0.1, "time after which a sensor whose bits do not change is faulty, s", at_most=FALL_TIME_S
    )
    frozen_tick_time: float = positive(
        0.025, "time after which a tick that does not change is a fault, s", at_most=FALL_TIME_S
    )
    frozen_foot_time: float = positive(1.0, "the same for a foot's force while walking, s", at_most=60.0)
    stuck_time: float = positive(
        0.5, "time after which a joint that pushes hard and does not move is stuck, s", at_most=FALL_TIME_S
    )
    stuck_torque: float = positive(
        0.8, "torque that counts as pushing hard, as a share of the drive's largest torque", at_most=1.0
    )
    max_velocity_error: float = positive(
        0.8, "largest difference of the velocity estimate and the Kalman filter, m/s", at_most=5.0
    )
    velocity_trust_time: float = positive(
        1.0, "time after which an estimate that is right again is used again, s", at_most=60.0
    )
    max_temperature: float = positive(
        80.0, "hottest motor before the robot has to stand, deg C", at_most=120.0
    )
    max_overruns: int = positive(20, "deadlines missed in a row before the robot has to stand", at_most=1000)

    @property
    def silence_limit(self) -> float:
        """Longest time without a state, and largest age of the state, s; longer if the robot's time may stand still."""
        return self.max_standstill if self.robot_waits else self.max_state_age

    def joint_bounds(self, robot: Robot) -> JointBounds:
        """Compute the accepted joint positions and speeds of a robot.

        Args:
            robot: The robot.

        Returns:
            The bounds.
        """
        return JointBounds(
            lower=robot.lower - self.joint_margin,
            upper=robot.upper + self.joint_margin,
            speed=self.max_joint_speed * robot.velocity_limit,
        )


@attrs.define
class GuardInput:
    """Input of the guards at one tick: the outer inputs (`TickInput`) and what the supervisor knows.

    Attributes:
        robot: The robot.
        bounds: Accepted joint positions and speeds.
        config: Limits.
        mode: Present mode of the supervisor.
        state: State of this tick.
        previous: State of the previous tick; None at the first one.
        age: Age of the state, s.
        gap: Time between the two states, s; 0 without a previous one.
        command: Joint command of the previous tick.
        velocity: Velocity estimate, body frame, (3,), m/s; None without a fresh one.
        backup: Velocity of the backup Kalman filter, body frame, (3,), m/s; None if there is none.
        is_moving: Whether the robot follows a velocity other than zero.
        overruns: Number of consecutive missed deadlines.
        motors: Status of the motors; None before the first message.
        duplicate_publisher: Sentence about a second publisher of states, found by the node; None if
            there is none.
        refused: By topic, the reason why messages since the last valid one were refused.
        stopped: Time that the controller did not run between the two states, s.
    """

    robot: Robot
    bounds: JointBounds
    config: GuardConfig
    mode: str
    state: RobotState
    previous: RobotState | None
    age: float
    gap: float
    command: JointCommand
    velocity: Array | None
    backup: Array | None
    is_moving: bool
    overruns: int
    motors: MotorStatus | None
    duplicate_publisher: str | None
    refused: Mapping[str, MessageError]
    stopped: float

    @cached_property
    def is_sound(self) -> bool:
        """Whether all numbers are finite and all joints within their limits; one check for the usual case."""
        state, bounds = self.state, self.bounds
        return bool(
            np.count_nonzero((state.q >= bounds.lower) & (state.q <= bounds.upper)) == 12
            and np.count_nonzero(np.abs(state.dq) <= bounds.speed) == 12
            and all(map(math.isfinite, (*state.quaternion.tolist(), *state.angular_velocity.tolist())))
        )

    @cached_property
    def motion(self) -> Array:
        """Change of the joint angles since the previous state, (12,), rad; there must be one."""
        assert self.previous is not None
        return self.state.q - self.previous.q

    @cached_property
    def commanded_torque(self) -> Array:
        """Torque that `command` asks for at the present joint state, (12,), N m."""
        return self.command.torque(self.state.q, self.state.dq)


class Guard:
    """Detects one kind of fault. The first paragraph of a guard's docstring is its row in docs/faults.md.

    Attributes:
        level: Response to the fault.
        is_immediate: Whether the guard runs before the answer of the tick. Guards that compare over
            a time run after the answer and take effect at the next tick, 5 ms later.
        modes: Modes in which the fault has an effect; a guard runs in every mode.
    """

    level = Level.DAMPING
    is_immediate = True
    modes: tuple[str, ...] = MOVING_MODES

    def check(self, data: GuardInput) -> str | None:
        """Check one tick.

        Args:
            data: The state and the context of the tick.

        Returns:
            The fault, in one sentence, or None.

        Raises:
            NotImplementedError: A subclass must implement this method.
        """
        raise NotImplementedError

    @classmethod
    def name(cls) -> str:
        """Return the name of the fault.

        Returns:
            The class name in lower case with underscores.
        """
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")


@attrs.frozen
class Finding:
    """Fault at the present tick.

    Attributes:
        name: Name in the table of faults.
        level: Response.
        modes: Modes in which it has an effect.
        sentence: Description for the operator.
    """

    name: str
    level: Level
    modes: tuple[str, ...]
    sentence: str


class GuardSet:
    """Runs guards on one robot."""

    def __init__(self, guards: Iterable[type[Guard]]) -> None:
        """Create the guards.

        Args:
            guards: Guard classes, in the order of their findings.
        """
        made = [guard() for guard in guards]
        self._immediate = [guard for guard in made if guard.is_immediate]
        self._deferred = [guard for guard in made if not guard.is_immediate]
        self._deferred_findings: list[Finding] = []

    def check(self, data: GuardInput) -> list[Finding]:
        """Run the immediate guards.

        Args:
            data: The state and the context of the tick.

        Returns:
            Their findings, then those of `check_deferred` at the previous tick, in any mode.
        """
        return _findings(self._immediate, data) + self._deferred_findings

    def check_deferred(self, data: GuardInput) -> None:
        """Run the deferred guards, after the answer of the tick.

        Args:
            data: The state and the context of the same tick.
        """
        self._deferred_findings = _findings(self._deferred, data)


def _findings(guards: Iterable[Guard], data: GuardInput) -> list[Finding]:
    found = []
    for guard in guards:
        sentence = guard.check(data)
        if sentence:
            found.append(Finding(guard.name(), guard.level, guard.modes, sentence))
    return found
