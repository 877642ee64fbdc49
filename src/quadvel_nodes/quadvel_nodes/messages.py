"""From messages to the plain records of `state` and back, and the refusal of what is not fit to use.

Works on the fields of `quadvel_msgs` messages without importing them: generated classes check no field, so
every node reads what it receives through here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadvel_description.state import JointCommand, RobotState

QUATERNION_TOLERANCE = 0.05  # by which the length of a quaternion may be off one
LOW_STATE = {
    "q": 12,
    "dq": 12,
    "tau": 12,
    "orientation_wxyz": 4,
    "angular_velocity": 3,
    "linear_acceleration": 3,
    "foot_force": 4,
}
LOW_CMD = dict.fromkeys(("q", "dq", "tau", "kp", "kd"), 12)
"""The fields of these messages that hold numbers, and how many."""


class MessageError(ValueError):
    """A message that must not be used; the text names the field, the value found and what was expected."""


class NotFiniteError(MessageError):
    """A number of the message is not finite."""


class NotUnitError(MessageError):
    """The length of a quaternion is not 1."""


class BackInTimeError(MessageError):
    """The message is older than one before it."""


def seconds(stamp: Any) -> float:
    """A builtin_interfaces/Time in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def numbers(message: Any, field: str, size: int) -> NDArray[np.float64]:
    """The field as (size,) finite numbers. Raises MessageError."""
    value = np.array(getattr(message, field), np.float64)
    if value.shape != (size,):
        raise MessageError(f"{field} has {value.size} numbers, expected {size}")
    if not np.isfinite(value).all():
        raise NotFiniteError(f"{field} holds {value[~np.isfinite(value)][0]}, expected finite numbers")
    return value


class _Block:
    """The fields of a message that hold numbers, read in one piece: the control loop does this every tick."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._fields, self._sizes = tuple(sizes), list(sizes.values())
        self._places = [slice(*ends) for ends in pairwise(accumulate(self._sizes, initial=0))]

    def read(self, message: Any) -> list[NDArray[np.float64]]:
        """`numbers` of each field. Raises MessageError."""
        values = [getattr(message, field) for field in self._fields]
        block = np.concatenate(values, dtype=np.float64)
        # Counting is quicker than `all`, which is Python inside.
        if list(map(len, values)) != self._sizes or np.count_nonzero(np.isfinite(block)) < len(block):
            for field, size in zip(self._fields, self._sizes, strict=True):
                numbers(message, field, size)
        return [block[place] for place in self._places]


_LOW_STATE, _LOW_CMD = _Block(LOW_STATE), _Block(LOW_CMD)


def read_low_state(message: Any) -> RobotState:
    """LowState to RobotState, the quaternion normalised. Raises MessageError."""
    q, dq, tau, quaternion, angular_velocity, linear_acceleration, foot_force = _LOW_STATE.read(message)
    norm = math.hypot(*quaternion.tolist())
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise NotUnitError(f"orientation_wxyz has norm {norm:.3g}, expected a unit quaternion")
    return RobotState(
        time=seconds(message.stamp),
        tick=message.tick,
        q=q,
        dq=dq,
        tau=tau,
        quaternion=quaternion / norm,
        angular_velocity=angular_velocity,
        linear_acceleration=linear_acceleration,
        foot_force=foot_force,
    )


def write_low_state(state: RobotState, message: Any) -> None:
    """Fill a LowState; its stamp is the caller's matter."""
    message.tick = state.tick
    message.orientation_wxyz = np.asarray(state.quaternion, np.float32)
    for field in ("q", "dq", "tau", "angular_velocity", "linear_acceleration", "foot_force"):
        setattr(message, field, np.asarray(getattr(state, field), np.float32))


def read_low_cmd(message: Any) -> JointCommand:
    """LowCmd to JointCommand. Raises MessageError."""
    fields = zip(LOW_CMD, _LOW_CMD.read(message), strict=True)
    return JointCommand(**dict(fields), mode=message.mode, tick=message.tick)


def write_low_cmd(command: JointCommand, message: Any) -> None:
    """Fill a LowCmd; its stamp is the caller's matter."""
    message.mode = command.mode
    message.tick = command.tick
    for field in LOW_CMD:
        setattr(message, field, np.asarray(getattr(command, field), np.float32))


class Refusals:
    """Counts refused messages by topic and remembers why the last one of each was refused."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reasons: dict[str, str] = {}

    def add(self, topic: str, reason: object) -> None:
        """Count one."""
        self._counts[topic] += 1
        self._reasons[topic] = str(reason)

    @property
    def total(self) -> int:
        """All refused messages since the start."""
        return self._counts.total()

    def values(self) -> dict[str, str]:
        """What `/diagnostics` shows: for each topic how many and the last reason."""
        counts = self._counts.items()
        return {f"refused {topic}": f"{count}, last: {self._reasons[topic]}" for topic, count in counts}
