"""Times of a clock in nanoseconds."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage

from quadvel_dds.errors import Partial, unsupported

from .duration import S_TO_NS


class ClockType(IntEnum):
    """Types of clocks, as in rclpy."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


class Time(Partial):
    """Time, see rclpy's Time; comparison and arithmetic are not supported.

    Attributes:
        nanoseconds: Time, ns.
        clock_type: Clock of this time.
    """

    def __init__(
        self, *, seconds: int | float = 0, nanoseconds: int = 0, clock_type: ClockType = ClockType.SYSTEM_TIME
    ) -> None:
        """Create a time as a sum.

        Args:
            seconds: Seconds.
            nanoseconds: Nanoseconds.
            clock_type: Clock of this time.

        Raises:
            ValueError: A number is negative.
        """
        if seconds < 0 or nanoseconds < 0:
            raise ValueError("Seconds and nanoseconds values must not be negative")
        self.nanoseconds = int(seconds * S_TO_NS) + int(nanoseconds)
        self.clock_type = ClockType(clock_type)

    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = unsupported("comparing times")
    __add__ = __sub__ = unsupported("computing with times")
    __hash__ = None  # type: ignore[assignment]

    def to_msg(self) -> Any:
        """Convert to a message.

        Returns:
            A builtin_interfaces/Time.
        """
        seconds, nanoseconds = divmod(self.nanoseconds, S_TO_NS)
        return TimeMessage(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, msg: Any, clock_type: ClockType = ClockType.ROS_TIME) -> Time:
        """Create a time from a message.

        Args:
            msg: A builtin_interfaces/Time.
            clock_type: Clock of this time.

        Returns:
            The time.
        """
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec, clock_type=clock_type)
