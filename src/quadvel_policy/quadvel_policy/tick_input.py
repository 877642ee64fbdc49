"""Inputs of one control tick: everything that the supervisor learns from outside. Knows no ROS."""

from __future__ import annotations

import attrs
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array, Bools
from quadvel_description.state import RobotState
from quadvel_nodes.messages import MessageError


@attrs.frozen
class MotorStatus:
    """Slow status of the motors, as the board reports it.

    Attributes:
        temperature: Motor temperatures, (12,), deg C.
        dropped_out: Whether the board has switched the motor off, (12,).
    """

    temperature: Array
    dropped_out: Bools


@attrs.define
class TickInput:
    """Inputs of one control tick.

    A caller keeps one record, updates it, and passes it at every tick. The supervisor reads it
    during the tick, and `duplicate_publisher` also at a request between two ticks.

    Attributes:
        now: Time, s, on the clock of `state.time`.
        state: The measured state; None before the first, which no tick answers.
        velocity: Velocity of the trunk, body frame, (3,), m/s; None without a fresh estimate.
        command: vx, vy (m/s), wz (rad/s), stance (0 or 1), (4,); None without a fresh command,
            then the robot stands.
        overruns: Number of consecutive missed deadlines.
        motors: Status of the motors; None before the first message.
        duplicate_publisher: Sentence about a second publisher of states; None if there is none.
        refused: By topic, the reason why messages since the last valid one were refused.
        stopped: Time that the controller did not run before this state, s.
    """

    now: float = 0.0
    state: RobotState | None = None
    velocity: ArrayLike | None = None
    command: ArrayLike | None = None
    overruns: int = 0
    motors: MotorStatus | None = None
    duplicate_publisher: str | None = None
    refused: dict[str, MessageError] = attrs.Factory(dict)
    stopped: float = 0.0
