"""Conversion of quadvel_msgs messages to the records of `quadvel_description.state`, with validation.

The functions use the fields of a message without importing its class. Generated message classes
check no values, so every node reads its inputs with these functions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand, RobotState

from .number_text import counted

QUATERNION_TOLERANCE = 0.05
"""Largest accepted deviation of a quaternion's norm from 1."""
LOW_STATE_SIZES = {
    "q": 12,
    "dq": 12,
    "tau": 12,
    "orientation_wxyz": 4,
    "angular_velocity": 3,
    "linear_acceleration": 3,
    "foot_force": 4,
}
"""Numeric fields of a LowState, and the length of each."""
LOW_CMD_SIZES = dict.fromkeys(("q", "dq", "tau", "kp", "kd"), 12)
"""Numeric fields of a LowCmd, and the length of each."""


class MessageError(ValueError):
    """A message must not be used; the text names field, value found and value expected."""


class NotFiniteError(MessageError):
    """A number of the message is not finite."""


class NotUnitError(MessageError):
    """The norm of a quaternion is not 1."""


class BackInTimeError(MessageError):
    """The message is older than an earlier message."""


def seconds(stamp: Any) -> float:
    """Convert a stamp to seconds.

    Args:
        stamp: A builtin_interfaces/Time.

    Returns:
        The time, s.
    """
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def read_numbers(message: Any, field: str, size: int) -> Array:
    """Read one field of a message as an array of finite numbers.

    Args:
        message: Any message that has the field.
        field: Name of the field.
        size: Expected length.

    Returns:
        A copy of the field, shape (size,), in the unit of the message.

    Raises:
        MessageError: The field has another length.
        NotFiniteError: A number is NaN or infinite.
    """
    value = np.array(getattr(message, field), np.float64)
    if value.shape != (size,):
        raise MessageError(f"{field} has {value.size} numbers, expected {size}")
    require_finite(field, value)
    return value


def require_finite(field: str, value: Array) -> None:
    """Refuse numbers that are not finite.

    Args:
        field: Name of their field.
        value: The numbers.

    Raises:
        NotFiniteError: A number is NaN or infinite.
    """
    if not np.isfinite(value).all():
        raise NotFiniteError(f"{field} holds {value[~np.isfinite(value)][0]}, expected finite numbers")


def read_low_state(message: Any) -> RobotState:
    """Convert a LowState to a RobotState and normalise its quaternion.

    Args:
        message: The LowState.

    Returns:
        The state; its `time` is the stamp of the message, s.

    Raises:
        MessageError: A field has another length.
        NotFiniteError: A number is NaN or infinite.
        NotUnitError: The norm of the quaternion is not 1 within QUATERNION_TOLERANCE.
    """
    fields = [read_numbers(message, field, size) for field, size in LOW_STATE_SIZES.items()]
    return robot_state(seconds(message.stamp), message.tick, fields)


def robot_state(time: float, tick: int, fields: Sequence[Array]) -> RobotState:
    """Make a RobotState from the fields of a LowState and normalise its quaternion.

    Args:
        time: Stamp of the message, s.
        tick: Its tick.
        fields: Its numeric fields, in the order of LOW_STATE_SIZES.

    Returns:
        The state.

    Raises:
        NotUnitError: The norm of the quaternion is not 1 within QUATERNION_TOLERANCE.
    """
    q, dq, tau, quaternion, angular_velocity, linear_acceleration, foot_force = fields
    norm = math.hypot(*quaternion.tolist())
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise NotUnitError(f"orientation_wxyz has norm {norm:.3g}, expected a unit quaternion")
    return RobotState(
        time, tick, q, dq, tau, quaternion / norm, angular_velocity, linear_acceleration, foot_force
    )


def write_low_state(state: RobotState, message: Any) -> None:
    """Fill a LowState from a RobotState; the caller sets the stamp.

    Args:
        state: The state to write.
        message: The LowState to fill, changed in place.
    """
    message.tick = state.tick
    message.orientation_wxyz = np.asarray(state.quaternion, np.float32)
    for field in ("q", "dq", "tau", "angular_velocity", "linear_acceleration", "foot_force"):
        setattr(message, field, np.asarray(getattr(state, field), np.float32))


def read_low_cmd(message: Any) -> JointCommand:
    """Convert a LowCmd to a JointCommand.

    Args:
        message: The LowCmd.

    Returns:
        The joint command.

    Raises:
        MessageError: A field has another length.
        NotFiniteError: A number is NaN or infinite.
    """
    fields = {field: read_numbers(message, field, size) for field, size in LOW_CMD_SIZES.items()}
    return JointCommand(**fields, mode=message.mode, tick=message.tick)


def write_low_cmd(command: JointCommand, message: Any) -> None:
    """Fill a LowCmd from a JointCommand; the caller sets the stamp.

    Args:
        command: The command to write.
        message: The LowCmd to fill, changed in place.
    """
    message.mode = command.mode
    message.tick = command.tick
    for field in LOW_CMD_SIZES:
        setattr(message, field, np.asarray(getattr(command, field), np.float32))


class Refusals:
    """Counts refused messages by topic and keeps the latest reason for each topic."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reasons: dict[str, str] = {}
        self._latest_topic, self._reported = "", 0

    def add(self, topic: str, reason: object) -> None:
        """Count one refused message.

        Args:
            topic: Topic of the message.
            reason: Why the message was refused; its text is kept.
        """
        self._counts[topic] += 1
        self._reasons[topic] = str(reason)
        self._latest_topic = topic

    @property
    def total(self) -> int:
        """Number of refused messages on all topics since the start."""
        return self._counts.total()

    def last_second(self) -> str:
        """Describe the messages that were refused since the last call; to be called at 1 Hz.

        Returns:
            Their number and the latest reason; "" if none was refused.
        """
        new, self._reported = self.total - self._reported, self.total
        if not new:
            return ""
        topic = self._latest_topic
        return f"{counted(new, 'message')} refused in the last second, the last on {topic}: {self._reasons[topic]}"

    def diagnostic_values(self) -> dict[str, str]:
        """Return the counts for /diagnostics.

        Returns:
            For each topic with refused messages: its count and the latest reason.
        """
        counts = self._counts.items()
        return {f"refused {topic}": f"{count}, last: {self._reasons[topic]}" for topic, count in counts}
